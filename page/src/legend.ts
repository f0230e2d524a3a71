// The legend: a wheel of directions or a bar of numbers.

import { gradient, paintDirection } from "./colours";
import { ink, make, surface } from "./dom";
import type { Layer, Run } from "./run";
import { roundUp, ticks, type Units } from "./units";

const WHEEL_PX = 132;

export interface Legend {
  element: HTMLElement;
  /** Value of the last colour, in stored units. */
  colourMax: number;
}

export function makeLegend(layer: Layer, run: Run, units: Units): Legend {
  if (layer.kind === "direction") return { element: wheel(layer, run), colourMax: layer.colour_max };
  const { factor, unit } = units.shown(layer);
  const end = layer.kind === "fraction" ? 100 : roundUp(layer.colour_max * factor);
  const note = make("p", { class: "note" }, layer.description, clipped(layer, end, factor, unit));
  return { element: make("div", {}, bar(layer, end, unit), note), colourMax: end / factor };
}

/** The note on values above the last colour: outliers would compress the scale of all others. */
function clipped(layer: Layer, end: number, factor: number, unit: string): string {
  const largest = layer.data_max * factor;
  if (!(largest > end * (1 + 1e-6))) return "";
  const maximum = `${+largest.toPrecision(3)}${unit && ` ${unit}`}`;
  return ` Values above ${+end.toPrecision(4)} have the last colour; the maximum is ${maximum}.`;
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

/** A ring coloured by direction, oriented as the map. */
function wheel(layer: Layer, run: Run): HTMLElement {
  const { canvas, context } = surface(WHEEL_PX, WHEEL_PX, "Colour wheel: the hue of each direction of travel");
  const scale = canvas.width / WHEEL_PX;
  const image = context.createImageData(canvas.width, canvas.width);
  const centre = canvas.width / 2;
  const [inner, outer] = [26 * scale, 46 * scale];
  for (let y = 0, at = 0; y < canvas.width; y++) {
    for (let x = 0; x < canvas.width; x++, at += 4) {
      const [dx, dy] = [x + 0.5 - centre, y + 0.5 - centre];
      const edge = Math.min(Math.hypot(dx, dy) - inner, outer - Math.hypot(dx, dy));
      if (edge <= 0) continue;
      paintDirection(image.data, at, Math.atan2(dy, dx));
      image.data[at + 3] = 255 * Math.min(edge, 1);
    }
  }
  context.putImageData(image, 0, 0);
  drawArrows(context);
  context.fillStyle = ink("--ink");
  context.font = "600 13px system-ui, sans-serif";
  context.textAlign = "center";
  context.textBaseline = "middle";
  const north = run.north_rad;
  const names: [string, number][] =
    north === null ? [["up", -Math.PI / 2]] : [..."NESW"].map((name, k) => [name, north + (k * Math.PI) / 2]);
  for (const [name, angle] of names) context.fillText(name, at(angle, 56), at(angle - Math.PI / 2, 56));
  const note = north === null ? `${layer.description} North is not known: up is the top of the image.` : layer.description;
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
