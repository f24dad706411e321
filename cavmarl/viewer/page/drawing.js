// WebGL2 programs and buffers, and the layers of the map, with one draw call each.

import { CORNER_BYTES, PIECE_BYTES, STOP_LINE_BYTES } from "./protocol.js";

export const COMMON = `#version 300 es
precision highp float;
precision highp int;
`;

// Positions to clip space. Depth: higher levels cover lower ones, and later layers earlier ones.
export const VIEW = `
uniform vec4 u_view; // centre, m; clip units per metre
vec4 onScreen(vec2 place, float level, float layer) {
  return vec4((place - u_view.xy) * u_view.zw, -(level * 8.0 + layer) / 256.0, 1.0);
}
`;

const PIECES = `${COMMON}${VIEW}
layout(location = 0) in vec2 a_start;
layout(location = 1) in vec2 a_end;
layout(location = 2) in float a_half;
layout(location = 3) in uint a_style;
layout(location = 4) in int a_level;
layout(location = 5) in uint a_joined;
uniform float u_grown; // m on each side
uniform float u_least; // m, smallest half width
uniform float u_layer;
uniform vec3 u_colors[6];
uniform bool u_kerb;
flat out vec4 v_shape; // length, half width, joined, grown
flat out vec3 v_color;
out vec2 v_at;
void main() {
  vec2 corner = vec2(float(gl_VertexID & 1), float(gl_VertexID >> 1) * 2.0 - 1.0);
  vec2 along = a_end - a_start;
  float len = max(length(along), 1e-4);
  vec2 ahead = along / len;
  bool outline = a_style == 2u;
  float hidden = outline && !u_kerb ? 0.0 : 1.0;
  float half_m = max(a_half, outline ? 0.0 : u_least) + u_grown;
  float beyond = a_joined == 1u ? half_m : 0.0;
  v_at = vec2(mix(-0.05, len + beyond + 0.05, corner.x), corner.y * half_m);
  v_shape = vec4(len, half_m, float(a_joined), u_grown);
  v_color = u_kerb ? u_colors[2] : u_colors[a_style];
  vec2 place = a_start + ahead * v_at.x + vec2(-ahead.y, ahead.x) * v_at.y;
  gl_Position = onScreen(place, float(a_level), u_layer) * hidden;
}`;

const PIECES_INK = `${COMMON}
flat in vec4 v_shape;
flat in vec3 v_color;
in vec2 v_at;
out vec4 color;
void main() {
  if (v_at.x > v_shape.x + 0.05 && length(v_at - vec2(v_shape.x, 0.0)) > v_shape.y) discard;
  color = vec4(v_color, 1.0);
}`;

const CORNERS = `${COMMON}${VIEW}
layout(location = 0) in vec2 a_place;
layout(location = 1) in uint a_style;
layout(location = 2) in int a_level;
uniform float u_layer;
uniform vec3 u_colors[6];
flat out vec3 v_color;
void main() {
  v_color = u_colors[a_style];
  gl_Position = onScreen(a_place, float(a_level), u_layer);
}`;

const FLAT_INK = `${COMMON}
flat in vec3 v_color;
out vec4 color;
void main() { color = vec4(v_color, 1.0); }`;

const STOP_LINES = `${COMMON}${VIEW}
layout(location = 0) in vec2 a_near;
layout(location = 1) in vec2 a_far;
layout(location = 2) in vec2 a_back;
layout(location = 3) in int a_level;
layout(location = 4) in vec4 a_color;
uniform float u_least; // m, smallest depth
uniform float u_layer;
flat out vec3 v_color;
void main() {
  vec2 edge = (gl_VertexID & 1) == 0 ? a_near : a_far;
  float depth = length(a_back);
  vec2 back = a_back / depth * max(depth, u_least);
  v_color = a_color.rgb;
  gl_Position = onScreen(edge + back * float(gl_VertexID >> 1), float(a_level), u_layer);
}`;

const ZONES = `${COMMON}${VIEW}
layout(location = 0) in vec4 a_rect;
layout(location = 1) in vec4 a_color;
uniform float u_border; // m
flat out vec4 v_rect;
flat out vec3 v_color;
out vec2 v_at;
void main() {
  vec2 corner = vec2(float(gl_VertexID & 1), float(gl_VertexID >> 1));
  v_at = mix(a_rect.xy, a_rect.zw, corner);
  v_rect = a_rect;
  v_color = a_color.rgb;
  gl_Position = onScreen(v_at, 30.0, 7.5);
}`;

