// The Worker of the page: the connection, and the decoding and painting of maps. The page's own thread draws finished
// pictures alone.
// From the page: { type: "want", vehicle, want } (feed.js; null ends it), "probe" { vehicle, at }, "drawn" { vehicle },
// "reconnect" { text }, "server" { request }. To the page: "frame", "cell", "refused", "link", "fleet", "replay",
// "recorder".

import { Feed } from "./feed.js";
import { Link } from "./link.js";
import { isPoints, readPoints } from "./space/points.js";
import { readMap, readMapUpdate } from "./wire/protobuf.js";

const feeds = new Map();
// Page and Worker have the same clock, each from its own origin.
const absolute = (ms) => performance.timeOrigin + ms;

const address = new URL("live", location.href);
address.protocol = address.protocol === "https:" ? "wss:" : "ws:";

const link = new Link({
  state(state) {
    postMessage({ type: "link", ...state });
    if (state.phase === "live") for (const feed of feeds.values()) feed.begin();
  },
  text(text) {
    const message = JSON.parse(text);
    if (message.type === "watching") feeds.get(message.vehicle)?.begun(message.id);
    else postMessage({ ...message, arrived_ms: absolute(performance.now()) });
  },
  update(bytes, arrived_ms) {
    try {
      if (isPoints(bytes)) return postMessage({ type: "points", ...readPoints(bytes) });
      const { header } = readMap(readMapUpdate(bytes).map);
      feeds.get(header?.vehicle)?.push(bytes, absolute(arrived_ms));
    } catch (error) {
      postMessage({ type: "refused", vehicle: "", reason: `A map was refused: ${error.message}` });
    }
  },
}, address);

const emit = (message) => {
  const pictures = [message.pixels, message.space?.bytes].filter(Boolean);
  postMessage(message, pictures.map(({ buffer }) => buffer));
};

const FROM_PAGE = {
  want({ vehicle, want }) {
    let feed = feeds.get(vehicle);
    if (!want) {
      feed?.end();
      return feeds.delete(vehicle);
    }
    if (!feed) feeds.set(vehicle, (feed = new Feed(vehicle, (request) => link.send(request), emit)));
    feed.want(want);
  },
  probe: ({ vehicle, at }) => feeds.get(vehicle)?.probe(at),
  drawn: ({ vehicle }) => feeds.get(vehicle)?.drawn(),
  reconnect: ({ text }) => link.reconnect(text),
  server: ({ request }) => link.send(request),
};

onmessage = ({ data }) => FROM_PAGE[data.type](data);
link.connect();
