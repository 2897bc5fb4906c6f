// The connection to the server. In: the name of a vehicle. Out: calls to `on`: vehicles(list, name), update(bytes,
// arrived_ms), text(string), state({ phase, text, retry_at_ms }). It reconnects with growing pauses; a connection on
// which nothing arrives counts as lost.
// Server: GET vehicles (JSON list), WebSocket live?vehicle=NAME (binary: MapUpdate, text: JSON with "type").

const PAUSE_MS_MIN = 250, PAUSE_MS_MAX = 5000;
// The server sends a status every second, so four missing ones mean that the connection is lost.
const SILENCE_MS_MAX = 4500;
const ANSWER_MS_MAX = 4000;
const LIST_EVERY_MS = 10000;

export class Link {
  #on;
  // The vehicle's name; undefined until one is chosen.
  #vehicle;
  #socket = null;
  #pause_ms = PAUSE_MS_MIN;
  #arrived_ms = 0;
  #timer = 0;
  // Counts attempts, so that an answer to an earlier one is ignored.
  #attempt = 0;

  constructor(on, vehicle) {
    this.#on = on;
    this.#vehicle = vehicle;
    setInterval(() => this.#checkSilence(), 500);
    setInterval(() => this.#socket && this.#list().catch(() => {}), LIST_EVERY_MS);
    addEventListener("online", () => !this.#socket && this.connect());
  }

  choose(vehicle) {
    this.#vehicle = vehicle;
    this.connect();
  }

  async connect() {
    this.#drop();
    const attempt = ++this.#attempt;
    this.#on.state({ phase: "connecting", text: "Connecting …" });
    try {
      const names = (await this.#list()).map((vehicle) => vehicle.name);
      if (attempt !== this.#attempt) return;
      this.#vehicle ??= names[0];
      if (this.#vehicle === undefined) return this.#retry("The server has no vehicle yet");
      if (!names.includes(this.#vehicle)) return this.#retry(`The server has no vehicle “${this.#vehicle}”`);
      this.#open(this.#vehicle);
    } catch {
      if (attempt === this.#attempt) this.#retry("The server does not answer");
    }
  }

  // Sends a text to the server, if there is a connection.
  send(text) {
    if (this.#socket?.readyState === WebSocket.OPEN) this.#socket.send(text);
  }

  // Drops the connection and the messages that wait in it, and makes a new one.
  reconnect(text) {
    this.#retry(text);
  }

  async #list() {
    const answer = await fetch("vehicles", { cache: "no-store", signal: AbortSignal.timeout(ANSWER_MS_MAX) });
    if (!answer.ok) throw new Error(`vehicles: ${answer.status}`);
    const vehicles = await answer.json();
    this.#on.vehicles(vehicles, this.#vehicle);
    return vehicles;
  }

  #open(vehicle) {
    const address = new URL(`live?vehicle=${encodeURIComponent(vehicle)}`, location.href);
    address.protocol = address.protocol === "https:" ? "wss:" : "ws:";
    const socket = (this.#socket = new WebSocket(address));
    socket.binaryType = "arraybuffer";
    this.#arrived_ms = performance.now();
    socket.onopen = () => {
      this.#arrived_ms = performance.now();
      this.#on.state({ phase: "live", text: "Connected", vehicle });
    };
    socket.onmessage = ({ data }) => {
      this.#arrived_ms = performance.now();
      this.#pause_ms = PAUSE_MS_MIN;
      if (typeof data === "string") this.#on.text(data);
      else this.#on.update(new Uint8Array(data), this.#arrived_ms);
    };
    socket.onclose = () => this.#retry("Connection lost");
  }

  #checkSilence() {
    const silence_ms = performance.now() - this.#arrived_ms;
    if (this.#socket && silence_ms > SILENCE_MS_MAX) this.#retry("The server sends nothing");
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
    // Closing a lost connection can take minutes; its messages are ignored meanwhile.
    socket.onopen = socket.onmessage = socket.onclose = null;
    socket.close();
  }
}
