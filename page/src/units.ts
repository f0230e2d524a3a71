// Numbers and units for people.

import type { Layer, Run } from "./run";

export const SPEED_UNITS = { "km/h": 3.6, mph: 2.2369362920544, "m/s": 1 } as const;
export type SpeedUnit = keyof typeof SPEED_UNITS;

const POINTS = ["N", "NE", "E", "SE", "S", "SW", "W", "NW"];

export class Units {
  constructor(
    private readonly run: Run,
    public speedUnit: SpeedUnit,
  ) {}

  /** What speeds are shown in: pixels a second where metres are not known. */
  get speed(): string {
    return this.run.gsd_m === null ? "px/s" : this.speedUnit;
  }

  get perPxPerS(): number {
    return this.run.gsd_m === null ? 1 : this.run.gsd_m * SPEED_UNITS[this.speedUnit];
  }

  fromMetresPerSecond(speed: number): number {
    return this.run.gsd_m === null ? speed : speed * SPEED_UNITS[this.speedUnit];
  }

  get stationarySpeed(): number {
    return this.run.stationary_speed_px_per_s;
  }

  speedText(pxPerS: number, decimals = 1): string {
    return Number.isFinite(pxPerS) ? `${(pxPerS * this.perPxPerS).toFixed(decimals)} ${this.speed}` : "–";
  }

  /** Compass heading, clockwise from north, or from the image's up where north is not known. */
  heading(directionRad: number): number {
    const degrees = ((directionRad - (this.run.north_rad ?? -Math.PI / 2)) * 180) / Math.PI;
    return ((degrees % 360) + 360) % 360;
  }

  /** "92° E", or "92° from up": without a known north the compass point would be a guess. */
  headingText(directionRad: number): string {
    if (!Number.isFinite(directionRad)) return "–";
    return this.headingDegrees(directionRad) + this.headingPoint(directionRad);
  }

  /** "92°", without the reference direction. */
  headingDegrees(directionRad: number): string {
    return `${Math.round(this.heading(directionRad)) % 360}°`;
  }

  /** " E", or " from up": the compass point or the reference direction, after the degrees. */
  headingPoint(directionRad: number): string {
    return this.run.north_rad === null ? " from up" : ` ${POINTS[Math.round(this.heading(directionRad) / 45) % 8]}`;
  }

  /** A column of headings: title and cell text. */
  get headingColumn(): { title: string; text: (directionRad: number) => string } {
    return this.run.north_rad === null
      ? { title: "From up", text: (direction) => this.headingDegrees(direction) }
      : { title: "Heading", text: (direction) => this.headingText(direction) };
  }

  length(px: number): string {
    return this.run.gsd_m === null ? `${px.toFixed(1)} px` : `${(px * this.run.gsd_m).toFixed(1)} m`;
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
    if (layer.kind === "fraction") return { factor: 100, unit: "%" };
    if (layer.units === "vehicles h-1") return { factor: 1, unit: "vehicles an hour" };
    return { factor: 1, unit: layer.kind === "count" ? "vehicles" : "" };
  }
}

/** "1 vehicle", "2 vehicles". */
export function countText(n: number, noun: string): string {
  return `${n} ${n === 1 ? noun : `${noun}s`}`;
}

/** The smallest of 1, 1.2, 1.5, 2, 3, 4, 5, 6, 8 times a power of ten that is not below: as `round_up` of the figures. */
export function roundUp(value: number): number {
  const power = 10 ** Math.floor(Math.log10(value));
  return [1, 1.2, 1.5, 2, 3, 4, 5, 6, 8, 10].map((step) => step * power).find((step) => step >= value * (1 - 1e-9))!;
}

/** The largest of 1, 2 and 5 times a power of ten that is not above. */
export function roundDown(value: number): number {
  const power = 10 ** Math.floor(Math.log10(value));
  return [5, 2, 1].map((step) => step * power).find((step) => step <= value * (1 + 1e-9))!;
}

/** Round numbers from 0 to a top, four to six of them; the last is the top itself where that is round. */
export function ticks(top: number): number[] {
  const power = 10 ** (Math.floor(Math.log10(top)) - 1);
  const steps = [1, 2, 5, 10, 20, 50, 4, 40].map((s) => s * power).filter((s) => top / s <= 5.01);
  const step = steps.find((s) => Math.abs(top / s - Math.round(top / s)) < 1e-6) ?? steps[0]!;
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
