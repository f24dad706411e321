// The vehicles: bodies in one draw call, and rings around marked ones in another.

import { decodePlaces } from "./protocol.js";
import { attribute, COMMON, Program, VIEW } from "./drawing.js";

export const SELECTED = 16;
export const GHOST = 32;
export const TRANSFER = 64;
const RING = SELECTED | GHOST | TRANSFER;

const MOVED = `
layout(location = 0) in vec4 a_before; // x, y, heading, speed
layout(location = 1) in vec4 a_now;
layout(location = 2) in vec2 a_size;
layout(location = 3) in vec4 a_color;
layout(location = 4) in uint a_bits; // lamps and marks; level from bit 8, colour from bit 16
uniform float u_share; // interpolation from the previous frame to this one
uniform float u_scale; // pixels per metre
uniform vec3 u_inks[8]; // of rings
vec2 placeNow() { return mix(a_before.xy, a_now.xy, u_share); }
float headingNow() {
  float turn = a_now.z - a_before.z;
  turn -= 6.283185307 * floor(turn / 6.283185307 + 0.5);
  return a_before.z + turn * u_share;
}
float levelOf() { return float(int((a_bits >> 8u) & 255u) - 128); }
`;

const BODIES = `${COMMON}${VIEW}${MOVED}
uniform bool u_bySpeed;
flat out vec2 v_size;
flat out vec3 v_color;
flat out uint v_bits;
flat out float v_pixel;
out vec2 v_at;
vec3 ofSpeed(float speed) {
  float x = clamp(speed / 25.0, 0.0, 1.0);
  vec3 slow = vec3(0.84, 0.18, 0.15), mid = vec3(0.97, 0.78, 0.25), fast = vec3(0.12, 0.62, 0.47);
  return x < 0.5 ? mix(slow, mid, 2.0 * x) : mix(mid, fast, 2.0 * x - 1.0);
}
void main() {
  vec2 corner = vec2(float(gl_VertexID & 1), float(gl_VertexID >> 1)) * 2.0 - 1.0;
  vec2 size = max(a_size, vec2(7.0, 3.5) / u_scale);
  float heading = headingNow();
  vec2 ahead = vec2(cos(heading), sin(heading));
  v_at = corner * size * 0.5;
  v_size = size * 0.5;
  v_color = u_bySpeed ? ofSpeed(mix(a_before.w, a_now.w, u_share)) : a_color.rgb;
  v_bits = a_bits;
  v_pixel = 1.0 / u_scale;
  vec2 place = placeNow() + ahead * v_at.x + vec2(-ahead.y, ahead.x) * v_at.y;
  gl_Position = onScreen(place, levelOf(), 5.0);
}`;

const BODIES_INK = `${COMMON}
flat in vec2 v_size;
flat in vec3 v_color;
flat in uint v_bits;
flat in float v_pixel;
in vec2 v_at;
out vec4 color;
void main() {
  float radius = min(v_size.y * 0.55, v_size.x * 0.4);
  vec2 over = abs(v_at) - v_size + radius;
  float outside = length(max(over, 0.0)) + min(max(over.x, over.y), 0.0) - radius;
  if (outside > 0.0) discard;
  vec3 ink = v_color;
  float side = abs(v_at.y) / v_size.y;
  float along = v_at.x / v_size.x;
  if (v_size.x > 4.0 * v_pixel) {
    if (outside > -max(0.12, v_pixel)) ink *= 0.62;
    bool glass = along > 0.12 && along < 0.42 && side < 0.8;
    glass = glass || (along < -0.62 && along > -0.8 && side < 0.7);
    if (glass) ink = vec3(0.15, 0.19, 0.25);
    if ((v_bits & 1u) != 0u && along < -0.86) ink = vec3(1.0, 0.16, 0.12);
    if (along > 0.88 && side > 0.45) ink = vec3(1.0, 0.98, 0.86);
    bool left = (v_bits & 2u) != 0u && v_at.y > 0.0;
    bool right = (v_bits & 4u) != 0u && v_at.y < 0.0;
    if ((left || right) && side > 0.6 && abs(along) > 0.72) ink = vec3(1.0, 0.66, 0.1);
  }
  if ((v_bits & 8u) != 0u) ink = mix(ink, vec3(0.87, 0.09, 0.13), 0.75);
  color = vec4(ink, 1.0);
}`;

