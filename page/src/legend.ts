// What the colours mean: a wheel of directions or a bar of numbers.

import { gradient, paintDirection } from "./colours";
import { ink, make, surface } from "./dom";
import type { Layer, Run } from "./run";
import { roundUp, ticks, type Units } from "./units";

const WHEEL_PX = 132;

export interface Legend {
  element: HTMLElement;
  /** Where the colours end, in stored units. */
  top: number;
}

export function makeLegend(layer: Layer, run: Run, units: Units): Legend {
  if (layer.kind === "direction") return { element: wheel(layer, run), top: layer.top };
  const { factor, unit } = units.shown(layer);
  const end = layer.kind === "share" ? 100 : roundUp(layer.top * factor);
  const about = make("p", { class: "note" }, layer.about, clipped(layer, end, factor, unit));
  return { element: make("div", {}, bar(layer, end, unit), about), top: end / factor };
}

/** A few values that are far above all others would flatten the colours: what is said of those that are cut off. */
function clipped(layer: Layer, end: number, factor: number, unit: string): string {
  const highest = layer.highest * factor;
  if (!(highest > end * (1 + 1e-6))) return "";
  const most = `${+highest.toPrecision(3)}${unit && ` ${unit}`}`;
  return ` Above ${+end.toPrecision(4)} all has the last colour; the highest is ${most}.`;
}

function bar(layer: Layer, end: number, unit: string): HTMLElement {
  const change = layer.kind === "change";
  const strip = make("div", { class: "strip" });
  strip.style.background = gradient(change);
  const values = change ? [-end, -end / 2, 0, end / 2, end] : ticks(end);
  const labels = values.map((value) => {
    const text = `${+value.toPrecision(4)}`.replace("-", "−");
    const label = make("span", {}, change && value > 0 ? `+${text}` : text);
    label.style.left = `${change ? 50 + (50 * value) / end : (100 * value) / end}%`;
    return label;
  });
  return make("div", { class: "bar" }, strip, make("div", { class: "ticks" }, ...labels), make("p", { class: "unit" }, unit));
}

/** A ring coloured by direction; it stands as the map does. */
function wheel(layer: Layer, run: Run): HTMLElement {
  const { canvas, context } = surface(WHEEL_PX, WHEEL_PX, "Colour wheel: the hue of each direction of travel");
  const scale = canvas.width / WHEEL_PX;
  const picture = context.createImageData(canvas.width, canvas.width);
  const centre = canvas.width / 2;
  const [inner, outer] = [26 * scale, 46 * scale];
  for (let y = 0, at = 0; y < canvas.width; y++) {
    for (let x = 0; x < canvas.width; x++, at += 4) {
      const [dx, dy] = [x + 0.5 - centre, y + 0.5 - centre];
      const edge = Math.min(Math.hypot(dx, dy) - inner, outer - Math.hypot(dx, dy));
      if (edge <= 0) continue;
      paintDirection(picture.data, at, Math.atan2(dy, dx));
      picture.data[at + 3] = 255 * Math.min(edge, 1);
    }
  }
  context.putImageData(picture, 0, 0);
  drawArrows(context);
  context.fillStyle = ink("--ink");
  context.font = "600 13px system-ui, sans-serif";
  context.textAlign = "center";
  context.textBaseline = "middle";
  const north = run.north_rad;
  const names: [string, number][] =
    north === null ? [["up", -Math.PI / 2]] : [..."NESW"].map((name, k) => [name, north + (k * Math.PI) / 2]);
  for (const [name, angle] of names) context.fillText(name, at(angle, 56), at(angle - Math.PI / 2, 56));
  const note = north === null ? `${layer.about} North is not known: up is the picture's.` : layer.about;
  return make("div", { class: "wheel" }, canvas, make("p", { class: "note" }, note));
}

const at = (angle: number, radius: number): number => WHEEL_PX / 2 + radius * Math.cos(angle);

function drawArrows(context: CanvasRenderingContext2D): void {
  context.strokeStyle = ink("--faint");
  context.lineWidth = 1.5;
  for (let k = 0; k < 4; k++) {
    context.save();
    context.translate(WHEEL_PX / 2, WHEEL_PX / 2);
    context.rotate((k * Math.PI) / 2);
    context.beginPath();
    context.moveTo(5, 0);
    context.lineTo(20, 0);
    context.moveTo(15, -4);
    context.lineTo(20, 0);
    context.lineTo(15, 4);
    context.stroke();
    context.restore();
  }
}
