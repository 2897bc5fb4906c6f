// In: messages of clearway.v1.Map, as Foxglove decodes protobuf. Out: foxglove.Grid, a layer with the fields, frame and
// colours of the server's own Foxglove output, and foxglove.FrameTransforms, the pose of the vehicle. A message that
// cannot be shown gives nothing, and its reason once in the console.

import type { ExtensionContext, Immutable, MessageEvent } from "@foxglove/extension";
import type { FrameTransforms, Grid, Quaternion } from "@foxglove/schemas";
import { LiveMap, type Header } from "clearway-map";
import { rasterOf, rgbaOf, type LayerMessage } from "./raster";

interface MapMessage {
  header?: Header | null;
  layers: LayerMessage[];
}
type Event = Immutable<MessageEvent<MapMessage>>;

/** NumericType.UINT8 of foxglove.PackedElementField. */
const UINT8 = 1;
const FIELDS = ["red", "green", "blue", "alpha"].map((name, offset) => ({ name, offset, type: UINT8 }));

/**
 * The newest maps by vehicle and layer, and in these by run and sequence number: a delta needs one of them. Several,
 * because each panel converts the messages of its own frames.
 */
const MAPS_KEPT = 8;
const kept = new Map<string, Map<string, LiveMap>>();

/** The layer whose name ends the topic's name, else the first layer. Recordings have one layer in each map. */
function grid(message: MapMessage, { topic }: Event): Grid {
  const layer_message = message.layers.find(({ name }) => topic.endsWith(`/${name}`)) ?? message.layers[0];
  if (!layer_message) throw new Error("a map without layers");
  const { name, base_sequence } = layer_message, map = new LiveMap(message), { header } = map;
  const of_layer = `${header.vehicle}/${name}`, maps = kept.get(of_layer) ?? new Map<string, LiveMap>();
  const layer = map.layer(name, maps.get(`${header.boot_id} ${base_sequence}`))!;
  const raster = rasterOf(layer_message, layer), data = rgbaOf(raster, layer);
  keep(maps, `${header.boot_id} ${header.sequence}`, map);
  kept.set(of_layer, maps);
  return {
    timestamp: stamp(header.capture_end_ns),
    frame_id: baseFrame(header),
    pose: { position: { x: raster.x_m, y: raster.y_m, z: 0 }, orientation: aboutZ(raster.yaw_rad) },
    column_count: raster.width,
    cell_size: { x: raster.cell_m, y: raster.cell_m },
    row_stride: raster.width * FIELDS.length,
    cell_stride: FIELDS.length,
    fields: FIELDS,
    data,
  };
}

/** The newest is the last. */
function keep(maps: Map<string, LiveMap>, key: string, map: LiveMap) {
  maps.delete(key);
  maps.set(key, map);
  if (maps.size > MAPS_KEPT) maps.delete(maps.keys().next().value!);
}

/** The ego frame in `map`, the vehicle's fixed frame; nothing if no pose is known. */
function transforms(message: MapMessage): FrameTransforms | undefined {
  const { header } = new LiveMap(message), pose = header.map_from_ego;
  if (!pose) return undefined;
  const { x, y, z, qx, qy, qz, qw } = pose, rotation = { x: qx, y: qy, z: qz, w: qw }, translation = { x, y, z };
  const timestamp = stamp(header.capture_end_ns), child_frame_id = baseFrame(header);
  return { transforms: [{ timestamp, parent_frame_id: "map", child_frame_id, translation, rotation }] };
}

const baseFrame = ({ vehicle }: Header) => `${vehicle}/base_link`;
function stamp(ns: bigint) {
  if (ns < 0n) throw new Error(`capture_end_ns is ${ns}; Foxglove has no time before 0`);
  return { sec: Number(ns / 1_000_000_000n), nsec: Number(ns % 1_000_000_000n) };
}
const aboutZ = (yaw: number): Quaternion => ({ x: 0, y: 0, z: Math.sin(yaw / 2), w: Math.cos(yaw / 2) });

/** `convert` without errors: Foxglove draws nothing for undefined. */
function orNothing<To>(convert: (message: MapMessage, event: Event) => To) {
  // By topic: why its last map is not shown.
  const refused = new Map<string, string>();
  return (message: MapMessage, event: Event) => {
    try {
      const converted = convert(message, event);
      refused.delete(event.topic);
      return converted;
    } catch (error) {
      const reason = String(error);
      if (refused.get(event.topic) !== reason) console.warn(`clearway: ${event.topic}: ${reason}`);
      refused.set(event.topic, reason);
      return undefined;
    }
  };
}

export function activate(context: ExtensionContext): void {
  const register = (toSchemaName: string, converter: ReturnType<typeof orNothing>) =>
    context.registerMessageConverter({ type: "schema", fromSchemaName: "clearway.v1.Map", toSchemaName, converter });
  register("foxglove.Grid", orNothing(grid));
  register("foxglove.FrameTransforms", orNothing(transforms));
}
