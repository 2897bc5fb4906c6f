// The page: one vehicle's newest map, live, with its age. Messages come in through link.js, are opened by map.js and
// counted here; drawing happens once a display frame, always of the newest map, however many came meanwhile.
// A map that is held is never shown as fresh: its age goes on by the server's clock (clock.js), map or no map.

import { freshness, ServerClock } from "./clock.js";
import { houseFigures, packetFigures, sensorRows, statusAge, streamFigures } from "./figures.js";
import { Link } from "./link.js";
import { openUpdate } from "./map.js";
import { Panel } from "./panel.js";
import { bytes, duration } from "./text.js";

const RATE_OVER_MS = 3000;
const FIGURES_EVERY_MS = 250;
// Both clocks of a browser run alike unless one was stepped or the machine slept.
const CLOCK_STEP_MS = 1000;

const $ = (id) => document.getElementById(id);
const clock = new ServerClock();
const panels = new Map();
let map = null, drawn = null;
let status = null, status_heard_ms = null;
let link_state = { phase: "connecting", text: "Connecting …" };
// Of this connection, ms: when its first map came, and those of the last RATE_OVER_MS.
let first_ms = null, arrivals = [];
// Maps this page refused since the last one it took: in a gap of the sequence, but not lost on the way.
let refused_since = 0n;
let stream, said = "", figures_at_ms = 0, view_m = 0;
let wall_minus_monotonic = Date.now() - performance.now();

function forgetVehicle() {
  map = drawn = status = status_heard_ms = first_ms = null;
  arrivals = [];
  stream = { taken: 0n, skipped: 0n, lost: 0n, repeated: 0n, refused: 0n, restarts: 0n };
  panels.forEach((panel) => panel.element.remove());
  panels.clear();
  $("refusal").hidden = true;
}

const link = new Link({
  vehicles(list, wanted) {
    const names = list.map((vehicle) => vehicle.name);
    if (wanted !== null && wanted !== undefined && !names.includes(wanted)) names.unshift(wanted);
    const select = $("vehicle");
    if ([...select.options].map((option) => option.value).join("\n") !== names.join("\n")) {
      select.replaceChildren(...names.map((name) => new Option(name, name)));
    }
    select.value = wanted ?? names[0];
    select.hidden = names.length < 2;
    $("vehicle-name").textContent = select.hidden ? (names[0] ?? "") : "";
  },
  update: takeUpdate,
  text(message) {
    try {
      const told = JSON.parse(message);
      if (told.type !== "status") return;
      status = told;
      status_heard_ms = performance.now();
    } catch (error) {
      refuse("status", error);
    }
  },
  state(next) {
    link_state = next;
    if (next.phase !== "live") return;
    clock.restart();
    first_ms = null;
    arrivals = [];
    refused_since = 0n;
  },
}, new URLSearchParams(location.search).get("vehicle") ?? undefined);

function takeUpdate(message, received_ms) {
  let next;
  try {
    next = openUpdate(message, map);
  } catch (error) {
    stream.refused++;
    refused_since++;
    return refuse("map", error);
  }
  const in_time = clock.sample(received_ms, next.sent_ns);
  if (!in_time) link.renew("Link lags behind; starting afresh");
  stream.skipped += next.skipped;
  const before = map?.header, { header } = next;
  if (before?.boot_id === header.boot_id) {
    const ahead = header.sequence - before.sequence;
    if (ahead <= 0n) {
      // After a reconnection the server sends its newest map, which may be the held one.
      if (ahead < 0n || first_ms !== null) stream.repeated++;
      return;
    }
    // What was made while the connection was cut is neither skipped nor lost on the way.
    const missing = ahead - 1n - next.skipped - refused_since;
    if (first_ms !== null && missing > 0n) stream.lost += missing;
  } else if (before) {
    stream.restarts++;
  }
  refused_since = 0n;
  map = next;
  stream.taken++;
  first_ms ??= received_ms;
  arrivals.push(received_ms);
  $("refusal").hidden = true;
}

function refuse(what, error) {
  $("refusal").hidden = false;
  $("refusal").textContent = `A ${what} message was refused: ${error.message}`;
}

