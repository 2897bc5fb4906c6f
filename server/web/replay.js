// The time bar of a replay. In: the server's texts of type "replay", and the user's clicks. Out: the bar, and requests
// through `send(request)`. Times are strings of nanoseconds on the wire; the bar counts seconds from the first event.

import { setText } from "./text.js";

// While the user drags, a seek is sent at most this often: each makes maps on the server.
const SEEK_EVERY_MS = 200;

const seconds = (state, ns) => Number(BigInt(ns) - BigInt(state.begin_ns)) / 1e9;
const nanoseconds = (state, s) => (BigInt(state.begin_ns) + BigInt(Math.round(s * 1e9))).toString();

// What the bar shows of a state: texts and positions, in seconds.
export function view(state) {
  const from_s = seconds(state, state.from_ns), to_s = seconds(state, state.to_ns);
  const position_s = Math.min(Math.max(seconds(state, state.position_ns), from_s), to_s);
  const waits = state.phase === "waiting";
  return {
    from_s, to_s, position_s,
    time: `${position_s.toFixed(1)} / ${to_s.toFixed(1)} s`,
    phase: waits ? `waiting for ${state.readers_awaited} readers` : state.phase,
    plays: state.phase === "playing",
    rate: String(state.rate),
  };
}

export class ReplayBar {
  #element;
  #send;
  #state = null;
  #is_dragged = false;
  #seek_at_ms = 0;
  #seek_timer = 0;

  constructor(element, send) {
    this.#element = element;
    this.#send = send;
    const part = (name) => this.#part(name);
    part("play").onclick = () => this.#toggle();
    part("step").onclick = () => this.#send({ step: 1 });
    part("rate").onchange = () => {
      const rate = part("rate").value;
      this.#send({ rate: rate === "max" ? rate : Number(rate) });
    };
    part("repeat").onchange = () => this.#send({ repeat: part("repeat").checked });
    part("position").oninput = () => {
      this.#is_dragged = true;
      this.#seekSoon();
    };
    part("position").onchange = () => {
      this.#is_dragged = false;
      this.#seek();
    };
  }

  // Shows a state of the server; a server that replays nothing sends none, and the bar stays hidden.
  show(state) {
    this.#state = state;
    const now = view(state);
    this.#element.hidden = false;
    setText(this.#part("time"), now.time);
    setText(this.#part("phase"), state.error || now.phase);
    setText(this.#part("play"), now.plays ? "Pause" : "Play");
    this.#part("repeat").checked = state.repeat;
    const rate = this.#part("rate");
    if (![...rate.options].some((option) => option.value === now.rate)) {
      rate.append(new Option(`${now.rate}×`, now.rate));
    }
    rate.value = now.rate;
    if (this.#is_dragged) return;
    const position = this.#part("position");
    position.min = now.from_s;
    position.max = now.to_s;
    position.value = now.position_s;
  }

  hide() {
    this.#element.hidden = true;
    this.#state = null;
  }

  #part(name) {
    return this.#element.querySelector(`[data-part="${name}"]`);
  }

  #toggle() {
    if (!this.#state) return;
    const { phase, from_ns } = this.#state;
    if (phase === "ended") this.#send({ seek_ns: from_ns, paused: false });
    else this.#send({ paused: phase !== "paused" });
  }

  #seekSoon() {
    clearTimeout(this.#seek_timer);
    const wait_ms = this.#seek_at_ms + SEEK_EVERY_MS - performance.now();
    if (wait_ms <= 0) this.#seek();
    else this.#seek_timer = setTimeout(() => this.#seek(), wait_ms);
  }

  #seek() {
    clearTimeout(this.#seek_timer);
    if (!this.#state) return;
    this.#seek_at_ms = performance.now();
    this.#send({ seek_ns: nanoseconds(this.#state, Number(this.#part("position").value)) });
  }
}
