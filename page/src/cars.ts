// Cars as they are marked: middle, axis, length and width, in raw pixels.

import type { Point } from "./coordinates";

export interface Car {
  frame: string;
  x_px: number;
  y_px: number;
  orientation_rad: number | null;
  length_px: number | null;
  width_px: number | null;
}

export const DEFAULT_RATIO = 0.45; // a car's width by its length, seen from above
const UNKNOWN_PX = 12; // size shown of a car whose label gives none

/** The car from one end to the other. */
export function carFromEnds(frame: string, from: Point, to: Point, ratio: number): Car {
  const [dx, dy] = [to.x - from.x, to.y - from.y];
  const length = Math.hypot(dx, dy);
  return {
    frame,
    x_px: (from.x + to.x) / 2,
    y_px: (from.y + to.y) / 2,
    orientation_rad: ((Math.atan2(dy, dx) % Math.PI) + Math.PI) % Math.PI,
    length_px: length,
    width_px: length * ratio,
  };
}

function axes(car: Car): { along: Point; across: Point } {
  const angle = car.orientation_rad ?? 0;
  const [length, width] = [car.length_px ?? UNKNOWN_PX, car.width_px ?? car.length_px ?? UNKNOWN_PX];
  return {
    along: { x: (Math.cos(angle) * length) / 2, y: (Math.sin(angle) * length) / 2 },
    across: { x: (-Math.sin(angle) * width) / 2, y: (Math.cos(angle) * width) / 2 },
  };
}

/** Its four corners, in order. */
export function corners(car: Car): Point[] {
  const { along, across } = axes(car);
  return [
    [1, 1],
    [1, -1],
    [-1, -1],
    [-1, 1],
  ].map(([a, b]) => ({ x: car.x_px + a! * along.x + b! * across.x, y: car.y_px + a! * along.y + b! * across.y }));
}

export function contains(car: Car, { x, y }: Point): boolean {
  const { along, across } = axes(car);
  const [dx, dy] = [x - car.x_px, y - car.y_px];
  const within = (axis: Point): boolean => Math.abs(dx * axis.x + dy * axis.y) <= axis.x ** 2 + axis.y ** 2;
  return within(along) && within(across);
}
