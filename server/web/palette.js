// In: a layer's legend or a channel's values. Out: colours, as [red, green, blue].
// The first four classes differ in lightness as well as in hue (unknown, obstacle, drivable, not_drivable from dark to
// light), so that they stay apart for colour-blind eyes and in grey.

const CLASSES = {
  unknown: [58, 63, 70],
  drivable: [28, 158, 150],
  not_drivable: [244, 184, 66],
  obstacle: [196, 38, 56],
  flat: [28, 158, 150],
  flat_inferred: [22, 110, 106],
  flat_elevated: [244, 184, 66],
  flat_unreachable: [170, 128, 60],
  passable: [28, 158, 150],
  free: [22, 110, 106],
  clear: [28, 158, 150],
  occupied: [196, 38, 56],
  occluded: [92, 92, 128],
  out_of_range: [24, 26, 30],
  road: [120, 190, 240],
  path: [250, 250, 240],
};
// Classes without a colour of their own, by value.
const OTHERS = [[86, 120, 200], [190, 140, 210], [120, 190, 240], [150, 160, 90], [220, 220, 220], [140, 90, 60]];

export const UNKNOWN = CLASSES.unknown;

export const classColour = (name, value) => CLASSES[name] ?? OTHERS[value % OTHERS.length];

// Dark blue to light yellow, even in lightness; t from 0 to 1.
const STOPS = [[20, 44, 110], [70, 90, 120], [120, 128, 120], [186, 172, 98], [254, 232, 90]];

export function scaleColour(t) {
  const at = Math.min(Math.max(t, 0), 1) * (STOPS.length - 1);
  const i = Math.min(Math.floor(at), STOPS.length - 2), part = at - i;
  return STOPS[i].map((low, k) => Math.round(low + (STOPS[i + 1][k] - low) * part));
}

// Ids that follow one another get hues far apart: steps of the golden angle.
export function idColour(id) {
  const hue = (id * 137.508) % 360, light = 0.46 + 0.1 * (id % 3);
  const chroma = 0.28 * (1 - Math.abs(2 * light - 1));
  return [0, 8, 4].map((shift) => {
    const k = (shift + hue / 30) % 12;
    return Math.round(255 * (light - chroma * Math.max(-1, Math.min(k - 3, 9 - k, 1))));
  });
}

// As ImageData holds it in memory seen as 32-bit words, little-endian.
export const word = ([red, green, blue]) => ((255 << 24) | (blue << 16) | (green << 8) | red) >>> 0;
export const css = ([red, green, blue]) => `rgb(${red} ${green} ${blue})`;
