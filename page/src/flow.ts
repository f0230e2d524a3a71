// Particles that move through the field. Each draws its velocity from the distribution where it is (view/flow.bin).

import type { Blocks, Painter, View } from "./animation";
import { fetchFile, type Run } from "./run";

const MAX_PARTICLES = 2500;
const ROAD_PX2 = 220; // screen pixels of road for each particle
const LIFE_S = [2, 5] as const;
const REDRAW_S = 0.25; // a vehicle keeps its speed for so long
const TURN_S = 0.15; // time in which a particle takes on a new velocity
const TAIL_S = 0.3;
const LINE_PX = 3.4;
const SCREEN_PX_PER_S = 45; // of a vehicle at 60 px/s in the map, at least
const STILL_BINS = 1.5; // the kernel blurs the velocities of a stationary vehicle over the bins around zero
const MIN_ALONG = 0.5; // cosine: a particle draws among the velocities that go its way
const SAME_WAY = 0.9; // cosine: a draw is a bin of several degrees, the mean of those around it is finer

interface Cells {
  /** Row of each cell of the grid, -1 where no vehicle passed. */
  row: Int32Array;
  cell: Uint32Array;
  vehicles: Uint8Array;
  /** Draws of each row by increasing speed: vx, vy. */
  draws: Float32Array;
}

interface Particle {
  x: number;
  y: number;
  vx: number;
  vy: number;
  /** Velocity drawn, which it takes on. */
  toX: number;
  toY: number;
  tailX: number;
  tailY: number;
  /** Fraction of vehicles that are slower than this one. */
  rank: number;
  left_s: number;
  redraw_s: number;
}

export class Flow implements Painter {
  private cells: Cells | undefined;
  private particles: Particle[] = [];
  private spawn: { key: string; rows: number[]; until: number[] } = { key: "", rows: [], until: [] };
  private last = 0;
  private readonly columns: number;
  private readonly rows: number;

  constructor(private readonly run: Run) {
    this.columns = Math.ceil(run.width_px / run.flow.cell_px);
    this.rows = Math.ceil(run.height_px / run.flow.cell_px);
  }

  /** Read the draws; the first time only. */
  async load(): Promise<void> {
    if (this.cells) return;
    const data = await (await fetchFile("view/flow.bin")).arrayBuffer();
    const { draws } = this.run.flow;
    const n = data.byteLength / (5 + 2 * draws);
    const cell = new Uint32Array(data, 0, n);
    const vehicles = new Uint8Array(data, 4 * n, n);
    const bins = new Uint16Array(data.slice(5 * n));
    const row = new Int32Array(this.columns * this.rows).fill(-1);
    cell.forEach((at, k) => (row[at] = k));
    this.cells = { row, cell, vehicles, draws: velocities(bins, this.run) };
  }

  /** How many times faster than the vehicles the particles move. */
  pace(scale: number): number {
    return Math.max(1, SCREEN_PX_PER_S / 60 / scale);
  }

  paint(context: CanvasRenderingContext2D, view: View, now: number, painted: Blocks): boolean {
    if (!this.cells) return false;
    const dt = Math.min((now - this.last) / 1000, 0.1);
    this.last = now;
    this.populate(view);
    const pace = this.pace(view.scale);
    for (const particle of this.particles) this.move(particle, dt, pace);
    this.particles = this.particles.filter(({ left_s }) => left_s > 0);
    this.draw(context, view, painted);
    return true;
  }

  /** Keep as many particles as the cells in view ask for; new ones start where vehicles pass, by their number. */
  private populate(view: View): void {
    const key = [view.scale, view.left, view.top, view.width, view.height].join();
    if (key !== this.spawn.key) this.spawn = { key, ...this.inView(view) };
    const road = this.spawn.rows.length * (this.run.flow.cell_px * view.scale) ** 2;
    const wanted = Math.min(MAX_PARTICLES, Math.ceil(road / ROAD_PX2));
    const first = this.particles.length === 0;
    while (this.particles.length < wanted) {
      const born = this.born();
      if (first) born.left_s *= Math.random();
      this.particles.push(born);
    }
  }

  private inView({ scale, left, top, width, height }: View): { rows: number[]; until: number[] } {
    const side = this.run.flow.cell_px;
    const [rows, until]: [number[], number[]] = [[], []];
    let sum = 0;
    this.cells!.cell.forEach((at, k) => {
      const x = (at % this.columns) * side * scale + left;
      const y = Math.floor(at / this.columns) * side * scale + top;
      if (x < -40 || y < -40 || x > width + 40 || y > height + 40) return;
      sum += this.cells!.vehicles[k]!;
      rows.push(k);
      until.push(sum);
    });
    return { rows, until };
  }

