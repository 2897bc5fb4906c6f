// In: the server's stamp on every update (sent_ns), and this browser's monotonic clock when it arrived, in ms.
// Out: the server's present time, and the age of a map by it. Browser and server may disagree about the time of day.
//
// For each update, arrival - sent_ns = (browser clock - server clock) + time on the way. The smallest difference of a
// connection is the best estimate of the first part. The estimate may rise by at most DRIFT_PPM, which is how far two
// quartz clocks drift apart; so a delay that grows by a millisecond a map appears as age, not as a clock offset. What
// stays hidden is the fastest trip of the connection: an age is too small by that (and by the allowed drift), not more.

import { duration } from "./text.js";

const DRIFT_PPM = 100;
// If a link lags by LAG_MS_MAX for LAG_FOR_MS, either a queue in it must be dropped or the server's clock was set back.
const LAG_MS_MAX = 1000, LAG_FOR_MS = 10000;
// A map is stamped before it is sent. A capture that ends this far after the server's present time has a wrong stamp.
const AHEAD_MS_MAX = 100;

export class ServerClock {
  #offset_ms = null;
  #sampled_ms = 0;
  #is_new_connection = true;
  #in_time_ms = 0;

  // Starts a new connection: the next sample replaces the offset, by which the shown map ages until then.
  restart() {
    this.#is_new_connection = true;
  }

  // Forgets the offset, because this browser's clock was set or the computer slept.
  forget() {
    this.#offset_ms = null;
    this.#is_new_connection = true;
  }

  // Records one update. Returns false if updates have lagged for so long that only a new connection helps.
  sample(local_ms, sent_ns) {
    const offset = local_ms - Number(sent_ns) / 1e6;
    const drifted = this.#offset_ms + ((local_ms - this.#sampled_ms) * DRIFT_PPM) / 1e6;
    this.#offset_ms = this.#is_new_connection ? offset : Math.min(offset, drifted);
    this.#sampled_ms = local_ms;
    this.#is_new_connection = false;
    if (offset - this.#offset_ms <= LAG_MS_MAX) this.#in_time_ms = local_ms;
    return local_ms - this.#in_time_ms <= LAG_FOR_MS;
  }

  // The server's time, in ns since the Unix epoch (BigInt); null while it is unknown.
  now_ns(local_ms) {
    if (this.#offset_ms === null) return null;
    return BigInt(Math.round((local_ms - this.#offset_ms) * 1e3)) * 1000n;
  }

  // How far the server's clock is ahead of this computer's time of day, in ms; null while it is unknown.
  ahead_ms(wall_minus_monotonic_ms) {
    return this.#offset_ms === null ? null : -this.#offset_ms - wall_minus_monotonic_ms;
  }
}

// The age of a map that came at the server's time came_ns, at its time now_ns: { age_ms, validity_ms, fresh, why }. Why
// a map is not fresh is said in the words of every client (client/golden/staleness.json). One of unknown age is not.
export function freshness(header, came_ns, now_ns) {
  const validity_ms = Number(header.valid_until_ns - header.capture_end_ns) / 1e6;
  if (now_ns === null) return { age_ms: null, validity_ms, fresh: false, why: "age unknown until the next map" };
  const ageAt_ms = (at_ns) => Number(at_ns - header.capture_end_ns) / 1e6;
  const why = staleness(ageAt_ms(came_ns ?? now_ns), ageAt_ms(now_ns), validity_ms);
  return { age_ms: ageAt_ms(now_ns), validity_ms, fresh: why === null, why: why ?? "" };
}

// Why a map that is shown is old although the server has a newer one; null if that is not so. age_ms: of the shown map,
// newest_ms: of the server's newest one when the server told it, told_ms ago.
export function behind(age_ms, newest_ms, told_ms, validity_ms) {
  const behind_ms = age_ms - newest_ms - told_ms;
  if (!(age_ms > validity_ms && behind_ms > validity_ms)) return null;
  return `this browser is ${duration(behind_ms)} behind; the server's newest map was ${duration(newest_ms)} old`;
}

function staleness(on_arrival_ms, age_ms, validity_ms) {
  if (age_ms < -AHEAD_MS_MAX) {
    return `it was captured ${(-age_ms).toFixed()} ms in the future: its stamps are ahead of the reader's clock`;
  }
  if (on_arrival_ms > validity_ms) {
    const causes = "maps are delayed, its stamps are behind the reader's clock, or a recording is replayed without";
    return `it was ${on_arrival_ms.toFixed()} ms old when it arrived: ${causes} --as-live`;
  }
  return age_ms > validity_ms ? "no newer map has arrived" : null;
}
