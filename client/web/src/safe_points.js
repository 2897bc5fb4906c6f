// In: the SafePoints message of a layer. Out: its points and links in the ego frame, or a DecodeError.
// Format: proto/clearway/v1/map.proto, SafePoints.

import { DecodeError, MAP_PARTS_MAX, SAFE_POINT_STEPS_MAX } from "./limits.js";

// { x, y, radius, links }: metres by point, and pairs [point, earlier point]. null if the layer has no safe points.
export function readSafePoints(layer, message) {
  if (!message) return null;
  const error = (what) => new DecodeError("safe_point", `layer ${layer}: ${what}`);
  const { step_m, x, y, radius_cm } = message, count = x.length;
  if (y.length !== count || radius_cm.length !== count || count > MAP_PARTS_MAX) {
    throw error(`${count} x, ${y.length} y, ${radius_cm.length} radii; as many of each, at most ${MAP_PARTS_MAX}`);
  }
  if (!(step_m > 0 && step_m < Infinity)) throw error(`steps of ${step_m} m; finite metres over 0 are needed`);
  const sums = (differences) => {
    let sum = 0;
    return Float64Array.from(differences, (difference) => {
      sum += difference;
      if (Math.abs(sum) > SAFE_POINT_STEPS_MAX) throw error(`${sum} steps; at most ${SAFE_POINT_STEPS_MAX}`);
      return sum;
    });
  };
  const radius = sums(radius_cm);
  if (radius.some((cm) => cm < 0)) throw error("a radius below 0");
  const metres = (values) => values.map((steps) => steps * step_m);
  const links = readLinks(message, count, error);
  return { x: metres(sums(x)), y: metres(sums(y)), radius: radius.map((cm) => cm / 100), links };
}

function readLinks({ starts, link_from, link_back }, count, error) {
  const is_start = new Uint8Array(count), links = [];
  let start = 0;
  for (const ahead of starts) {
    start += ahead;
    if (ahead === 0 || start >= count) throw error(`point ${start} starts a line; ascending points are needed`);
    is_start[start] = 1;
  }
  for (let point = 1; point < count; point++) if (!is_start[point]) links.push([point, point - 1]);
  if (link_from.length !== link_back.length) throw error(`${link_from.length} links to ${link_back.length} points`);
  let from = 0, to_before = -1;
  link_from.forEach((ahead, i) => {
    from += ahead;
    const to = from - link_back[i];
    if (from >= count || to < 0 || link_back[i] < 2) throw error(`point ${from} has a link ${link_back[i]} back`);
    if (i > 0 && ahead === 0 && to <= to_before) throw error(`point ${from} has links that do not ascend`);
    to_before = to;
    links.push([from, to]);
  });
  return links;
}
