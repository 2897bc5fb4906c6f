// The maps of one vehicle in the Worker. In: what is wanted of them, and the updates as they arrive. Out: requests to
// the server, and frames of the newest map. A frame is made only after the page has drawn the last one; then the server
// gets the acknowledgement. So neither a slow page nor a slow link has a backlog of maps.
//
// want: { layers, max_rate_hz, deltas, show: of frame.js, raster: of grid.js, probe: { x, y } or null }.

import { PLAN_COLOUR } from "./draw/palette.js";
import { cellValues, newFrame } from "./frame.js";
import { MapStream } from "./map_stream.js";

// One map is drawn while the next one is on the way.
const IN_FLIGHT_MAX = 2;
let last_id = 0;

export class Feed {
  #vehicle;
  #send;
  #emit;
  #want = null;
  #id = 0;
  #is_begun = false;
  #stream = new MapStream();
  // The update that is shown; null before the first.
  #shown = null;
  #ranges = new Map();
  // True from a frame until the page has drawn it.
  #is_busy = false;
  #is_repaint_due = false;

  // send(request): to the server. emit(message): to the page.
  constructor(vehicle, send, emit) {
    this.#vehicle = vehicle;
    this.#send = (request) => send({ vehicle, ...request });
    this.#emit = (message) => emit({ vehicle, ...message });
  }

  // Changes what is wanted. Only another selection is sent to the server.
  want(want) {
    const key = (of) => of && JSON.stringify([of.layers, of.max_rate_hz, of.deltas]);
    const is_new = key(want) !== key(this.#want);
    this.#want = want;
    if (is_new) this.begin();
    else this.#repaint();
  }

  // Sends the selection: the selection has changed, or the connection is new.
  begin() {
    if (!this.#want) return;
    const { layers, max_rate_hz, deltas } = this.#want;
    this.#id = ++last_id;
    this.#is_begun = false;
    this.#send({ type: "watch", id: this.#id, layers, max_rate_hz, deltas, max_in_flight: IN_FLIGHT_MAX });
  }

  // The server has taken the selection with this id: the maps from now on belong to it.
  begun(id) {
    if (id !== this.#id) return;
    this.#is_begun = true;
    this.#stream.restart();
  }

  end() {
    this.#send({ type: "unwatch" });
  }

  // Records one update, as its bytes. Throws a DecodeError or WireError if it is refused.
  push(message, arrived_ms) {
    if (!this.#is_begun) return;
    try {
      const update = this.#stream.push(message, this.#want.deltas);
      update.arrived_ms = arrived_ms;
      update.id = this.#id;
    } catch (error) {
      this.#send({ type: "keyframe", id: this.#id });
      this.#stream.restart();
      throw error;
    }
    this.#next();
  }

  // The page has drawn the last frame.
  drawn() {
    // A frame of another view of this vehicle.
    if (!this.#is_busy) return;
    this.#is_busy = false;
    const { id, map } = this.#shown;
    if (id === this.#id && this.#is_begun && !this.#shown.is_acknowledged) {
      this.#shown.is_acknowledged = true;
      this.#send({ type: "acknowledge", id, sequence: map.header.sequence.toString() });
    }
    if (this.#is_repaint_due) this.#repaint();
    this.#next();
  }

  // Answers which values the cell at a point has in the shown map.
  probe(at) {
    if (!this.#want) return;
    this.#want.probe = at;
    this.#answerProbe();
  }

  #next() {
    if (this.#is_busy) return;
    const newest = this.#stream.removeNewest();
    if (newest) this.#show(newest);
  }

  #repaint() {
    this.#is_repaint_due = this.#is_busy;
    if (!this.#is_busy && this.#shown) this.#show(this.#shown);
  }

  #show(update) {
    const { show, raster } = this.#want;
    let frame;
    try {
      frame = newFrame(update.map, show, raster, this.#ranges);
    } catch (error) {
      // A map with a refused part is not shown at all. It is acknowledged, so that the next one comes.
      this.#stream.counts.refused++;
      this.#send({ type: "acknowledge", id: update.id, sequence: update.map.header.sequence.toString() });
      this.#emit({ type: "refused", reason: `A map was refused: ${error.message}` });
      return;
    }
    this.#shown = update;
    this.#is_busy = true;
    const { map, sent_ns, arrived_ms, plan } = update, { counts } = this.#stream;
    if (plan) frame.legend = [...frame.legend, [PLAN_COLOUR, `plan ${plan.planner}${plan.text && `: ${plan.text}`}`]];
    this.#emit({
      type: "frame", raster, header: map.header, sent_ns, arrived_ms, length: map.length, names: map.names,
      counts: { ...counts }, plan, ...frame,
    });
    this.#answerProbe();
  }

  #answerProbe() {
    const { probe } = this.#want;
    if (!probe || !this.#shown) return;
    try {
      const { map } = this.#shown;
      this.#emit({ type: "cell", at: probe, sequence: map.header.sequence, layers: cellValues(map, probe) });
    } catch (error) {
      this.#emit({ type: "refused", reason: `A layer was refused: ${error.message}` });
    }
  }
}