function frame() {
  // First, so that no fault below can stop the age from going on.
  requestAnimationFrame(frame);
  const now_ms = performance.now();
  watchClock();
  if (map !== drawn) draw();
  const age = map && freshness(map.header, clock.now_ns(now_ms));
  showFreshness(age);
  if (now_ms - figures_at_ms >= FIGURES_EVERY_MS) {
    figures_at_ms = now_ms;
    showFigures(now_ms);
  }
}

// After a sleep, what queued up in the connection is old and the monotonic clock may have stood still.
function watchClock() {
  const difference = Date.now() - performance.now();
  if (Math.abs(difference - wall_minus_monotonic) < CLOCK_STEP_MS) return;
  wall_minus_monotonic = difference;
  clock.forget();
  link.renew("This computer's clock was stepped or slept");
}

function draw() {
  drawn = map;
  const names = map.layers.map((layer) => layer.name);
  for (const [name, panel] of panels) {
    if (names.includes(name)) continue;
    panel.element.remove();
    panels.delete(name);
  }
  for (const layer of map.layers) {
    if (!panels.has(layer.name)) {
      const panel = new Panel($("panel"), layer.name);
      panels.set(layer.name, panel);
      $("panels").append(panel.element);
    }
    panels.get(layer.name).show(layer, view_m);
  }
}

function showFreshness(age) {
  const state = !age ? "none" : age.fresh ? "fresh" : "stale";
  const word = { none: "NO MAP YET", fresh: "FRESH", stale: "STALE" }[state];
  document.body.dataset.map = state;
  if (said !== word) {
    said = word;
    // Only the change is announced; the age itself would never let a screen reader finish.
    $("freshness").textContent = word;
  }
  const share = age?.age_ms == null ? 1 : Math.min(Math.max(age.age_ms / age.validity_ms, 0), 1);
  $("bar").style.transform = `scaleX(${age ? share : 0})`;
  $("age").textContent = age ? duration(age.age_ms) : "–";
  const valid = age && `valid for ${duration(age.validity_ms)} after capture`;
  $("why").textContent = age ? age.why || valid : "waiting for the first map";
  const label = state === "stale" ? `STALE · ${duration(age.age_ms)}` : "";
  panels.forEach((panel) => panel.stale(label));
}

function showFigures(now_ms) {
  arrivals = arrivals.filter((at) => now_ms - at <= RATE_OVER_MS);
  // Until a connection is old enough, intervals are counted rather than maps.
  const over_ms = first_ms === null ? 0 : now_ms - first_ms;
  const { phase, text, retry_at_ms } = link_state;
  const per_ms = over_ms >= RATE_OVER_MS ? arrivals.length / RATE_OVER_MS : (arrivals.length - 1) / over_ms;
  const rate = phase === "live" ? per_ms : 0;
  $("rate").textContent = (Number.isFinite(rate) && rate > 0 ? 1e3 * rate : 0).toFixed(1);
  $("size").textContent = map ? bytes(map.bytes) : "–";
  const wait = retry_at_ms ? ` · again in ${Math.max(0, Math.ceil((retry_at_ms - now_ms) / 1e3))} s` : "";
  $("link").dataset.phase = phase;
  if ($("link-text").textContent !== text + wait) $("link-text").textContent = text + wait;
  streamFigures($("stream"), map, stream, clock.ahead_ms(wall_minus_monotonic));
  packetFigures($("packets"), status);
  houseFigures($("house"), status);
  sensorRows($("sensors"), map?.header.sensors ?? status?.sensors ?? []);
  document.querySelectorAll("[data-heard]").forEach((element) => statusAge(element, status_heard_ms, now_ms));
}

$("vehicle").onchange = () => {
  forgetVehicle();
  const address = new URL(location.href);
  address.searchParams.set("vehicle", $("vehicle").value);
  history.replaceState(null, "", address);
  link.choose($("vehicle").value);
};
$("view").onchange = () => {
  view_m = Number($("view").value);
  drawn = null;
};

forgetVehicle();
link.connect();
requestAnimationFrame(frame);
