// Tests of what the page must never get wrong: ages and counts. Run: cd server/web && node --test

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import test from "node:test";
import { behind, freshness, ServerClock } from "./clock.js";
import { paintChannel } from "./draw/paint.js";
import { MapStream } from "./map_stream.js";
import { view as recorderView } from "./recorder.js";
import { view } from "./replay.js";
import { clockWords } from "./text.js";

const ns = (ms) => BigInt(Math.round(ms * 1e6));

test("a skewed clock does not change an age", () => {
  for (const skew of [-3.6e6, 0, 3.6e6]) {
    const clock = new ServerClock(), start = 1.7e12 + skew;
    for (const [at, delay] of [[0, 20], [100, 5], [200, 60]]) clock.sample(at + delay, ns(start + at));
    const header = { capture_end_ns: ns(start + 150), valid_until_ns: ns(start + 450) };
    const age = freshness(header, null, clock.now_ns(260));
    assert.ok(Math.abs(age.age_ms - 105) < 0.1, `${age.age_ms} ms at skew ${skew}`);
    assert.ok(age.fresh);
  }
});

test("a delay that grows a millisecond a map becomes stale", () => {
  const clock = new ServerClock();
  let age;
  for (let i = 0; i < 600; i++) {
    const sent = 1e12 + i * 100, received = i * 100 + i;
    clock.sample(received, ns(sent));
    age = freshness({ capture_end_ns: ns(sent - 60), valid_until_ns: ns(sent + 240) }, null, clock.now_ns(received));
  }
  assert.equal(age.fresh, false);
  assert.ok(age.age_ms > 640, `${age.age_ms} ms`);
});

test("a map whose time is unknown, past or from the future is not fresh", () => {
  const header = { capture_end_ns: ns(1000), valid_until_ns: ns(1300) };
  const fresh = (now) => freshness(header, ns(1000), now).fresh;
  assert.deepEqual([null, ns(1301), ns(800), ns(1300)].map(fresh), [false, false, false, true]);
});

test("a stale map says why in the words of every client", () => {
  const cases = JSON.parse(readFileSync(new URL("../../client/golden/staleness.json", import.meta.url)));
  for (const { age_on_arrival_ms, since_arrival_ms, stale_because } of cases) {
    const came = ns(5000 + age_on_arrival_ms);
    const age = freshness({ capture_end_ns: ns(5000), valid_until_ns: ns(5300) }, came, came + ns(since_arrival_ms));
    assert.deepEqual([age.fresh, age.why], [stale_because === null, stale_because ?? ""]);
  }
});

test("a browser that lags says how far, and how old the server's newest map is", () => {
  const words = "this browser is 9.0 s behind; the server's newest map was 400 ms old";
  assert.equal(behind(9400, 400, 0, 300), words);
  assert.equal(behind(9400, 9000, 300, 300), null, "the server has no newer one either");
  assert.equal(behind(200, 40, 0, 300), null, "the map is fresh");
  for (const unknown of [null, undefined]) assert.equal(behind(unknown, 40, 0, 300), null);
  assert.equal(behind(9400, undefined, 0, 300), null);
});

test("a sensor's clock is named with how far the host is from it", () => {
  assert.equal(clockWords("gps", 0n), "GPS");
  assert.equal(clockWords("gps_unlocked", -7000n), "GPS, not locked, host 7.0 s behind");
  assert.equal(clockWords("arrival", 1n), "arrival, host 1 ms ahead");
  assert.equal(clockWords("", undefined), "–");
});

const varint = (n) => (n < 128 ? [n] : [(n & 127) | 128, ...varint(n >> 7)]);
const field = (number, bytes) => [8 * number + 2, ...varint(bytes.length), ...bytes];

// An encoded MapUpdate whose map has no layers.
function update({ boot_id = 1, sequence, skipped = 0, left_out = 0 }) {
  const header = [0x11, boot_id, 0, 0, 0, 0, 0, 0, 0, 0x18, ...varint(sequence)];
  const map = field(1, header);
  return Uint8Array.from([...field(1, map), 0x10, ...varint(skipped), 0x19, 1, 0, 0, 0, 0, 0, 0, 0, 0x20, ...varint(left_out)]);
}

// The counts, but those that are 0, after these updates; "restart" is a new connection.
function countsAfter(...updates) {
  const stream = new MapStream();
  for (const given of updates) {
    try {
      if (given === "restart") stream.restart();
      else stream.push(given instanceof Uint8Array ? given : update(given));
    } catch (error) {
      assert.equal(error.name, "WireError");
    }
  }
  const counts = Object.entries(stream.counts).map(([name, n]) => [name, Number(n)]);
  return Object.fromEntries(counts.filter(([, n]) => n > 0));
}

