// Zstandard for zarrita and for the histogram's tiles. zarrita's own wants `unsafe-eval`; this one does not. It checks the
// checksum that every chunk carries.

import { ZSTDDecoder } from "zstddec/stream";
import { Unreadable } from "./run";

const decoder = new ZSTDDecoder();
const DAMAGED = "a chunk is damaged: its checksum is wrong";
const MAX_EMPTY = 8; // empty pieces in a row: the decoder makes no progress

/** A codec as zarrita wants it. */
export class Zstd {
  readonly kind = "bytes_to_bytes";

  static async load(): Promise<typeof Zstd> {
    await decoder.init();
    return Zstd;
  }

  static fromConfig(): Zstd {
    return new Zstd();
  }

  encode(): never {
    throw new Error("the page only reads");
  }

  decode(bytes: Uint8Array): Uint8Array {
    const decoded = decoder.decode(bytes);
    if (decoded.length === 0) throw new Unreadable(DAMAGED);
    return decoded;
  }
}

/** Bytes [from, to) of compressed data; all of it is decoded, for its checksum, but never held at once. */
export async function decodePart(compressed: Uint8Array, from: number, to: number): Promise<Uint8Array> {
  await decoder.init();
  const part = new Uint8Array(to - from);
  let [at, empty] = [0, 0];
  for (const piece of decoder.decodeStreaming([compressed])) {
    const [first, last] = [Math.max(from, at), Math.min(to, at + piece.length)];
    if (first < last) part.set(piece.subarray(first - at, last - at), first - from);
    at += piece.length;
    empty = piece.length ? 0 : empty + 1;
    if (empty > MAX_EMPTY) throw new Unreadable(DAMAGED);
  }
  if (at < to) throw new Unreadable(DAMAGED);
  return part;
}
