// What a pixel says: its velocity distribution, modes, percentiles, who passed.

import { arrow, grid, make, pairs } from "./dom";
import type { Field } from "./field";
import type { Point } from "./place";
import { findModes, type Mode } from "./modes";
import { polarPicture } from "./polar";
import type { Near, TrackIndex } from "./tracks";
import type { Units } from "./units";

export interface PixelAnswer {
  x: number;
  y: number;
  n: number;
  histogram: Int32Array | null;
  modes: Mode[];
  /** Values of the field's layers here, by name. */
  values: Record<string, number>;
}

/** What is told of a pixel, where the field holds it. `..._ci90_lower`, `_ci90_upper` and `_ci90_half_width` are 90 % intervals. */
const WANTED = [
  "count",
  "modal_vx",
  "modal_vy",
  "direction_ci90_half_width",
  "direction_se",
  "speed_p15",
  "speed_p15_ci90_lower",
  "speed_p15_ci90_upper",
  "speed_p50",
  "speed_p50_ci90_lower",
  "speed_p50_ci90_upper",
  "speed_se",
  "speed_p85",
  "speed_p85_ci90_lower",
  "speed_p85_ci90_upper",
  "stationary_fraction",
];
/** What makes another value needless. */
const BETTER: Record<string, string> = { direction_se: "direction_ci90_half_width", speed_se: "speed_p50_ci90_lower" };

export async function askPixel(field: Field, { x, y }: Point): Promise<PixelAnswer> {
  const names = WANTED.filter((name) => field.has(name) && !field.has(BETTER[name] ?? ""));
  const [histogram, ...found] = await Promise.all([field.histogram(x, y), ...names.map((name) => field.at(name, x, y))]);
  const values = Object.fromEntries(names.map((name, k) => [name, found[k]!]));
  const n = values.count || 0; // NaN where no chunk is stored
  const modes = histogram && n ? findModes(histogram, field.run.bins, n) : [];
  return { x, y, n, histogram, modes, values };
}

/** A value with its number in full, for whoever reads the page by program. */
function told(name: string, value: number, text: string): HTMLElement {
  return make("span", { "data-name": name, "data-value": String(value) }, text);
}

/** The answer of a pixel, `away` px from the place that was pointed at. */
export function showPixel(answer: PixelAnswer, field: Field, units: Units, away: number): HTMLElement {
  const { x, y, n, values, histogram } = answer;
  const card = make("section", { class: "answer", "aria-label": "Pixel" }, make("h2", {}, `Pixel (${x}, ${y})`));
  if (away) {
    const words = `No vehicle passed where you pointed: this is the nearest pixel that some did, ${units.length(away)} away.`;
    card.append(make("p", { class: "note", "data-name": "away", "data-value": String(away) }, words));
  }
  if (!n || !histogram) {
    card.append(make("p", { "data-name": "n", "data-value": "0" }, "No vehicle passed here."));
    return card;
  }
  card.append(
    pairs(rows(answer, field, units)),
    make("h3", {}, "Velocity distribution"),
    polarPicture(histogram, answer.modes, field.run, units),
    make("p", { class: "note" }, "The way is the way on the map, farther out is faster; the circles are the modes."),
    make("h3", {}, answer.modes.length > 1 ? "Modes" : "Mode"),
    grid(
      ["", units.headingColumn.title, "Speed", "Share"],
      answer.modes.map((mode, k) => modeRow(mode, k, field, units)),
    ),
  );
  const few = n < 5 ? `${n === 1 ? "One vehicle" : `${n} vehicles`} only: take the percentiles as a hint. ` : "";
  card.append(make("p", { class: "note" }, few + errorNote(values)));
  return card;
}

function errorNote(values: Record<string, number>): string {
  if ("direction_ci90_half_width" in values) return "In grey beside a number: its 90 % interval.";
  return "direction_se" in values ? "± is one standard error." : "";
}

