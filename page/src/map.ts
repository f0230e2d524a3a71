// The map: base image and a layer of the field, in base pixels.

import L from "leaflet";
import { painter } from "./colours";
import type { Numbers } from "./chunks";
import type { Field } from "./field";
import type { Layer, Run } from "./run";
import { roundDown } from "./units";

const DIMMING = 0.32;
const CASING_ALPHA = 254; // what is painted has 255

export function makeMap(element: HTMLElement, run: Run): L.Map {
  const whole = L.latLngBounds([0, 0], [-run.height_px, run.width_px]);
  const map = L.map(element, {
    crs: L.CRS.Simple,
    attributionControl: false,
    zoomSnap: 0.25,
    minZoom: -run.base.levels - 1,
    maxZoom: 5,
    maxBounds: whole.pad(0.5),
    maxBoundsViscosity: 0.8,
    zoomAnimation: !window.matchMedia("(prefers-reduced-motion: reduce)").matches,
  });
  map.fitBounds(whole);
  keepInView(map, whole);
  new BaseTiles(run).addTo(map);
  new ScaleBar(run).addTo(map);
  map.getContainer().setAttribute("role", "application"); // arrow keys move the map, they do not read the page
  return map;
}

/**
 * What is in view stays in view when the map's element changes its size, as where a wider panel takes its place; at its
 * former size the map stands again as the user left it.
 */
function keepInView(map: L.Map, whole: L.LatLngBounds): void {
  const view = () => ({ centre: map.getCenter(), zoom: map.getZoom(), size: map.getSize(), bounds: map.getBounds() });
  let chosen = view(); // by the user
  let fitted: typeof chosen | null = null; // by us, at another size
  let size = map.getSize();
  let moving = false;
  map.on("resize", () => {
    size = map.getSize();
    if (!size.x || !size.y) return; // hidden
    const asChosen = size.equals(chosen.size);
    moving = true;
    if (asChosen) map.setView(chosen.centre, chosen.zoom, { animate: false });
    else map.setView(...fit(map, chosen.bounds, chosen.zoom, whole), { animate: false });
    moving = false;
    fitted = asChosen ? null : view();
  });
  map.on("moveend", () => {
    const now = view();
    // Leaflet ends a move before it tells of a new size, and perhaps once more after it.
    if (moving || !now.size.equals(size) || (fitted && now.zoom === fitted.zoom && now.centre.equals(fitted.centre))) return;
    [chosen, fitted] = [now, null];
  });
}

/** Centre and zoom that show what of the map lies in these bounds, no closer than before. */
function fit(map: L.Map, bounds: L.LatLngBounds, zoom: number, whole: L.LatLngBounds): [L.LatLng, number] {
  const [south, west] = [Math.max(bounds.getSouth(), whole.getSouth()), Math.max(bounds.getWest(), whole.getWest())];
  const [north, east] = [Math.min(bounds.getNorth(), whole.getNorth()), Math.min(bounds.getEast(), whole.getEast())];
  const seen = L.latLngBounds([south, west], [north, east]);
  return [seen.getCenter(), Math.min(zoom, map.getBoundsZoom(seen))];
}

/** A round length at the map's scale, in metres where they are known. */
class ScaleBar extends L.Control {
  private readonly bar = L.DomUtil.create("div", "scale");

  constructor(private readonly run: Run) {
    super({ position: "bottomright" });
  }

  onAdd(map: L.Map): HTMLElement {
    const draw = (): void => {
      const perScreenPx = (this.run.gsd_m ?? 1) / map.getZoomScale(map.getZoom(), 0);
      const length = roundDown(120 * perScreenPx);
      this.bar.style.width = `${length / perScreenPx}px`;
      this.bar.textContent = `${length} ${this.run.gsd_m === null ? "px" : "m"}`;
    };
    map.on("zoomend", draw);
    map.whenReady(draw);
    return this.bar;
  }
}

/** Common to all tile layers: tiles of level k are reduced 2^k times, zoom 0 is the map's own pixels. */
function tiling(run: Run, tile: number): L.GridLayerOptions {
  const halvings = Math.log2(tile & -tile);
  return {
    tileSize: tile,
    minNativeZoom: -Math.min(run.base.levels - 1, halvings),
    maxNativeZoom: 0,
    minZoom: -run.base.levels - 1,
    maxZoom: 5,
    bounds: L.latLngBounds([0, 0], [-run.height_px, run.width_px]),
    noWrap: true,
  };
}

class BaseTiles extends L.GridLayer {
  constructor(private readonly run: Run) {
    super({ ...tiling(run, run.base.tile), className: "base" });
  }

