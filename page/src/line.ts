// The answer of a line across a road: counts, directions, speeds.

import type { Crossing } from "./crossings";
import { arrow, make, pairs } from "./dom";
import type { Point } from "./coordinates";
import { cautionNote, isShown, PERCENTILES } from "./percentiles";
import type { Run } from "./run";
import { countText, percentile, roundUp, ticks, type Units } from "./units";

const FLOW_OF_S = 60; // in less a platoon may come or not
const PLOT = { width: 280, height: 112, left: 10, bottom: 34, top: 6 };

export function showLine(crossings: Crossing[], [start, end]: [Point, Point], run: Run, units: Units): HTMLElement {
  const length = units.length(Math.hypot(end.x - start.x, end.y - start.y));
  const card = make("section", { class: "answer", "aria-label": "Line" }, make("h2", {}, "Across the line"));
  const seconds = run.last_time_s - run.first_time_s;
  card.append(
    make(
      "p",
      { class: "note" },
      `${length} long; ${countText(crossings.length, "crossing")} in ${seconds.toFixed(0)} s.`,
    ),
  );
  const top = roundUp(Math.max(...crossings.map((c) => c.speed * units.perPxPerS), 1));
  for (const direction of [1, -1] as const) {
    const part = crossings.filter((crossing) => crossing.direction === direction);
    card.append(...oneWay(part, direction, across([start, end], direction), top, run, units));
  }
  return card;
}

/** Direction across the line. */
function across([start, end]: [Point, Point], direction: 1 | -1): number {
  return Math.atan2(direction * (end.x - start.x), -direction * (end.y - start.y));
}

function oneWay(
  part: Crossing[],
  direction: 1 | -1,
  across: number,
  top: number,
  run: Run,
  units: Units,
): HTMLElement[] {
  const speeds = part.map((crossing) => crossing.speed).sort((a, b) => a - b);
  const name = direction === 1 ? "forward" : "back";
  const title = make("h3", {}, arrow(across), ` towards ${units.headingText(across)}`);
  const count = make("span", { "data-name": `${name}_count`, "data-value": String(part.length) }, `${part.length}`);
  if (!part.length) return [title, make("p", {}, count, " vehicles")];
  const speed = (percent: number): HTMLElement => {
    const value = percentile(speeds, percent);
    const attributes = { "data-name": `${name}_p${percent}`, "data-value": String(value) };
    return make("span", attributes, units.speedText(value));
  };
  const shown = PERCENTILES.filter(([percent]) => isShown(percent, part.length, run));
  const rows: [string, Node | string][] = [
    ["Vehicles", count],
    ["Flow", flowText(part.length, run.last_time_s - run.first_time_s)],
    ...shown.map(([percent, label]): [string, Node] => [label, speed(percent)]),
  ];
  const caution = cautionNote(part.length, "crossed this way", run);
  const note = caution ? [make("p", { class: "note", "data-name": `${name}_caution` }, caution)] : [];
  return [title, pairs(rows), ...note, bars(speeds.map((value) => value * units.perPxPerS), top, units.speed)];
}

function flowText(vehicles: number, seconds: number): string {
  if (seconds < FLOW_OF_S) return "not known: less than a minute was seen";
  return `${Math.round((360 * vehicles) / seconds) * 10} an hour${seconds < 300 ? " (short flight: uncertain)" : ""}`;
}

/** A histogram of speeds, as SVG. */
function bars(speeds: number[], top: number, unit: string): HTMLElement {
  const { width, height, left, bottom } = PLOT;
  const bins = 20;
  const counts = new Array<number>(bins).fill(0);
  for (const speed of speeds) counts[Math.min(Math.floor((speed / top) * bins), bins - 1)]! += 1;
  const largest = Math.max(...counts, 1);
  const step = (width - 2 * left) / bins;
  const svg = element("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", class: "bars" });
  svg.setAttribute("aria-label", `Histogram of ${countText(speeds.length, "speed")} from 0 to ${top} ${unit}`);
  counts.forEach((count, k) => {
    const barHeight = ((height - bottom - PLOT.top) * count) / largest;
    const at = { x: left + k * step + 0.5, y: height - bottom - barHeight, width: step - 1, height: barHeight };
    svg.append(element("rect", at));
  });
  svg.append(element("line", { x1: left, x2: width - left, y1: height - bottom, y2: height - bottom }));
  const write = (x: number, y: number, label: string): void => {
    const text = element("text", { x, y, "text-anchor": "middle" });
    text.textContent = label;
    svg.append(text);
  };
  for (const value of ticks(top)) write(left + ((width - 2 * left) * value) / top, height - bottom + 14, `${value}`);
  write(width / 2, height - 4, unit);
  return make("div", {}, svg);
}

function element(name: string, attributes: Record<string, string | number>): SVGElement {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, String(value));
  return made;
}
