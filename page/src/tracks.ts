// Track segments (view/segments.zarr), and the tracks near a point.

import { readColumn } from "./chunks";
import type { Run } from "./run";

const CELL_PX = 32;

export interface Segments {
  count: number;
  track: Int32Array;
  start_s: Float64Array;
  duration_s: Float32Array;
  x0_px: Float32Array;
  y0_px: Float32Array;
  x1_px: Float32Array;
  y1_px: Float32Array;
  vx_px_per_s: Float32Array;
  vy_px_per_s: Float32Array;
}

export async function loadSegments(run: Run): Promise<Segments> {
  const reals = ["duration_s", "x0_px", "y0_px", "x1_px", "y1_px", "vx_px_per_s", "vy_px_per_s"] as const;
  const [track, start_s, ...columns] = await Promise.all([
    readColumn<Int32Array>("track"),
    readColumn<Float64Array>("start_s"),
    ...reals.map((name) => readColumn<Float32Array>(name)),
  ]);
  const named = Object.fromEntries(reals.map((name, k) => [name, columns[k]!])) as Record<(typeof reals)[number], Float32Array>;
  return { count: run.segments.count, track, start_s, ...named };
}

/** A track near a point: its rows, and the nearest of them. */
export interface Near {
  first: number;
  last: number;
  nearest: number;
}

/** Grid index: the segments that touch each cell. */
export class TrackIndex {
  private readonly columns: number;
  private readonly cells = new Map<number, number[]>();

  constructor(
    readonly segments: Segments,
    run: Run,
  ) {
    this.columns = Math.ceil(run.width_px / CELL_PX) + 2;
    const { x0_px, y0_px, x1_px, y1_px } = segments;
    for (let row = 0; row < segments.count; row++) {
      const [left, right] = order(x0_px[row]!, x1_px[row]!);
      const [top, bottom] = order(y0_px[row]!, y1_px[row]!);
      for (let j = cell(top); j <= cell(bottom); j++) {
        for (let i = cell(left); i <= cell(right); i++) this.add(j * this.columns + i, row);
      }
    }
  }

  private add(key: number, row: number): void {
    const rows = this.cells.get(key);
    if (rows) rows.push(row);
    else this.cells.set(key, [row]);
  }

  /** Tracks that come within `radius` px, in the order of time. */
  near(x: number, y: number, radius: number): Near[] {
    const best = new Map<number, { row: number; distance: number }>();
    for (let j = cell(y - radius); j <= cell(y + radius); j++) {
      for (let i = cell(x - radius); i <= cell(x + radius); i++) {
        for (const row of this.cells.get(j * this.columns + i) ?? []) {
          const distance = this.distance(row, x, y);
          const track = this.segments.track[row]!;
          const known = best.get(track);
          if (distance <= radius && (!known || distance < known.distance)) best.set(track, { row, distance });
        }
      }
    }
    const found = [...best.values()].map(({ row }) => this.whole(row));
    return found.sort((a, b) => this.segments.start_s[a.nearest]! - this.segments.start_s[b.nearest]!);
  }

  private whole(row: number): Near {
    const { track, count } = this.segments;
    let [first, last] = [row, row];
    while (first > 0 && track[first - 1] === track[row]) first--;
    while (last < count - 1 && track[last + 1] === track[row]) last++;
    return { first, last, nearest: row };
  }

  private distance(row: number, x: number, y: number): number {
    const s = this.segments;
    const [x0, y0] = [s.x0_px[row]!, s.y0_px[row]!];
    const [dx, dy] = [s.x1_px[row]! - x0, s.y1_px[row]! - y0];
    const length = dx * dx + dy * dy;
    const along = length ? Math.min(Math.max(((x - x0) * dx + (y - y0) * dy) / length, 0), 1) : 0;
    return Math.hypot(x - x0 - along * dx, y - y0 - along * dy);
  }

  /** The path of a track, (x, y) by (x, y). */
  path({ first, last }: Near): [number, number][] {
    const s = this.segments;
    const path: [number, number][] = [[s.x0_px[first]!, s.y0_px[first]!]];
    for (let row = first; row <= last; row++) path.push([s.x1_px[row]!, s.y1_px[row]!]);
    return path;
  }
}

const cell = (value: number): number => Math.floor(value / CELL_PX) + 1;
const order = (a: number, b: number): [number, number] => (a < b ? [a, b] : [b, a]);
