// Zstandard for zarrita and for the histogram's blocks. zarrita's own wants `unsafe-eval`; this one does not. It checks
// the checksum that every chunk carries.

import { ZSTDDecoder } from "zstddec";
import { Unreadable } from "./run";

const decoder = new ZSTDDecoder();
const DAMAGED = "a chunk is damaged: its checksum is wrong";

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
