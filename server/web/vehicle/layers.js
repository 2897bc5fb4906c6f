// The choice of layers: for each layer a button that shows it, and a box that draws it over the shown one; the channel
// of the shown layer; safe paths, road, trail, colours, rate. In: settings, the vehicle's layers, the newest frame.
// Out: changed settings, and the legend of what is shown.

import { isQuiet } from "../draw/paint.js";
import { css, scaleGradient } from "../draw/palette.js";
import { percent, setText, words } from "../text.js";

const BOXES = ["safe_points", "road", "trail", "by_meaning", "save_data"];
// The layer without which a box has nothing to show.
const NEEDS = { safe_points: "safe_path", road: "speed" };

export class Layers {
  #part;
  #settings;
  #changed;
  #names = "";
  #channels = "";
  #legend = "";
  // What the classes say, and what a planner may do by their meanings (/classes.json).
  #classes = {};

  // changed(): the settings have changed.
  constructor(part, settings, changed) {
    this.#part = part;
    this.#settings = settings;
    this.#changed = changed;
    for (const name of BOXES) {
      part(name).checked = settings[name];
      part(name).onchange = () => this.#set({ [name]: part(name).checked });
    }
    part("max_rate_hz").value = String(settings.max_rate_hz);
    part("max_rate_hz").onchange = () => this.#set({ max_rate_hz: Number(part("max_rate_hz").value) });
    part("channel").onchange = () => this.#set({ channel: part("channel").value });
  }

  explain(classes) {
    this.#classes = classes;
    this.#legend = "";
  }

  writeNames(names) {
    if (names.join() === this.#names) return;
    this.#names = names.join();
    const template = this.#part("layer");
    this.#part("layers").replaceChildren(...names.map((name, i) => {
      const row = template.content.firstElementChild.cloneNode(true);
      const [radio, box] = row.querySelectorAll("input");
      radio.value = box.value = name;
      setText(row.querySelector("span"), words(name));
      setText(row.querySelector("kbd"), String(i + 1));
      box.setAttribute("aria-label", `Draw ${words(name)} over the shown layer`);
      radio.onchange = () => this.choose(name);
      box.onchange = () => {
        const others = this.#settings.overlays.filter((other) => other !== name);
        this.#set({ overlays: box.checked ? [...others, name] : others });
      };
      return row;
    }));
    for (const [box, layer] of Object.entries(NEEDS)) this.#part(box).closest("label").hidden = !names.includes(layer);
    this.#writeChosen();
  }

  // Shows a layer, by its name or its number from 1.
  choose(layer) {
    const name = typeof layer === "number" ? this.#names.split(",")[layer - 1] : layer;
    if (name) this.#set({ layer: name, channel: "class" });
  }

  // The frame that is shown; null if there is none.
  writeFrame(frame) {
    const channels = frame?.channels ?? [];
    const channel = this.#part("channel");
    if (channels.join() !== this.#channels) {
      this.#channels = channels.join();
      channel.replaceChildren(...channels.map((name) => new Option(words(name), name)));
    }
    if (frame?.base && channel.value !== frame.base.channel) channel.value = frame.base.channel;
    const shown = frame?.base?.layer, chosen = this.#settings.layer;
    // A layer that no reader wanted so far is made with the next map.
    const is_awaited = shown !== undefined && shown !== chosen && this.#names.split(",").includes(chosen);
    const text = is_awaited ? `${words(chosen)} comes with the next map; this is ${words(shown)}` : "";
    setText(this.#part("awaited"), text);
    setText(this.#part("shown"), words(shown ?? "Legend"));
    this.#writeScale(frame?.bar ?? null);
    this.#writeLegend(shown, frame?.legend ?? []);
  }

  #set(changes) {
    Object.assign(this.#settings, changes);
    this.#writeChosen();
    this.#changed();
  }

  #writeChosen() {
    const known = this.#names.split(","), { layer } = this.#settings, shown = known.includes(layer) ? layer : known[0];
    for (const row of this.#part("layers").children) {
      const [radio, box] = row.querySelectorAll("input");
      radio.checked = radio.value === shown;
      box.checked = this.#settings.overlays.includes(box.value) && !radio.checked;
      box.disabled = radio.checked;
    }
  }

  // texts: of the colour bar, from left to right; null hides it.
  #writeScale(texts) {
    const scale = this.#part("scale"), [bar, labels] = scale.children;
    scale.hidden = !texts;
    if (!texts) return;
    bar.style.background = scaleGradient();
    while (labels.children.length > texts.length) labels.lastChild.remove();
    while (labels.children.length < texts.length) labels.append(document.createElement("span"));
    texts.forEach((text, i) => setText(labels.children[i], text));
  }

  // A press says what the pointer is told: a finger has none.
  #writeLegend(layer, entries) {
    const legend = this.#part("legend");
    const key = [layer, ...entries.map(([colour, text]) => `${colour} ${text}`)].join();
    if (key !== this.#legend) {
      this.#legend = key;
      setText(this.#part("says"), "");
      legend.replaceChildren(...entries.map(([colour, text, , meaning]) => {
        const [entry, button, swatch, share] = ["li", "button", "i", "b"].map((tag) => document.createElement(tag));
        if (colour) swatch.style.background = css(colour);
        swatch.classList.toggle("quiet", isQuiet(meaning));
        button.type = "button";
        button.title = saysOf(this.#classes, layer, text, meaning);
        button.onclick = () => setText(this.#part("says"), button.title && `${text}: ${button.title}`);
        button.append(...(colour ? [swatch] : []), text, share);
        entry.append(button);
        return entry;
      }));
    }
    entries.forEach(([, , share], i) => {
      setText(legend.children[i].firstChild.lastChild, shareText(share));
    });
  }
}

const shareText = (share) => (!share ? "" : share < 0.005 ? "< 1 %" : percent(share, 0));

// What a class says, and what a planner may do there.
export function saysOf({ layers, meanings }, layer, text, meaning) {
  const says = layers?.[layer]?.[text.replaceAll(" ", "_")], may = meanings?.[meaning];
  return [says, may && `A planner may ${may}.`].filter(Boolean).join(" ");
}
