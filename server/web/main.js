// The page: which view is open, and messages between it and the Worker. The address says what is shown: `?vehicle=NAME`
// one vehicle, `?fleet` all of them, neither: the fleet, or the vehicle if there is only one.

import { ServerClock } from "./clock.js";
import { FleetView } from "./fleet/fleet.js";
import { elsewhere } from "./fleet/state.js";
import { Recorder } from "./recorder.js";
import { ReplayBar } from "./replay.js";
import { keepSettings, loadSettings } from "./settings.js";
import { setText } from "./text.js";
import { VehicleView } from "./vehicle/vehicle.js";

// The two clocks of a browser run alike, unless one was set or the computer slept.
const CLOCK_STEP_MS = 1000;
const TICK_MS = 1000;

const $ = (id) => document.getElementById(id);
const worker = new Worker("worker.js", { type: "module" });
const post = (message) => worker.postMessage(message);
const clock = new ServerClock(), settings = loadSettings();
const keep = () => keepSettings(settings);
const fleet = new FleetView(post, clock, settings, keep), view = new VehicleView(post, clock, settings, keep);
const control = (request) => post({ type: "server", request: { type: "replay", ...request } });
const replay = new ReplayBar($("replay"), control);
const record = (request) => post({ type: "server", request: { type: "recorder", ...request } });
const recorder = new Recorder($("recorder"), record);
// Frames that are not drawn yet, by vehicle.
const frames = new Map();
let is_draw_scheduled = false, wall_minus_monotonic = Date.now() - performance.now();
let link = { phase: "connecting", text: "Connecting …" }, retry_at_ms = 0;
let names = null;

// A time of the Worker, from the Unix epoch -> the same time on this thread's clock.
const local = (absolute_ms) => absolute_ms - performance.timeOrigin;

const FROM_WORKER = {
  link(state) {
    link = state;
    retry_at_ms = state.retry_in_ms ? performance.now() + state.retry_in_ms : 0;
    writeLink();
    view.link(state);
    if (state.phase !== "live") return;
    clock.restart();
    // A replay reports itself again on the new connection.
    replay.hide();
    recorder.hide();
    view.replay(null);
  },
  fleet({ vehicles, others, arrived_ms }) {
    names = vehicles.map(({ name }) => name);
    const is_alone = names.length === 1 && others.length === 0;
    if (view.name === null && isUndecided()) go(is_alone ? names[0] : null, "replaceState");
    writePicker();
    fleet.status([...vehicles, ...others.map(elsewhere)], local(arrived_ms));
    if (view.name === null) return;
    const status = vehicles.find(({ name }) => name === view.name);
    view.status(status, local(arrived_ms));
    recorder.status(status?.recorder);
  },
  replay(state) {
    replay.show(state);
    view.replay(state);
  },
  recorder: (message) => recorder.answer(message),
  frame(frame) {
    if (!clock.sample(local(frame.arrived_ms), frame.sent_ns)) {
      post({ type: "reconnect", text: "The connection lags; starting again" });
    }
    frame.came_ns = clock.now_ns(local(frame.arrived_ms));
    frames.set(frame.vehicle, frame);
    if (is_draw_scheduled) return;
    is_draw_scheduled = true;
    requestAnimationFrame(draw);
  },
  points: (message) => view.points(message),
  cell: (message) => message.vehicle === view.name && view.cell(message),
  refused({ vehicle, reason }) {
    if (view.name !== null && (vehicle === view.name || vehicle === "")) view.refuse(reason);
    else if (view.name === null) setText($("fleet-refusal"), reason);
    $("fleet-refusal").hidden = $("fleet-refusal").textContent === "";
  },
};

worker.onmessage = ({ data }) => FROM_WORKER[data.type]?.(data);
worker.onerror = (event) => {
  link = { phase: "lost", text: `This page failed: ${event.message}` };
  writeLink();
};

function draw() {
  is_draw_scheduled = false;
  const drawn = [...frames];
  frames.clear();
  for (const [vehicle, frame] of drawn) {
    // The Worker sends the next frame after this, even if this frame cannot be drawn.
    post({ type: "drawn", vehicle });
    if (view.name === null) fleet.frame(vehicle, frame);
    else if (vehicle === view.name) view.frame(frame);
  }
}

const query = () => new URLSearchParams(location.search);
const isUndecided = () => !query().has("vehicle") && !query().has("fleet");

// Shows a vehicle, or the fleet (null).
function go(vehicle, how = "pushState") {
  history[how](null, "", vehicle === null ? "?fleet" : `?vehicle=${encodeURIComponent(vehicle)}`);
  show(vehicle);
}

function show(vehicle) {
  document.body.dataset.view = vehicle === null ? "fleet" : "vehicle";
  if (vehicle === null) {
    document.body.dataset.map = "none";
    document.title = "Fleet · Clearway";
    view.close();
    return fleet.open();
  }
  document.title = `${vehicle} · Clearway`;
  fleet.close(vehicle);
  view.open(vehicle);
}

function writePicker() {
  const select = $("vehicle");
  if ([...select.options].map((option) => option.value).join("\n") !== names.join("\n")) {
    select.replaceChildren(...names.map((name) => new Option(name, name)));
  }
  if (view.name !== null) select.value = view.name;
  select.hidden = names.length < 2;
}

function writeLink() {
  const wait = link.phase === "lost" && retry_at_ms ? Math.ceil((retry_at_ms - performance.now()) / 1e3) : 0;
  $("link").dataset.phase = link.phase;
  setText($("link-text"), link.text + (wait > 0 ? ` · again in ${wait} s` : ""));
}

// After a sleep the messages that wait in the connection are old, and the monotonic clock may have stood still.
function checkClock() {
  const difference = Date.now() - performance.now();
  if (Math.abs(difference - wall_minus_monotonic) < CLOCK_STEP_MS) return;
  wall_minus_monotonic = difference;
  clock.forget();
  post({ type: "reconnect", text: "This computer's clock was set, or the computer slept" });
}

setInterval(() => {
  checkClock();
  writeLink();
  fleet.write();
}, TICK_MS);

onpopstate = () => show(query().get("vehicle"));
$("vehicle").onchange = () => go($("vehicle").value);

// Links of this page open without loading it again, unless the user wants a new tab.
document.addEventListener("click", (event) => {
  const link = event.target.closest?.("a[href^='?']");
  if (!link || event.ctrlKey || event.metaKey || event.shiftKey || event.button !== 0) return;
  event.preventDefault();
  go(new URLSearchParams(new URL(link.href).search).get("vehicle"));
  scrollTo(0, 0);
});

document.addEventListener("keydown", (event) => {
  const is_typing = event.target.closest?.("input:not([type=checkbox],[type=radio],[type=range]), select, textarea");
  if (is_typing || event.ctrlKey || event.metaKey || event.altKey) return;
  const isIn = (name) => document.body.dataset.view === name;
  if (event.key === "?") $("keys").showModal();
  else if ($("keys").open) return;
  else if (event.key === "f" && isIn("vehicle")) go(null);
  else if (event.key === "/" && isIn("fleet")) $("find").focus();
  else if (!isIn("vehicle") || !view.pressKey(event.key)) return;
  event.preventDefault();
});

$("help").onclick = () => $("keys").showModal();

// Without these words the legend has its names alone.
fetch("classes.json").then((answer) => answer.json()).then((classes) => view.explain(classes)).catch(() => {});

writeLink();
if (!isUndecided()) show(query().get("vehicle"));
