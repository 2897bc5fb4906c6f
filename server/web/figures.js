// In: the newest map, the stream's counts, the server's status. Out: the page's figures as text.
// Status message: JSON of clearway.v1 Vehicle with "type": "status", snake_case keys, 64-bit numbers as numbers.

import { bytes, clockWords, count, dash, duration, percent, utc } from "./text.js";

const STATUS_LATE_MS = 3000;

// entries: [[term, description, alarming?]]
function list(element, entries) {
  const rows = entries.map(([term, text, alarming]) => {
    const row = document.createElement("div"), dt = document.createElement("dt"), dd = document.createElement("dd");
    dt.textContent = term;
    dd.textContent = text;
    dd.classList.toggle("alarm", Boolean(alarming));
    row.append(dt, dd);
    return row;
  });
  element.replaceChildren(...rows);
}

export function streamFigures(element, map, stream, server_ahead_ms) {
  const header = map?.header, pose = header?.map_from_ego;
  const ms = (from, to) => duration(Number(to - from) / 1e6);
  list(element, [
    ["Sequence", header ? count(header.sequence) : dash],
    ["Captured until", header ? utc(header.capture_end_ns) : dash],
    ["Capture end → sent", map ? ms(header.capture_end_ns, map.sent_ns) : dash],
    ["Speed", header?.speed_mps == null ? "unknown" : `${header.speed_mps.toFixed(1)} m/s`],
    ["Pose", pose ? `${pose.x.toFixed(1)}, ${pose.y.toFixed(1)}, ${pose.z.toFixed(1)} m` : "unknown"],
    ["Points moved by", header?.compensation || "unknown"],
    ["Maps taken", count(stream.taken)],
    ["Skipped (server told)", count(stream.skipped), stream.skipped > 0],
    ["Lost on the way", count(stream.lost), stream.lost > 0],
    ["Repeated or late", count(stream.repeated), stream.repeated > 0],
    ["Refused by this page", count(stream.refused), stream.refused > 0],
    ["Server restarts seen", count(stream.restarts)],
    ["Map size", map ? bytes(map.bytes) : dash],
    ["Server clock ahead by", duration(server_ahead_ms)],
  ]);
}

export function packetFigures(element, status) {
  const ledger = status?.ledger;
  if (!ledger) return list(element, [["Packets", "not told yet"]]);
  const refused = Object.entries(ledger.refused ?? {});
  list(element, [
    ["Received", count(ledger.received ?? 0)],
    ["Decoded", count(ledger.decoded ?? 0)],
    ["Telemetry", count(ledger.telemetry ?? 0)],
    ["Refused", count(refused.reduce((sum, [, n]) => sum + n, 0))],
    ...refused.map(([reason, n]) => [`refused: ${reason.replaceAll("_", " ")}`, count(n), n > 0]),
    ["Lost at the door", count(ledger.lost ?? 0), ledger.lost > 0],
    ["Dropped by the kernel", count(ledger.kernel_drops ?? 0), ledger.kernel_drops > 0],
  ]);
}

export function houseFigures(element, status) {
  const recorder = status?.recorder;
  const readers = Object.entries(status?.readers ?? {});
  list(element, [
    ["Maps made", status ? count(status.maps ?? 0) : dash],
    ["Readers", readers.length ? readers.map(([kind, n]) => `${n} ${kind}`).join(", ") : status ? "none" : dash],
    ["Recorder", !status ? dash : recorder?.file ? recorder.file : "not recording"],
    ...(recorder?.file
      ? [
          ["Recorded events", count(recorder.events ?? 0)],
          ["Recorded maps", count(recorder.maps ?? 0)],
          ["Recorder lost", count(recorder.lost ?? 0), recorder.lost > 0],
        ]
      : []),
  ]);
}

export function sensorRows(body, sensors) {
  const rows = sensors.map((sensor) => {
    const blocked = [
      ...(sensor.blocked_sectors ?? []).map(({ from_deg, to_deg }) => `${from_deg}° to ${to_deg}°`),
      ...(sensor.blocked_lasers ?? []).map((laser) => `laser ${laser}`),
    ].join(", ");
    const row = document.createElement("tr");
    const texts = [
      sensor.name, sensor.model || "not known yet", sensor.rpm ? sensor.rpm.toFixed(0) : dash, count(sensor.returns),
      count(sensor.packets), count(sensor.refused), percent(sensor.completeness), clockWords(sensor.clock, sensor.clock_offset_ms),
      (sensor.partial ? `partial: ${sensor.partial}` : "whole") + (blocked && `, blocked: ${blocked}`),
    ];
    texts.forEach((text, i) => {
      const cell = document.createElement(i ? "td" : "th");
      if (!i) cell.scope = "row";
      cell.textContent = text;
      row.append(cell);
    });
    row.lastChild.classList.toggle("alarm", Boolean(sensor.partial || blocked));
    return row;
  });
  body.replaceChildren(...rows);
}

export function statusAge(element, heard_ms, now_ms) {
  const late = heard_ms !== null && now_ms - heard_ms > STATUS_LATE_MS;
  element.textContent = late ? `as heard ${duration(now_ms - heard_ms)} ago` : "";
}
