// The velocity histogram, (y, x, vy, vx), pixel by pixel. A tile holds tens of megabytes once decoded, most of them zeros:
// it is kept compressed, and the requested pixel is cut from it while decoding.

import { fetchFile, Unreadable, type StoredArray } from "./run";
import { decodePart } from "./zstd";

const MAX_TILES = 64;

export class Histogram {
  private readonly stored = new Set<string>();
  private readonly compressed = new Map<string, Promise<Uint8Array>>();

  constructor(
    private readonly path: string,
    private readonly record: StoredArray,
    private readonly bins: number,
  ) {
    for (let k = 0; k < record.stored.length; k += 2) this.stored.add(`${record.stored[k]}/${record.stored[k + 1]}`);
    const { codecs } = record.metadata as { codecs: { name: string; configuration?: { endian?: string } }[] };
    const names = codecs.map(({ name }) => name).join();
    if (names !== "bytes,zstd" || codecs[0]!.configuration?.endian !== "little") {
      throw new Unreadable(`${path} is compressed as ${names}, this page reads little-endian bytes compressed by zstd`);
    }
  }

  /** The histogram at a pixel, (vy, vx) flat; null where no vehicle passed. */
  async at(x: number, y: number): Promise<Int32Array | null> {
    const [height, width] = this.record.chunk;
    const key = `${Math.floor(y / height)}/${Math.floor(x / width)}`;
    if (!this.stored.has(key)) return null;
    const size = 4 * this.bins ** 2;
    const index = (y % height) * width + (x % width);
    const part = await decodePart(await this.tile(key), index * size, (index + 1) * size);
    return new Int32Array(part.buffer);
  }

  private tile(key: string): Promise<Uint8Array> {
    const known = this.compressed.get(key);
    if (known) return known;
    const asked = fetchFile(`${this.path}/c/${key}/0/0`).then(async (file) => new Uint8Array(await file.arrayBuffer()));
    this.compressed.set(key, asked);
    asked.catch(() => this.compressed.delete(key)); // requested again the next time
    if (this.compressed.size > MAX_TILES) this.compressed.delete(this.compressed.keys().next().value!);
    return asked;
  }
}
