// In: numbers. Out: the texts that the page shows for them.

export const dash = "–";

export const count = (n) => (n === undefined || n === null ? dash : n.toLocaleString("en"));

export const percent = (share, digits = 1) => (Number.isFinite(share) ? `${(100 * share).toFixed(digits)} %` : dash);

export const words = (name) => name.replaceAll("_", " ");

export function duration(ms) {
  if (ms === null || !Number.isFinite(ms)) return dash;
  if (ms < 0) return `−${duration(-ms)}`;
  if (ms < 999.5) return `${Math.round(ms)} ms`;
  if (ms < 59950) return `${(ms / 1e3).toFixed(1)} s`;
  const s = Math.round(ms / 1e3);
  if (s < 3600) return `${Math.floor(s / 60)} min ${Math.floor(s % 60)} s`;
  if (s < 172800) return `${Math.floor(s / 3600)} h ${Math.floor((s % 3600) / 60)} min`;
  const days = s / 86400;
  return days < 730 ? `${Math.floor(days)} days` : `${(days / 365.25).toFixed(1)} years`;
}

// A duration that is written again and again: it changes rarely, so that it can be read fifty times.
export function coarse(ms) {
  if (ms === null || ms < 1000) return ms === null ? dash : `${Math.max(0.1, Math.round(ms / 100) / 10).toFixed(1)} s`;
  return ms < 60_000 ? `${Math.floor(ms / 1e3)} s` : ms < 3.6e6 ? `${Math.floor(ms / 60_000)} min` : duration(ms);
}

// A value of a channel with its unit, with as many decimals as a step of its scale needs.
export function valueText(value, { unit, scale }) {
  // 0.01 in single precision is a little less than 0.01.
  const digits = Math.min(Math.max(Math.ceil(-Math.log10(scale) - 1e-6), 0), 6);
  return `${value.toFixed(digits)} ${unit}`.trimEnd();
}

// The clock that a sensor's stamps follow, and how far the host's clock is from it (BigInt, ms).
export function clockWords(clock, offset_ms) {
  const name = { gps: "GPS", gps_unlocked: "GPS, not locked" }[clock] ?? clock;
  const ms = Number(offset_ms ?? 0n);
  if (!name) return dash;
  return ms === 0 ? name : `${name}, host ${duration(Math.abs(ms))} ${ms > 0 ? "ahead" : "behind"}`;
}

export function utc(ns) {
  const date = new Date(Number(ns / 1000000n));
  return Number.isNaN(date.getTime()) ? dash : date.toISOString().replace("T", " ").replace("Z", " UTC");
}

export function bytes(n) {
  return n < 1024 ? `${n} B` : `${(n / 1024).toFixed(1)} KiB`;
}

// A direction, given as the azimuth from the ego x axis (radians, counter-clockwise).
export function bearing(azimuth) {
  const degrees = (azimuth * 180) / Math.PI;
  const size = Math.abs(degrees).toFixed(1);
  if (size === "0.0" || size === "180.0") return size === "0.0" ? "straight ahead" : "straight behind";
  return `${size}° ${degrees > 0 ? "left" : "right"}`;
}

// Writes a text only if it has changed: a browser lays out and paints what is written.
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}
