// The velocity histogram, (y, x, vy, vx), pixel by pixel. A tile is a shard of Zarr: blocks of pixels, each compressed by
// itself, and behind them the offset and the size of each. It is kept compressed: the block of a requested pixel is decoded.

import { fetchFile, Unreadable, type StoredArray } from "./run";
import { Zstd } from "./zstd";

const MAX_TILES = 64;
const CHECKSUM_BYTES = 4;
const NOT_STORED = 0xffffffffffffffffn; // of a block that no vehicle passed

interface Sharding {
  name: string;
  configuration?: { chunk_shape?: number[]; codecs?: { name: string; configuration?: { endian?: string } }[] };
}

export class Histogram {
  private readonly stored = new Set<string>();
  private readonly compressed = new Map<string, Promise<Uint8Array>>();
  private readonly block: number[];

  constructor(
    private readonly path: string,
    private readonly record: StoredArray,
    private readonly bins: number,
  ) {
    for (let k = 0; k < record.stored.length; k += 2) this.stored.add(`${record.stored[k]}/${record.stored[k + 1]}`);
    const [sharding] = (record.metadata as { codecs: Sharding[] }).codecs;
    const codecs = sharding?.configuration?.codecs ?? [];
    const names = codecs.map(({ name }) => name).join();
    if (sharding?.name !== "sharding_indexed" || names !== "bytes,zstd" || codecs[0]!.configuration?.endian !== "little") {
      throw new Unreadable(`${path} is stored as ${sharding?.name} of ${names}, this page reads shards of little-endian bytes compressed by zstd`);
    }
    this.block = sharding.configuration!.chunk_shape!;
  }

  /** The histogram at a pixel, (vy, vx) flat; null where no vehicle passed. */
  async at(x: number, y: number): Promise<Int32Array | null> {
    const [height, width] = this.record.chunk;
    const [blockHeight, blockWidth] = this.block as [number, number];
    const key = `${Math.floor(y / height)}/${Math.floor(x / width)}`;
    if (!this.stored.has(key)) return null;
    const [row, column] = [Math.floor((y % height) / blockHeight), Math.floor((x % width) / blockWidth)];
    const shard = await this.tile(key);
    const across = width / blockWidth;
    const indexAt = shard.length - CHECKSUM_BYTES - 16 * (height / blockHeight) * across;
    const entry = new DataView(shard.buffer, shard.byteOffset + indexAt + 16 * (row * across + column), 16);
    const [start, size] = [entry.getBigUint64(0, true), entry.getBigUint64(8, true)];
    if (start === NOT_STORED) return null;
    const decoded = (await Zstd.load()).fromConfig().decode(shard.subarray(Number(start), Number(start + size)));
    const values = new Int32Array(decoded.buffer, decoded.byteOffset, decoded.byteLength / 4);
    const pixel = (y % blockHeight) * blockWidth + (x % blockWidth);
    return values.slice(pixel * this.bins ** 2, (pixel + 1) * this.bins ** 2);
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