const RINGS = `${COMMON}${VIEW}${MOVED}
flat out vec3 v_color;
flat out vec2 v_radius;
flat out float v_dashed;
out vec2 v_at;
void main() {
  vec2 corner = vec2(float(gl_VertexID & 1), float(gl_VertexID >> 1)) * 2.0 - 1.0;
  bool shown = (a_bits & ${RING}u) != 0u;
  float radius = max(a_size.x * 0.5 + 1.2, 9.0 / u_scale);
  float outer = radius + 3.0 / u_scale;
  v_radius = vec2(radius, outer);
  v_at = corner * outer;
  v_color = u_inks[(a_bits >> 16u) & 7u];
  v_dashed = (a_bits & ${SELECTED | TRANSFER}u) == 0u ? 1.0 : 0.0;
  gl_Position = shown ? onScreen(placeNow() + v_at, 30.0, 7.0) : vec4(2.0, 2.0, 2.0, 1.0);
}`;

const RINGS_INK = `${COMMON}
flat in vec3 v_color;
flat in vec2 v_radius;
flat in float v_dashed;
in vec2 v_at;
out vec4 color;
void main() {
  float from = length(v_at);
  float edge = (v_radius.y - v_radius.x) * 0.3;
  float alpha = smoothstep(v_radius.x - edge, v_radius.x, from)
    * (1.0 - smoothstep(v_radius.y - edge, v_radius.y, from));
  if (v_dashed > 0.5 && fract(atan(v_at.y, v_at.x) * 12.0 / 6.2831853) > 0.6) alpha = 0.0;
  if (alpha < 0.02) discard;
  color = vec4(v_color * alpha, alpha);
}`;

export class VehicleLayer {
  constructor(gl, ringColors) {
    this.gl = gl;
    this.bodies = new Program(gl, BODIES, BODIES_INK);
    this.rings = new Program(gl, RINGS, RINGS_INK);
    this.inks = new Float32Array(24);
    ringColors.slice(0, 8).forEach((ink, k) => this.inks.set(ink.map((c) => c / 255), 3 * k));
    this.room = 0;
    this.count = 0;
    this.marked = 0;
    this.shown = null;
    this.reserve(256);
  }

  reserve(count) {
    if (count <= this.room) return;
    this.room = Math.max(2 * this.room, count);
    const gl = this.gl;
    const kept = this.now;
    const flags = this.flags;
    this.before = new Float32Array(4 * this.room);
    this.now = new Float32Array(4 * this.room);
    this.flags = new Uint8Array(this.room);
    if (kept) this.now.set(kept);
    if (flags) this.flags.set(flags);
    this.spare = new Float32Array(4 * this.room);
    this.looks = new ArrayBuffer(16 * this.room);
    this.sizes = new Float32Array(this.looks);
    this.colors = new Uint32Array(this.looks);
    this.layout = gl.createVertexArray();
    gl.bindVertexArray(this.layout);
    this.buffers = [this.before, this.now, this.looks].map((bytes, k) => {
      const buffer = gl.createBuffer();
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.bufferData(gl.ARRAY_BUFFER, bytes.byteLength, gl.DYNAMIC_DRAW);
      if (k < 2) attribute(gl, k, 4, gl.FLOAT, 16, 0, { each: 1 });
      return buffer;
    });
    attribute(gl, 2, 2, gl.FLOAT, 16, 0, { each: 1 });
    attribute(gl, 3, 4, gl.UNSIGNED_BYTE, 16, 8, { each: 1, share: true });
    attribute(gl, 4, 1, gl.UNSIGNED_INT, 16, 12, { each: 1, whole: true });
  }

  // Takes a frame; without `smooth`, the vehicles jump to their positions.
  take(frame, smooth) {
    const old = this.shown?.roster;
    this.reserve(frame.count);
    this.count = frame.count;
    const last = this.now;
    this.now = this.spare;
    this.spare = last;
    decodePlaces(frame, this.now, this.flags);
    if (!smooth || !old) {
      this.before.set(this.now.subarray(0, 4 * frame.count));
    } else if (old === frame.roster) {
      this.before.set(last.subarray(0, 4 * frame.count));
    } else {
      this.match(old, frame.roster, last);
    }
    this.shown = frame;
  }