const ZONES_INK = `${COMMON}
flat in vec4 v_rect;
flat in vec3 v_color;
in vec2 v_at;
uniform float u_border;
out vec4 color;
void main() {
  vec2 inside = min(v_at - v_rect.xy, v_rect.zw - v_at);
  float alpha = min(inside.x, inside.y) < u_border ? 0.85 : 0.1;
  color = vec4(v_color * alpha, alpha);
}`;

export class Program {
  constructor(gl, vertex, fragment) {
    this.gl = gl;
    this.program = gl.createProgram();
    for (const [type, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(type);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(this.program, shader);
    }
    gl.linkProgram(this.program);
    if (!gl.getProgramParameter(this.program, gl.LINK_STATUS)) {
      const logs = gl.getAttachedShaders(this.program).map((one) => gl.getShaderInfoLog(one));
      throw new Error(`a shader cannot be used: ${logs.join(" ")}`);
    }
    this.places = new Map();
  }

  use(camera) {
    this.gl.useProgram(this.program);
    this.gl.uniform4fv(this.at("u_view"), camera.view());
  }

  at(name) {
    if (!this.places.has(name)) {
      this.places.set(name, this.gl.getUniformLocation(this.program, name));
    }
    return this.places.get(name);
  }
}

// Sets one attribute of the bound buffer; with `whole` it stays an integer.
export function attribute(gl, place, size, type, stride, offset, options = {}) {
  gl.enableVertexAttribArray(place);
  if (options.whole) gl.vertexAttribIPointer(place, size, type, stride, offset);
  else gl.vertexAttribPointer(place, size, type, options.share ?? false, stride, offset);
  gl.vertexAttribDivisor(place, options.each ?? 0);
}

export class MapLayers {
  constructor(gl, map) {
    this.gl = gl;
    this.map = map;
    this.programs = {
      pieces: new Program(gl, PIECES, PIECES_INK),
      corners: new Program(gl, CORNERS, FLAT_INK),
      stops: new Program(gl, STOP_LINES, FLAT_INK),
      zones: new Program(gl, ZONES, ZONES_INK),
    };
    this.roads = this.pieces(map.roads);
    this.lines = this.pieces(map.lines);
    this.surfaces = this.corners(map.surfaces);
    this.marks = this.corners(map.marks);
    this.buildings = this.corners(map.buildings);
    this.stops = this.stopLines(map.stopLines);
    this.zones = null;
    this.shownPhases = null;
    this.calls = 0;
  }

  array(bytes) {
    const gl = this.gl;
    const layout = gl.createVertexArray();
    gl.bindVertexArray(layout);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, bytes, gl.STATIC_DRAW);
    return layout;
  }

  pieces(section) {
    const gl = this.gl;
    const layout = this.array(section.bytes);
    const each = { each: 1 };
    const whole = { each: 1, whole: true };
    attribute(gl, 0, 2, gl.FLOAT, PIECE_BYTES, 0, each);
    attribute(gl, 1, 2, gl.FLOAT, PIECE_BYTES, 8, each);
    attribute(gl, 2, 1, gl.FLOAT, PIECE_BYTES, 16, each);
    attribute(gl, 3, 1, gl.UNSIGNED_BYTE, PIECE_BYTES, 20, whole);
    attribute(gl, 4, 1, gl.BYTE, PIECE_BYTES, 21, whole);
    attribute(gl, 5, 1, gl.UNSIGNED_BYTE, PIECE_BYTES, 22, whole);
    return { layout, count: section.count };
  }

  corners(section) {
    const gl = this.gl;
    const layout = this.array(section.bytes);
    attribute(gl, 0, 2, gl.FLOAT, CORNER_BYTES, 0);
    attribute(gl, 1, 1, gl.UNSIGNED_BYTE, CORNER_BYTES, 8, { whole: true });
    attribute(gl, 2, 1, gl.BYTE, CORNER_BYTES, 9, { whole: true });
    return { layout, count: section.count };
  }

