// The replay: vehicles where they were at a time, from view/replay/<k>.bin (velfield/viewer/replay.py).

import type { Blocks, Painter, View } from "./animation";
import { rampColour } from "./colours";
import type { Point } from "./coordinates";
import { fetchFile, type Run } from "./run";

const CHUNKS_KEPT = 4;
const LENGTH_M = 4.5;
const WIDTH_M = 1.9;
const UNKNOWN_LENGTH_PX = 20; // of a vehicle in the map, where metres are not known
const MIN_SCREEN_PX = 9; // length drawn, at least
const TRAIL_S = 3;
const LINE_PX = 3; // the widest
const SPEED_S = 0.5; // the speed shown is of so long before and after
const PARKED = "parked";

/** Positions of all vehicles in a stretch of time. */
interface Chunk {
  vehicle: Uint32Array;
  /** First position of each vehicle; one more at the end. */
  first: Uint32Array;
  time: Float32Array;
  x: Uint16Array;
  y: Uint16Array;
  state: Uint8Array;
  axis: Uint8Array;
  gap: Uint8Array;
  /** Number of the class from 1, 0 where it was not measured. */
  kind: Uint8Array;
  percent: Uint8Array;
  /** Tenths of a metre, 0 where it is not known. */
  length: Uint8Array;
}

/** A vehicle at a time. */
export interface Seen {
  vehicle: number;
  x: number;
  y: number;
  vx: number;
  vy: number;
  state: string;
  /** Nothing was seen of it: the position is interpolated. */
  gap: boolean;
  axis: number;
  measured: { kind: string; percent: number; length_m: number } | null;
}

function parse(data: ArrayBuffer): Chunk {
  const [n, m] = new Uint32Array(data, 0, 2) as unknown as [number, number];
  let at = 8;
  const take = <T>(Type: new (data: ArrayBuffer, at: number, length: number) => T, length: number, size: number): T => {
    const taken = new Type(data, at, length);
    at += length * size;
    return taken;
  };
  // Files of an earlier release end before.
  const takeMeasured = (): Uint8Array => (at < data.byteLength ? take(Uint8Array, n, 1) : new Uint8Array(n));
  const vehicle = take(Uint32Array, n, 4);
  const first = new Uint32Array(n + 1);
  first.set(take(Uint32Array, n, 4));
  first[n] = m;
  return {
    vehicle,
    first,
    time: take(Float32Array, m, 4),
    x: take(Uint16Array, m, 2),
    y: take(Uint16Array, m, 2),
    state: take(Uint8Array, n, 1),
    axis: take(Uint8Array, n, 1),
    gap: take(Uint8Array, m, 1),
    kind: takeMeasured(),
    percent: takeMeasured(),
    length: takeMeasured(),
  };
}

export class Replay implements Painter {
  time_s = 0;
  playing = false;
  rate = 1;
  selected: number | null = null;
  private readonly chunks = new Map<number, Chunk | Promise<void>>();
  private last = 0;

  constructor(
    private readonly run: Run,
    /** Speed of the last colour, px/s. */
    private readonly colourMax: number,
    private readonly changed: (ended: boolean) => void,
    private readonly fail: (error: unknown) => void,
  ) {}

  get duration_s(): number {
    return this.run.last_time_s - this.run.first_time_s;
  }

  play(playing: boolean): void {
    if (playing && this.time_s >= this.duration_s) this.time_s = 0;
    this.playing = playing;
    this.last = performance.now();
  }

  paint(context: CanvasRenderingContext2D, view: View, now: number, painted: Blocks): boolean {
    const chunk = this.chunk(this.time_s);
    if (this.playing && chunk) this.advance(now);
    this.last = now;
    if (!chunk) return true; // on its way
    this.draw(context, view, this.at(chunk), painted);
    return this.playing;
  }

  private advance(now: number): void {
    this.time_s = Math.min(this.time_s + (Math.min(now - this.last, 250) / 1000) * this.rate, this.duration_s);
    const ended = this.time_s >= this.duration_s;
    if (ended) this.playing = false;
    this.changed(ended);
  }

  /** The vehicle nearest to a point, within `reach` px. */
  near(point: Point, reach: number): Seen | null {
    let [found, best]: [Seen | null, number] = [null, reach];
    for (const seen of this.now()) {
      const distance = Math.hypot(seen.x - point.x, seen.y - point.y);
      if (distance <= best) [found, best] = [seen, distance];
    }
    return found;
  }

  /** All vehicles at the present time; empty until they are read. */
  now(): Seen[] {
    const chunk = this.chunk(this.time_s);
    return chunk ? this.at(chunk) : [];
  }

  private chunk(time_s: number): Chunk | null {
    const { chunk_s, chunks } = this.run.replay;
    const k = Math.min(Math.floor(time_s / chunk_s), chunks - 1);
    if (k + 1 < chunks && this.playing) this.need(k + 1);
    const known = this.need(k);
    return known instanceof Promise ? null : known;
  }

  private need(k: number): Chunk | Promise<void> {
    const known = this.chunks.get(k);
    if (known) {
      this.chunks.delete(k); // to the end: used last
      this.chunks.set(k, known);
      return known;
    }
    const asked = fetchFile(`view/replay/${k}.bin`)
      .then(async (file) => void this.chunks.set(k, parse(await file.arrayBuffer())))
      .catch((error) => {
        this.chunks.delete(k);
        this.playing = false;
        this.fail(error);
      });
    this.chunks.set(k, asked);
    if (this.chunks.size > CHUNKS_KEPT) this.chunks.delete(this.chunks.keys().next().value!);
    return asked;
  }

