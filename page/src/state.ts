// What is shown. It stands in the page's address after the #, so that a link holds the view.

import type { Point } from "./place";
import { SPEED_UNITS, type SpeedUnit } from "./units";

export interface State {
  tab: "map" | "summary";
  layer: string;
  unit: SpeedUnit;
  /** Cover of the layer, per cent. */
  opacity: number;
  /** Pixels that fewer vehicles passed are not painted. */
  least: number;
  tracks: boolean;
  pixel: Point | null;
  line: [Point, Point] | null;
  /** Centre and zoom; null: the whole map. */
  view: { x: number; y: number; zoom: number } | null;
}

export const START: State = {
  tab: "map",
  layer: "direction",
  unit: "km/h",
  opacity: 80,
  least: 1,
  tracks: false,
  pixel: null,
  line: null,
  view: null,
};

function numbers(text: string | null, count: number): number[] | null {
  const found = (text ?? "").split(",").map(Number);
  return text !== null && found.length === count && found.every(Number.isFinite) ? found : null;
}

/** What the address tells; whatever in it makes no sense is as at the start. */
export function readState(hash: string): State {
  const told = new URLSearchParams(hash.replace(/^#/, ""));
  const within = (name: string, low: number, high: number, start: number): number => {
    const value = numbers(told.get(name), 1)?.[0] ?? start;
    return Math.min(Math.max(value, low), high);
  };
  const unit = told.get("unit") as SpeedUnit | null;
  const pixel = numbers(told.get("pixel"), 2);
  const line = numbers(told.get("line"), 4);
  const view = numbers(told.get("view"), 3);
  return {
    tab: told.get("tab") === "summary" ? "summary" : "map",
    layer: told.get("layer") ?? START.layer,
    unit: unit && unit in SPEED_UNITS ? unit : START.unit,
    opacity: within("opacity", 0, 100, START.opacity),
    least: Math.round(within("least", 1, 1e6, START.least)),
    tracks: told.get("tracks") === "1",
    pixel: pixel && { x: Math.round(pixel[0]!), y: Math.round(pixel[1]!) },
    line: line && [
      { x: line[0]!, y: line[1]! },
      { x: line[2]!, y: line[3]! },
    ],
    view: view && { x: view[0]!, y: view[1]!, zoom: view[2]! },
  };
}

/** The address of a state: only what differs from the start. */
export function writeState(state: State): string {
  const told = new URLSearchParams();
  for (const name of ["tab", "layer", "unit", "opacity", "least"] as const) {
    if (state[name] !== START[name]) told.set(name, String(state[name]));
  }
  if (state.tracks) told.set("tracks", "1");
  if (state.pixel) told.set("pixel", `${state.pixel.x},${state.pixel.y}`);
  if (state.line) told.set("line", state.line.flatMap(({ x, y }) => [x.toFixed(1), y.toFixed(1)]).join(","));
  if (state.view) told.set("view", [state.view.x.toFixed(1), state.view.y.toFixed(1), state.view.zoom].join(","));
  return told.toString().replaceAll("%2C", ",");
}
