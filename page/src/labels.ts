// Labels of places on the map, none over another: a label moves along its line to where there is room, and is left out
// where there is none. Closer in there is more room, so they are placed again after each zoom.

import L from "leaflet";
import type { Geometry, Place } from "./analysis";
import { toLatLng } from "./coordinates";
import { make } from "./dom";

const SPOTS = [0.5, 0.35, 0.65, 0.2, 0.8]; // along a line, as fractions of its length, the best first
const GAP_PX = 2; // between labels

/** Where a label can stand, in base pixels, and the direction of its line there; no direction: not on a line. */
interface Spot {
  x: number;
  y: number;
  direction: number | null;
}

interface Label {
  marker: L.Marker;
  spots: Spot[];
  arrow: HTMLElement | null;
  width: number;
  height: number;
}

interface Box {
  left: number;
  top: number;
  right: number;
  bottom: number;
}

export class Labels {
  private readonly group = L.layerGroup();
  private labels: Label[] = [];

  constructor(private readonly map: L.Map) {
    this.group.addTo(map);
    map.on("zoomend", () => this.arrange());
  }

  /** Labels of these places, the first ones first where there is little room; lines have an arrow. */
  show(places: Place[]): void {
    this.group.clearLayers();
    const added = places
      .map((place) => ({ ...place, spots: spotsOf(place.geometry) }))
      .filter(({ spots, label }) => label || spots[0]!.direction !== null)
      .map(({ spots, label, isName }) => this.add(spots, label, isName ? "place-label name" : "place-label"));
    const texts = added.map(({ marker }) => marker.getElement()!.querySelector<HTMLElement>(".place-label")!);
    const sizes = texts.map(({ offsetWidth, offsetHeight }) => [offsetWidth, offsetHeight] as const);
    this.labels = added.map((label, k) => ({ ...label, width: sizes[k]![0], height: sizes[k]![1] }));
    this.arrange();
  }

  private add(spots: Spot[], text: string, kind: string): Omit<Label, "width" | "height"> {
    const content = make("span", { class: kind }, text);
    const arrow = spots[0]!.direction === null ? null : make("span", { class: "place-arrow" }, "➤");
    if (arrow) content.prepend(arrow);
    const icon = L.divIcon({ className: "", html: content, iconSize: [0, 0] });
    const marker = L.marker(toLatLng(spots[0]!.x, spots[0]!.y), { icon, interactive: false, keyboard: false });
    this.group.addLayer(marker);
    return { marker, spots, arrow };
  }

  private arrange(): void {
    const taken: Box[] = [];
    for (const label of this.labels) {
      const spot = label.spots.find((each) => !taken.some((box) => overlap(box, this.box(label, each))));
      label.marker.getElement()!.hidden = spot === undefined;
      if (spot === undefined) continue;
      taken.push(this.box(label, spot));
      label.marker.setLatLng(toLatLng(spot.x, spot.y));
      if (label.arrow) label.arrow.style.transform = `rotate(${spot.direction}rad)`;
    }
  }

  /** What a label would cover, screen px. */
  private box({ width, height }: Label, { x, y }: Spot): Box {
    const at = this.map.latLngToLayerPoint(toLatLng(x, y));
    return { left: at.x - width / 2, top: at.y - height / 2, right: at.x + width / 2, bottom: at.y + height / 2 };
  }
}

function overlap(a: Box, b: Box): boolean {
  const [across, down] = [Math.min(a.right, b.right) - Math.max(a.left, b.left), Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top)];
  return across > -GAP_PX && down > -GAP_PX;
}

function spotsOf({ type, xy_px }: Geometry): Spot[] {
  if (type === "LineString" && xy_px.length > 1) return SPOTS.map((fraction) => along(xy_px, fraction));
  const sum = xy_px.reduce(([x, y], point) => [x + point[0], y + point[1]], [0, 0]);
  return [{ x: sum[0] / xy_px.length, y: sum[1] / xy_px.length, direction: null }];
}

/** The place at a fraction of a line's length. */
function along(xy: [number, number][], fraction: number): Spot {
  const steps = xy.slice(1).map(([x, y], k) => ({ from: xy[k]!, dx: x - xy[k]![0], dy: y - xy[k]![1] }));
  const lengths = steps.map(({ dx, dy }) => Math.hypot(dx, dy));
  let left = fraction * lengths.reduce((sum, length) => sum + length, 0);
  let k = 0;
  while (k < steps.length - 1 && left > lengths[k]!) left -= lengths[k++]!;
  const { from, dx, dy } = steps[k]!;
  const part = lengths[k]! > 0 ? left / lengths[k]! : 0;
  return { x: from[0] + part * dx, y: from[1] + part * dy, direction: Math.atan2(dy, dx) };
}