  // Maps the previous positions of another roster to the vehicles of a roster.
  match(old, roster, places) {
    for (let k = 0, a = 0; k < roster.count; k++) {
      while (a < old.count && old.ids[a] < roster.ids[k]) a += 1;
      const known = a < old.count && old.ids[a] === roster.ids[k];
      const from = known ? places : this.now;
      const at = 4 * (known ? a : k);
      for (let c = 0; c < 4; c++) this.before[4 * k + c] = from[at + c];
    }
  }

  // Sets colours and marks; `inkOf(row)` returns 0xAABBGGRR.
  paint(inkOf, selected, ghosts, ghostInk) {
    const { roster } = this.shown;
    const { sizes, colors, flags } = this;
    this.marked = 0;
    for (let k = 0; k < this.count; k++) {
      sizes[4 * k] = roster.sizes[2 * k];
      sizes[4 * k + 1] = roster.sizes[2 * k + 1];
      colors[4 * k + 2] = inkOf(roster, k);
      let bits = flags[k] | ((roster.levels[k] + 128) << 8);
      if (roster.targets[k] >= 0) {
        bits |= TRANSFER | ((roster.targets[k] % 7) << 16);
        this.marked += 1;
      }
      colors[4 * k + 3] = bits;
    }
    for (const k of ghosts ?? []) {
      if (!(colors[4 * k + 3] & TRANSFER)) colors[4 * k + 3] |= GHOST | (ghostInk << 16);
      this.marked += 1;
    }
    const row = selected === null ? -1 : roster.find(selected);
    if (row >= 0) {
      colors[4 * row + 3] = (colors[4 * row + 3] & 0xffff) | SELECTED | (7 << 16);
      this.marked += 1;
    }
    const gl = this.gl;
    [this.before, this.now, this.colors].forEach((array, k) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers[k]);
      gl.bufferSubData(gl.ARRAY_BUFFER, 0, array, 0, 4 * this.count);
    });
  }

  // Interpolates a row between the last two frames: x, y, heading, speed.
  placeOf(row, share) {
    const [a, b] = [this.before, this.now];
    const at = 4 * row;
    return [0, 1].map((c) => a[at + c] + (b[at + c] - a[at + c]) * share)
      .concat([b[at + 2], b[at + 3]]);
  }

  // Like `placeOf`, but with an interpolated heading and without speed.
  poseOf(row, share) {
    const [x, y] = this.placeOf(row, share);
    const [from, to] = [this.before[4 * row + 2], this.now[4 * row + 2]];
    const turn = ((to - from + 3 * Math.PI) % (2 * Math.PI)) - Math.PI;
    return [x, y, from + turn * share];
  }

  // Returns the row nearest to a position, within a distance in metres; -1 if there is none.
  nearest(x, y, within, share) {
    let best = within * within;
    let found = -1;
    for (let k = 0; k < this.count; k++) {
      const [px, py] = this.placeOf(k, share);
      const far = (px - x) ** 2 + (py - y) ** 2;
      if (far < best) [best, found] = [far, k];
    }
    return found;
  }

  draw(camera, share, bySpeed) {
    if (!this.count) return 0;
    const gl = this.gl;
    this.begin(this.bodies, camera, share);
    gl.uniform1i(this.bodies.at("u_bySpeed"), bySpeed ? 1 : 0);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.count);
    if (!this.marked) return 1;
    gl.disable(gl.DEPTH_TEST);
    this.begin(this.rings, camera, share);
    gl.uniform3fv(this.rings.at("u_inks"), this.inks);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.count);
    gl.enable(gl.DEPTH_TEST);
    return 2;
  }

  begin(program, camera, share) {
    program.use(camera);
    this.gl.uniform1f(program.at("u_share"), share);
    this.gl.uniform1f(program.at("u_scale"), camera.scale);
    this.gl.bindVertexArray(this.layout);
  }
}
