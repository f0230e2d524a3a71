// Chunks of the run folder's Zarr arrays. A chunk that is not stored is known from run.json and never requested.

import * as zarr from "zarrita";
import { fetchFile, type StoredArray } from "./run";
import { Zstd } from "./zstd";

zarr.registry.set("zstd", () => Zstd.load() as never);

export type Numbers = Float32Array | Float64Array | Int32Array;

/** An array; known `metadata` saves a request. */
async function openArray(path: string, metadata?: object) {
  const store = {
    async get(key: string): Promise<Uint8Array> {
      if (metadata && key === "/zarr.json") return new TextEncoder().encode(JSON.stringify(metadata));
      return new Uint8Array(await (await fetchFile(path + key)).arrayBuffer());
    },
  };
  return zarr.open.v3(store, { kind: "array" });
}

type OpenArray = Awaited<ReturnType<typeof openArray>>;

/** A (y, x, ...) array; caches the chunks read last. */
export class ChunkedArray {
  readonly chunk: [number, number];
  private readonly stored: Set<string>;
  private readonly kept = new Map<string, Promise<Numbers>>();
  private readonly ready = new Map<string, Numbers>();
  private open: Promise<OpenArray> | undefined;

  constructor(
    readonly name: string,
    private readonly record: StoredArray,
    private readonly maxChunks: number,
  ) {
    this.chunk = record.chunk;
    this.stored = new Set();
    for (let k = 0; k < record.stored.length; k += 2) this.stored.add(`${record.stored[k]},${record.stored[k + 1]}`);
  }

  /** The numbers of a chunk, C order; null where nothing is stored: no vehicle passed there. */
  read(row: number, column: number): Promise<Numbers | null> {
    const key = `${row},${column}`;
    if (!this.stored.has(key)) return Promise.resolve(null);
    const known = this.kept.get(key);
    if (known) {
      this.kept.delete(key); // to the end: read last
      this.kept.set(key, known);
      return known;
    }
    const promise = this.load(row, column, key);
    this.kept.set(key, promise);
    promise.catch(() => this.kept.delete(key)); // requested again the next time
    for (const oldest of this.kept.keys()) {
      if (this.kept.size <= this.maxChunks) break;
      this.kept.delete(oldest);
      this.ready.delete(oldest);
    }
    return promise;
  }

  /** A chunk that is in memory already; undefined where it is not. */
  peek(row: number, column: number): Numbers | null | undefined {
    const key = `${row},${column}`;
    return this.stored.has(key) ? this.ready.get(key) : null;
  }

  private async load(row: number, column: number, key: string): Promise<Numbers> {
    this.open ??= openArray(`${this.record.store}/${this.name}`, this.record.metadata);
    const array = await this.open;
    const rest = array.shape.slice(2).map(() => 0);
    const data = (await array.getChunk([row, column, ...rest])).data as Numbers;
    if (this.kept.has(key)) this.ready.set(key, data);
    return data;
  }
}

/** A whole column of view/segments.zarr. */
export async function readColumn<T extends Numbers>(name: string): Promise<T> {
  const array = await openArray(`view/segments.zarr/${name}`);
  const length = array.shape[0]!;
  const chunks = length === 0 ? 0 : Math.ceil(length / array.chunks[0]!);
  const parts = await Promise.all(Array.from({ length: chunks }, (_, k) => array.getChunk([k])));
  if (parts.length === 1) return (parts[0]!.data as T).subarray(0, length) as T;
  const Type = name === "track" ? Int32Array : name === "start_s" ? Float64Array : Float32Array;
  const whole = new Type(length);
  parts.forEach((part, k) => whole.set((part.data as T).subarray(0, length - k * array.chunks[0]!), k * array.chunks[0]!));
  return whole as unknown as T;
}
