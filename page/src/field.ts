// The field's arrays by name, read pixel by pixel.

import { ChunkedArray, type Numbers } from "./chunks";
import { Histogram } from "./histogram";
import type { Point } from "./coordinates";
import type { Run } from "./run";

const HISTOGRAM = "velocity_histogram";
const CHUNKS_KEPT = 24; // of each array

export class Field {
  private readonly arrays = new Map<string, ChunkedArray>();
  private readonly histograms: Histogram;

  constructor(readonly run: Run) {
    for (const [name, record] of Object.entries(run.arrays)) {
      if (name !== HISTOGRAM) this.arrays.set(name, new ChunkedArray(name, record, CHUNKS_KEPT));
    }
    const record = run.arrays[HISTOGRAM]!;
    this.histograms = new Histogram(`${record.store}/${HISTOGRAM}`, record, run.bins);
  }

  has(name: string): boolean {
    return this.arrays.has(name);
  }

  array(name: string): ChunkedArray {
    const array = this.arrays.get(name);
    if (!array) throw new Error(`the field has no ${name}`);
    return array;
  }

  inside(x: number, y: number): boolean {
    return x >= 0 && y >= 0 && x < this.run.width_px && y < this.run.height_px;
  }

  /** The value at a pixel; NaN where nothing is stored. */
  async at(name: string, x: number, y: number): Promise<number> {
    const array = this.array(name);
    const { row, column, index } = locate(array, x, y);
    return value(await array.read(row, column), index);
  }

  /** As `at`, of what is in memory; undefined where it is not. */
  peek(name: string, x: number, y: number): number | undefined {
    const array = this.array(name);
    const { row, column, index } = locate(array, x, y);
    const chunk = array.peek(row, column);
    return chunk === undefined ? undefined : value(chunk, index);
  }

  /**
   * The pixel meant by a point of the map: its own where vehicles passed it, else the nearest within `reach` px that
   * `minVehicles` passed; its own where there is none.
   */
  async nearest(at: Point, reach: number, minVehicles: number): Promise<Point> {
    const own = { x: Math.round(at.x), y: Math.round(at.y) };
    if (reach <= 1 || (await this.at("count", own.x, own.y)) > 0) return own;
    const count = this.array("count");
    const [height, width] = count.chunk;
    const { width_px, height_px } = this.run;
    const around = [...covered(at.y, reach, height_px, height)].flatMap((row) =>
      [...covered(at.x, reach, width_px, width)].map((column) => ({ row, column, counts: count.read(row, column) })),
    );
    let [found, best] = [own, reach];
    for (const { row, column, counts } of around) {
      const read = await counts;
      for (let k = 0; read && k < read.length; k++) {
        if (read[k]! < minVehicles) continue;
        const [x, y] = [column * width + (k % width), row * height + Math.floor(k / width)];
        const distance = Math.hypot(x - at.x, y - at.y);
        if (distance <= best && this.inside(x, y)) [found, best] = [{ x, y }, distance];
      }
    }
    return found;
  }

  /** The histogram at a pixel, (vy, vx) flat; null where nothing passed. */
  histogram(x: number, y: number): Promise<Int32Array | null> {
    return this.histograms.at(x, y);
  }
}

/** The chunks of `chunk` pixels that come within `reach` of a point, along one axis of `size` pixels. */
function* covered(at: number, reach: number, size: number, chunk: number): Generator<number> {
  const first = Math.floor(Math.max(at - reach, 0) / chunk);
  for (let k = first; k * chunk <= Math.min(at + reach, size - 1); k++) yield k;
}

function locate(array: ChunkedArray, x: number, y: number): { row: number; column: number; index: number } {
  const [height, width] = array.chunk;
  return {
    row: Math.floor(y / height),
    column: Math.floor(x / width),
    index: (y % height) * width + (x % width),
  };
}

function value(chunk: Numbers | null, index: number): number {
  return chunk === null ? NaN : chunk[index]!;
}
