// The velocity distribution of a pixel as a polar plot: the radius is speed, the angle the direction on the map.

import { paintRamp } from "./colours";
import { ink, surface } from "./dom";
import type { Mode } from "./modes";
import type { Run } from "./run";
import { ticks, type Units } from "./units";

const SIDE = 264;
const MARGIN = 16;

export function polarPlot(h: Int32Array, modes: Mode[], run: Run, units: Units): HTMLCanvasElement {
  const { canvas, context } = surface(SIDE, SIDE, "Polar plot of the velocity distribution at this pixel");
  const centre = (run.bins - 1) / 2;
  const reach = Math.min(occupiedReach(h, run.bins) + 1, centre + 0.5);
  const radius = SIDE / 2 - MARGIN;
  paintDistribution(context, canvas, h, run.bins, reach);
  const perBin = run.bin_width_px_per_s * units.perPxPerS;
  drawRings(context, reach * perBin, radius, units.speed);
  drawNames(context, run);
  drawModes(context, modes, centre, radius / reach);
  return canvas;
}

/** Radius of the distribution about zero, bins; at least four, so that stationary vehicles are seen to be at rest. */
function occupiedReach(h: Int32Array, n: number): number {
  const largest = h.reduce((a, b) => Math.max(a, b), 0);
  const centre = (n - 1) / 2;
  let reach = 4;
  for (let k = 0; k < h.length; k++) {
    if (h[k]! > 0.02 * largest) reach = Math.max(reach, Math.hypot((k % n) - centre, Math.floor(k / n) - centre));
  }
  return reach;
}

/** Weight as colour and opacity, bilinear between bins, within the outer ring. */
function paintDistribution(
  context: CanvasRenderingContext2D,
  canvas: HTMLCanvasElement,
  h: Int32Array,
  n: number,
  reach: number,
): void {
  const side = canvas.width;
  const radius = (side * (SIDE / 2 - MARGIN)) / SIDE;
  const image = context.createImageData(side, side);
  const largest = h.reduce((a, b) => Math.max(a, b), 1);
  const centre = (n - 1) / 2;
  for (let j = 0, at = 0; j < side; j++) {
    for (let i = 0; i < side; i++, at += 4) {
      const [dx, dy] = [(i + 0.5 - side / 2) / radius, (j + 0.5 - side / 2) / radius];
      if (dx * dx + dy * dy > 1) continue;
      const weight = bilinear(h, n, centre + dx * reach, centre + dy * reach) / largest;
      if (weight < 0.004) continue;
      paintRamp(image.data, at, Math.sqrt(weight));
      image.data[at + 3] = 255 * Math.min(1, 4 * Math.sqrt(weight));
    }
  }
  context.putImageData(image, 0, 0);
}

function bilinear(h: Int32Array, n: number, x: number, y: number): number {
  const [i, j] = [Math.floor(x), Math.floor(y)];
  const [u, v] = [x - i, y - j];
  const value = (a: number, b: number): number => (a < 0 || b < 0 || a >= n || b >= n ? 0 : h[b * n + a]!);
  return (
    (1 - v) * ((1 - u) * value(i, j) + u * value(i + 1, j)) + v * ((1 - u) * value(i, j + 1) + u * value(i + 1, j + 1))
  );
}

function drawRings(context: CanvasRenderingContext2D, top: number, radius: number, unit: string): void {
  context.strokeStyle = ink("--faint");
  context.globalAlpha = 0.55;
  context.lineWidth = 1;
  const rings = ticks(top).slice(1);
  for (const ring of [...rings, top]) {
    context.beginPath();
    context.arc(SIDE / 2, SIDE / 2, (ring / top) * radius, 0, 2 * Math.PI);
    context.stroke();
  }
  context.beginPath();
  context.moveTo(SIDE / 2 - radius, SIDE / 2);
  context.lineTo(SIDE / 2 + radius, SIDE / 2);
  context.moveTo(SIDE / 2, SIDE / 2 - radius);
  context.lineTo(SIDE / 2, SIDE / 2 + radius);
  context.stroke();
  context.globalAlpha = 1;
  context.font = "11px system-ui, sans-serif";
  context.textAlign = "left";
  context.textBaseline = "bottom";
  const diagonal = Math.SQRT1_2 * radius;
  rings.forEach((ring, k) => {
    const offset = (ring / top) * diagonal;
    label(context, k === rings.length - 1 ? `${ring} ${unit}` : `${ring}`, SIDE / 2 + offset + 2, SIDE / 2 - offset - 1);
  });
}

function drawNames(context: CanvasRenderingContext2D, run: Run): void {
  const north = run.north_rad;
  const names: [string, number][] =
    north === null ? [["up", -Math.PI / 2]] : [..."NESW"].map((name, k) => [name, north + (k * Math.PI) / 2]);
  context.font = "600 12px system-ui, sans-serif";
  context.textAlign = "center";
  context.textBaseline = "middle";
  const radius = SIDE / 2 - MARGIN / 2;
  for (const [name, angle] of names) {
    label(context, name, SIDE / 2 + radius * Math.cos(angle), SIDE / 2 + radius * Math.sin(angle));
  }
}

/** Circles in the order of their weight, with their number. */
function drawModes(context: CanvasRenderingContext2D, modes: Mode[], centre: number, scale: number): void {
  context.font = "600 12px system-ui, sans-serif";
  context.textAlign = "left";
  context.textBaseline = "middle";
  modes.forEach((mode, k) => {
    const [x, y] = [SIDE / 2 + (mode.x - centre) * scale, SIDE / 2 + (mode.y - centre) * scale];
    for (const [width, colour] of [
      [4, ink("--card")],
      [1.5, ink("--ink")],
    ] as const) {
      context.lineWidth = width;
      context.strokeStyle = colour;
      context.beginPath();
      context.arc(x, y, 6, 0, 2 * Math.PI);
      context.stroke();
    }
    label(context, `${k + 1}`, x + 10, y);
  });
}

/** Text with a halo: for text over colours. */
function label(context: CanvasRenderingContext2D, text: string, x: number, y: number): void {
  context.lineWidth = 3;
  context.lineJoin = "round";
  context.strokeStyle = ink("--card");
  context.strokeText(text, x, y);
  context.fillStyle = ink("--ink");
  context.fillText(text, x, y);
}
