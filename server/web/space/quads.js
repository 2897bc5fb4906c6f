// A list of quads for the view in 3-D, as the graphics card reads it: for each quad four corners in order around it (x,
// y, z as int16, centimetres in the ego frame) and a colour (an ImageData word). All arguments are metres.

// Bytes of one quad, and the offset of its colour.
export const QUAD_BYTES = 28, COLOUR_AT = 24;
const SHORTS = QUAD_BYTES / 2, WORDS = QUAD_BYTES / 4;
const CM_MAX = 32767;

const cm = (metres) => Math.min(Math.max(Math.round(100 * metres), -CM_MAX), CM_MAX);

export class QuadList {
  count = 0;
  #shorts;
  #words;

  constructor(room = 1024) {
    this.#place(new ArrayBuffer(room * QUAD_BYTES));
  }

  // The quads so far, as a view.
  get bytes() {
    return new Uint8Array(this.#words.buffer, 0, this.count * QUAD_BYTES);
  }

  // xy: x0, y0 ... x3, y3, around the quad. z0 to z3: the heights of its corners.
  push(xy, z0, z1, z2, z3, colour) {
    if ((this.count + 1) * QUAD_BYTES > this.#words.byteLength) this.#grow();
    const shorts = this.#shorts;
    let at = this.count * SHORTS;
    shorts[at++] = cm(xy[0]);
    shorts[at++] = cm(xy[1]);
    shorts[at++] = cm(z0);
    shorts[at++] = cm(xy[2]);
    shorts[at++] = cm(xy[3]);
    shorts[at++] = cm(z1);
    shorts[at++] = cm(xy[4]);
    shorts[at++] = cm(xy[5]);
    shorts[at++] = cm(z2);
    shorts[at++] = cm(xy[6]);
    shorts[at++] = cm(xy[7]);
    shorts[at] = cm(z3);
    this.#words[this.count * WORDS + COLOUR_AT / 4] = colour;
    this.count++;
  }

  // A quad that lies in a plane z = a x + b y + c, and `lift` over it.
  pushInPlane(xy, [a, b, c], lift, colour) {
    const z = (i) => a * xy[i] + b * xy[i + 1] + c + lift;
    this.push(xy, z(0), z(2), z(4), z(6), colour);
  }

  // A prism over a quad: from the plane up to `height` over it. It has no floor.
  pushBox(xy, plane, height, colour) {
    const [a, b, c] = plane;
    for (let i = 0; i < 8; i += 2) {
      const j = (i + 2) % 8, from = a * xy[i] + b * xy[i + 1] + c, to = a * xy[j] + b * xy[j + 1] + c;
      const side = [xy[i], xy[i + 1], xy[j], xy[j + 1], xy[j], xy[j + 1], xy[i], xy[i + 1]];
      this.push(side, from, to, to + height, from + height, colour);
    }
    this.pushInPlane(xy, plane, height, colour);
  }

  // A line on the ground with a width.
  pushLine([x0, y0, z0], [x1, y1, z1], width, colour) {
    const length = Math.hypot(x1 - x0, y1 - y0);
    if (!(length > 0)) return;
    const across = (width / 2 / length) * (y0 - y1), along = (width / 2 / length) * (x1 - x0);
    const xy = [x0 + across, y0 + along, x0 - across, y0 - along, x1 - across, y1 - along, x1 + across, y1 + along];
    this.push(xy, z0, z0, z1, z1, colour);
  }

  // A ring on the ground about the vehicle.
  pushRing(radius, width, z, colour) {
    const parts = Math.max(32, Math.ceil(radius * 4));
    const at = (i) => [radius * Math.cos((2 * Math.PI * i) / parts), radius * Math.sin((2 * Math.PI * i) / parts), z];
    for (let i = 0; i < parts; i++) this.pushLine(at(i), at(i + 1), width, colour);
  }

  #grow() {
    const old = this.bytes;
    this.#place(new ArrayBuffer(2 * this.#words.byteLength));
    new Uint8Array(this.#words.buffer).set(old);
  }

  #place(buffer) {
    this.#shorts = new Int16Array(buffer);
    this.#words = new Uint32Array(buffer);
  }
}
