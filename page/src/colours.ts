// The two colour scales of velfield/report/colours.py, handed over with the page: a wheel and a ramp.

import { find } from "./dom";
import type { Layer } from "./run";

type Scale = Uint8Array; // r, g, b, r, g, b, ...

function parse(hex: string): Scale {
  const scale = new Uint8Array(hex.length / 2);
  for (let k = 0; k < scale.length; k++) scale[k] = parseInt(hex.slice(2 * k, 2 * k + 2), 16);
  return scale;
}

const scales = JSON.parse(find("colours").textContent!) as { wheel: string; ramp: string };
const wheel = parse(scales.wheel);
const ramp = parse(scales.ramp);
const COOL = [44, 123, 182];
const WARM = [215, 48, 39];

function put(target: Uint8ClampedArray, at: number, scale: Scale, step: number): void {
  target[at] = scale[3 * step]!;
  target[at + 1] = scale[3 * step + 1]!;
  target[at + 2] = scale[3 * step + 2]!;
  target[at + 3] = 255;
}

export function paintDirection(target: Uint8ClampedArray, at: number, directionRad: number): void {
  const steps = wheel.length / 3;
  const step = Math.floor((directionRad / (2 * Math.PI)) * steps + 0.5);
  put(target, at, wheel, ((step % steps) + steps) % steps);
}

export function paintRamp(target: Uint8ClampedArray, at: number, fraction: number): void {
  const last = ramp.length / 3 - 1;
  put(target, at, ramp, Math.round(Math.min(Math.max(fraction, 0), 1) * last));
}

/** CSS colour of a fraction of the ramp. */
export function rampColour(fraction: number): string {
  const step = 3 * Math.round(Math.min(Math.max(fraction, 0), 1) * (ramp.length / 3 - 1));
  return `rgb(${ramp[step]} ${ramp[step + 1]} ${ramp[step + 2]})`;
}

/** Decrease is blue, increase is red, no change is pale. */
export function paintChange(target: Uint8ClampedArray, at: number, fraction: number): void {
  const strength = Math.sqrt(Math.min(Math.abs(fraction), 1));
  const end = fraction < 0 ? COOL : WARM;
  for (let k = 0; k < 3; k++) target[at + k] = 245 + (end[k]! - 245) * strength;
  target[at + 3] = 255;
}

/** Paints the pixel at `at` with a layer's value there; unknown values are not painted. */
export type Painter = (target: Uint8ClampedArray, at: number, a: number, b: number) => void;

/** How a layer's values become colours; `colourMax` in stored units. */
export function painter(layer: Layer, colourMax: number, stationarySpeed: number): Painter {
  if (layer.kind === "direction") {
    return (target, at, vx, vy) => {
      if (Math.hypot(vx, vy) > stationarySpeed) paintDirection(target, at, Math.atan2(vy, vx));
    };
  }
  const paint = layer.kind === "change" ? paintChange : paintRamp;
  const zeroIsNothing = layer.kind === "count" || layer.kind === "time";
  return (target, at, a, b) => {
    const value = layer.arrays.length === 2 ? Math.hypot(a, b) : a;
    if (Number.isFinite(value) && !(zeroIsNothing && value === 0)) paint(target, at, value / colourMax);
  };
}

/** CSS gradient of a bar's colours, left to right. */
export function gradient(change: boolean): string {
  const colour = new Uint8ClampedArray(4);
  const stops = Array.from({ length: 33 }, (_, k) => {
    if (change) paintChange(colour, 0, (k - 16) / 16);
    else paintRamp(colour, 0, k / 32);
    return `rgb(${colour[0]} ${colour[1]} ${colour[2]})`;
  });
  return `linear-gradient(to right, ${stops.join(", ")})`;
}
