// The list of a vehicle's changes of state. In: a history, and the address of Grafana that the user gave. Out: the
// list, and links to Grafana's range.

import { coarse, setText } from "../text.js";
import { grafanaLink, told } from "./history.js";

const $ = (id) => document.getElementById(id);

export class Changes {
  #settings;
  #vehicle = "";
  #history = { changes: [] };

  // changed(): another address of Grafana was given.
  constructor(settings, changed) {
    this.#settings = settings;
    $("grafana").value = settings.grafana;
    $("grafana").onchange = () => {
      settings.grafana = $("grafana").value.trim();
      changed();
      this.write(this.#vehicle, this.#history);
    };
  }

  write(vehicle, history) {
    this.#vehicle = vehicle;
    this.#history = history;
    const linkTo = (from, to) => grafanaLink(this.#settings.grafana, vehicle, from, to);
    const all = linkTo("now-10m", "now");
    $("grafana-link").hidden = all === null;
    if (all !== null) $("grafana-link").href = all;
    $("changes").replaceChildren(...told(history).map((change) => entry(change, linkTo(change.from, change.to))));
  }
}

function entry({ at_ms, state, reasons, file, lasted_ms }, grafana) {
  const item = document.createElement("li"), badge = document.createElement("b"), at = new Date(at_ms);
  const time = document.createElement(grafana === null ? "time" : "a");
  item.dataset.state = state;
  badge.className = "state";
  setText(badge, state.toUpperCase());
  setText(time, at.toLocaleTimeString("en-GB"));
  time.title = grafana === null ? at.toISOString() : `${at.toISOString()}, in Grafana`;
  if (grafana !== null) Object.assign(time, { href: grafana, target: "_blank", rel: "noreferrer" });
  const lasted = lasted_ms === null ? "since then" : `for ${coarse(lasted_ms)}`;
  item.append(time, " ", badge, ` ${lasted}${reasons.length ? `: ${reasons.join(" · ")}` : ""}`);
  if (file) {
    const recorded = document.createElement("code");
    setText(recorded, file.split("/").at(-1));
    recorded.title = file;
    item.append(" · recorded in ", recorded);
  }
  return item;
}
