// Quads and points on a canvas, by WebGL 2. In: buffers of quads.js and points.js, and a matrix of orbit.js.

import { scaleColour } from "../draw/palette.js";
import { COLOUR_AT, CORNER_BYTES } from "./quads.js";

const GROUND = [0.043, 0.055, 0.067, 1];
// Colours of points: from their height over the ground under the vehicle, metres.
export const LOW_M = -0.5, HIGH_M = 3;
const STOPS = [0, 0.25, 0.5, 0.75, 1];

// A quad is two triangles of four corners. It is lit from above, so that planes of another slope differ, and its edge
// is darker where a pixel is smaller than it.
const QUAD = [`#version 300 es
uniform mat4 matrix;
in vec3 corner;
in vec4 colour;
out vec4 painted;
out vec3 place;
out vec2 at;
void main() {
  int number = gl_VertexID & 3;
  at = vec2(number == 1 || number == 2 ? 1.0 : 0.0, number >= 2 ? 1.0 : 0.0);
  painted = colour;
  place = 0.01 * corner;
  gl_Position = matrix * vec4(place, 1.0);
}`, `#version 300 es
precision highp float;
in vec4 painted;
in vec3 place;
in vec2 at;
out vec4 pixel;
void main() {
  vec3 normal = cross(dFdx(place), dFdy(place));
  float light = 0.62 + 0.38 * abs(dot(normal / max(length(normal), 1e-12), vec3(-0.34, 0.2, 0.919)));
  vec2 size = max(fwidth(at), vec2(1e-4)), inside = min(at, 1.0 - at) / size;
  float is_large = 1.0 - smoothstep(0.1, 0.35, max(size.x, size.y));
  float edge = (1.0 - smoothstep(0.4, 1.4, min(inside.x, inside.y))) * is_large;
  pixel = vec4(painted.rgb * light * (1.0 - 0.35 * edge), painted.a);
}`];

const POINT = [`#version 300 es
uniform mat4 matrix;
uniform vec3 stops[5];
uniform vec2 heights;
uniform float pixels;
// Where the points' ego frame is in the cells': x, y, yaw.
uniform vec3 move;
in vec3 point;
out vec3 tint;
void main() {
  float t = 4.0 * clamp((0.01 * point.z - heights.x) / (heights.y - heights.x), 0.0, 1.0);
  int below = int(min(t, 3.0));
  tint = mix(stops[below], stops[below + 1], t - float(below));
  vec2 at = 0.01 * point.xy, turn = vec2(cos(move.z), sin(move.z));
  at = vec2(at.x * turn.x - at.y * turn.y, at.x * turn.y + at.y * turn.x) + move.xy;
  gl_Position = matrix * vec4(at, 0.01 * point.z, 1.0);
  gl_PointSize = clamp(pixels * 45.0 / gl_Position.w, pixels, 3.0 * pixels);
}`, `#version 300 es
precision mediump float;
in vec3 tint;
out vec4 pixel;
void main() { pixel = vec4(tint, 1.0); }`];

export class Scene {
  #gl;
  #quads;
  #points;
  // The buffers of quads by name, in the order in which they are drawn, and the buffer of the points.
  #lists = new Map();
  #cloud;
  // The corners of the triangles of all quads, and of how many.
  #corners;
  #corners_of = 0;
  // Signalled when the graphics card has drawn the last picture; null if it has.
  #drawing = null;

