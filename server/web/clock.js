// In: the server's stamp on every update (sent_ns) and this browser's monotonic clock at its receipt, ms.
// Out: the server's clock now, and how old a map is by it. Browser and server need not agree on the time of day.
//
// Each update gives receipt - sent_ns = (browser clock - server clock) + time on the way. The smallest difference of a
// connection is the best guess of the first part. It may rise by at most DRIFT, what two quartz clocks can drift
// apart, so a delay that grows by a millisecond a map shows as age and is not taken for a clock. What stays hidden is
// the fastest trip of the connection: an age is short by that much (and what DRIFT allows), not by more.

const DRIFT_PPM = 100;
// A link that lags by this much for this long has a queue to drop, or the server's clock was stepped back.
const LAG_MS_MAX = 1000, LAG_FOR_MS = 10000;
// Maps are stamped before they are sent; a capture this far after the server's own clock is a wrong stamp.
const AHEAD_MS_MAX = 100;

export class ServerClock {
  #offset_ms = null;
  #sampled_ms = 0;
  #anew = true;
  #in_time_ms = 0;

  // A new connection: the next sample replaces what was known, and until it comes the held map goes on ageing.
  restart() {
    this.#anew = true;
  }

  // This browser's clock was stepped or slept: nothing is known until the next sample.
  forget() {
    this.#offset_ms = null;
    this.#anew = true;
  }

  // Gives false once updates have lagged behind the fastest trip for so long that only a new connection helps.
  sample(local_ms, sent_ns) {
    const offset = local_ms - Number(sent_ns) / 1e6;
    const drifted = this.#offset_ms + ((local_ms - this.#sampled_ms) * DRIFT_PPM) / 1e6;
    this.#offset_ms = this.#anew ? offset : Math.min(offset, drifted);
    this.#sampled_ms = local_ms;
    this.#anew = false;
    if (offset - this.#offset_ms <= LAG_MS_MAX) this.#in_time_ms = local_ms;
    return local_ms - this.#in_time_ms <= LAG_FOR_MS;
  }

  // Server's clock, ns since the Unix epoch (BigInt); null while unknown.
  now_ns(local_ms) {
    if (this.#offset_ms === null) return null;
    return BigInt(Math.round((local_ms - this.#offset_ms) * 1e3)) * 1000n;
  }

  // How far the server's clock is ahead of this computer's time of day, ms; null while unknown.
  ahead_ms(wall_minus_monotonic_ms) {
    return this.#offset_ms === null ? null : -this.#offset_ms - wall_minus_monotonic_ms;
  }
}

// How a map stands at the server's time now_ns: { age_ms, validity_ms, fresh, why }. Unknown time is never fresh.
export function freshness(header, now_ns) {
  const validity_ms = Number(header.valid_until_ns - header.capture_end_ns) / 1e6;
  if (now_ns === null) return { age_ms: null, validity_ms, fresh: false, why: "age unknown until the next map" };
  const age_ms = Number(now_ns - header.capture_end_ns) / 1e6;
  if (age_ms < -AHEAD_MS_MAX) return { age_ms, validity_ms, fresh: false, why: "its stamp lies in the future" };
  const fresh = now_ns <= header.valid_until_ns;
  return { age_ms, validity_ms, fresh, why: fresh ? "" : "its validity has passed" };
}
