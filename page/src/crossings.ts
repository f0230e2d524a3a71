// Crossings of a line: velfield/analysis/crossings.py in TypeScript, number for number.

import type { Point } from "./coordinates";
import type { Segments } from "./tracks";

export interface Crossing {
  track: number;
  time_s: number;
  vx: number;
  vy: number;
  speed: number;
  /** +1: from the left of the line to its right, looking from its start to its end; else -1. */
  direction: 1 | -1;
}

/** Crossings of the line, by track and time; a vehicle that comes back before it is `hysteresisPx` away has not crossed. */
export function lineCrossings(segments: Segments, start: Point, end: Point, hysteresisPx: number): Crossing[] {
  const [dx, dy] = [end.x - start.x, end.y - start.y];
  const length = Math.max(Math.hypot(dx, dy), 1e-9);
  const right = (x: number, y: number): number => (dx * (y - start.y) - dy * (x - start.x)) / length;
  const along = (x: number, y: number): number => (dx * (x - start.x) + dy * (y - start.y)) / length ** 2;
  const { x0_px, y0_px, x1_px, y1_px, track } = segments;
  const after = (row: number): number => right(x1_px[row]!, y1_px[row]!);

  const found: Crossing[] = [];
  let stack: { row: number; fraction: number }[] = [];
  const flush = (): void => {
    for (const { row, fraction } of stack) found.push(crossing(segments, row, fraction, after(row)));
    stack = [];
  };
  for (let row = 0; row < segments.count; row++) {
    const [from, to] = [right(x0_px[row]!, y0_px[row]!), after(row)];
    if (from >= 0 === to >= 0) continue;
    const fraction = from / (from - to);
    const [a, b] = [along(x0_px[row]!, y0_px[row]!), along(x1_px[row]!, y1_px[row]!)];
    const position = a + fraction * (b - a);
    if (position < 0 || position > 1) continue;
    const last = stack.at(-1);
    if (last && track[last.row] !== track[row]) flush();
    const out = stack.at(-1);
    if (out && after(out.row) >= 0 !== to >= 0 && excursion(after, out.row, row) < hysteresisPx) stack.pop();
    else stack.push({ row, fraction });
  }
  flush();
  return found;
}

/** Farthest from the line between crossing out and back, px. */
function excursion(after: (row: number) => number, out: number, back: number): number {
  let largest = 0;
  for (let row = out; row < back; row++) largest = Math.max(largest, Math.abs(after(row)));
  return largest;
}

function crossing(segments: Segments, row: number, fraction: number, after: number): Crossing {
  const [vx, vy] = [segments.vx_px_per_s[row]!, segments.vy_px_per_s[row]!];
  return {
    track: segments.track[row]!,
    time_s: segments.start_s[row]! + fraction * segments.duration_s[row]!,
    vx,
    vy,
    speed: Math.hypot(vx, vy),
    direction: after >= 0 ? 1 : -1,
  };
}
