// The map's tiles as one image while something moves over them.
//
// A browser blends every tile, the layer's opacity and the animation anew for each frame; without a graphics card that
// takes ten times as long as the animation itself. So what stands still is painted once, at the screen's resolution,
// and takes the place of the tiles until one of them changes.

import type L from "leaflet";

const SETTLED_FRAMES = 6; // while tiles load, fade or follow the mouse, they are shown themselves

interface Tile {
  element: HTMLElement;
  layer: HTMLElement;
  /** All that decides where and how it is seen; tiles themselves are painted once. */
  state: string;
}

export class Backdrop {
  private readonly canvas = document.createElement("canvas");
  // A canvas of another context is copied for each frame, though nothing is painted on it.
  private readonly context = this.canvas.getContext("bitmaprenderer", { alpha: false })!;
  private readonly pane: HTMLElement;
  private tiles: Tile[] = [];
  private settled = 0;

  constructor(private readonly map: L.Map) {
    this.pane = map.getPane("tilePane")!;
    this.canvas.className = "backdrop";
    this.canvas.hidden = true;
    this.canvas.setAttribute("aria-hidden", "true");
    map.getContainer().prepend(this.canvas);
    map.on("move zoomstart resize", () => this.hide());
  }

  /** To be called once a frame: takes the tiles' place as soon as they have settled. */
  follow(): void {
    const tiles = this.visibleTiles();
    const same = tiles.length === this.tiles.length && tiles.every((tile, k) => isSame(tile, this.tiles[k]!));
    this.tiles = tiles;
    if (!same) return this.hide();
    this.settled += 1;
    if (this.settled === SETTLED_FRAMES) this.show();
  }

  hide(): void {
    this.settled = 0;
    this.canvas.hidden = true;
    this.pane.style.visibility = "";
  }

  private show(): void {
    const { width, height } = this.map.getContainer().getBoundingClientRect();
    const ratio = window.devicePixelRatio || 1;
    const image = new OffscreenCanvas(Math.max(1, Math.round(width * ratio)), Math.max(1, Math.round(height * ratio)));
    const context = image.getContext("2d", { alpha: false })!;
    context.fillStyle = getComputedStyle(this.map.getContainer()).backgroundColor;
    context.fillRect(0, 0, image.width, image.height);
    for (const layer of new Set(this.tiles.map((tile) => tile.layer))) {
      // Tiles of a layer overlap by a pixel: its opacity is for all of them together.
      context.globalAlpha = Number(layer.style.opacity || 1);
      context.drawImage(this.layerImage(layer, image, ratio), 0, 0);
    }
    this.context.transferFromImageBitmap(image.transferToImageBitmap());
    this.canvas.style.width = `${width}px`;
    this.canvas.style.height = `${height}px`;
    this.canvas.hidden = false;
    this.pane.style.visibility = "hidden";
  }

  private layerImage(layer: HTMLElement, { width, height }: OffscreenCanvas, ratio: number): OffscreenCanvas {
    const image = new OffscreenCanvas(width, height);
    const context = image.getContext("2d")!;
    const { left, top } = this.map.getContainer().getBoundingClientRect();
    context.setTransform(ratio, 0, 0, ratio, -left * ratio, -top * ratio);
    for (const tile of this.tiles) {
      const painted = tile.layer === layer && tile.element.querySelector("canvas");
      if (!painted) continue;
      const box = painted.getBoundingClientRect();
      context.imageSmoothingEnabled = getComputedStyle(painted).imageRendering !== "pixelated";
      context.imageSmoothingQuality = "medium";
      context.drawImage(painted, box.left, box.top, box.width, box.height);
    }
    return image;
  }

  /** In the order in which they are painted. */
  private visibleTiles(): Tile[] {
    const layers = [...this.pane.querySelectorAll<HTMLElement>(".leaflet-layer")];
    layers.sort((a, b) => Number(a.style.zIndex) - Number(b.style.zIndex));
    return layers.flatMap((layer) =>
      [...layer.querySelectorAll<HTMLElement>(".leaflet-tile")].map((element) => ({
        element,
        layer,
        state: [layer.style.opacity, element.parentElement!.style.transform, element.style.cssText, element.className].join(),
      })),
    );
  }
}

const isSame = (a: Tile, b: Tile): boolean => a.element === b.element && a.state === b.state;
