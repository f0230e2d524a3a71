// A canvas over the map that follows it, and the loop that paints moving things on it.

import type L from "leaflet";
import { Backdrop } from "./backdrop";

/** Base pixels to CSS pixels of the map: x * scale + left. */
export interface View {
  scale: number;
  left: number;
  top: number;
  width: number;
  height: number;
}

export interface Painter {
  /** Paint at a time (ms), and mark where; true: something moves, paint again. */
  paint(context: CanvasRenderingContext2D, view: View, now: number, painted: Blocks): boolean;
}

const BLOCK_PX = 64;

/** Which blocks of the canvas were painted: to clear those alone takes a third of the time of clearing all of it. */
export class Blocks {
  private readonly marked = new Set<number>();

  /** Mark the blocks within `reach` of a point, CSS px. */
  mark(x: number, y: number, reach: number): void {
    const [right, bottom] = [Math.floor((x + reach) / BLOCK_PX), Math.floor((y + reach) / BLOCK_PX)];
    for (let j = Math.floor((y - reach) / BLOCK_PX); j <= bottom; j++) {
      for (let i = Math.floor((x - reach) / BLOCK_PX); i <= right; i++) {
        if (i >= 0 && j >= 0 && i < ROW_BLOCKS) this.marked.add(j * ROW_BLOCKS + i);
      }
    }
  }

  /** Clear them, on a canvas of `ratio` pixels a CSS pixel: whole pixels, as a part of one is not cleared whole. */
  clear(context: CanvasRenderingContext2D, ratio: number): void {
    context.setTransform(1, 0, 0, 1, 0, 0);
    const edge = (k: number): number => Math.floor(k * BLOCK_PX * ratio);
    for (const block of this.marked) {
      const [i, j] = [block % ROW_BLOCKS, Math.floor(block / ROW_BLOCKS)];
      context.clearRect(edge(i), edge(j), edge(i + 1) - edge(i), edge(j + 1) - edge(j));
    }
    this.marked.clear();
  }
}

const ROW_BLOCKS = 1 << 10;

const MAX_CANVAS_PX = 6e6; // a larger screen gets a coarser canvas
const MIN_CANVAS_PX = 1.2e6; // as coarse as a slow machine's may become
const [SLOW_PER_S, COARSER] = [50, 0.75]; // fewer frames a second make the canvas coarser
const BREAK_MS = 250; // a longer pause is no slow frame: the tab was hidden

export const reducedMotion = (): boolean => window.matchMedia("(prefers-reduced-motion: reduce)").matches;

export class Animation {
  private readonly canvas = document.createElement("canvas");
  private readonly context = this.canvas.getContext("2d")!;
  private readonly backdrop: Backdrop;
  private readonly painted = new Blocks();
  private readonly painters: Painter[] = [];
  private requested = false;
  private zooming = false;
  private empty = true;
  private times: number[] = [];
  private fineness = 1;

  constructor(private readonly map: L.Map) {
    this.canvas.className = "animation";
    this.canvas.setAttribute("aria-hidden", "true");
    map.getContainer().append(this.canvas);
    this.backdrop = new Backdrop(map);
    map.on("resize", () => {
      this.fineness = 1;
      this.resize();
    });
    map.on("move", () => this.request());
    map.on("zoomstart", () => this.setZooming(true));
    map.on("zoomend", () => this.setZooming(false));
    this.resize();
  }

  add(painter: Painter): void {
    if (!this.painters.includes(painter)) this.painters.push(painter);
    this.request();
  }

  remove(painter: Painter): void {
    const at = this.painters.indexOf(painter);
    if (at >= 0) this.painters.splice(at, 1);
    this.request();
  }

  request(): void {
    if (this.requested) return;
    this.requested = true;
    requestAnimationFrame((now) => this.paint(now));
  }

  /** Show or hide the canvas; nothing is painted on a hidden one. */
  show(shown: boolean): void {
    this.canvas.hidden = !shown;
    if (!shown) this.backdrop.hide();
    this.request();
  }

  view(): View {
    const { x, y } = this.map.latLngToContainerPoint([0, 0]);
    const { x: width, y: height } = this.map.getSize();
    return { scale: this.map.getZoomScale(this.map.getZoom(), 0), left: x, top: y, width, height };
  }

  private setZooming(zooming: boolean): void {
    this.zooming = zooming;
    this.canvas.style.visibility = zooming ? "hidden" : "";
    this.request();
  }

  private resize(): void {
    const { x, y } = this.map.getSize();
    const limit = (pixels: number): number => Math.sqrt(pixels / Math.max(x * y, 1));
    const finest = Math.min(window.devicePixelRatio || 1, limit(MAX_CANVAS_PX));
    const ratio = Math.max(finest * this.fineness, Math.min(finest, limit(MIN_CANVAS_PX)));
    this.canvas.width = Math.max(1, Math.round(x * ratio));
    this.canvas.height = Math.max(1, Math.round(y * ratio));
    this.canvas.style.width = `${x}px`;
    this.canvas.style.height = `${y}px`;
    this.request();
  }

  private paint(now: number): void {
    this.requested = false;
    if (this.zooming || this.canvas.hidden) return;
    const view = this.view();
    if (!this.painters.length && this.empty) return;
    const ratio = this.canvas.width / Math.max(view.width, 1);
    this.painted.clear(this.context, ratio);
    this.context.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.empty = !this.painters.length;
    const moves = this.painters.map((painter) => painter.paint(this.context, view, now, this.painted));
    this.count(now);
    if (moves.includes(true)) {
      this.backdrop.follow();
      this.request();
    } else {
      this.backdrop.hide();
      this.times = [];
    }
  }

  /** Frames a second over the last sixty frames, for measurements. */
  private count(now: number): void {
    if (now - this.times[this.times.length - 1]! > BREAK_MS) this.times = [];
    this.times.push(now);
    if (this.times.length > 61) this.times.shift();
    const [first, n] = [this.times[0]!, this.times.length];
    if (n <= 10) return;
    const perSecond = (1000 * (n - 1)) / (now - first);
    this.canvas.dataset.framesPerSecond = perSecond.toFixed(1);
    if (n > 30 && perSecond < SLOW_PER_S) this.coarsen();
  }

  /** Fewer pixels to paint, where this machine is slow (most often one without a graphics card). */
  private coarsen(): void {
    const before = this.canvas.width;
    this.fineness *= COARSER;
    this.resize();
    if (this.canvas.width < before) this.times = [];
    else this.fineness /= COARSER; // as coarse as it may be
  }
}
