// Decodes the protocol's messages (docs/view-protocol.md). A message that breaks the protocol raises a MessageError, whose text is shown.

export class MessageError extends Error {}

// Another version of the protocol: its messages cannot be read.
export class ProtocolError extends MessageError {}

export const PROTOCOL = 1;
const BASE_WORDS = 8;

function demand(holds, what) {
  if (!holds) {
    throw new MessageError(what);
  }
}

function isCount(value) {
  return Number.isInteger(value) && value >= 0;
}

function isVector(value, size) {
  return Array.isArray(value) && value.length >= size && value.slice(0, size).every(v => typeof v === "number" && Number.isFinite(v));
}

function isPosed(value) {
  return value !== null && typeof value === "object" && isVector(value.p, 3) && isVector(value.q, 4);
}

export function isCamera(value) {
  return value !== null && typeof value === "object"
    && ["width", "height", "fx", "fy"].every(k => Number.isFinite(value[k]) && value[k] > 0)
    && Number.isFinite(value.cx) && Number.isFinite(value.cy);
}

const TEXT_CHECKS = {
  hello(m) {
    if (m.protocol !== PROTOCOL) {
      throw new ProtocolError(`This page reads protocol ${PROTOCOL}; keysplat sent protocol ${m.protocol}. Load the page anew from keysplat.`);
    }
    demand(m.camera === null || m.camera === undefined || isCamera(m.camera), "The camera of a hello has no intrinsics.");
  },
  poses(m) {
    demand(Array.isArray(m.keyframes) && m.keyframes.every(k => isPosed(k) && isCount(k.id)), "A list of keyframes has an entry without id or pose.");
    demand(!m.loops || (Array.isArray(m.loops) && m.loops.every(l => isVector(l, 2))), "A loop edge does not have two keyframes.");
    demand(!m.current || isPosed(m.current) || m.current.lost === true, "The current camera has no pose.");
  },
  path(m) {
    demand(Array.isArray(m.poses) && m.poses.every(p => isVector(p, 4)), "A pose of the path is not a list of numbers.");
    demand(!m.truth || (Array.isArray(m.truth) && m.truth.every(p => isVector(p, 3))), "A position of the true path is not a list of numbers.");
  },
  statistics(m) {
    const isEntry = e => e !== null && typeof e === "object" && Number.isFinite(e.s);
    demand(Array.isArray(m.entries) && m.entries.every(isEntry), "An entry of the statistics has no time.");
  },
  refused(m) {
    demand(typeof m.why === "string", "A refusal gives no reason.");
  },
};

function readText(text) {
  let message;
  try {
    message = JSON.parse(text);
  } catch {
    throw new MessageError("A text message is not JSON.");
  }
  demand(message !== null && typeof message === "object" && typeof message.type === "string", "A text message has no type.");
  if (Object.hasOwn(TEXT_CHECKS, message.type)) {
    TEXT_CHECKS[message.type](message);
  }
  return message;
}

function isChunk(chunk) {
  return chunk !== null && typeof chunk === "object" && isVector(chunk.at, 3) && isCount(chunk.part) && isCount(chunk.count);
}

function readMap(header, buffer, start) {
  demand(isCount(header.sh_degree) && header.sh_degree <= 3, "A map has harmonics of an unknown degree.");
  demand(Array.isArray(header.chunks) && header.chunks.every(isChunk), "A map has a chunk without place or count.");
  const wordsEach = BASE_WORDS + 4 * header.sh_degree;
  const count = header.chunks.reduce((sum, chunk) => sum + chunk.count, 0);
  demand(buffer.byteLength - start === 4 * wordsEach * count, "The size of a map's payload does not match its chunks.");
  // Typed arrays want whole words; the protocol pads for that, other senders may not.
  const words = start % 4 === 0 ? new Uint32Array(buffer, start) : new Uint32Array(buffer.slice(start));
  return { ...header, words, wordsEach };
}

function readImage(header, buffer, start) {
  demand(header.format === "jpeg" || header.format === "png", "A picture has an unknown format.");
  demand(isCount(header.width) && isCount(header.height) && header.width > 0 && header.height > 0, "A picture has no size.");
  demand(!header.camera || isCamera(header.camera), "The camera of a picture has no intrinsics.");
  return { ...header, blob: new Blob([new Uint8Array(buffer, start)], { type: `image/${header.format}` }) };
}

function readBinary(buffer) {
  demand(buffer.byteLength >= 4, "A binary message is too short.");
  const length = new DataView(buffer).getUint32(0, true);
  demand(length <= buffer.byteLength - 4, "A binary message is shorter than its header.");
  const header = readText(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  if (header.type === "map") {
    return readMap(header, buffer, 4 + length);
  }
  return header.type === "image" ? readImage(header, buffer, 4 + length) : header;
}

// A message of either form: its fields, and for maps `words` and `wordsEach`, for images `blob`.
export function readMessage(data) {
  return typeof data === "string" ? readText(data) : readBinary(data);
}

export function bytesOfBase64(text) {
  if (typeof Uint8Array.fromBase64 === "function") {
    return Uint8Array.fromBase64(text).buffer;
  }
  const raw = atob(text);
  const bytes = new Uint8Array(raw.length);
  for (let i = 0; i < raw.length; i++) {
    bytes[i] = raw.charCodeAt(i);
  }
  return bytes.buffer;
}
