// Modes of a pixel's velocity distribution: velfield/field/modes.py in TypeScript, number for number.

const BANDWIDTH_BINS = 2.0;
const MIN_BANDWIDTH_BINS = 1.0;
const MAX_MODES = 4;
const ITERATIONS = 60;
const CONVERGENCE_BINS = 1e-3;
const SAME_MODE_BINS = 1.0;
const MAX_PEAKS = 64;

/** A mode, in bins from the first bin's centre, and the fraction of the histogram's weight that is nearest to it. */
export interface Mode {
  x: number;
  y: number;
  weight: number;
}

/** The largest modes by weight; the histogram is (n, n) flat, x fastest. */
export function findModes(h: Int32Array, n: number, tracks: number): Mode[] {
  const bandwidth = Math.max(BANDWIDTH_BINS * Math.max(tracks, 1) ** (-1 / 6), MIN_BANDWIDTH_BINS);
  const found: Mode[] = [];
  for (let y = 0; y < n; y++) {
    for (let x = 0; x < n; x++) {
      if (h[y * n + x]! <= 0 || found.length >= MAX_PEAKS || !isPeak(h, n, y, x)) continue;
      const mode = climb(h, n, y, x, bandwidth);
      if (!found.some((other) => (other.x - mode.x) ** 2 + (other.y - mode.y) ** 2 < SAME_MODE_BINS ** 2)) found.push(mode);
    }
  }
  assignWeights(h, n, found);
  return found.sort((a, b) => b.weight - a.weight).slice(0, MAX_MODES);
}

/** The histogram at a bin smoothed by a binomial 3x3 kernel: a peak over two bins counts as one. */
function smoothed(h: Int32Array, n: number, y: number, x: number): number {
  let total = 0;
  for (let j = Math.max(y - 1, 0); j < Math.min(y + 2, n); j++) {
    for (let i = Math.max(x - 1, 0); i < Math.min(x + 2, n); i++) {
      total += h[j * n + i]! * (2 - Math.abs(j - y)) * (2 - Math.abs(i - x));
    }
  }
  return total;
}

function isPeak(h: Int32Array, n: number, y: number, x: number): boolean {
  const here = smoothed(h, n, y, x);
  for (let j = Math.max(y - 1, 0); j < Math.min(y + 2, n); j++) {
    for (let i = Math.max(x - 1, 0); i < Math.min(x + 2, n); i++) {
      if (j === y && i === x) continue;
      const there = smoothed(h, n, j, i);
      // Of equal neighbours the first in raster order is the peak.
      if (there > here || (there === here && (j < y || (j === y && i < x)))) return false;
    }
  }
  return true;
}

/** Mean shift to the maximum of the smoothed histogram. */
function climb(h: Int32Array, n: number, y: number, x: number, bandwidth: number): Mode {
  const reach = 3 * bandwidth;
  const weightX = new Float64Array(n);
  for (let k = 0; k < ITERATIONS; k++) {
    const first = Math.max(0, Math.floor(x - reach + 0.5));
    const last = Math.min(n - 1, Math.floor(x + reach + 0.5));
    for (let i = first; i <= last; i++) weightX[i] = Math.exp((-0.5 * (i - x) ** 2) / (bandwidth * bandwidth));
    let [total, sumY, sumX] = [0, 0, 0];
    const bottom = Math.min(n - 1, Math.floor(y + reach + 0.5));
    for (let j = Math.max(0, Math.floor(y - reach + 0.5)); j <= bottom; j++) {
      let [row, rowX] = [0, 0];
      for (let i = first; i <= last; i++) {
        const w = h[j * n + i]! * weightX[i]!;
        row += w;
        rowX += w * i;
      }
      if (row > 0) {
        const weightY = Math.exp((-0.5 * (j - y) ** 2) / (bandwidth * bandwidth));
        total += weightY * row;
        sumY += weightY * row * j;
        sumX += weightY * rowX;
      }
    }
    if (total <= 0) break;
    const [stepY, stepX] = [sumY / total - y, sumX / total - x];
    y += stepY;
    x += stepX;
    if (Math.abs(stepY) + Math.abs(stepX) < CONVERGENCE_BINS) break;
  }
  return { x, y, weight: 0 };
}

/** Each bin's weight goes to the nearest mode. */
function assignWeights(h: Int32Array, n: number, modes: Mode[]): void {
  let total = 0;
  for (let y = 0; y < n; y++) {
    for (let x = 0; x < n; x++) {
      const here = h[y * n + x]!;
      if (here <= 0) continue;
      let nearest = modes[0]!;
      let smallest = Infinity;
      for (const mode of modes) {
        const distance = (mode.y - y) ** 2 + (mode.x - x) ** 2;
        if (distance < smallest) [smallest, nearest] = [distance, mode];
      }
      nearest.weight += here;
      total += here;
    }
  }
  for (const mode of modes) mode.weight /= total;
}
