// The limits of what the page accepts, checked before anything is allocated. The Rust and the Python decoder have the
// same limits: a test compares them with proto/golden/limits.json.

// Cells of one channel.
export const CHANNEL_CELLS_MAX = 4 << 20;
// Cells of all channels of one map together.
export const MAP_CELLS_MAX = 16 << 20;
// Bytes of one encoded map.
export const MAP_BYTES_MAX = 4 << 20;
// Layers, channels, planes, sensors and names of one map together.
export const MAP_PARTS_MAX = 1 << 16;

// Largest coordinate of a safe point in steps, and its largest radius in centimetres.
export const SAFE_POINT_STEPS_MAX = 1 << 24;

// Latest major version of the wire that is read; 0 and 1 are the first one.
export const WIRE_VERSION = 1;

// The error for a message that is refused. `reason` is the name that the golden vectors give the fault.
export class DecodeError extends Error {
  name = "DecodeError";
  constructor(reason, detail) {
    super(`${reason}: ${detail}`);
    this.reason = reason;
  }
}
