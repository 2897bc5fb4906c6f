// In: the three parallel lists of a Layer message. Out: its legend, [{ name, meaning, colour }] by class, or a
// DecodeError. Format: proto/clearway/v1/map.proto, Layer.legend and ClassMeaning.

import { DecodeError } from "./limits.js";

// By number on the wire. A meaning that is not listed counts as unknown.
const MEANINGS = ["unknown", "free", "inferred", "occupied", "hidden", "not reached", "low"];
const UNKNOWN = 0;

export function readLegend({ name: layer, legend: names, legend_meanings: meanings, legend_rgb: colours }) {
  const error = (what) => new DecodeError("legend", `layer ${layer}: ${what}`);
  if (meanings.length !== names.length || colours.length !== names.length) {
    const what = `${names.length} names, ${meanings.length} meanings and ${colours.length} colours`;
    throw error(`${what}; one of each per class is needed`);
  }
  if (names.length > 0 && (names[0] !== "unknown" || meanings[0] !== UNKNOWN)) {
    throw error(`class 0 is named ${names[0]} and means ${meanings[0]}; it must be unknown and mean ${UNKNOWN}`);
  }
  return names.map((name, value) => {
    const rgb = colours[value];
    if (rgb > 0xffffff) throw error(`class ${value} has the colour 0x${rgb.toString(16)}; at most 0xffffff is allowed`);
    const colour = [rgb >> 16, (rgb >> 8) & 0xff, rgb & 0xff];
    return { name, meaning: MEANINGS[meanings[value]] ?? MEANINGS[UNKNOWN], colour };
  });
}

// True if a delta leaves out its legend, which then equals the legend of its base.
export const isWithoutLegend = ({ legend, legend_meanings, legend_rgb }) =>
  legend.length + legend_meanings.length + legend_rgb.length === 0;