  private born(): Particle {
    const { rows, until } = this.spawn;
    const at = Math.random() * until[until.length - 1]!;
    let [low, high] = [0, until.length - 1];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (until[middle]! <= at) low = middle + 1;
      else high = middle;
    }
    const row = rows[low]!;
    const { draws } = this.run.flow;
    const drawn = row * draws + Math.floor(Math.random() * draws);
    const [vx, vy] = [this.cells!.draws[2 * drawn]!, this.cells!.draws[2 * drawn + 1]!];
    const side = this.run.flow.cell_px;
    const cell = this.cells!.cell[row]!;
    const x = ((cell % this.columns) + Math.random()) * side;
    const y = (Math.floor(cell / this.columns) + Math.random()) * side;
    const left_s = LIFE_S[0] + Math.random() * (LIFE_S[1] - LIFE_S[0]);
    return { x, y, vx, vy, toX: vx, toY: vy, tailX: x, tailY: y, rank: Math.random(), left_s, redraw_s: REDRAW_S };
  }

  private move(p: Particle, dt: number, pace: number): void {
    p.left_s -= dt;
    const turn = Math.min(1, dt / TURN_S);
    p.vx += (p.toX - p.vx) * turn;
    p.vy += (p.toY - p.vy) * turn;
    p.x += p.vx * dt * pace;
    p.y += p.vy * dt * pace;
    const follow = Math.min(1, dt / TAIL_S);
    p.tailX += (p.x - p.tailX) * follow;
    p.tailY += (p.y - p.tailY) * follow;
    p.redraw_s -= dt;
    if (p.redraw_s > 0) return;
    p.redraw_s = REDRAW_S / pace;
    this.redraw(p);
  }

  /** A velocity of the distribution here, among those that go its way: the same quantile of speed, near enough. */
  private redraw(p: Particle): void {
    const speed = Math.hypot(p.vx, p.vy);
    if (speed <= this.run.stationary_speed_px_per_s) return; // stays where it is
    const side = this.run.flow.cell_px;
    const [i, j] = [Math.floor(p.x / side), Math.floor(p.y / side)];
    const inside = i >= 0 && j >= 0 && i < this.columns && j < this.rows;
    const row = inside ? this.cells!.row[j * this.columns + i]! : -1;
    const { draws } = this.run.flow;
    const mine: number[] = [];
    for (let k = row * draws; row >= 0 && k < (row + 1) * draws; k++) {
      const [vx, vy] = [this.cells!.draws[2 * k]!, this.cells!.draws[2 * k + 1]!];
      const along = vx * p.vx + vy * p.vy;
      if (along > MIN_ALONG * speed * Math.hypot(vx, vy)) mine.push(k);
    }
    if (!mine.length) {
      p.left_s = Math.min(p.left_s, TAIL_S); // has left the roads
      return;
    }
    const place = p.rank * mine.length + 2 * (Math.random() - 0.5);
    const k = mine[Math.min(Math.max(Math.floor(place), 0), mine.length - 1)]!;
    [p.toX, p.toY] = this.refined(k, mine);
  }

  /** The speed of draw k, in the mean direction of those that go its way. */
  private refined(k: number, mine: number[]): [number, number] {
    const { draws } = this.cells!;
    const [vx, vy] = [draws[2 * k]!, draws[2 * k + 1]!];
    const speed = Math.hypot(vx, vy);
    let [x, y] = [0, 0];
    for (const m of mine) {
      const [ux, uy] = [draws[2 * m]!, draws[2 * m + 1]!];
      if (ux * vx + uy * vy < SAME_WAY * speed * Math.hypot(ux, uy)) continue;
      x += ux;
      y += uy;
    }
    const length = Math.hypot(x, y);
    return [(x / length) * speed, (y / length) * speed];
  }

  /** Dark below, light above: seen on any colour. */
  private draw(context: CanvasRenderingContext2D, { scale, left, top }: View, painted: Blocks): void {
    const path = new Path2D();
    for (const p of this.particles) {
      const [x, y] = [p.x * scale + left, p.y * scale + top];
      const [tailX, tailY] = [p.tailX * scale + left, p.tailY * scale + top];
      painted.mark((x + tailX) / 2, (y + tailY) / 2, Math.hypot(x - tailX, y - tailY) / 2 + LINE_PX);
      path.moveTo(tailX, tailY);
      path.lineTo(x + 0.01, y);
    }
    context.lineCap = "square"; // round ends take half as long again to paint in software
    for (const [width, colour] of [
      [LINE_PX, "rgb(0 0 0 / .5)"],
      [1.7, "#fff"],
    ] as const) {
      context.lineWidth = width;
      context.strokeStyle = colour;
      context.stroke(path);
    }
  }
}

/** (vx, vy) of every draw, px/s; those of a cell by increasing speed. */
function velocities(bins: Uint16Array, run: Run): Float32Array {
  const { draws } = run.flow;
  const centre = (run.bins - 1) / 2;
  const velocity = (bin: number): [number, number] => {
    const [i, j] = [(bin % run.bins) - centre, Math.floor(bin / run.bins) - centre];
    return Math.hypot(i, j) < STILL_BINS ? [0, 0] : [i * run.bin_width_px_per_s, j * run.bin_width_px_per_s];
  };
  const found = new Float32Array(2 * bins.length);
  for (let first = 0; first < bins.length; first += draws) {
    const sorted = Array.from(bins.subarray(first, first + draws), velocity);
    sorted.sort((a, b) => Math.hypot(...a) - Math.hypot(...b));
    sorted.forEach((v, k) => found.set(v, 2 * (first + k)));
  }
  return found;
}
