// Tests of the built extension. Messages come to it as Foxglove hands them over: protobufjs, snake_case, BigInt. Run:
// npm install && npm run package && npm test. CLEARWAY_EXPORTED names what `clearway export --format foxglove` makes of
// client/golden/town.mcap.

import { McapIndexedReader } from "@mcap/core";
import { loadDecompressHandlers, protobufFromBinaryDescriptor } from "@mcap/support";
import { LiveMap } from "clearway-map";
import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import test from "node:test";
import extension from "./dist/extension.js";

const repository = new URL("../../../", import.meta.url);
const golden = (name) => new Uint8Array(readFileSync(new URL(`proto/golden/${name}.bin`, repository)));

// A function from encoded messages of a channel's schema to objects.
function decoder({ name, data }) {
  const type = protobufFromBinaryDescriptor(data).lookupType(name);
  return (bytes) => type.toObject(type.decode(bytes), { defaults: true, longs: BigInt });
}

// The messages of some schemas of a recording: { topic, bytes, message }, and the decoder of the last one.
async function read(file, schemas) {
  const bytes = new Uint8Array(readFileSync(file)), decompressHandlers = await loadDecompressHandlers();
  const readable = {
    size: async () => BigInt(bytes.length),
    read: async (offset, length) => bytes.slice(Number(offset), Number(offset + length)),
  };
  const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });
  const decoders = new Map(), messages = [];
  for (const [id, channel] of reader.channelsById) {
    const schema = reader.schemasById.get(channel.schemaId);
    if (schemas.includes(schema.name)) decoders.set(id, decoder(schema));
  }
  for await (const { channelId, data } of reader.readMessages()) {
    if (!decoders.has(channelId)) continue;
    const { topic } = reader.channelsById.get(channelId);
    messages.push({ topic, bytes: data, message: decoders.get(channelId)(data) });
  }
  return { messages, decode: [...decoders.values()].at(-1) };
}

const converters = {};
extension.activate({
  registerMessageConverter: ({ type, fromSchemaName, toSchemaName, converter }) => {
    assert.deepEqual([type, fromSchemaName], ["schema", "clearway.v1.Map"]);
    converters[toSchemaName] = converter;
  },
});
const topic = "/car/map/occupancy";
const gridOf = (message, on = topic) => converters["foxglove.Grid"](message, { topic: on });
const transformsOf = (message) => converters["foxglove.FrameTransforms"](message, { topic });

const town = await read(new URL("client/golden/town.mcap", repository), ["clearway.v1.Map"]);
const ofVehicle = (vehicle, name) => {
  const message = town.decode(golden(name));
  return { ...message, header: { ...message.header, vehicle } };
};

let warnings = [];
test.beforeEach((context) => {
  warnings = [];
  context.mock.method(console, "warn", (text) => warnings.push(text));
});

test("each layer of the golden recording is a grid with the cells of the decoder in the colours of its legend", () => {
  const seen = new Set();
  // Of the first map and the last one.
  for (const { topic, bytes, message } of [...town.messages.slice(0, 7), ...town.messages.slice(-7)]) {
    const map = new LiveMap(bytes), [name] = map.names, layer = map.layer(name), cells = layer.cells("class");
    const grid = gridOf(message, topic), columns = grid.column_count, rows = grid.data.length / grid.row_stride;
    seen.add(topic);
    const stamp = BigInt(grid.timestamp.sec) * 1_000_000_000n + BigInt(grid.timestamp.nsec);
    assert.deepEqual([grid.frame_id, stamp], ["car/base_link", map.header.capture_end_ns]);
    const colours = new Map(layer.legend.map(({ colour, meaning }) => [colour.join(), meaning]));
    for (let i = 0, free = 0; i < rows * columns; i++) {
      // The middle of a square in the ego frame.
      const x = ((i % columns) + 0.5) * grid.cell_size.x, y = (Math.floor(i / columns) + 0.5) * grid.cell_size.y;
      const { z, w } = grid.pose.orientation, cos = w * w - z * z, sin = 2 * z * w, { position } = grid.pose;
      const cell = layer.grid.cellAt(position.x + cos * x - sin * y, position.y + sin * x + cos * y);
      const [red, green, blue, alpha] = grid.data.subarray(4 * i, 4 * i + 4), shown = [red, green, blue].join();
      const entry = layer.legend[cells[cell]];
      if (cell < 0) assert.ok(alpha === 0 || colours.has(shown), `${topic}: square ${i} lies outside`);
      // A square of a radial layer may show a worse cell than that at its middle.
      else if (shown !== entry.colour.join()) assert.ok(!layer.grid.is_straight && colours.get(shown) !== "free");
    }
  }
  assert.deepEqual([seen.size, warnings], [7, []]);
});