function rows({ n, values }: PixelAnswer, field: Field, units: Units): [string, Node | string][] {
  const direction = Math.atan2(values.modal_vy!, values.modal_vx!);
  const speed = Math.hypot(values.modal_vx!, values.modal_vy!);
  const moving = speed > field.run.stationary_speed_px_per_s;
  const heading = make("span", {}, ...(moving ? [arrow(direction), " "] : []));
  heading.append(
    told("direction", direction, moving ? units.headingDegrees(direction) : "stands"),
    plusMinus(values.direction_ci90_half_width ?? values.direction_se, (half) => `${((half * 180) / Math.PI).toFixed(1)}°`),
    moving ? units.headingPoint(direction) : "",
  );
  const listed: [string, Node | string][] = [
    ["Vehicles", told("n", n, String(n))],
    ["Direction", heading],
    ["Speed (mode)", speedCell("modal_speed", speed, values, units)],
  ];
  for (const [name, label] of [
    ["speed_p15", "15th percentile"],
    ["speed_p50", "Median speed"],
    ["speed_p85", "85th percentile"],
  ] as const) {
    if (name in values) listed.push([label, speedCell(name, values[name]!, values, units)]);
  }
  if ("stationary_fraction" in values) {
    const share = values.stationary_fraction!;
    listed.push(["Stand here", told("stationary_fraction", share, `${Math.round(100 * share)} %`)]);
  }
  return listed;
}

function speedCell(name: string, speed: number, values: Record<string, number>, units: Units): HTMLElement {
  const cell = make("span", {}, told(name, speed, units.speedText(speed)));
  const shown = (pxPerS: number): string => (pxPerS * units.perPxPerS).toFixed(1);
  const [low, high] = [values[`${name}_ci90_lower`], values[`${name}_ci90_upper`]];
  if (low !== undefined && high !== undefined) {
    if (Number.isFinite(low)) cell.append(make("span", { class: "error" }, ` ${shown(low)} to ${shown(high)}`));
  } else if (name === "speed_p50") cell.append(plusMinus(values.speed_se, shown));
  return cell;
}

function plusMinus(error: number | undefined, text: (error: number) => string): Node | string {
  return error !== undefined && Number.isFinite(error) ? make("span", { class: "error" }, ` ± ${text(error)}`) : "";
}

function modeRow(mode: Mode, k: number, field: Field, units: Units): (Node | string)[] {
  const { bins, bin_width_px_per_s: width, stationary_speed_px_per_s: standing } = field.run;
  const [vx, vy] = [(mode.x - (bins - 1) / 2) * width, (mode.y - (bins - 1) / 2) * width];
  const [direction, speed] = [Math.atan2(vy, vx), Math.hypot(vx, vy)];
  const way = speed > standing ? make("span", {}, arrow(direction), ` ${units.headingColumn.text(direction)}`) : "stands";
  const whole = make("span", { "data-name": `mode_${k}`, "data-value": JSON.stringify([vx, vy, mode.share]) }, `${k + 1}`);
  return [whole, way, units.speedText(speed), `${Math.round(100 * mode.share)} %`];
}

/** Who passed near the pixel, when and how fast. */
export function showTracks(near: Near[], index: TrackIndex, units: Units): HTMLElement {
  const most = 50;
  const s = index.segments;
  const table = grid(
    ["Time", units.headingColumn.title, "Speed"],
    near.slice(0, most).map(({ nearest: row }) => {
      const [vx, vy] = [s.vx_px_per_s[row]!, s.vy_px_per_s[row]!];
      return [units.time(s.start_s[row]!), units.headingColumn.text(Math.atan2(vy, vx)), units.speedText(Math.hypot(vx, vy))];
    }),
  );
  const more = near.length > most ? [make("p", { class: "note" }, `and ${near.length - most} more`)] : [];
  const summary = make("summary", {}, `Who passed: ${near.length}`);
  return make("details", { class: "tracks", "data-count": String(near.length) }, summary, table, ...more);
}
