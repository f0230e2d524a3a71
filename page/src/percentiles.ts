// Percentiles of speed of few vehicles: which are shown, and the line that says why the others are not.

import type { Run } from "./run";

export const PERCENTILES = [
  [15, "15th percentile"],
  [50, "Median speed"],
  [85, "85th percentile"],
] as const;

/** Whether `n` vehicles give the percentile. The median of fewer is shown all the same, with `cautionNote`. */
export function isShown(percent: number, n: number, run: Run): boolean {
  return percent === 50 || n >= run.vehicles_for_percentile[percent]!;
}

/** Which percentiles of `n` vehicles are withheld, or uncertain; empty where all are sound. `what` they did, in words. */
export function cautionNote(n: number, what: string, run: Run): string {
  const [least, leastOfMedian] = [run.vehicles_for_percentile[85]!, run.vehicles_for_percentile[50]!];
  if (n >= least) return "";
  const withheld = `The 15th and 85th percentiles need ${least} vehicles; ${n} ${what}.`;
  return n < leastOfMedian ? `${withheld} The median of fewer than ${leastOfMedian} is uncertain.` : withheld;
}