const exported = process.env.CLEARWAY_EXPORTED;
test("the grids are those of the server's own output", { skip: !exported && "CLEARWAY_EXPORTED is not set" }, async () => {
  const { messages } = await read(exported, ["foxglove.Grid"]);
  assert.deepEqual([messages.length, town.messages.length], [70, 70]);
  const plain = (grid) => ({ ...grid, timestamp: null, data: Buffer.from(grid.data).toString("base64") });
  for (const { topic } of town.messages.slice(0, 7)) {
    const of = ({ messages }) => messages.filter((message) => message.topic === topic);
    const ours = of(town).map(({ message }) => plain(gridOf(message, topic)));
    assert.deepEqual(ours, of({ messages }).map(({ message }) => plain(message)), topic);
  }
});

test("the pose of a map is a transform from the vehicle's frame to the fixed frame, and no pose gives none", () => {
  const message = town.decode(golden("map")), { header } = new LiveMap(golden("map")), pose = header.map_from_ego;
  const [{ parent_frame_id, child_frame_id, translation, rotation }] = transformsOf(message).transforms;
  assert.deepEqual([parent_frame_id, child_frame_id], ["map", `${header.vehicle}/base_link`]);
  assert.deepEqual(Object.values(translation), [pose.x, pose.y, pose.z]);
  assert.deepEqual(Object.values(rotation), [pose.qx, pose.qy, pose.qz, pose.qw]);
  assert.equal(transformsOf({ ...message, header: { ...message.header, map_from_ego: null } }), undefined);
});

test("a delta on a map that came gives the grid of the whole map, in every panel, else nothing and a warning", () => {
  const [base, delta, whole] = ["delta_base", "delta", "delta_whole"].map((name) => ofVehicle("late", name));
  assert.equal(gridOf(delta), undefined);
  assert.equal(gridOf(delta), undefined);
  assert.equal(warnings.length, 1, "a reason is given once");
  assert.match(warnings[0], /no_base: layer \w+ is a delta to that of map \d+/);
  const truth = gridOf(whole);
  assert.ok(truth.data.length > 0, "a whole map mends it");
  gridOf(base);
  for (let panel = 0; panel < 2; panel++) assert.deepEqual(gridOf(delta), truth);
  assert.deepEqual(gridOf(town.decode(golden("delta")), topic), undefined, "another vehicle's map is no base");
});

test("two vehicles have frames and bases of their own", () => {
  const [one, other] = ["one", "other"].map((vehicle) => {
    gridOf(ofVehicle(vehicle, "delta_base"));
    return gridOf(ofVehicle(vehicle, "delta"));
  });
  assert.deepEqual([one.frame_id, other.frame_id], ["one/base_link", "other/base_link"]);
  assert.deepEqual(one.data, other.data);
});

test("a map after a restart of the server is no base of a delta from before", () => {
  const base = ofVehicle("restarted", "delta_base");
  gridOf({ ...base, header: { ...base.header, boot_id: base.header.boot_id + 1n } });
  assert.equal(gridOf(ofVehicle("restarted", "delta")), undefined);
});

test("a damaged map gives nothing and is no base", () => {
  const base = ofVehicle("damaged", "delta_base");
  const channel = base.layers[0].channels.find(({ name }) => name === "class");
  channel.payload = channel.payload.map((byte) => byte ^ 0xff);
  assert.equal(gridOf(base), undefined);
  assert.equal(gridOf({ header: null, layers: [] }), undefined);
  assert.equal(gridOf(ofVehicle("damaged", "delta")), undefined);
  assert.equal(warnings.length, 3);
});

test("a map whose grid, header or stamps are false gives nothing", () => {
  const base = ofVehicle("false", "delta_base"), [layer] = base.layers, { cartesian, channels } = layer;
  const [channel] = channels, one = { ...channel, name: "other", cell_count: 1 };
  const wide = { ...layer, radial: null, cartesian: { ...cartesian, width: 1 << 15, height: 1 << 15 }, channels: [one] };
  assert.equal(gridOf({ ...base, layers: [wide] }), undefined);
  const headed = (header) => ({ ...base, header: { ...base.header, ...header } });
  assert.equal(transformsOf(headed({ map_from_ego: { x: NaN, y: 0, z: 0, qx: 0, qy: 0, qz: 0, qw: 1 } })), undefined);
  assert.equal(gridOf(headed({ capture_start_ns: -2n, capture_end_ns: -1n })), undefined);
  assert.deepEqual(warnings.map((text) => text.match(/cell_count|header|before 0/)?.[0]), ["cell_count", "header", "before 0"]);
});

test("of a map with several layers the one is shown whose name ends the topic, else the first", () => {
  const bytes = golden("map"), message = town.decode(bytes), names = new LiveMap(bytes).names;
  const shown = names.map((name) => gridOf(message, `/car/map/${name}`)?.column_count);
  assert.ok(names.length > 1 && shown.every((columns) => columns > 0), `${names}: ${shown}`);
  assert.equal(gridOf(message, "/bridge").column_count, shown[0]);
});
