// In: a binary message of the server. Out: the points of one vehicle, if it is a frame of points. The format is defined
// in server/daemon/src/publish/page_points.rs.

import { egoFrom, yawOf } from "../vehicle/view.js";
import { DecodeError } from "../wire/limits.js";

const MAGIC = 0x54505743, HEAD_BYTES = 24, POINT_BYTES = 6;

const viewOf = (bytes) => new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);

// True if a message begins as a frame of points does. A MapUpdate never does.
export const isPoints = (bytes) => bytes.length >= 4 && viewOf(bytes).getUint32(0, true) === MAGIC;

// { vehicle, capture_end_ns, total: points of the map, count: points in the frame, xyz: Int16Array, centimetres, ego
// frame }. Throws a DecodeError.
export function readPoints(bytes) {
  const error = (what) => new DecodeError("points", what);
  if (bytes.length < HEAD_BYTES) throw error(`${bytes.length} bytes; at least ${HEAD_BYTES} are needed`);
  const view = viewOf(bytes), count = view.getUint32(4, true), name_length = view.getUint32(20, true);
  const length = HEAD_BYTES + count * POINT_BYTES + name_length;
  if (bytes.length !== length) throw error(`${bytes.length} bytes; ${count} points and a name have ${length}`);
  const total = view.getUint32(16, true);
  if (count > total) throw error(`${count} of ${total} points`);
  const name_at = length - name_length;
  // A copy lies at an even address.
  const xyz = new Int16Array(bytes.slice(HEAD_BYTES, name_at).buffer);
  const vehicle = new TextDecoder().decode(bytes.subarray(name_at));
  return { vehicle, capture_end_ns: view.getBigInt64(8, true), total, count, xyz };
}

// The poses of the newest maps, in which the points of an earlier one are moved to where the vehicle is now.
const POSES_MAX = 60;

export class Poses {
  #poses = [];

  push(stamp_ns, pose) {
    const last = this.#poses.at(-1);
    if (!pose || (last && stamp_ns < last.stamp_ns)) this.#poses = [];
    if (!pose || stamp_ns === this.#poses.at(-1)?.stamp_ns) return;
    this.#poses.push({ stamp_ns, x: pose.x, y: pose.y, yaw: yawOf(pose), pose });
    if (this.#poses.length > POSES_MAX) this.#poses.shift();
  }

  // Pose of the ego frame at a time in the ego frame of the newest map: { x, y, yaw }; null if it is not known. Between
  // two maps the vehicle moves evenly.
  move(stamp_ns) {
    const after = this.#poses.findIndex((at) => at.stamp_ns >= stamp_ns), to = this.#poses[after];
    if (!to || (after === 0 && to.stamp_ns !== stamp_ns)) return null;
    const from = this.#poses[Math.max(after - 1, 0)];
    const part = to === from ? 1 : Number(stamp_ns - from.stamp_ns) / Number(to.stamp_ns - from.stamp_ns);
    const turn = Math.atan2(Math.sin(to.yaw - from.yaw), Math.cos(to.yaw - from.yaw));
    const then = { x: from.x + part * (to.x - from.x), y: from.y + part * (to.y - from.y) };
    const now = this.#poses.at(-1);
    return { ...egoFrom(now.pose, then), yaw: from.yaw + part * turn - now.yaw };
  }
}
