// In: the wish for one vehicle's maps. Out: calls to `on`: vehicles(list, wanted), update(bytes, received_ms),
// text(string), state({ phase, text, retry_at_ms }). Keeps trying, with growing pauses; a silent connection counts as cut.
// Server: GET vehicles (JSON list), WebSocket live?vehicle=NAME (binary: MapUpdate, text: JSON with "type").

const PAUSE_MS_MIN = 250, PAUSE_MS_MAX = 5000;
// Status comes every second, so four missed ones mean that the link is gone though no one said so.
const SILENCE_MS_MAX = 4500;
const ANSWER_MS_MAX = 4000;
const LIST_EVERY_MS = 10000;

export class Link {
  #on;
  #wanted;
  #socket = null;
  #pause_ms = PAUSE_MS_MIN;
  #heard_ms = 0;
  #timer = 0;
  // Counts attempts: an answer to an earlier one is not listened to.
  #attempt = 0;

  constructor(on, wanted) {
    this.#on = on;
    this.#wanted = wanted;
    setInterval(() => this.#watch(), 500);
    setInterval(() => this.#socket && this.#list().catch(() => {}), LIST_EVERY_MS);
    addEventListener("online", () => !this.#socket && this.connect());
  }

  choose(vehicle) {
    this.#wanted = vehicle;
    this.connect();
  }

  async connect() {
    this.#drop();
    const attempt = ++this.#attempt;
    this.#on.state({ phase: "connecting", text: "Connecting …" });
    try {
      const names = (await this.#list()).map((vehicle) => vehicle.name);
      if (attempt !== this.#attempt) return;
      this.#wanted ??= names[0];
      if (this.#wanted === undefined) return this.#retry("No vehicle yet");
      if (!names.includes(this.#wanted)) return this.#retry(`No vehicle “${this.#wanted}” here`);
      this.#open(this.#wanted);
    } catch {
      if (attempt === this.#attempt) this.#retry("Server does not answer");
    }
  }

  // Drops the connection and what is queued in it, and makes a new one.
  renew(text) {
    this.#retry(text);
  }

  async #list() {
    const answer = await fetch("vehicles", { cache: "no-store", signal: AbortSignal.timeout(ANSWER_MS_MAX) });
    if (!answer.ok) throw new Error(`vehicles: ${answer.status}`);
    const vehicles = await answer.json();
    this.#on.vehicles(vehicles, this.#wanted);
    return vehicles;
  }

  #open(vehicle) {
    const address = new URL(`live?vehicle=${encodeURIComponent(vehicle)}`, location.href);
    address.protocol = address.protocol === "https:" ? "wss:" : "ws:";
    const socket = (this.#socket = new WebSocket(address));
    socket.binaryType = "arraybuffer";
    this.#heard_ms = performance.now();
    socket.onopen = () => {
      this.#heard_ms = performance.now();
      this.#on.state({ phase: "live", text: "Connected", vehicle });
    };
    socket.onmessage = ({ data }) => {
      this.#heard_ms = performance.now();
      this.#pause_ms = PAUSE_MS_MIN;
      if (typeof data === "string") this.#on.text(data);
      else this.#on.update(new Uint8Array(data), this.#heard_ms);
    };
    socket.onclose = () => this.#retry("Connection lost");
  }

  #watch() {
    if (this.#socket && performance.now() - this.#heard_ms > SILENCE_MS_MAX) this.#retry("Connection silent");
  }

  #retry(text) {
    this.#drop();
    this.#attempt++;
    const pause_ms = this.#pause_ms * (0.75 + Math.random() / 2);
    this.#pause_ms = Math.min(2 * this.#pause_ms, PAUSE_MS_MAX);
    this.#timer = setTimeout(() => this.connect(), pause_ms);
    this.#on.state({ phase: "lost", text, retry_at_ms: performance.now() + pause_ms });
  }

  #drop() {
    clearTimeout(this.#timer);
    const socket = this.#socket;
    this.#socket = null;
    if (!socket) return;
    // Closing a cut connection can take minutes; nothing of it is wanted meanwhile.
    socket.onopen = socket.onmessage = socket.onclose = null;
    socket.close();
  }
}
