// The last ten minutes of a vehicle, a sample a second: age, rate, loss, share of drivable ground, latency.

export const SPAN_MS = 600_000;

export class History {
  samples = [];

  // sample: { at_ms, age_ms, hz, loss, share, latency_ms }; a value that is not known is null.
  push(sample) {
    this.samples.push(sample);
    const first = this.samples.findIndex(({ at_ms }) => sample.at_ms - at_ms <= SPAN_MS);
    if (first > 0) this.samples.splice(0, first);
  }

  has(name) {
    return this.samples.some((sample) => Number.isFinite(sample[name]));
  }
}

// Lines of a plot of one value: [[[x, y]]] in pixels, one list for each stretch in which the value is known. top: the
// value at the upper edge. A gap of more than GAP_MS between two samples breaks the line.
const GAP_MS = 3000;

export function lines(samples, name, now_ms, { width, height, top, span_ms = SPAN_MS }) {
  const out = [];
  let before_ms = -Infinity;
  for (const sample of samples) {
    const value = sample[name];
    if (!Number.isFinite(value)) {
      before_ms = -Infinity;
      continue;
    }
    if (sample.at_ms - before_ms > GAP_MS) out.push([]);
    before_ms = sample.at_ms;
    const x = width * (1 - (now_ms - sample.at_ms) / span_ms), y = height * (1 - Math.min(Math.max(value / top, 0), 1));
    out.at(-1).push([x, y]);
  }
  return out;
}

// The least of 1, 2, 5 times a power of ten that is not below the greatest value.
export function niceTop(samples, name, least) {
  const known = samples.map((sample) => sample[name]).filter(Number.isFinite);
  const greatest = Math.max(least, ...known);
  const power = 10 ** Math.floor(Math.log10(greatest));
  return [1, 2, 5, 10].map((factor) => factor * power).find((top) => top >= greatest - 1e-9);
}
