// What the package exports. The page of the server imports the same modules.

export { DecodeError } from "./limits.js";
export { LiveMap, openUpdate } from "./map.js";
export { WireError } from "./protobuf.js";
