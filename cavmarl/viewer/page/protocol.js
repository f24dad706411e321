// The server's binary messages; cavmarl/viewer/map_geometry.py and frame_messages.py write them.

export const MAP = 1;
export const ROSTER = 2;
export const FRAME = 3;

export const PIECE_BYTES = 24;
export const CORNER_BYTES = 12;
export const STOP_LINE_BYTES = 32;

const ROSTER_HEAD_BYTES = 16;
const ROSTER_ROW_BYTES = 26;
const FRAME_HEAD_BYTES = 36;
const ROW_BYTES = 9;
const MARGIN_M = 1000;

export const BRAKING = 1;
export const BLINKS_LEFT = 2;
export const BLINKS_RIGHT = 4;
export const COLLIDED = 8;

export function kindOf(buffer) {
  return new Uint8Array(buffer, 0, 1)[0];
}

export function decodeMap(buffer) {
  const length = new DataView(buffer).getUint32(4, true);
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 8, length)));
  const start = 8 + length;
  const section = (name, rowBytes) => {
    const [at, count] = head.sections[name];
    return { count, bytes: new Uint8Array(buffer, start + at, count * rowBytes) };
  };
  const numbers = (name) => {
    const [at, count] = head.sections[name];
    return new Uint32Array(buffer.slice(start + at), 0, count);
  };
  return {
    ...head,
    roads: section("roads", PIECE_BYTES),
    lines: section("lines", PIECE_BYTES),
    surfaces: section("surfaces", CORNER_BYTES),
    marks: section("marks", CORNER_BYTES),
    buildings: section("buildings", CORNER_BYTES),
    stopLines: section("stop_lines", STOP_LINE_BYTES),
    stopLinks: numbers("stop_links"),
    phaseFirst: numbers("phase_first"),
    phaseStates: section("phase_states", 1).bytes,
  };
}

// Rarely changing fields of each vehicle, in the order of ids; immutable.
export class Roster {
  constructor(count, version) {
    this.version = version;
    this.count = count;
    this.ids = new Float64Array(count);
    this.agents = new Int32Array(count);
    this.sizes = new Float32Array(2 * count); // length and width, m
    this.zones = new Int16Array(count);
    this.targets = new Int16Array(count);
    this.classes = new Uint8Array(count);
    this.drivers = new Uint8Array(count);
    this.levels = new Int8Array(count);
  }

  // Returns the row of a vehicle; -1 if it is missing.
  find(id) {
    let low = 0;
    let high = this.count - 1;
    while (low <= high) {
      const middle = (low + high) >> 1;
      if (this.ids[middle] === id) return middle;
      if (this.ids[middle] < id) low = middle + 1;
      else high = middle - 1;
    }
    return -1;
  }

  copyRow(to, from, at) {
    this.ids[to] = from.ids[at];
    this.agents[to] = from.agents[at];
    this.sizes[2 * to] = from.sizes[2 * at];
    this.sizes[2 * to + 1] = from.sizes[2 * at + 1];
    this.zones[to] = from.zones[at];
    this.targets[to] = from.targets[at];
    this.classes[to] = from.classes[at];
    this.drivers[to] = from.drivers[at];
    this.levels[to] = from.levels[at];
  }

  // Returns the roster after a message of changes.
  after(buffer) {
    const view = new DataView(buffer);
    const whole = view.getUint8(1) === 1;
    const version = view.getUint32(4, true);
    const count = view.getUint32(8, true);
    const numLeft = view.getUint32(12, true);
    const left = new Set();
    for (let k = 0; k < numLeft; k++) left.add(view.getFloat64(ROSTER_HEAD_BYTES + 8 * k, true));
    const fresh = readRows(view, ROSTER_HEAD_BYTES + 8 * numLeft, count, version);
    if (whole) return fresh;
    return merge(this, left, fresh, version);
  }
}

function readRows(view, start, count, version) {
  const rows = new Roster(count, version);
  for (let k = 0; k < count; k++) {
    const at = start + k * ROSTER_ROW_BYTES;
    rows.ids[k] = view.getFloat64(at, true);
    rows.agents[k] = view.getInt32(at + 8, true);
    rows.sizes[2 * k] = view.getUint16(at + 12, true) / 100;
    rows.sizes[2 * k + 1] = view.getUint16(at + 14, true) / 100;
    rows.zones[k] = view.getInt16(at + 18, true);
    rows.targets[k] = view.getInt16(at + 20, true);
    rows.classes[k] = view.getUint8(at + 22);
    rows.drivers[k] = view.getUint8(at + 23);
    rows.levels[k] = view.getInt8(at + 24);
  }
  return rows;
}

function merge(old, left, fresh, version) {
  const sources = [];
  let a = 0;
  let b = 0;
  while (a < old.count || b < fresh.count) {
    const idA = a < old.count ? old.ids[a] : Infinity;
    const idB = b < fresh.count ? fresh.ids[b] : Infinity;
    if (idB <= idA) {
      sources.push(-1 - b);
      b += 1;
      if (idA === idB) a += 1;
    } else {
      if (!left.has(idA)) sources.push(a);
      a += 1;
    }
  }
  const merged = new Roster(sources.length, version);
  sources.forEach((source, to) => {
    if (source >= 0) merged.copyRow(to, old, source);
    else merged.copyRow(to, fresh, -1 - source);
  });
  return merged;
}

// A frame; `places`: x, y in metres, heading and speed of each vehicle; `flags`: its lamps.
export function decodeFrame(buffer, roster) {
  const view = new DataView(buffer);
  const count = view.getUint32(24, true);
  const numSignals = view.getUint32(28, true);
  const numGhosts = view.getUint32(32, true);
  let at = FRAME_HEAD_BYTES;
  const signals = new Uint32Array(buffer, at, numSignals);
  at += 4 * numSignals;
  const ghosts = new Map();
  for (let k = 0; k < numGhosts; k++) {
    const num = view.getUint32(at + 4, true);
    ghosts.set(view.getUint32(at, true), new Uint32Array(buffer, at + 8, num));
    at += 8 + 4 * num;
  }
  return {
    roster,
    paused: (view.getUint8(1) & 1) === 1,
    version: view.getUint32(4, true),
    time: view.getFloat64(8, true),
    tick: view.getUint32(16, true),
    pace: view.getFloat32(20, true),
    count,
    signals,
    ghosts,
    rows: new Uint8Array(buffer, at, count * ROW_BYTES),
    bytes: buffer.byteLength,
  };
}

// Fills `places` (4 per vehicle) and `flags` of a frame.
export function decodePlaces(frame, places, flags) {
  const rows = frame.rows;
  const turn = (2 * Math.PI) / 2048;
  for (let k = 0, at = 0, to = 0; k < frame.count; k++, at += ROW_BYTES, to += 4) {
    places[to] = (rows[at] | (rows[at + 1] << 8) | (rows[at + 2] << 16)) / 100 - MARGIN_M;
    places[to + 1] = (rows[at + 3] | (rows[at + 4] << 8) | (rows[at + 5] << 16)) / 100 - MARGIN_M;
    const bits = rows[at + 6] | (rows[at + 7] << 8) | (rows[at + 8] << 16);
    places[to + 2] = (bits & 2047) * turn;
    places[to + 3] = ((bits >> 11) & 511) / 4;
    flags[k] = bits >> 20;
  }
}
