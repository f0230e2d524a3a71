// Who crosses a line: velfield/analysis/crossings.py in TypeScript, number for number.

import type { Point } from "./place";
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

/** Crossings of the line, by track and time; who comes back before `settlePx` from it has not crossed it. */
export function lineCrossings(segments: Segments, start: Point, end: Point, settlePx: number): Crossing[] {
  const [dx, dy] = [end.x - start.x, end.y - start.y];
  const length = Math.max(Math.hypot(dx, dy), 1e-9);
  const right = (x: number, y: number): number => (dx * (y - start.y) - dy * (x - start.x)) / length;
  const along = (x: number, y: number): number => (dx * (x - start.x) + dy * (y - start.y)) / length ** 2;
  const { x0_px, y0_px, x1_px, y1_px, track } = segments;
  const after = (row: number): number => right(x1_px[row]!, y1_px[row]!);

  const found: Crossing[] = [];
  let stack: { row: number; share: number }[] = [];
  const settle = (): void => {
    for (const { row, share } of stack) found.push(crossing(segments, row, share, after(row)));
    stack = [];
  };
  for (let row = 0; row < segments.count; row++) {
    const [from, to] = [right(x0_px[row]!, y0_px[row]!), after(row)];
    if (from >= 0 === to >= 0) continue;
    const share = from / (from - to);
    const [a, b] = [along(x0_px[row]!, y0_px[row]!), along(x1_px[row]!, y1_px[row]!)];
    const place = a + share * (b - a);
    if (place < 0 || place > 1) continue;
    const last = stack.at(-1);
    if (last && track[last.row] !== track[row]) settle();
    const out = stack.at(-1);
    if (out && after(out.row) >= 0 !== to >= 0 && excursion(after, out.row, row) < settlePx) stack.pop();
    else stack.push({ row, share });
  }
  settle();
  return found;
}

/** Farthest from the line between crossing out and back, px. */
function excursion(after: (row: number) => number, out: number, back: number): number {
  let most = 0;
  for (let row = out; row < back; row++) most = Math.max(most, Math.abs(after(row)));
  return most;
}

function crossing(segments: Segments, row: number, share: number, after: number): Crossing {
  const [vx, vy] = [segments.vx_px_per_s[row]!, segments.vy_px_per_s[row]!];
  return {
    track: segments.track[row]!,
    time_s: segments.start_s[row]! + share * segments.duration_s[row]!,
    vx,
    vy,
    speed: Math.hypot(vx, vy),
    direction: after >= 0 ? 1 : -1,
  };
}