  protected createTile(coords: L.Coords, done: L.DoneCallback): HTMLElement {
    const { base } = this.run;
    const image = new Image();
    const canvas = document.createElement("canvas");
    const tile = document.createElement("div");
    tile.append(canvas);
    image.onload = () => {
      // Its own size: those at the edge are smaller, the others hold the first pixels of their neighbours, against seams.
      [canvas.width, canvas.height] = [image.naturalWidth, image.naturalHeight];
      canvas.style.width = `${(100 * canvas.width) / base.tile}%`;
      canvas.style.height = `${(100 * canvas.height) / base.tile}%`;
      const context = canvas.getContext("2d", { alpha: false })!;
      context.drawImage(image, 0, 0);
      // Dimmed here, once: a filter in the style sheet is computed again for each frame of an animation.
      context.fillStyle = `rgb(0 0 0 / ${DIMMING})`;
      context.fillRect(0, 0, canvas.width, canvas.height);
      done(undefined, tile);
    };
    image.onerror = () => done(new Error(`${image.src} cannot be read`), tile);
    image.src = `view/base/${-coords.z}/${coords.y}-${coords.x}.jpg`;
    return tile;
  }
}

/** A dark edge around what is painted: against it the colours are read on light and dark images alike. */
function addCasing(context: CanvasRenderingContext2D, side: number): void {
  const image = context.getImageData(0, 0, side, side);
  const { data } = image;
  const isPainted = (x: number, y: number): boolean =>
    x >= 0 && y >= 0 && x < side && y < side && data[4 * (y * side + x) + 3] === 255;
  for (let y = 0, at = 3; y < side; y++) {
    for (let x = 0; x < side; x++, at += 4) {
      if (data[at] !== 0) continue;
      if (isPainted(x - 1, y) || isPainted(x + 1, y) || isPainted(x, y - 1) || isPainted(x, y + 1)) data[at] = CASING_ALPHA;
    }
  }
  context.putImageData(image, 0, 0);
}

/** A layer of the field, painted from its chunks. */
export class Overlay extends L.GridLayer {
  constructor(
    private readonly field: Field,
    private readonly shown: Layer,
    private readonly colourMax: number,
    private readonly minVehicles: number,
    opacity: number,
    private readonly onError: (error: unknown) => void,
  ) {
    super({ ...tiling(field.run, field.array(shown.arrays[0]!).chunk[0]), opacity, className: "overlay" });
  }

  protected createTile(coords: L.Coords, done: L.DoneCallback): HTMLElement {
    const side = this.field.array(this.shown.arrays[0]!).chunk[0];
    const canvas = document.createElement("canvas");
    canvas.width = canvas.height = side + 1; // with the first pixels of the next tiles: else a seam shows
    const tile = document.createElement("div");
    tile.append(canvas);
    canvas.style.width = canvas.style.height = `${(100 * (side + 1)) / side}%`;
    this.paint(canvas, coords.x, coords.y, -coords.z).then(
      () => done(undefined, tile),
      (error) => {
        this.onError(error);
        done(error, tile);
      },
    );
    return tile;
  }

  /** A tile of level k covers 2^k x 2^k chunks. */
  private async paint(canvas: HTMLCanvasElement, x: number, y: number, level: number): Promise<void> {
    const context = canvas.getContext("2d")!;
    const chunk = canvas.width - 1;
    const side = chunk >> level;
    const across = 2 ** level;
    const work: Promise<void>[] = [];
    for (let j = 0; j <= across; j++) {
      for (let i = 0; i <= across; i++) {
        const [row, column] = [y * across + j, x * across + i];
        const size: [number, number] = [i < across ? side : 1, j < across ? side : 1];
        work.push(
          this.chunks(row, column).then((data) => {
            if (data) context.putImageData(this.tileImage(data, chunk, level, size), i * side, j * side);
          }),
        );
      }
    }
    await Promise.all(work);
    addCasing(context, canvas.width);
  }

  private async chunks(row: number, column: number): Promise<(Numbers | null)[] | null> {
    const values = this.shown.arrays.map((name) => this.field.array(name).read(row, column));
    const count = this.minVehicles > 1 ? this.field.array("count").read(row, column) : Promise.resolve(null);
    const data = await Promise.all([...values, count]);
    return data.slice(0, -1).every((chunk) => chunk !== null) ? data : null;
  }

  /** The first `width` and `height` pixels of a chunk, reduced 2^level times. */
  private tileImage(data: (Numbers | null)[], side: number, level: number, [width, height]: [number, number]): ImageData {
    const step = 2 ** level;
    const image = new ImageData(width, height);
    const paint = painter(this.shown, this.colourMax, this.field.run.stationary_speed_px_per_s);
    const [a, b] = [data[0]!, data.length === 3 ? data[1]! : data[0]!];
    const count = data[data.length - 1];
    for (let j = 0, at = 0; j < height; j++) {
      for (let i = 0; i < width; i++, at += 4) {
        const index = this.known(a, count ?? null, j * step, i * step, step, side);
        if (index >= 0) paint(image.data, at, a[index]!, b[index]!);
      }
    }
    return image;
  }

  /** The first known pixel of a block that enough vehicles passed: no interpolation. */
  private known(values: Numbers, count: Numbers | null, y: number, x: number, step: number, side: number): number {
    for (let j = y; j < y + step; j++) {
      for (let i = x; i < x + step; i++) {
        const index = j * side + i;
        if (Number.isFinite(values[index]!) && (this.minVehicles <= 1 || (count && count[index]! >= this.minVehicles))) {
          if (values[index] !== 0 || step === 1) return index;
        }
      }
    }
    return -1;
  }
}
