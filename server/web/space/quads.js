// A list of quads for the view in 3-D, as the graphics card reads it: for each quad four corners in order around it,
// each x, y, z as int16 (centimetres in the ego frame), two bytes of nothing and a colour (an ImageData word). All
// arguments are metres. All quads of a list are one draw of triangles, not instances of one quad, which a browser
// without a graphics card draws one by one.

// Bytes of one corner and of one quad, and the offset of a corner's colour.
export const CORNER_BYTES = 12, QUAD_BYTES = 4 * CORNER_BYTES, COLOUR_AT = 8;
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
    const shorts = this.#shorts, words = this.#words, first = 4 * this.count;
    for (let i = 0; i < 4; i++) {
      const at = 6 * (first + i);
      shorts[at] = cm(xy[2 * i]);
      shorts[at + 1] = cm(xy[2 * i + 1]);
      shorts[at + 2] = cm(i < 2 ? (i === 0 ? z0 : z1) : i === 2 ? z2 : z3);
      words[3 * (first + i) + 2] = colour;
    }
    this.count++;
  }

  // A quad that lies in a plane z = a x + b y + c, and `lift` over it.
  pushInPlane(xy, [a, b, c], lift, colour) {
    const z = (i) => a * xy[i] + b * xy[i + 1] + c + lift;
    this.push(xy, z(0), z(2), z(4), z(6), colour);
  }

  // A side of a prism over a quad: over its edge `edge` (from corner `edge` to the next), from `low` to `high` over the
  // plane.
  pushSide(xy, edge, [a, b, c], low, high, colour) {
    const i = 2 * edge, j = (i + 2) % 8, from = a * xy[i] + b * xy[i + 1] + c, to = a * xy[j] + b * xy[j + 1] + c;
    const side = [xy[i], xy[i + 1], xy[j], xy[j + 1], xy[j], xy[j + 1], xy[i], xy[i + 1]];
    this.push(side, from + low, to + low, to + high, from + high, colour);
  }

  // A prism over a quad: from the plane up to `height` over it. It has no floor.
  pushBox(xy, plane, height, colour) {
    for (let edge = 0; edge < 4; edge++) this.pushSide(xy, edge, plane, 0, height, colour);
    this.pushInPlane(xy, plane, height, colour);
  }

  // All quads of another list, after the quads so far.
  append(list) {
    while ((this.count + list.count) * QUAD_BYTES > this.#words.byteLength) this.#grow();
    new Uint8Array(this.#words.buffer).set(list.bytes, this.count * QUAD_BYTES);
    this.count += list.count;
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