  stopLines(section) {
    const gl = this.gl;
    const layout = this.array(section.bytes);
    for (let k = 0; k < 3; k++) attribute(gl, k, 2, gl.FLOAT, STOP_LINE_BYTES, 8 * k, { each: 1 });
    attribute(gl, 3, 1, gl.SHORT, STOP_LINE_BYTES, 30, { each: 1, whole: true });
    const colors = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, colors);
    gl.bufferData(gl.ARRAY_BUFFER, 4 * section.count, gl.DYNAMIC_DRAW);
    attribute(gl, 4, 4, gl.UNSIGNED_BYTE, 4, 0, { each: 1, share: true });
    return { layout, count: section.count, colors };
  }

  setZones(rects, colors) {
    const gl = this.gl;
    if (!rects.length) return;
    const layout = this.array(new Float32Array(rects.flat()));
    attribute(gl, 0, 4, gl.FLOAT, 16, 0, { each: 1 });
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    const inks = rects.flatMap((_, k) => [...colors[k % colors.length], 255]);
    gl.bufferData(gl.ARRAY_BUFFER, new Uint8Array(inks), gl.STATIC_DRAW);
    attribute(gl, 1, 4, gl.UNSIGNED_BYTE, 4, 0, { each: 1, share: true });
    this.zones = { layout, count: rects.length };
  }

  // Updates the signals, if their states have changed.
  setPhases(phases) {
    const before = this.shownPhases;
    if (before && before.length === phases.length && phases.every((p, k) => p === before[k])) return;
    this.shownPhases = phases.slice();
    const { bytes, count } = this.map.stopLines;
    const rows = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
    const inks = new Uint8Array(4 * count);
    for (let k = 0; k < count; k++) {
      const phase = phases[rows.getUint32(k * STOP_LINE_BYTES + 24, true)] ?? 0;
      const letter = rows.getUint16(k * STOP_LINE_BYTES + 28, true);
      const overridden = phases[this.map.signals + this.map.stopLinks[k]];
      const code = overridden
        ? overridden - 1 : this.map.phaseStates[this.map.phaseFirst[phase] + letter];
      inks.set(this.map.signal_colors[code] ?? [170, 176, 182], 4 * k);
    }
    this.gl.bindBuffer(this.gl.ARRAY_BUFFER, this.stops.colors);
    this.gl.bufferSubData(this.gl.ARRAY_BUFFER, 0, inks);
  }

  draw(camera, theme) {
    this.calls = 0;
    const gl = this.gl;
    const least = 0.8 / camera.scale;
    this.drawPieces(this.roads, camera, theme, Math.max(0.6, 1 / camera.scale), least, 0, true);
    this.drawPieces(this.roads, camera, theme, 0.02, least, 1, false);
    this.drawCorners(this.surfaces, camera, theme, 1);
    if (camera.scale > 0.9) {
      this.drawPieces(this.lines, camera, theme, 0, 0.3 / camera.scale, 2, false);
      this.drawCorners(this.marks, camera, theme, 2);
    }
    this.drawCorners(this.buildings, camera, theme, 0.5);
    if (this.stops.count) {
      const program = this.programs.stops;
      program.use(camera);
      gl.uniform1f(program.at("u_least"), 4 / camera.scale);
      gl.uniform1f(program.at("u_layer"), 3);
      this.instances(this.stops);
    }
  }

  drawZones(camera) {
    if (!this.zones) return;
    const program = this.programs.zones;
    program.use(camera);
    this.gl.uniform1f(program.at("u_border"), 1.5 / camera.scale);
    this.gl.disable(this.gl.DEPTH_TEST);
    this.instances(this.zones);
    this.gl.enable(this.gl.DEPTH_TEST);
  }

  drawPieces(batch, camera, theme, grown, least, layer, kerb) {
    if (!batch.count) return;
    const { gl } = this;
    const program = this.programs.pieces;
    program.use(camera);
    gl.uniform1f(program.at("u_grown"), grown);
    gl.uniform1f(program.at("u_least"), least);
    gl.uniform1f(program.at("u_layer"), layer);
    gl.uniform1i(program.at("u_kerb"), kerb ? 1 : 0);
    gl.uniform3fv(program.at("u_colors"), theme.surfaces);
    this.instances(batch);
  }

  drawCorners(batch, camera, theme, layer) {
    if (!batch.count) return;
    const { gl } = this;
    const program = this.programs.corners;
    program.use(camera);
    gl.uniform1f(program.at("u_layer"), layer);
    gl.uniform3fv(program.at("u_colors"), theme.surfaces);
    gl.bindVertexArray(batch.layout);
    gl.drawArrays(gl.TRIANGLES, 0, batch.count);
    this.calls += 1;
  }

  instances(batch) {
    this.gl.bindVertexArray(batch.layout);
    this.gl.drawArraysInstanced(this.gl.TRIANGLE_STRIP, 0, 4, batch.count);
    this.calls += 1;
  }
}
