// The answer of a pixel: its velocity distribution, modes, percentiles, vehicle tracks.

import { arrow, grid, make, pairs } from "./dom";
import type { Field } from "./field";
import type { Point } from "./coordinates";
import { findModes, type Mode } from "./modes";
import { cautionNote, isShown, PERCENTILES } from "./percentiles";
import { polarPlot } from "./polar";
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

/** Layers shown of a pixel, where the field has them; names with `ci90` are 90 % confidence intervals. */
const LAYERS = [
  "count",
  "modal_vx",
  "modal_vy",
  "direction_ci90_half_width",
  "direction_se",
  "speed_p15",
  "speed_p50",
  "speed_p50_ci90_lower",
  "speed_p50_ci90_upper",
  "speed_se",
  "speed_p85",
  "stationary_fraction",
];
/** A layer -> the better one that replaces it. */
const REPLACED_BY: Record<string, string> = { direction_se: "direction_ci90_half_width", speed_se: "speed_p50_ci90_lower" };

export async function queryPixel(field: Field, { x, y }: Point): Promise<PixelAnswer> {
  const names = LAYERS.filter((name) => field.has(name) && !field.has(REPLACED_BY[name] ?? ""));
  const [histogram, ...found] = await Promise.all([field.histogram(x, y), ...names.map((name) => field.at(name, x, y))]);
  const values = Object.fromEntries(names.map((name, k) => [name, found[k]!]));
  const n = values.count || 0; // NaN where no chunk is stored
  const modes = histogram && n ? findModes(histogram, field.run.bins, n) : [];
  return { x, y, n, histogram, modes, values };
}

/** A value as text, with its full precision in an attribute for programs. */
function valueSpan(name: string, value: number, text: string): HTMLElement {
  return make("span", { "data-name": name, "data-value": String(value) }, text);
}

/** The answer of a pixel, `away` px from the point that was clicked. */
export function showPixel(answer: PixelAnswer, field: Field, units: Units, away: number): HTMLElement {
  const { x, y, n, values, histogram } = answer;
  const card = make("section", { class: "answer", "aria-label": "Pixel" }, make("h2", {}, `Pixel (${x}, ${y})`));
  if (away) {
    const words = `No vehicle passed the pixel you clicked: this is the nearest one with vehicles, ${units.length(away)} away.`;
    card.append(make("p", { class: "note", "data-name": "away", "data-value": String(away) }, words));
  }
  if (!n || !histogram) {
    card.append(make("p", { "data-name": "n", "data-value": "0" }, "No vehicle passed here."));
    return card;
  }
  card.append(
    pairs(rows(answer, field, units)),
    make("p", { class: "note", "data-name": "caution" }, [cautionNote(n, "passed here", field.run), errorNote(values)].join(" ").trim()),
    make("h3", {}, "Velocity distribution"),
    polarPlot(histogram, answer.modes, field.run, units),
    make("p", { class: "note" }, "Angle: direction on the map; radius: speed. Circles mark the modes."),
    make("h3", {}, answer.modes.length > 1 ? "Modes" : "Mode"),
    grid(
      ["No.", units.headingColumn.title, "Speed", "Fraction"],
      answer.modes.map((mode, k) => modeRow(mode, k, field, units)),
    ),
  );
  return card;
}

function errorNote(values: Record<string, number>): string {
  if ("direction_ci90_half_width" in values) return "In grey: 90 % confidence interval.";
  return "direction_se" in values ? "± is one standard error." : "";
}

function rows({ n, values }: PixelAnswer, field: Field, units: Units): [string, Node | string][] {
  const direction = Math.atan2(values.modal_vy!, values.modal_vx!);
  const speed = Math.hypot(values.modal_vx!, values.modal_vy!);
  const moving = speed > field.run.stationary_speed_px_per_s;
  const heading = make("span", {}, ...(moving ? [arrow(direction), " "] : []));
  heading.append(
    valueSpan("direction", direction, moving ? units.headingDegrees(direction) : "stationary"),
    plusMinus(values.direction_ci90_half_width ?? values.direction_se, (half) => `${((half * 180) / Math.PI).toFixed(1)}°`),
    moving ? units.headingPoint(direction) : "",
  );
  const listed: [string, Node | string][] = [
    ["Vehicles", valueSpan("n", n, String(n))],
    ["Direction", heading],
    ["Speed (mode)", speedCell("modal_speed", speed, values, units)],
  ];
  for (const [percent, label] of PERCENTILES) {
    const name = `speed_p${percent}`;
    if (name in values && isShown(percent, n, field.run)) listed.push([label, speedCell(name, values[name]!, values, units)]);
  }
  if ("stationary_fraction" in values) {
    const fraction = values.stationary_fraction!;
    listed.push(["Stationary", valueSpan("stationary_fraction", fraction, `${Math.round(100 * fraction)} %`)]);
  }
  return listed;
}

function speedCell(name: string, speed: number, values: Record<string, number>, units: Units): HTMLElement {
  const cell = make("span", {}, valueSpan(name, speed, units.speedText(speed)));
  const shown = (pxPerS: number): string => (pxPerS * units.perPxPerS).toFixed(1);
  const [low, high] = [values[`${name}_ci90_lower`], values[`${name}_ci90_upper`]];
  if (low !== undefined && high !== undefined) {
    cell.append(make("span", { class: "error" }, ` ${shown(low)} to ${shown(high)}`));
  } else if (name === "speed_p50") cell.append(plusMinus(values.speed_se, shown));
  return cell;
}

function plusMinus(error: number | undefined, text: (error: number) => string): Node | string {
  return error !== undefined && Number.isFinite(error) ? make("span", { class: "error" }, ` ± ${text(error)}`) : "";
}

function modeRow(mode: Mode, k: number, field: Field, units: Units): (Node | string)[] {
  const { bins, bin_width_px_per_s: width, stationary_speed_px_per_s: stationarySpeed } = field.run;
  const [vx, vy] = [(mode.x - (bins - 1) / 2) * width, (mode.y - (bins - 1) / 2) * width];
  const [direction, speed] = [Math.atan2(vy, vx), Math.hypot(vx, vy)];
  const heading = speed > stationarySpeed ? make("span", {}, arrow(direction), ` ${units.headingColumn.text(direction)}`) : "stationary";
  const number = make("span", { "data-name": `mode_${k}`, "data-value": JSON.stringify([vx, vy, mode.weight]) }, `${k + 1}`);
  return [number, heading, units.speedText(speed), `${Math.round(100 * mode.weight)} %`];
}

/** The vehicle tracks near the pixel: time, direction, speed. */
export function showTracks(near: Near[], index: TrackIndex, units: Units): HTMLElement {
  const limit = 50;
  const s = index.segments;
  const table = grid(
    ["Time", units.headingColumn.title, "Speed"],
    near.slice(0, limit).map(({ nearest: row }) => {
      const [vx, vy] = [s.vx_px_per_s[row]!, s.vy_px_per_s[row]!];
      return [units.time(s.start_s[row]!), units.headingColumn.text(Math.atan2(vy, vx)), units.speedText(Math.hypot(vx, vy))];
    }),
  );
  const more = near.length > limit ? [make("p", { class: "note" }, `and ${near.length - limit} more`)] : [];
  const summary = make("summary", {}, `Vehicle tracks: ${near.length}`);
  return make("details", { class: "tracks", "data-count": String(near.length) }, summary, table, ...more);
}