  // Throws an Error that says what the browser lacks.
  constructor(canvas) {
    const gl = (this.#gl = canvas.getContext("webgl2", { antialias: devicePixelRatio < 2 }));
    if (!gl) throw new Error("this browser gives no WebGL 2");
    this.#quads = program(gl, QUAD);
    this.#points = program(gl, POINT);
    this.#cloud = this.#newPoints();
    this.#corners = gl.createBuffer();
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.clearColor(...GROUND);
  }

  // True if the last picture is not drawn yet. A new one would only wait, and the page with it.
  get is_busy() {
    const gl = this.#gl;
    if (this.#drawing && gl.getSyncParameter(this.#drawing, gl.SYNC_STATUS) === gl.SIGNALED) {
      gl.deleteSync(this.#drawing);
      this.#drawing = null;
    }
    return this.#drawing !== null;
  }

  // Replaces the quads of a name.
  setQuads(name, { bytes, count }) {
    const gl = this.#gl;
    if (!this.#lists.has(name)) this.#lists.set(name, this.#newList());
    const list = this.#lists.get(name);
    gl.bindBuffer(gl.ARRAY_BUFFER, list.buffer);
    gl.bufferData(gl.ARRAY_BUFFER, bytes, gl.DYNAMIC_DRAW);
    list.count = count;
    if (count > this.#corners_of) this.#addCorners(2 * count);
  }

  // xyz: Int16Array, centimetres.
  setPoints(xyz) {
    const gl = this.#gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.#cloud.buffer);
    gl.bufferData(gl.ARRAY_BUFFER, xyz, gl.DYNAMIC_DRAW);
    this.#cloud.count = xyz.length / 3;
  }

  // pixels: of the canvas for each CSS pixel. move: { x, y, yaw }: the pose of the points' ego frame in the cells' ego
  // frame.
  draw(matrix, pixels, move) {
    const gl = this.#gl;
    gl.viewport(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.useProgram(this.#points);
    gl.uniformMatrix4fv(gl.getUniformLocation(this.#points, "matrix"), false, matrix);
    const stops = STOPS.flatMap((t) => scaleColour(t).map((part) => part / 255));
    gl.uniform3fv(gl.getUniformLocation(this.#points, "stops"), stops);
    gl.uniform2f(gl.getUniformLocation(this.#points, "heights"), LOW_M, HIGH_M);
    gl.uniform1f(gl.getUniformLocation(this.#points, "pixels"), 1.2 * pixels);
    gl.uniform3f(gl.getUniformLocation(this.#points, "move"), move.x, move.y, move.yaw);
    gl.bindVertexArray(this.#cloud.vertices);
    gl.drawArrays(gl.POINTS, 0, this.#cloud.count);
    gl.useProgram(this.#quads);
    gl.uniformMatrix4fv(gl.getUniformLocation(this.#quads, "matrix"), false, matrix);
    for (const { vertices, count } of this.#lists.values()) {
      gl.bindVertexArray(vertices);
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.#corners);
      gl.drawElements(gl.TRIANGLES, 6 * count, gl.UNSIGNED_INT, 0);
    }
    gl.bindVertexArray(null);
    this.#drawing = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
  }

  #newList() {
    const gl = this.#gl, vertices = gl.createVertexArray(), buffer = gl.createBuffer();
    gl.bindVertexArray(vertices);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    const add = (name, size, type, normalized, offset) => {
      const place = gl.getAttribLocation(this.#quads, name);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, size, type, normalized, CORNER_BYTES, offset);
    };
    add("corner", 3, gl.SHORT, false, 0);
    add("colour", 4, gl.UNSIGNED_BYTE, true, COLOUR_AT);
    return { vertices, buffer, count: 0 };
  }

  #addCorners(quads) {
    const gl = this.#gl, corners = new Uint32Array(6 * quads);
    for (let quad = 0, at = 0; quad < quads; quad++) {
      for (const corner of [0, 1, 2, 0, 2, 3]) corners[at++] = 4 * quad + corner;
    }
    gl.bindVertexArray(null);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.#corners);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.STATIC_DRAW);
    this.#corners_of = quads;
  }

  #newPoints() {
    const gl = this.#gl, vertices = gl.createVertexArray(), buffer = gl.createBuffer();
    gl.bindVertexArray(vertices);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    const place = gl.getAttribLocation(this.#points, "point");
    gl.enableVertexAttribArray(place);
    gl.vertexAttribPointer(place, 3, gl.SHORT, false, 0, 0);
    return { vertices, buffer, count: 0 };
  }
}

function program(gl, [vertex, fragment]) {
  const made = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (gl.getProgramParameter(made, gl.LINK_STATUS)) return made;
  const logs = gl.getAttachedShaders(made).map((shader) => gl.getShaderInfoLog(shader));
  throw new Error(`this browser's WebGL refuses a shader: ${[gl.getProgramInfoLog(made), ...logs].join(" ")}`);
}
