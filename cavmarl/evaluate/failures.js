"use strict";
// The list of failed trips, and a replay of the chosen one on a canvas.
const data = JSON.parse(document.getElementById("data").textContent);
const $ = (id) => document.getElementById(id);
const canvas = $("view"), pen = canvas.getContext("2d");
let chosen = null, at = 0, playing = true, last = 0, key = "cause", down = false;

const columns = {
  cause: (f) => data.causes.indexOf(f.cause), policy: (f) => f.policy, severity: (f) => -f.severity,
  episode: (f) => f.run * 1e6 + f.episode, agent: (f) => f.agent, speed_mps: (f) => -f.speed_mps,
  delay_s: (f) => -f.delay_s,
};

function listed() {
  const wanted = $("cause").value, by = columns[key];
  const rows = data.failures.filter((f) => !wanted || f.cause === wanted);
  rows.sort((a, b) => (by(a) < by(b) ? -1 : by(a) > by(b) ? 1 : 0) * (down ? -1 : 1));
  return rows;
}

function list() {
  const body = $("rows");
  body.replaceChildren();
  const rows = listed();
  for (const f of rows) {
    const line = body.insertRow();
    const cells = [f.cause.replaceAll("_", " "), f.policy, `${f.run} / ${f.episode}`, f.agent, f.speed_mps, f.delay_s];
    for (const text of cells) line.insertCell().textContent = text;
    line.tabIndex = 0;
    line.dataset.number = f.number;
    line.setAttribute("aria-selected", f === chosen);
    line.onclick = () => choose(f);
    line.onkeydown = (e) => { if (e.key === "Enter") choose(f); };
  }
  $("count").textContent = `${rows.length} of ${data.failures.length} trips`;
  return rows;
}

function choose(f) {
  chosen = f; at = 0; playing = true;
  $("sensors-note").textContent = f.clip.sensors_note && `Sensors: ${f.policy} ${f.clip.sensors_note}.`;
  $("sensors").disabled = Boolean(f.clip.sensors_note);
  $("seek").max = f.clip.frames.length - 1;
  $("told").textContent = `${f.cause.replaceAll("_", " ")}: agent ${f.agent} (vehicle ${f.vehicle}), ${f.policy}, ` +
    `run ${f.run}, episode ${f.episode}, seed ${f.seed}; it began at ${f.began_s} s and lasted ${f.duration_s} s`;
  for (const line of $("rows").rows) line.setAttribute("aria-selected", line.dataset.number == f.number);
  draw();
}

function color(name) { return getComputedStyle(document.body).getPropertyValue(name); }

function draw() {
  const scale = devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
  canvas.width = w * scale; canvas.height = h * scale;
  pen.setTransform(scale, 0, 0, scale, 0, 0);
  pen.fillStyle = color("--ground"); pen.fillRect(0, 0, w, h);
  if (!chosen) return;
  const zoom = Math.min(w, h) / (1.4 * data.reach_m), [cx, cy] = chosen.center_m;
  const px = (x) => w / 2 + (x - cx) * zoom, py = (y) => h / 2 - (y - cy) * zoom;
  pen.lineCap = "round"; pen.lineJoin = "round";
  pen.strokeStyle = color("--road"); pen.lineWidth = data.lane_width_m * zoom;
  for (const line of data.lines) {
    if (!line.some(([x, y]) => Math.abs(x - cx) < 4 * data.reach_m && Math.abs(y - cy) < 4 * data.reach_m)) continue;
    pen.beginPath();
    for (const [x, y] of line) pen.lineTo(px(x), py(y));
    pen.stroke();
  }
  const [tick, rows] = chosen.clip.frames[Math.floor(at)];
  for (const [id, x, y, heading, speed, lights] of rows) {
    const [length, width, agent] = chosen.clip.vehicles[id];
    pen.save();
    pen.translate(px(x), py(y)); pen.rotate(-heading);
    pen.fillStyle = id === chosen.vehicle ? color("--failed") : agent >= 0 ? color("--agent") : color("--other");
    pen.fillRect(-length * zoom / 2, -width * zoom / 2, length * zoom, width * zoom);
    pen.fillStyle = color("--glass");
    pen.fillRect(length * zoom * 0.12, -width * zoom * 0.38, length * zoom * 0.14, width * zoom * 0.76);
    pen.fillStyle = color("--brake");
    if (lights & 1) pen.fillRect(-length * zoom / 2, -width * zoom / 2, 2, width * zoom);
    pen.fillStyle = color("--blink");
    if (lights & 2) pen.fillRect(-length * zoom / 2, -width * zoom / 2 - 1, length * zoom, 2);
    if (lights & 4) pen.fillRect(-length * zoom / 2, width * zoom / 2 - 1, length * zoom, 2);
    pen.restore();
  }
  const sensed = chosen.clip.sensors[Math.floor(at)] ?? [];
  const mine = rows.find((row) => row[0] === chosen.vehicle);
  if (mine && $("sensors").checked) for (const shape of sensed) sense(shape, mine, px, py);
  $("now").textContent = `${((Math.floor(at) - chosen.clip.frames.length + 1) * chosen.step_s).toFixed(1)} s` +
    (mine ? `, ${mine[4]} m/s` : "");
  $("seek").value = Math.floor(at);
  canvas.dataset.tick = tick; canvas.dataset.shown = rows.length;
  canvas.dataset.sensed = sensed.map((shape) => shape.name).join(" ");
}

// Draws the rays of a sensor to the objects that they hit, or links to vehicles that were seen.
function sense(shape, [, x, y, heading], px, py) {
  const turn = shape.axes === "map" ? 0 : heading, cos = Math.cos(turn), sin = Math.sin(turn);
  const at = (ax, ay) => [px(x + ax * cos - ay * sin), py(y + ax * sin + ay * cos)];
  const ends = shape.ends ?? shape.points, from = shape.from ?? [0, 0];
  pen.strokeStyle = pen.fillStyle = color(shape.kind === "rays" ? "--ray" : "--link"); pen.lineWidth = 1;
  pen.beginPath();
  for (let k = 0; k < ends.length; k += 2) {
    pen.moveTo(...at(...from)); pen.lineTo(...at(ends[k], ends[k + 1]));
  }
  pen.stroke();
  for (let k = 0; k < ends.length; k += 2) {
    if (shape.hits && !shape.hits[k / 2]) continue;
    const [hx, hy] = at(ends[k], ends[k + 1]);
    pen.fillRect(hx - 2, hy - 2, 4, 4);
  }
}

function run(now) {
  if (chosen && playing) {
    at += Math.min(0.2, (now - last) / 1e3) * $("speed").value / chosen.step_s;
    if (at >= chosen.clip.frames.length) at = 0;
    draw();
  }
  last = now;
  requestAnimationFrame(run);
}

for (const cause of data.causes) {
  const number = data.failures.filter((f) => f.cause === cause).length;
  if (number) $("cause").add(new Option(`${cause.replaceAll("_", " ")} (${number})`, cause));
}
$("cause").onchange = () => { const rows = list(); if (rows.length) choose(rows[0]); };
for (const head of document.querySelectorAll("th button")) {
  head.onclick = () => { down = key === head.dataset.key && !down; key = head.dataset.key; list(); };
}
$("play").onclick = () => { playing = !playing; $("play").textContent = playing ? "Pause" : "Play"; };
$("seek").oninput = () => { playing = false; $("play").textContent = "Play"; at = +$("seek").value; draw(); };
$("sensors").onchange = draw;
onresize = draw;
const first = list();
if (first.length) choose(first[0]);
document.body.dataset.ready = "yes";
requestAnimationFrame(run);
