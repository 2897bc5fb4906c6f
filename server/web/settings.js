// What a reader chose, kept in this browser: the shown layer, what lies over it, rate, colours, order of the fleet,
// address of Grafana.

const KEY = "clearway.page";
const DEFAULTS = {
  layer: "freespace", channel: "class", overlays: [], road: false, safe_points: false, trail: true, by_meaning: false,
  space: false, points: false, max_rate_hz: 0, save_data: false, order: "state", only: "all",
  table: false, grafana: "",
};

// Reads what was kept. A value of another type than its default is left out, so that no old version harms.
export function readSettings(text) {
  const settings = { ...DEFAULTS, overlays: [] };
  try {
    const kept = JSON.parse(text ?? "{}");
    for (const name in DEFAULTS) {
      const value = kept?.[name], other = DEFAULTS[name];
      const fits = typeof value === typeof other && Array.isArray(value) === Array.isArray(other);
      if (fits) settings[name] = kept[name];
    }
    settings.overlays = settings.overlays.filter((layer) => typeof layer === "string");
  } catch {
    // What is no JSON is not ours.
  }
  return settings;
}

// A browser may refuse to keep anything; then the choice lasts as long as the page.
export function loadSettings() {
  try {
    return readSettings(localStorage.getItem(KEY));
  } catch {
    return readSettings(null);
  }
}

export function keepSettings(settings) {
  try {
    localStorage.setItem(KEY, JSON.stringify(settings));
  } catch {
    // As above.
  }
}

// The selection that the server gets and what is shown of it, of a vehicle with these layers.
export function wantOf(settings, layers) {
  const known = (name) => layers.includes(name);
  const base = known(settings.layer) ? settings.layer : layers[0];
  const overlays = settings.overlays.filter((name) => known(name) && name !== base);
  const wanted = [base, ...overlays];
  // The layer with the road's cells, and the layer with the safe points.
  if (settings.road) wanted.push("speed");
  if (settings.safe_points) wanted.push("safe_path");
  // The layers with planes, on which the view in 3-D puts all cells.
  if (settings.space) wanted.push("terrain", "drivability");
  return {
    layers: [...new Set(wanted)].filter(known).sort(),
    max_rate_hz: settings.max_rate_hz > 0 ? settings.max_rate_hz : null,
    deltas: settings.save_data,
    show: {
      base: { layer: base, channel: settings.channel }, overlays, road: settings.road,
      safe_points: settings.safe_points, by_meaning: settings.by_meaning, space: settings.space,
    },
  };
}
