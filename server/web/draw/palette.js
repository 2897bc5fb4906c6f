// In: a channel's values. Out: colours, as [red, green, blue]. The colours of classes come with the map.

// The colour of unknown cells in a layer without classes.
export const UNKNOWN = [58, 63, 70];

// The colour of a plan, which no class has.
export const PLAN_COLOUR = [255, 79, 216];

// Colours from blue, lighter than unknown cells, to light yellow, even in lightness, for colour-blind eyes and in grey;
// t from 0 to 1. Exported pictures have the same (server/daemon/src/encode/palette.rs).
const STOPS = [[48, 88, 184], [100, 120, 150], [150, 154, 140], [206, 192, 112], [254, 232, 90]];

// The colours as a CSS gradient from left to right.
export const scaleGradient = () => `linear-gradient(to right, ${STOPS.map(css).join(", ")})`;

export function scaleColour(t) {
  const at = Math.min(Math.max(t, 0), 1) * (STOPS.length - 1);
  const i = Math.min(Math.floor(at), STOPS.length - 2), part = at - i;
  return STOPS[i].map((low, k) => Math.round(low + (STOPS[i + 1][k] - low) * part));
}

// The colour of an id. Hues of consecutive ids are far apart: one golden angle.
export function idColour(id) {
  const hue = (id * 137.508) % 360, light = 0.46 + 0.1 * (id % 3);
  const chroma = 0.28 * (1 - Math.abs(2 * light - 1));
  return [0, 8, 4].map((shift) => {
    const k = (shift + hue / 30) % 12;
    return Math.round(255 * (light - chroma * Math.max(-1, Math.min(k - 3, 9 - k, 1))));
  });
}

// A colour as a 32-bit word of ImageData, in little-endian memory.
export const word = ([red, green, blue]) => ((255 << 24) | (blue << 16) | (green << 8) | red) >>> 0;
export const css = ([red, green, blue]) => `rgb(${red} ${green} ${blue})`;

// Colours by what a class means to a planner, told apart by all kinds of colour-blind eyes (Okabe and Ito 2008), for
// readers to whom the classes' own colours look alike.
const BY_MEANING = {
  free: [0, 114, 178], inferred: [86, 180, 233], occupied: [213, 94, 0], hidden: [204, 121, 167],
  "not reached": [150, 150, 150], low: [240, 228, 66], unknown: UNKNOWN,
};

// A legend with colours by meaning. Classes of one meaning differ in lightness.
export function legendByMeaning(legend) {
  const seen = {};
  return legend.map((entry) => {
    const order = (seen[entry.meaning] = (seen[entry.meaning] ?? -1) + 1);
    const lighter = Math.min(0.3 * order, 0.75);
    const colour = (BY_MEANING[entry.meaning] ?? UNKNOWN).map((part) => Math.round(part + (255 - part) * lighter));
    return { ...entry, colour };
  });
}
