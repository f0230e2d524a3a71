// What view/run.json holds (schemas/view.py) and where the page's files stand.

export type LayerKind = "direction" | "speed" | "count" | "angle" | "fraction" | "time" | "plain" | "change";

export interface Layer {
  name: string;
  title: string;
  description: string;
  kind: LayerKind;
  arrays: string[];
  units: string;
  colour_max: number;
  data_max: number;
  main: boolean;
}

export interface StoredArray {
  /** Path of its store in the run folder. */
  store: string;
  chunk: [number, number];
  stored: number[];
  units: string;
  /** zarr.json of the array. */
  metadata: object;
}

export interface Run {
  width_px: number;
  height_px: number;
  gsd_m: number | null;
  north_rad: number | null;
  stationary_speed_px_per_s: number;
  first_time_s: number;
  last_time_s: number;
  bin_width_px_per_s: number;
  bins: number;
  base: { levels: number; tile: number; overlap: number };
  layers: Layer[];
  arrays: Record<string, StoredArray>;
  segments: { count: number; tracks: number; hysteresis_px: number; band_radius_px: number };
  replay: { chunk_s: number; chunks: number; step_px: number; states: string[]; classes: string[] };
  flow: { cell_px: number; draws: number };
  /** Smallest number of vehicles of which a percentile of speed is shown, by percentage. */
  vehicles_for_percentile: Record<number, number>;
  /** A note for people where hardly any pixel was passed by several vehicles. */
  low_coverage_note: string;
}

/** A file or an array cannot be read: the message is for people. */
export class Unreadable extends Error {}

/** A file of the run folder, as it is now: a browser that kept an older one asks whether it changed. */
export async function fetchFile(path: string): Promise<Response> {
  const response = await fetch(path, { cache: "no-cache" });
  if (!response.ok) throw new Unreadable(`${path} cannot be read (${response.status} ${response.statusText})`);
  return response;
}

export async function loadRun(): Promise<Run> {
  return (await fetchFile("view/run.json")).json();
}
