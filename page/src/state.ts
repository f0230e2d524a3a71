// The state of the view, kept in the page's address after the #, so that a link restores it.

import type { Point } from "./coordinates";
import { SPEED_UNITS, type SpeedUnit } from "./units";

export interface State {
  tab: "map" | "analysis" | "summary";
  layer: string;
  unit: SpeedUnit;
  /** Of the layer, per cent. */
  opacity: number;
  /** Pixels of fewer vehicles are not painted. */
  minVehicles: number;
  tracks: boolean;
  flow: boolean;
  /** Time of the replay, s; null: no replay. */
  replay: number | null;
  pixel: Point | null;
  line: [Point, Point] | null;
  /** Centre and zoom; null: the whole map. */
  view: { x: number; y: number; zoom: number } | null;
}

export const START: State = {
  tab: "map",
  layer: "direction",
  unit: "km/h",
  opacity: 100,
  minVehicles: 1,
  tracks: false,
  flow: false,
  replay: null,
  pixel: null,
  line: null,
  view: null,
};

const TABS: State["tab"][] = ["map", "analysis", "summary"];

function numbers(text: string | null, count: number): number[] | null {
  const found = (text ?? "").split(",").map(Number);
  return text !== null && found.length === count && found.every(Number.isFinite) ? found : null;
}

/** The state in an address; invalid values are replaced by those of the start. */
export function readState(hash: string): State {
  const parameters = new URLSearchParams(hash.replace(/^#/, ""));
  const within = (name: string, low: number, high: number, start: number): number => {
    const value = numbers(parameters.get(name), 1)?.[0] ?? start;
    return Math.min(Math.max(value, low), high);
  };
  const unit = parameters.get("unit") as SpeedUnit | null;
  const pixel = numbers(parameters.get("pixel"), 2);
  const line = numbers(parameters.get("line"), 4);
  const view = numbers(parameters.get("view"), 3);
  return {
    tab: TABS.find((name) => name === parameters.get("tab")) ?? "map",
    layer: parameters.get("layer") ?? START.layer,
    unit: unit && unit in SPEED_UNITS ? unit : START.unit,
    opacity: within("opacity", 0, 100, START.opacity),
    minVehicles: Math.round(within("min_vehicles", 1, 1e6, START.minVehicles)),
    tracks: parameters.get("tracks") === "1",
    flow: parameters.get("flow") === "1",
    replay: numbers(parameters.get("replay"), 1)?.[0] ?? null,
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
  const parameters = new URLSearchParams();
  for (const name of ["tab", "layer", "unit", "opacity"] as const) {
    if (state[name] !== START[name]) parameters.set(name, String(state[name]));
  }
  if (state.minVehicles !== START.minVehicles) parameters.set("min_vehicles", String(state.minVehicles));
  if (state.tracks) parameters.set("tracks", "1");
  if (state.flow) parameters.set("flow", "1");
  if (state.replay !== null) parameters.set("replay", state.replay.toFixed(1));
  if (state.pixel) parameters.set("pixel", `${state.pixel.x},${state.pixel.y}`);
  if (state.line) parameters.set("line", state.line.flatMap(({ x, y }) => [x.toFixed(1), y.toFixed(1)]).join(","));
  if (state.view) parameters.set("view", [state.view.x.toFixed(1), state.view.y.toFixed(1), state.view.zoom].join(","));
  return parameters.toString().replaceAll("%2C", ",");
}
