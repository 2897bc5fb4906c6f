// The page: one vehicle's newest map, live, with its age. Messages arrive through link.js and are counted by
// map_stream.js. Once a display frame the newest map is decoded, as far as it is in sight, and drawn.
// The age of the shown map grows by the server's clock (clock.js) whether maps arrive or not.

import { freshness, ServerClock } from "./clock.js";
import { Link } from "./link.js";
import { MapStream } from "./map_stream.js";
import * as metrics from "./metrics.js";
import { Panel } from "./panel.js";
import { ReplayBar } from "./replay.js";
import { bytes, dash, duration, setText } from "./text.js";

const RATE_OVER_MS = 3000;
// Ages are written ten times a second, which a reader can follow; each text costs the browser a layout.
const AGE_EVERY_MS = 100;
const METRICS_EVERY_MS = 500;
// The two clocks of a browser run alike, unless one was set or the computer slept.
const CLOCK_STEP_MS = 1000;

// The layer whose safe points can be drawn over the other layers.
const SAFE_PATH = "safe_path";

const $ = (id) => document.getElementById(id);
const clock = new ServerClock();
const panels = new Map();
let stream = new MapStream();
// The update that is shown; null before the first.
let shown = null;
let status = null, status_arrived_ms = null;
let link_state = { phase: "connecting", text: "Connecting …" };
// When maps were drawn on this connection: the first, and those of the last RATE_OVER_MS.
let first_drawn_ms = null, drawn_ms = [];
// True if the safe paths are drawn over every layer.
let with_paths = false;
let is_draw_scheduled = false, age_timer = 0, metrics_at_ms = 0, view_m = 0;
let wall_minus_monotonic = Date.now() - performance.now();

const link = new Link({
  vehicles: writeVehicles,
  update: pushUpdate,
  text: readStatus,
  state(next) {
    link_state = next;
    if (next.phase !== "live") return;
    clock.restart();
    stream.restart();
    first_drawn_ms = null;
    drawn_ms = [];
    // A replay reports itself again on the new connection.
    replay.hide();
  },
}, new URLSearchParams(location.search).get("vehicle") ?? undefined);

const replay = new ReplayBar($("replay"), (text) => link.send(text));

function writeVehicles(list, chosen) {
  const names = list.map((vehicle) => vehicle.name);
  if (chosen !== undefined && !names.includes(chosen)) names.unshift(chosen);
  const select = $("vehicle");
  if ([...select.options].map((option) => option.value).join("\n") !== names.join("\n")) {
    select.replaceChildren(...names.map((name) => new Option(name, name)));
  }
  select.value = chosen ?? names[0];
  select.hidden = names.length < 2;
  setText($("vehicle-name"), select.hidden ? (names[0] ?? "") : "");
}

function readStatus(text) {
  try {
    const message = JSON.parse(text);
    if (message.type === "replay") replay.show(message);
    if (message.type !== "status") return;
    status = message;
    status_arrived_ms = performance.now();
  } catch (error) {
    writeRefusal("status", error);
  }
}

function pushUpdate(message, arrived_ms) {
  try {
    const update = stream.push(message);
    if (!clock.sample(arrived_ms, update.sent_ns)) link.reconnect("The connection lags; starting again");
    scheduleDraw();
  } catch (error) {
    writeRefusal("map", error);
  }
}

function writeRefusal(what, error) {
  $("refusal").hidden = false;
  setText($("refusal"), `A ${what} message was refused: ${error.message}`);
}

function scheduleDraw() {
  if (is_draw_scheduled) return;
  is_draw_scheduled = true;
  requestAnimationFrame(draw);
}

function draw() {
  is_draw_scheduled = false;
  const newest = stream.removeNewest();
  if (newest && canDecode(newest.map)) {
    shown = newest;
    const now_ms = performance.now();
    first_drawn_ms ??= now_ms;
    drawn_ms.push(now_ms);
    $("refusal").hidden = true;
  }
  if (!shown) return;
  writePanels(shown.map.names);
  for (const panel of panels.values()) drawPanel(panel);
  writeAge();
}

// Decodes what is in sight. A map of which a part is refused is not shown at all.
function canDecode(map) {
  try {
    for (const panel of panels.values()) if (panel.is_in_sight) panel.decode(map);
    safePoints(map);
    return true;
  } catch (error) {
    stream.counts.refused++;
    writeRefusal("map", error);
    return false;
  }
}

// The safe points to draw over every layer; null if none are wanted or the map has none.
const safePoints = (map) => (with_paths ? (map.layer(SAFE_PATH)?.safe_points ?? null) : null);

