// In: the updates of one vehicle, as they arrive. Out: the newest map that was not drawn yet, and counts of what
// happened to all others. Of a whole map only the header is read here; the cells of a map that is replaced before it
// was drawn are never decoded. A delta is decoded at once, because the next one starts from it.

import { openUpdate } from "./wire/map.js";

export class MapStream {
  counts = { received: 0n, skipped: 0n, replaced: 0n, lost: 0n, repeated: 0n, refused: 0n, restarts: 0n };
  #newest = null;
  // The header of the last map that was received; null before the first.
  #last = null;
  #is_new_connection = true;
  // Updates that could not be read since the last map: they are in a gap of the sequence, but were not lost.
  #unreadable = 0n;
  // The map that the next delta starts from; null if maps are whole.
  #base = null;

  // Starts a new connection or selection. The maps that were made while there was none count neither as skipped nor as
  // lost.
  restart() {
    this.#is_new_connection = true;
    this.#unreadable = 0n;
    this.#base = null;
  }

  // Records one message; returns its update. Throws a DecodeError or WireError if the message is refused.
  // with_deltas: true if the server may send deltas.
  push(message, with_deltas = false) {
    let update;
    try {
      update = openUpdate(message, this.#base);
      this.#base = with_deltas ? update.map : null;
    } catch (error) {
      this.#unreadable++;
      this.counts.refused++;
      throw error;
    }
    this.counts.skipped += update.skipped;
    if (this.#isShownAgain(update)) {
      this.#newest = update;
    } else if (this.#isNew(update)) {
      if (this.#newest) this.counts.replaced++;
      this.#newest = update;
      this.#last = update.map.header;
      this.counts.received++;
      this.#unreadable = 0n;
    }
    this.#is_new_connection = false;
    return update;
  }

  // Removes and returns the newest update that was not drawn; null if there is none.
  removeNewest() {
    const newest = this.#newest;
    this.#newest = null;
    return newest;
  }

  // True if a new connection or selection begins with the last map that was received: it may have other layers.
  #isShownAgain({ map: { header } }) {
    const last = this.#last;
    return this.#is_new_connection && last?.boot_id === header.boot_id && last.sequence === header.sequence;
  }

  // True if the map follows the maps received so far. Counts the gap before it.
  #isNew({ map: { header }, skipped, left_out }) {
    const last = this.#last;
    if (!last) return true;
    if (last.boot_id !== header.boot_id) {
      this.counts.restarts++;
      return true;
    }
    const ahead = header.sequence - last.sequence;
    if (ahead <= 0n) {
      this.counts.repeated++;
      return false;
    }
    const missing = ahead - 1n - skipped - left_out - this.#unreadable;
    if (!this.#is_new_connection && missing > 0n) this.counts.lost += missing;
    return true;
  }
}
