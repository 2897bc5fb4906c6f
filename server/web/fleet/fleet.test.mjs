// Tests of what the fleet says of a vehicle, and of the order of the cards. Run: cd server/web && node --test

import assert from "node:assert/strict";
import test from "node:test";
import { gridStep, vehicleAt, viewOf } from "./places.js";
import { coarse } from "../text.js";
import { addressOf, ageOf, beganAt, chosen, elsewhere, freshOf, needsCare, stateOf, tally } from "./state.js";

test("a state that the server does not send, or that is unknown, is not shown", () => {
  assert.deepEqual(stateOf(undefined), { state: null, reasons: [] });
  assert.deepEqual(stateOf({ state: "constructor" }), { state: null, reasons: [] });
  const reasons = ["no packets from top for 76 s"];
  assert.deepEqual(stateOf({ state: "error", reasons }), { state: "error", reasons });
  assert.deepEqual(stateOf({ claimed_by: ["b:50051"] }).reasons, ["also claimed by b:50051"]);
});

test("the age of a vehicle's maps is that of the newest one told of, and grows when there is no news", () => {
  assert.equal(ageOf({}, 100, null), null);
  assert.equal(ageOf({ map_age_ms: 200 }, 700, null), 200);
  assert.equal(ageOf({ map_age_ms: 200 }, 3700, null), 3900);
  assert.equal(ageOf({ map_age_ms: 200 }, 700, 40), 40);
  assert.equal(ageOf({ map_age_ms: null }, 700, 1400), 1400);
});

test("a map is fresh until its validity has passed", () => {
  assert.deepEqual([freshOf(null, 300), freshOf(300, 300), freshOf(301, 300)], ["none", "fresh", "stale"]);
});

const card = (name, more = {}, fresh = "fresh", age_ms = 100) =>
  ({ status: { name, ...more }, fresh, age_ms, speed: more.speed_m_s ?? null });
const CARDS = [
  card("car 10", { state: "ok", speed_m_s: 3, loss: 0 }),
  card("car 9", { state: "warn", speed_m_s: 9, loss: 0.2 }),
  card("bus", {}, "stale", 9000),
  card("tram", { state: "error" }, "none", null),
];
const order = (order, only = "all", text = "") => chosen(CARDS, { order, only, text });

test("vehicles are ordered by state, name, age, loss or speed, and the unknown comes last", () => {
  assert.deepEqual(order("state"), ["tram", "bus", "car 9", "car 10"]);
  assert.deepEqual(order("name"), ["bus", "car 9", "car 10", "tram"]);
  assert.deepEqual(order("age"), ["tram", "bus", "car 9", "car 10"], "a vehicle without a map first");
  assert.deepEqual(order("speed").slice(0, 2), ["car 9", "car 10"]);
  assert.deepEqual(order("loss").slice(0, 2), ["car 9", "car 10"]);
  assert.deepEqual(order("no such order"), order("name"));
});

test("what needs hands comes first: errors, old maps, warnings, and of two alike what has lasted longer", () => {
  const of = (name, state, began_ms, fresh = "fresh") => ({ ...card(name, { state }, fresh), began_ms });
  const cards = [
    of("a", "ok", 900), of("b", "warn", 500), of("c", "warn", 200), of("d", "ok", 600, "stale"),
    of("e", "error", 800, "stale"), of("f", "error", 700, "none"), of("g", "warn", null), of("h", "ok", 100),
  ];
  const keys = chosen(cards, { order: "state", only: "all", text: "" });
  assert.equal(keys.join(""), "fedcbgah", "those that are well by name");
});

test("a state has one beginning in all statuses of it, and how long it lasts is told coarsely", () => {
  const began = (state_ms, before_ms) => beganAt({ state_ms }, 9000, before_ms);
  assert.deepEqual([began(5000, null), began(5000, 4400), began(5000, 100)], [4000, 4400, 4000]);
  assert.equal(began(undefined, 4400), null);
  const told = [null, 40, 940, 59_900, 185_000, 7.5e6].map(coarse);
  assert.deepEqual(told, ["–", "0.1 s", "0.9 s", "59 s", "3 min", "2 h 5 min"]);
});

test("vehicles are found by a part of their name, and by their need of care", () => {
  assert.deepEqual(order("name", "all", " CAR "), ["car 9", "car 10"]);
  assert.deepEqual(order("name", "care"), ["bus", "car 9", "tram"]);
  assert.ok(!needsCare(CARDS[0]));
  assert.deepEqual(tally(CARDS), { all: 4, error: 1, warn: 1, ok: 1, stale: 1 });
});

test("all vehicles are on the map, x to the right and y up, and a click finds the nearest", () => {
  const at = (name, x_m, y_m) => ({ name, pose: { x_m, y_m } });
  const places = [at("a", 1000, -50), at("b", 1400, 50)], view = viewOf(places, { width: 468, height: 168 });
  assert.equal(view.scale, 1);
  const drawn = places.map(({ name, pose }) => ({ name, px: view.px(pose), py: view.py(pose) }));
  assert.deepEqual(drawn, [{ name: "a", px: 34, py: 134 }, { name: "b", px: 434, py: 34 }]);
  assert.deepEqual([vehicleAt(drawn, 40, 130), vehicleAt(drawn, 200, 100), vehicleAt([], 0, 0)], ["a", null, null]);
  assert.deepEqual([gridStep(1, 60), gridStep(10, 60), gridStep(0.03, 60)], [100, 10, 2000]);
});

test("a vehicle of another server has its own key, says who serves it, and links to that server's page alone", () => {
  const van = elsewhere({ name: "van", server: "b", grpc: "b:1", page: "https://b:8080/", reasons: ["old"] });
  assert.equal(van.key, "van @ b @ b:1");
  assert.deepEqual(stateOf(van).reasons, ["served by b (b:1)", "old"]);
  const [first, second] = ["run 1", "run 2"].map((run) => elsewhere({ name: "van", server: "b", grpc: "", run }));
  assert.notEqual(first.key, second.key);
  assert.deepEqual(stateOf(first).reasons, ["served by b (run 1)"]);
  assert.equal(addressOf(van), "https://b:8080/?vehicle=van");
  assert.equal(addressOf({ name: "a b" }), "?vehicle=a%20b");
  for (const page of [undefined, "", "b:8080", "javascript:alert(1)"]) assert.equal(addressOf({ ...van, page }), null);
  const cards = [van, { name: "van" }].map((status) => ({ status, age_ms: 1, fresh: "fresh", speed: null }));
  assert.deepEqual(chosen(cards, { order: "name", only: "all", text: "VAN" }), ["van @ b @ b:1", "van"]);
});
