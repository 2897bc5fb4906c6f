// The last ten minutes of a vehicle, which the server keeps: a row of numbers a second, and the changes of its state.
// In: the answer of /history, and the statuses after it. Times are the server's, in ms since the Unix epoch.

export const SPAN_MS = 600_000;
// Grafana shows a change with so much before it, and as much after the next one.
const AROUND_MS = 120_000;

export class History {
  // { at_ms, map_age_ms, latency_ms_total, map_rate_hz, loss, drivable_share }; a number that is not known is null.
  rows = [];
  // { at_ms, state, reasons, file }, oldest first.
  changes = [];

  load({ columns, rows, changes }) {
    this.rows = rows.map(([at_ms, numbers]) => ({
      at_ms, ...Object.fromEntries(columns.map((name, i) => [name, numbers[i]])),
    }));
    this.changes = changes;
  }

  // Adds the numbers of a status, unless a row as new has them already.
  push({ now_ns, map_age_ms, latency_ms, map_rate_hz, loss, drivable_share }) {
    const at_ms = Number(now_ns) / 1e6;
    if (at_ms <= (this.rows.at(-1)?.at_ms ?? 0)) return;
    this.rows.push({ at_ms, map_age_ms, latency_ms_total: latency_ms?.total, map_rate_hz, loss, drivable_share });
    const first = this.rows.findIndex((row) => at_ms - row.at_ms <= SPAN_MS);
    if (first > 0) this.rows.splice(0, first);
  }

  has(name) {
    return this.rows.some((row) => Number.isFinite(row[name]));
  }
}

// Lines of a plot of one value: [[[x, y]]] in pixels, one list for each stretch in which the value is known. top: the
// value at the upper edge. A gap of more than GAP_MS between two rows breaks the line.
const GAP_MS = 3000;

export function lines(rows, name, now_ms, { width, height, top, span_ms = SPAN_MS }) {
  const out = [];
  let before_ms = -Infinity;
  for (const row of rows) {
    const value = row[name];
    if (!Number.isFinite(value)) {
      before_ms = -Infinity;
      continue;
    }
    if (row.at_ms - before_ms > GAP_MS) out.push([]);
    before_ms = row.at_ms;
    const x = width * (1 - (now_ms - row.at_ms) / span_ms), y = height * (1 - Math.min(Math.max(value / top, 0), 1));
    out.at(-1).push([x, y]);
  }
  return out;
}

// The least of 1, 2, 5 times a power of ten that is not below the greatest value.
export function niceTop(rows, name, least) {
  const known = rows.map((row) => row[name]).filter(Number.isFinite);
  const greatest = Math.max(least, ...known);
  const power = 10 ** Math.floor(Math.log10(greatest));
  return [1, 2, 5, 10].map((factor) => factor * power).find((top) => top >= greatest - 1e-9);
}

// The dashboard of deploy/grafana for a vehicle and a range of times; null if that is no address of a Grafana.
export function grafanaLink(grafana, vehicle, from, to) {
  if (!URL.canParse(grafana) || !/^https?:$/.test(new URL(grafana).protocol)) return null;
  const link = new URL("d/clearway/clearway", grafana.endsWith("/") ? grafana : `${grafana}/`);
  link.search = new URLSearchParams({ from, to, "var-vehicle": vehicle });
  return link.href;
}

// The changes, newest first, each with its range in Grafana and how long the state lasted; null: it lasts.
export function told({ changes }) {
  return changes.map((change, i) => {
    const end_ms = changes[i + 1]?.at_ms ?? null;
    const to = end_ms === null ? "now" : Math.round(end_ms + AROUND_MS);
    return { ...change, lasted_ms: end_ms && end_ms - change.at_ms, from: Math.round(change.at_ms - AROUND_MS), to };
  }).reverse();
}