// Makes a panel for each layer, and removes the panels of layers that the map has not.
function writePanels(names) {
  $("paths-choice").hidden = !names.includes(SAFE_PATH);
  for (const [name, panel] of panels) {
    if (names.includes(name)) continue;
    panel.element.remove();
    panels.delete(name);
  }
  for (const name of names) {
    if (panels.has(name)) continue;
    const panel = new Panel($("panel"), name, () => requestAnimationFrame(() => shown && drawPanel(panel)));
    panels.set(name, panel);
    $("panels").append(panel.element);
  }
}

// A layer that comes into sight is decoded only now, so it can be refused only now.
function drawPanel(panel) {
  if (!panel.is_in_sight) return;
  try {
    panel.draw(shown.map, view_m, safePoints(shown.map));
  } catch (error) {
    panel.clear();
    writeRefusal("map", error);
  }
}

// Writes the age every AGE_EVERY_MS, and at the moment at which the map becomes stale.
function writeAge() {
  clearTimeout(age_timer);
  let wait_ms = AGE_EVERY_MS;
  try {
    checkClock();
    const now_ms = performance.now();
    const age = shown && freshness(shown.map.header, clock.now_ns(now_ms));
    writeFreshness(age);
    if (age?.fresh) wait_ms = Math.min(wait_ms, Math.max(1, age.validity_ms - age.age_ms + 1));
    if (now_ms - metrics_at_ms >= METRICS_EVERY_MS) {
      metrics_at_ms = now_ms;
      writeMetrics(now_ms);
    }
  } finally {
    // An error must not stop the age.
    age_timer = setTimeout(writeAge, wait_ms);
  }
}

// After a sleep the messages that wait in the connection are old, and the monotonic clock may have stood still.
function checkClock() {
  const difference = Date.now() - performance.now();
  if (Math.abs(difference - wall_minus_monotonic) < CLOCK_STEP_MS) return;
  wall_minus_monotonic = difference;
  clock.forget();
  link.reconnect("This computer's clock was set, or the computer slept");
}

function writeFreshness(age) {
  const state = !age ? "none" : age.fresh ? "fresh" : "stale";
  document.body.dataset.map = state;
  // A screen reader announces this text, so it holds the state alone and not the age.
  setText($("freshness"), { none: "NO MAP YET", fresh: "FRESH", stale: "STALE" }[state]);
  const share = age?.age_ms == null ? 1 : Math.min(Math.max(age.age_ms / age.validity_ms, 0), 1);
  $("bar").style.transform = `scaleX(${age ? share.toFixed(2) : 0})`;
  setText($("age"), age ? duration(age.age_ms) : dash);
  const valid = age && `valid for ${duration(age.validity_ms)} after capture`;
  setText($("why"), age ? age.why || valid : "waiting for the first map");
  const label = state === "stale" ? `STALE · ${duration(age.age_ms)}` : "";
  for (const panel of panels.values()) panel.writeStale(label);
}

function writeMetrics(now_ms) {
  drawn_ms = drawn_ms.filter((at) => now_ms - at <= RATE_OVER_MS);
  // Until a connection is RATE_OVER_MS old, the rate is that of the intervals so far.
  const over_ms = first_drawn_ms === null ? 0 : now_ms - first_drawn_ms;
  const { phase, text, retry_at_ms } = link_state;
  const per_ms = over_ms >= RATE_OVER_MS ? drawn_ms.length / RATE_OVER_MS : (drawn_ms.length - 1) / over_ms;
  const rate = phase === "live" ? per_ms : 0;
  setText($("rate"), (Number.isFinite(rate) && rate > 0 ? 1e3 * rate : 0).toFixed(1));
  setText($("size"), shown ? bytes(shown.map.length) : dash);
  const wait = retry_at_ms ? ` · again in ${Math.max(0, Math.ceil((retry_at_ms - now_ms) / 1e3))} s` : "";
  $("link").dataset.phase = phase;
  setText($("link-text"), text + wait);
  metrics.writeMapMetrics($("stream"), shown, stream.counts, clock.ahead_ms(wall_minus_monotonic));
  metrics.writePacketMetrics($("packets"), status);
  metrics.writeServerMetrics($("server"), status);
  metrics.writeSensors($("sensors"), shown?.map.header.sensors ?? status?.sensors ?? []);
  for (const element of document.querySelectorAll("[data-status-age]")) {
    metrics.writeStatusAge(element, status_arrived_ms, now_ms);
  }
}

function forgetVehicle() {
  shown = status = status_arrived_ms = first_drawn_ms = null;
  drawn_ms = [];
  stream = new MapStream();
  for (const panel of panels.values()) panel.element.remove();
  panels.clear();
  $("refusal").hidden = true;
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
  scheduleDraw();
};
// A browser may keep the check mark when the page is loaded again.
with_paths = $("paths").checked;
$("paths").onchange = () => {
  with_paths = $("paths").checked;
  scheduleDraw();
};

link.connect();
writeAge();
