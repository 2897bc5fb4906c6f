// What a vehicle's status says, in the words of the fleet. Pure. A field that the server does not send is not shown.

const ORDER = { error: 0, warn: 1, ok: 2 };
// A status arrives once a second. A vehicle without news for longer is silent.
const NEWS_MS = 2500;
// Two states begin at least so far apart.
const SAME_MS = 1500;

// A vehicle of another server, as that server says it. Two servers may claim one name: its card has a key of its own.
export const elsewhere = (status) => {
  const { name, server, grpc, run } = status;
  return { ...status, is_elsewhere: true, key: [name, server, grpc || run].join(" @ ") };
};

// Where a click on a vehicle's card leads: its view here, or the page of its server; null if that has none for others.
export function addressOf({ name, is_elsewhere, page }) {
  const vehicle = `?vehicle=${encodeURIComponent(name)}`;
  if (!is_elsewhere) return vehicle;
  return URL.canParse(page ?? "") && /^https?:$/.test(new URL(page).protocol) ? new URL(vehicle, page).href : null;
}

export function stateOf(status) {
  const state = Object.hasOwn(ORDER, status?.state ?? "") ? status.state : null;
  const claimed = status?.claimed_by?.length ? [`also claimed by ${status.claimed_by.join(", ")}`] : [];
  const served = status?.is_elsewhere ? [`served by ${status.server} (${status.grpc || status.run})`] : [];
  return { state, reasons: [...served, ...(status?.reasons ?? []), ...claimed] };
}

// The age of the newest map, in ms, when it was last told: by the status, which arrived status_age_ms ago, or by the
// map on the card, frame_age_ms old. Without news for longer it grows. null if no map is known.
export function ageOf(status, status_age_ms, frame_age_ms) {
  const silent_ms = status_age_ms > NEWS_MS ? status_age_ms : 0;
  const by_status = status.map_age_ms == null ? Infinity : status.map_age_ms + silent_ms;
  const age = Math.min(by_status, frame_age_ms ?? Infinity);
  return Number.isFinite(age) ? age : null;
}

// "fresh", "stale" or "none".
export const freshOf = (age_ms, validity_ms) => (age_ms === null ? "none" : age_ms <= validity_ms ? "fresh" : "stale");

// When the state began, by the clock of arrived_ms: before_ms, as it was told before, unless it is another state; null
// if the server does not say it. Statuses are up to half a second old, and an order must not change by that.
export function beganAt({ state_ms }, arrived_ms, before_ms) {
  if (!(state_ms > 0)) return null;
  const began_ms = arrived_ms - state_ms;
  return before_ms !== null && Math.abs(began_ms - before_ms) < SAME_MS ? before_ms : began_ms;
}

// A vehicle that is not well: its state says so, or its maps are old.
export const needsCare = ({ status, fresh }) =>
  ["error", "warn"].includes(stateOf(status).state) || fresh === "stale";

const compare = (a, b) => (a < b ? -1 : a > b ? 1 : 0);
const natural = new Intl.Collator("en", { numeric: true });
const byName = (a, b) => natural.compare(a.status.name, b.status.name);
// The unknown comes last.
const descending = (of) => (a, b) => compare(of(b) ?? -Infinity, of(a) ?? -Infinity);
const ORDERS = {
  name: byName,
  // What needs hands first: no maps, old maps, maps with something wrong, and of two alike what has waited longer.
  state: (a, b) => compare(rank(a), rank(b)) || (rank(a) < WELL ? compare(beganOf(a), beganOf(b)) : 0),
  age: descending(({ age_ms }) => age_ms ?? Infinity),
  loss: descending(({ status }) => status.loss),
  speed: descending(({ speed }) => speed),
};

const WELL = 3;
const beganOf = ({ began_ms }) => began_ms ?? Infinity;

function rank(card) {
  const { state } = stateOf(card.status);
  return state === "error" ? 0 : card.fresh === "stale" ? 1 : state === "warn" ? 2 : WELL;
}

// cards: [{ status, age_ms, fresh, began_ms, speed }]. The keys of the shown cards, in order.
export function chosen(cards, { order, only, text }) {
  const wanted = text.trim().toLowerCase();
  const isShown = (card) =>
    card.status.name.toLowerCase().includes(wanted) && (only !== "care" || needsCare(card));
  const by = ORDERS[order] ?? byName;
  return cards.filter(isShown).sort((a, b) => by(a, b) || byName(a, b)).map(({ status }) => status.key ?? status.name);
}

// The numbers of vehicles: { all, error, warn, ok, stale }.
export function tally(cards) {
  const counts = { all: cards.length, error: 0, warn: 0, ok: 0, stale: 0 };
  for (const { status, fresh } of cards) {
    const { state } = stateOf(status);
    if (state) counts[state]++;
    if (fresh === "stale") counts.stale++;
  }
  return counts;
}