  private at(chunk: Chunk): Seen[] {
    const found: Seen[] = [];
    for (let v = 0; v < chunk.vehicle.length; v++) {
      const k = before(chunk, v, this.time_s);
      if (k >= 0) found.push(this.seen(chunk, v, k));
    }
    return found;
  }

  private seen(chunk: Chunk, v: number, k: number): Seen {
    const [x, y] = this.position(chunk, k, this.time_s);
    const [first, last] = [chunk.first[v]!, chunk.first[v + 1]! - 1];
    const from = Math.max(this.time_s - SPEED_S, chunk.time[first]!);
    const to = Math.min(this.time_s + SPEED_S, chunk.time[last]!);
    const [x0, y0] = this.position(chunk, before(chunk, v, from), from);
    const [x1, y1] = this.position(chunk, before(chunk, v, to), to);
    const span = Math.max(to - from, 1e-6);
    const state = this.run.replay.states[chunk.state[v]!]!;
    const axis = ((chunk.axis[v]! + 0.5) * Math.PI) / 256;
    const [vx, vy] = [(x1 - x0) / span, (y1 - y0) / span];
    return { vehicle: chunk.vehicle[v]!, x, y, vx, vy, state, gap: chunk.gap[k] === 1, axis, measured: this.measured(chunk, v) };
  }

  private measured({ kind, percent, length }: Chunk, v: number): Seen["measured"] {
    const name = this.run.replay.classes[kind[v]! - 1];
    return name === undefined ? null : { kind: name, percent: percent[v]!, length_m: length[v]! / 10 };
  }

  /** Where it is at a time, from position k to the next. */
  private position({ time, x, y }: Chunk, k: number, time_s: number): [number, number] {
    const step = this.run.replay.step_px;
    const fraction = Math.min(Math.max((time_s - time[k]!) / (time[k + 1]! - time[k]!), 0), 1);
    const between = (values: Uint16Array): number => (values[k]! + fraction * (values[k + 1]! - values[k]!)) * step - 0.5;
    return [between(x), between(y)];
  }

  private draw(context: CanvasRenderingContext2D, view: View, vehicles: Seen[], painted: Blocks): void {
    const { scale, left, top, width, height } = view;
    const ofCar = Math.max(MIN_SCREEN_PX, scale * (this.run.gsd_m === null ? UNKNOWN_LENGTH_PX : LENGTH_M / this.run.gsd_m));
    const wide = (ofCar * WIDTH_M) / LENGTH_M;
    for (const seen of vehicles) {
      const length = seen.measured === null ? ofCar : (ofCar * Math.max(seen.measured.length_m, 2 * WIDTH_M)) / LENGTH_M;
      const [x, y] = [(seen.x + 0.5) * scale + left, (seen.y + 0.5) * scale + top];
      if (x < -length || y < -length || x > width + length || y > height + length) continue;
      painted.mark(x, y, length / 2 + LINE_PX);
      const speed = Math.hypot(seen.vx, seen.vy);
      const moves = speed > this.run.stationary_speed_px_per_s;
      context.save();
      context.translate(x, y);
      context.rotate(moves ? Math.atan2(seen.vy, seen.vx) : seen.axis);
      outline(context, length, wide, moves);
      context.restore();
      context.globalAlpha = seen.gap ? 0.5 : 1;
      context.fillStyle = seen.state === PARKED ? "#9aa0a8" : rampColour(speed / this.colourMax);
      context.fill();
      context.lineWidth = seen.vehicle === this.selected ? 3 : 1;
      context.strokeStyle = seen.vehicle === this.selected ? "#fff" : "#000";
      context.stroke();
      context.globalAlpha = 1;
    }
    const chosen = vehicles.find(({ vehicle }) => vehicle === this.selected);
    if (chosen) this.drawTrail(context, view, chosen, painted);
  }

  private drawTrail(context: CanvasRenderingContext2D, { scale, left, top }: View, seen: Seen, painted: Blocks): void {
    const chunk = this.chunk(this.time_s);
    const v = chunk ? chunk.vehicle.indexOf(seen.vehicle) : -1;
    if (!chunk || v < 0) return;
    let [x, y] = [(seen.x + 0.5) * scale + left, (seen.y + 0.5) * scale + top];
    context.beginPath();
    context.moveTo(x, y);
    for (let k = before(chunk, v, this.time_s); k >= chunk.first[v]! && chunk.time[k]! > this.time_s - TRAIL_S; k--) {
      const step = this.run.replay.step_px * scale;
      const [fromX, fromY] = [chunk.x[k]! * step + left, chunk.y[k]! * step + top];
      painted.mark((x + fromX) / 2, (y + fromY) / 2, Math.hypot(x - fromX, y - fromY) / 2 + LINE_PX);
      [x, y] = [fromX, fromY];
      context.lineTo(x, y);
    }
    context.lineWidth = 2;
    context.strokeStyle = "#fff";
    context.stroke();
  }
}

/** The position of vehicle v before a time that has another after it; -1 where it was not there. */
function before({ first, time }: Chunk, v: number, time_s: number): number {
  let [low, high] = [first[v]!, first[v + 1]! - 1];
  if (time_s < time[low]! || time_s > time[high]!) return -1;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (time[middle]! <= time_s) low = middle;
    else high = middle;
  }
  return low;
}

/** A box whose front is pointed where the way it goes is known. */
function outline(context: CanvasRenderingContext2D, length: number, wide: number, pointed: boolean): void {
  const [front, side] = [length / 2, wide / 2];
  context.beginPath();
  context.moveTo(-front, -side);
  context.lineTo(pointed ? front - side : front, -side);
  if (pointed) context.lineTo(front, 0);
  context.lineTo(pointed ? front - side : front, side);
  context.lineTo(-front, side);
  context.closePath();
}
