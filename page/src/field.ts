// The field's arrays by name, read pixel by pixel.

import { ChunkedArray, type Numbers } from "./chunks";
import type { Run } from "./run";

export const HISTOGRAM = "velocity_histogram";
const LAYER_CHUNKS_KEPT = 24;
const HISTOGRAM_CHUNKS_KEPT = 4; // tens of megabytes each once decoded

export class Field {
  private readonly arrays = new Map<string, ChunkedArray>();

  constructor(readonly run: Run) {
    for (const [name, told] of Object.entries(run.arrays)) {
      const most = name === HISTOGRAM ? HISTOGRAM_CHUNKS_KEPT : LAYER_CHUNKS_KEPT;
      this.arrays.set(name, new ChunkedArray(name, told, most));
    }
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
    const { row, column, index } = place(array, x, y);
    return value(await array.read(row, column), index);
  }

  /** As `at`, of what is in memory; undefined where it is not. */
  peek(name: string, x: number, y: number): number | undefined {
    const array = this.array(name);
    const { row, column, index } = place(array, x, y);
    const chunk = array.peek(row, column);
    return chunk === undefined ? undefined : value(chunk, index);
  }

  /** The histogram at a pixel, (vy, vx) flat; null where nothing passed. */
  async histogram(x: number, y: number): Promise<Int32Array | null> {
    const array = this.array(HISTOGRAM);
    const { row, column, index } = place(array, x, y);
    const chunk = (await array.read(row, column)) as Int32Array | null;
    const size = this.run.bins ** 2;
    return chunk && chunk.subarray(index * size, (index + 1) * size);
  }
}

function place(array: ChunkedArray, x: number, y: number): { row: number; column: number; index: number } {
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
