// Numbers as people say them.

import type { Layer, Run } from "./run";

export const SPEED_UNITS = { "km/h": 3.6, mph: 2.2369362920544, "m/s": 1 } as const;
export type SpeedUnit = keyof typeof SPEED_UNITS;

const POINTS = ["N", "NE", "E", "SE", "S", "SW", "W", "NW"];

export class Units {
  constructor(
    private readonly run: Run,
    public chosen: SpeedUnit,
  ) {}

  /** What speeds are shown in: pixels a second where metres are not known. */
  get speed(): string {
    return this.run.gsd_m === null ? "px/s" : this.chosen;
  }

  get perPxPerS(): number {
    return this.run.gsd_m === null ? 1 : this.run.gsd_m * SPEED_UNITS[this.chosen];
  }

  speedText(pxPerS: number, decimals = 1): string {
    return Number.isFinite(pxPerS) ? `${(pxPerS * this.perPxPerS).toFixed(decimals)} ${this.speed}` : "–";
  }

  /** Compass heading, clockwise from north, or from the picture's up where north is not known. */
  heading(directionRad: number): number {
    const degrees = ((directionRad - (this.run.north_rad ?? -Math.PI / 2)) * 180) / Math.PI;
    return ((degrees % 360) + 360) % 360;
  }

  /** "92° E"; without a known north the compass point would be a guess. */
  headingText(directionRad: number): string {
    if (!Number.isFinite(directionRad)) return "–";
    const heading = Math.round(this.heading(directionRad)) % 360;
    return this.run.north_rad === null ? `${heading}°` : `${heading}° ${POINTS[Math.round(heading / 45) % 8]}`;
  }

  get headingNote(): string {
    return this.run.north_rad === null ? "clockwise from the picture's up" : "clockwise from north";
  }

  time(seconds: number): string {
    const since = seconds - this.run.first_time_s;
    const minutes = Math.floor(since / 60);
    return minutes ? `${minutes} min ${(since - 60 * minutes).toFixed(1)} s` : `${since.toFixed(1)} s`;
  }

  /** Factor and unit that a layer's values are shown in. */
  shown(layer: Layer): { factor: number; unit: string } {
    if (layer.units === "px s-1") return { factor: this.perPxPerS, unit: this.speed };
    if (layer.units === "rad") return { factor: 180 / Math.PI, unit: "degrees" };
    if (layer.units === "ms") return { factor: 1e-3, unit: "s" };
    if (layer.kind === "share") return { factor: 100, unit: "%" };
    if (layer.units === "vehicles h-1") return { factor: 1, unit: "vehicles an hour" };
    return { factor: 1, unit: layer.kind === "count" ? "vehicles" : "" };
  }
}

/** The least of 1, 2, 3, 4, 5, 6, 8 times a power of ten that is not below. */
export function roundUp(value: number): number {
  const power = 10 ** Math.floor(Math.log10(value));
  return [1, 2, 3, 4, 5, 6, 8, 10].map((step) => step * power).find((step) => step >= value * (1 - 1e-9))!;
}

/** The largest of 1, 2 and 5 times a power of ten that is not above. */
export function roundDown(value: number): number {
  const power = 10 ** Math.floor(Math.log10(value));
  return [5, 2, 1].map((step) => step * power).find((step) => step <= value * (1 + 1e-9))!;
}

/** Round numbers from 0 to a round top, four to six of them. */
export function ticks(top: number): number[] {
  const step = [1, 2, 5, 10, 20, 50].map((s) => s * 10 ** (Math.floor(Math.log10(top)) - 1)).find((s) => top / s <= 5.01)!;
  return Array.from({ length: Math.floor(top / step + 1e-9) + 1 }, (_, k) => +(k * step).toPrecision(6));
}

/** As numpy's percentile: linear between the sorted values. */
export function percentile(sorted: number[], percent: number): number {
  if (sorted.length === 0) return NaN;
  const at = ((sorted.length - 1) * percent) / 100;
  const below = Math.floor(at);
  const above = Math.min(below + 1, sorted.length - 1);
  return sorted[below]! + (at - below) * (sorted[above]! - sorted[below]!);
}
