// The connection to the server, in the Worker. Out: calls to `on`: update(bytes, arrived_ms), text(string), state({
// phase, text, retry_in_ms }). It reconnects with growing pauses; a connection on which nothing arrives counts as lost.
// Server: WebSocket live (server/daemon/src/publish/page_live.rs).

const PAUSE_MS_MIN = 250, PAUSE_MS_MAX = 5000;
// The server sends a status every second, so four missing statuses mean that the connection is lost.
const SILENCE_MS_MAX = 4500;

export class Link {
  #on;
  #address;
  #socket = null;
  #pause_ms = PAUSE_MS_MIN;
  #arrived_ms = 0;
  #timer = 0;

  constructor(on, address) {
    this.#on = on;
    this.#address = address;
    setInterval(() => this.#checkSilence(), 500);
    addEventListener("online", () => !this.#socket && this.connect());
  }

  connect() {
    this.#drop();
    this.#on.state({ phase: "connecting", text: "Connecting …" });
    const socket = (this.#socket = new WebSocket(this.#address));
    socket.binaryType = "arraybuffer";
    this.#arrived_ms = performance.now();
    socket.onopen = () => {
      this.#arrived_ms = performance.now();
      this.#on.state({ phase: "live", text: "Connected" });
    };
    socket.onmessage = ({ data }) => {
      this.#arrived_ms = performance.now();
      this.#pause_ms = PAUSE_MS_MIN;
      if (typeof data === "string") this.#on.text(data);
      else this.#on.update(new Uint8Array(data), this.#arrived_ms);
    };
    const was_live = () => this.#pause_ms === PAUSE_MS_MIN;
    socket.onclose = () => this.#retry(was_live() ? "Connection lost" : "The server does not answer");
  }

  // Sends a request to the server, if there is a connection.
  send(request) {
    if (this.#socket?.readyState === WebSocket.OPEN) this.#socket.send(JSON.stringify(request));
  }

  // Drops the connection and the messages that wait in it, and makes a new one.
  reconnect(text) {
    this.#retry(text);
  }

  #checkSilence() {
    const silence_ms = performance.now() - this.#arrived_ms;
    if (this.#socket && silence_ms > SILENCE_MS_MAX) this.#retry("The server sends nothing");
  }

  #retry(text) {
    this.#drop();
    const pause_ms = this.#pause_ms * (0.75 + Math.random() / 2);
    this.#pause_ms = Math.min(2 * this.#pause_ms, PAUSE_MS_MAX);
    this.#timer = setTimeout(() => this.connect(), pause_ms);
    this.#on.state({ phase: "lost", text, retry_in_ms: pause_ms });
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