test("only the newest of the maps that wait is drawn, and the others are counted", () => {
  const stream = new MapStream();
  for (const sequence of [1, 2, 3]) stream.push(update({ sequence }));
  assert.equal(stream.removeNewest().map.header.sequence, 3n);
  assert.equal(stream.removeNewest(), null);
  assert.equal(stream.counts.replaced, 2n);
  stream.push(update({ sequence: 4 }));
  assert.equal(stream.counts.replaced, 2n);
});

test("a gap in the sequence is lost unless the server skipped it, left it out or the page could not read it", () => {
  const two = { received: 2, replaced: 1 };
  assert.deepEqual(countsAfter({ sequence: 5 }, { sequence: 9 }), { ...two, lost: 3 });
  assert.deepEqual(countsAfter({ sequence: 5 }, { sequence: 9, skipped: 2 }), { ...two, lost: 1, skipped: 2 });
  assert.deepEqual(countsAfter({ sequence: 5 }, { sequence: 15, skipped: 1, left_out: 8 }), { ...two, skipped: 1 });
  const unreadable = Uint8Array.of(0);
  assert.deepEqual(countsAfter({ sequence: 5 }, unreadable, { sequence: 7 }), { ...two, refused: 1 });
});

test("a map that arrives twice is repeated, but not if a new connection starts with it", () => {
  assert.deepEqual(countsAfter({ sequence: 5 }, { sequence: 5 }, { sequence: 4 }), { received: 1, repeated: 2 });
  const two = { received: 2, replaced: 1 };
  assert.deepEqual(countsAfter({ sequence: 5 }, "restart", { sequence: 5 }, { sequence: 6 }), two);
  assert.deepEqual(countsAfter({ sequence: 5 }, "restart", { sequence: 9 }), two);
});

test("the last map is shown again with the layers of a new selection", () => {
  const stream = new MapStream();
  stream.push(update({ sequence: 5 }));
  stream.removeNewest();
  stream.restart();
  stream.push(update({ sequence: 5 }));
  assert.equal(stream.removeNewest().map.header.sequence, 5n);
  assert.deepEqual([stream.counts.received, stream.counts.repeated], [1n, 0n]);
});

test("a server that starts again is counted, and its sequence starts again", () => {
  const counts = countsAfter({ sequence: 5 }, { boot_id: 2, sequence: 0 });
  assert.deepEqual(counts, { received: 2, replaced: 1, restarts: 1 });
});

test("a scale keeps its range from map to map and unknown cells stay out of it", () => {
  const channel = { name: "height", unit: "m", scale: 0.5, unknown: -128 };
  const layer = { legend: [{ name: "unknown", meaning: "unknown", colour: [1, 2, 3] }] };
  const range = (cells, before) => paintChannel(layer, channel, Int8Array.from(cells), before).range;
  assert.deepEqual(range([-128, -128], null), null);
  assert.deepEqual(range([-128, 2, 4], null), [1, 2]);
  assert.deepEqual(range([-2, 3], [1, 2]), [-1, 2]);
});

test("a legend gives each class its colour, its share of the cells and its meaning", () => {
  const legend = [
    { name: "unknown", meaning: "unknown", colour: [1, 2, 3] },
    { name: "not_drivable", meaning: "not reached", colour: [4, 5, 6] },
  ];
  const painted = paintChannel({ legend }, { name: "class" }, Uint8Array.of(0, 1, 1, 1), null);
  assert.deepEqual(painted.legend, [
    [[1, 2, 3], "unknown", 0.25, "unknown"],
    [[4, 5, 6], "not drivable", 0.75, "not reached"],
  ]);
  assert.deepEqual([...painted.colours.slice(0, 3)], [0xff030201, 0xff060504, 0]);
});

test("the time bar counts seconds from the first event, within the range that is played", () => {
  const at = (ms) => (1_317_000_000_000_000_000n + ns(ms)).toString();
  const state = {
    phase: "playing", rate: "max", begin_ns: at(0), end_ns: at(9000), from_ns: at(2000), to_ns: at(8000),
    position_ns: at(500),
  };
  const before = view(state);
  assert.deepEqual([before.from_s, before.to_s, before.position_s, before.plays], [2, 8, 2, true]);
  assert.equal(view({ ...state, position_ns: at(3456) }).time, "3.5 / 8.0 s");
  assert.equal(view({ ...state, phase: "waiting", readers_awaited: 2 }).phase, "waiting for 2 readers");
});

test("the recorder's section says its state, what was saved and what went wrong", () => {
  const on = { state: "recording", file: "drive.mcap", part: 2, reason: "" };
  assert.deepEqual(recorderView(on), { is_on: true, toggle: "Stop", text: "recording: part 2, drive.mcap", said: "" });
  assert.equal(recorderView(on, { files: ["a.mcap"] }).said, "Saved a.mcap");
  const failed = recorderView({ state: "failed", file: "", part: 2, reason: "disk full" }, { error: "no" });
  assert.deepEqual(failed, { is_on: false, toggle: "Record", text: "failed: disk full", said: "no" });
});
