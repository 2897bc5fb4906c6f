// In: the newest map, the counts of its stream, the server's status. Out: the page's lists and tables.
// Status message: JSON of clearway.v1 Vehicle with "type": "status", snake_case keys, 64-bit numbers as numbers.

import { bytes, clockWords, count, dash, duration, percent, setText, utc, words } from "./text.js";

const STATUS_LATE_MS = 3000;

// Writes the cells of a table or list. texts: for each row its cells' texts; alarms: for each row true if it alarms.
function writeRows(body, texts, alarms, newRow) {
  while (body.children.length > texts.length) body.lastChild.remove();
  while (body.children.length < texts.length) body.append(newRow());
  texts.forEach((row, i) => {
    const cells = body.children[i].children;
    row.forEach((text, j) => setText(cells[j], text));
    cells[row.length - 1].classList.toggle("alarm", alarms[i]);
  });
}

function row(tag, cells) {
  const element = document.createElement(tag);
  element.append(...cells.map((cell) => document.createElement(cell)));
  return element;
}

// entries: [[term, text, alarm?]]
function writeList(element, entries) {
  const texts = entries.map(([term, text]) => [term, text]), alarms = entries.map(([, , alarm]) => Boolean(alarm));
  writeRows(element, texts, alarms, () => row("div", ["dt", "dd"]));
}

export function writeMapMetrics(element, shown, counts, server_ahead_ms) {
  const header = shown?.header, pose = header?.map_from_ego;
  const ms = (from, to) => duration(Number(to - from) / 1e6);
  writeList(element, [
    ["Sequence", header ? count(header.sequence) : dash],
    ["Captured until", header ? utc(header.capture_end_ns) : dash],
    ["Capture end → sent", header ? ms(header.capture_end_ns, shown.sent_ns) : dash],
    ["Speed", header?.speed_mps == null ? "unknown" : `${header.speed_mps.toFixed(1)} m/s`],
    ["Pose", pose ? `${pose.x.toFixed(1)}, ${pose.y.toFixed(1)}, ${pose.z.toFixed(1)} m` : "unknown"],
    ["Motion compensation by", header?.compensation || "unknown"],
    ["Received", count(counts.received)],
    ["Skipped by the server", count(counts.skipped), counts.skipped > 0],
    ["Replaced before they were drawn", count(counts.replaced)],
    ["Lost on the way", count(counts.lost), counts.lost > 0],
    ["Repeated or late", count(counts.repeated), counts.repeated > 0],
    ["Refused by this page", count(counts.refused), counts.refused > 0],
    ["Restarts of the server", count(counts.restarts)],
    ["Map size", shown ? bytes(shown.length) : dash],
    ["Server clock ahead by", duration(server_ahead_ms)],
  ]);
}

export function writePacketMetrics(element, status) {
  const ledger = status?.ledger;
  if (!ledger) return writeList(element, [["Packets", "no status yet"]]);
  const refused = Object.entries(ledger.refused ?? {});
  writeList(element, [
    ["Received", count(ledger.received ?? 0)],
    ["Decoded", count(ledger.decoded ?? 0)],
    ["Telemetry", count(ledger.telemetry ?? 0)],
    ["Refused", count(refused.reduce((sum, [, n]) => sum + n, 0))],
    ...refused.map(([reason, n]) => [`refused: ${words(reason)}`, count(n), n > 0]),
    ["Lost at the full event queue", count(ledger.lost ?? 0), ledger.lost > 0],
    ["Dropped by the kernel", count(ledger.kernel_drops ?? 0), ledger.kernel_drops > 0],
  ]);
}

export function writeServerMetrics(element, status) {
  const recorder = status?.recorder;
  const readers = Object.entries(status?.readers ?? {}).filter(([, n]) => n > 0);
  const reader_text = readers.length > 0 ? readers.map(([transport, n]) => `${n} ${transport}`).join(", ") : "none";
  writeList(element, [
    ["Maps made", status ? count(status.maps ?? 0) : dash],
    ["Readers", status ? reader_text : dash],
    ...(status?.sensors ?? []).filter(({ mount }) => mount?.contradicts).map(({ name, mount }) => [
      `Mount of ${name}`,
      `the ground contradicts it: ${signed(mount.height_m, 2)} m, pitch ${signed(mount.pitch_deg, 1)}°, ` +
        `roll ${signed(mount.roll_deg, 1)}°`,
      true,
    ]),
    ["Recorder", !status ? dash : recorder?.file ? recorder.file : recorder?.state || "not recording"],
    ...(recorder?.reason ? [["Fault of the recorder", recorder.reason, true]] : []),
    ...(recorder?.file
      ? [
          ["Recorded events", count(recorder.events ?? 0)],
          ["Recorded maps", count(recorder.maps ?? 0)],
          ["Lost by the recorder", count(recorder.lost ?? 0), recorder.lost > 0],
        ]
      : []),
  ]);
}

const signed = (value, digits) => `${value < 0 ? "−" : "+"}${Math.abs(value).toFixed(digits)}`;

/// Sources that do not give the elevations of the sensor itself.
const DOUBTFUL = ["nominal", "estimated", "unknown"];

export function writeSensors(body, sensors) {
  const blocked = (sensor) => [
    ...(sensor.blocked_sectors ?? []).map(({ from_deg, to_deg }) => `${from_deg}° to ${to_deg}°`),
    ...(sensor.blocked_lasers ?? []).map((laser) => `laser ${laser}`),
  ].join(", ");
  const texts = sensors.map((sensor) => [
    sensor.name, sensor.model || "not known yet", sensor.rpm ? sensor.rpm.toFixed(0) : dash, count(sensor.returns),
    count(sensor.packets), count(sensor.refused), percent(sensor.completeness),
    clockWords(sensor.clock, sensor.clock_offset_ms),
    (sensor.partial ? `partial: ${sensor.partial}` : "whole") + (blocked(sensor) && `, blocked: ${blocked(sensor)}`) +
      (DOUBTFUL.includes(sensor.elevations) ? `, elevations: ${sensor.elevations}` : ""),
  ]);
  const alarms = sensors.map((sensor) => Boolean(sensor.partial || blocked(sensor)));
  const newRow = () => {
    const element = row("tr", ["th", ...Array(8).fill("td")]);
    element.firstChild.scope = "row";
    return element;
  };
  writeRows(body, texts, alarms, newRow);
}

export function writeStatusAge(element, arrived_ms, now_ms) {
  const is_late = arrived_ms !== null && now_ms - arrived_ms > STATUS_LATE_MS;
  setText(element, is_late ? `${duration(now_ms - arrived_ms)} old` : "");
}
