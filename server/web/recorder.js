// The recorder's buttons. In: the server's texts of type "recorder", which only an operator of a recording server gets,
// the recorder's part of each status, and the user's clicks. Out: the section, and requests through `send(request)`.

import { setText } from "./text.js";

// What the section says of a state and of the answer to the last request; answer: { files, error }.
export function view({ state, file, part, reason }, { files = [], error = "" } = {}) {
  const is_on = state === "recording";
  const where = is_on ? `part ${part}, ${file}` : reason || "";
  const saved = files.length > 0 ? `Saved ${files.join(", ")}` : "";
  const text = [state, where].filter(Boolean).join(": ");
  return { is_on, toggle: is_on ? "Stop" : "Record", text, said: error || saved };
}

export class Recorder {
  #element;
  #answer = {};

  constructor(element, send) {
    this.#element = element;
    const part = (name) => this.#part(name);
    const ask = (command, more) => {
      this.#setBusy(true);
      send({ command, ...more });
    };
    part("toggle").onclick = () => ask(part("toggle").dataset.command);
    part("split").onclick = () => ask("split");
    part("save").onclick = () => ask("save", { seconds: Math.max(0, Math.round(Number(part("seconds").value) || 0)) });
  }

  // The state after a request, or after the connection was made.
  answer(message) {
    this.#answer = message;
    this.#setBusy(false);
    this.#element.hidden = false;
    this.status(message);
  }

  // The recorder's part of a status; undefined if there is none.
  status(recorder) {
    if (this.#element.hidden || !recorder) return;
    const now = view(recorder, this.#answer);
    setText(this.#part("state"), now.text);
    setText(this.#part("said"), now.said);
    setText(this.#part("toggle"), now.toggle);
    this.#part("toggle").dataset.command = now.is_on ? "stop" : "start";
    this.#part("split").hidden = !now.is_on;
  }

  // The connection is lost: what the next one may control is not known yet.
  hide() {
    this.#element.hidden = true;
    this.#answer = {};
  }

  #setBusy(is_busy) {
    for (const button of this.#element.querySelectorAll("button")) button.disabled = is_busy;
  }

  #part(name) {
    return this.#element.querySelector(`[data-recorder="${name}"]`);
  }
}
