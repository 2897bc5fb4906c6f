// Tests of the colours. Run: cd server/web && node --test

import assert from "node:assert/strict";
import test from "node:test";
import { css, idColour, scaleColour, scaleGradient, UNKNOWN, word } from "./palette.js";

// Relative luminance (WCAG 2.1, without its gamma curve, which keeps the order).
const luminance = ([red, green, blue]) => 0.2126 * red + 0.7152 * green + 0.0722 * blue;

test("the colours of a scale get lighter from its least value to its greatest", () => {
  const lights = Array.from({ length: 101 }, (_, i) => luminance(scaleColour(i / 100)));
  for (let i = 1; i < lights.length; i++) assert.ok(lights[i] >= lights[i - 1], `at ${i} %`);
  assert.ok(lights[100] - lights[0] > 130, `${lights[0]} to ${lights[100]}`);
  assert.ok(lights[0] - luminance(UNKNOWN) > 20, "the least value is told from an unknown cell");
  assert.deepEqual([scaleColour(-1), scaleColour(2)], [scaleColour(0), scaleColour(1)]);
});

test("the gradient of a colour bar has the colours of the scale", () => {
  const stops = [0, 0.25, 0.5, 0.75, 1].map((t) => css(scaleColour(t)));
  assert.equal(scaleGradient(), `linear-gradient(to right, ${stops.join(", ")})`);
});

test("consecutive ids have colours far apart", () => {
  for (let id = 0; id < 500; id++) {
    const [a, b] = [idColour(id), idColour(id + 1)];
    const apart = Math.hypot(...a.map((value, i) => value - b[i]));
    assert.ok(apart > 60, `${id}: ${a} and ${b}`);
    assert.ok(a.every((value) => Number.isInteger(value) && value >= 0 && value <= 255), `${id}: ${a}`);
  }
});

test("a colour is an opaque word of an image's bytes", () => {
  assert.deepEqual([...new Uint8Array(Uint32Array.of(word([1, 2, 250])).buffer)], [1, 2, 250, 255]);
});
