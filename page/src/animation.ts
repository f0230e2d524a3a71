// A canvas over the map that follows it, and the loop that paints moving things on it.

import type L from "leaflet";

/** Base pixels to CSS pixels of the map: x * scale + left. */
export interface View {
  scale: number;
  left: number;
  top: number;
  width: number;
  height: number;
}

export interface Painter {
  /** Paint at a time (ms); true: something moves, paint again. */
  paint(context: CanvasRenderingContext2D, view: View, now: number): boolean;
}

const MAX_CANVAS_PX = 6e6; // a larger screen gets a coarser canvas

export const reducedMotion = (): boolean => window.matchMedia("(prefers-reduced-motion: reduce)").matches;

export class Animation {
  private readonly canvas = document.createElement("canvas");
  private readonly context = this.canvas.getContext("2d")!;
  private readonly painters: Painter[] = [];
  private requested = false;
  private zooming = false;
  private empty = true;
  private times: number[] = [];

  constructor(private readonly map: L.Map) {
    this.canvas.className = "animation";
    this.canvas.setAttribute("aria-hidden", "true");
    map.getContainer().append(this.canvas);
    map.on("resize", () => this.resize());
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
    const ratio = Math.min(window.devicePixelRatio || 1, Math.sqrt(MAX_CANVAS_PX / Math.max(x * y, 1)));
    this.canvas.width = Math.max(1, Math.round(x * ratio));
    this.canvas.height = Math.max(1, Math.round(y * ratio));
    this.canvas.style.width = `${x}px`;
    this.canvas.style.height = `${y}px`;
    this.request();
  }

  private paint(now: number): void {
    this.requested = false;
    if (this.zooming) return;
    const view = this.view();
    if (!this.painters.length && this.empty) return;
    this.context.setTransform(1, 0, 0, 1, 0, 0);
    this.context.clearRect(0, 0, this.canvas.width, this.canvas.height);
    this.empty = !this.painters.length;
    const ratio = this.canvas.width / Math.max(view.width, 1);
    this.context.setTransform(ratio, 0, 0, ratio, 0, 0);
    const moves = this.painters.map((painter) => painter.paint(this.context, view, now));
    this.count(now);
    if (moves.includes(true)) this.request();
    else this.times = [];
  }

  /** Frames a second over the last sixty frames, for measurements. */
  private count(now: number): void {
    this.times.push(now);
    if (this.times.length > 61) this.times.shift();
    const [first, n] = [this.times[0]!, this.times.length];
    if (n > 10) this.canvas.dataset.framesPerSecond = ((1000 * (n - 1)) / (now - first)).toFixed(1);
  }
}
