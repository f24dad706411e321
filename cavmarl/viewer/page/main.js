// The page: receives messages, stores frames, draws, and sends requests.

import { Camera, listenToPointers } from "./camera.js";
import { inks, legend, SELECTION, THEMES } from "./colors.js";
import { MapLayers } from "./drawing.js";
import { Seat } from "./driving.js";
import { drawLabels, drawSensed } from "./overlay.js";
import { $, addEvents, element, notice, showLegend, showLoads, showScale, showVehicle } from "./panels.js";
import { Placing } from "./placing.js";
import { showPictures, Shapes } from "./sensed_shapes.js";
import { decodeFrame, decodeMap, FRAME, kindOf, MAP, Roster, ROSTER } from "./protocol.js";
import { drawStill } from "./still.js";
import { TimeLine } from "./timeline.js";
import { VehicleLayer } from "./vehicles.js";
import { small, toggleAll } from "./worlds.js";

const COUNTED = 240;
const SMOOTH_S = 1.5; // simulated time between frames above which vehicles jump

const page = {
  hello: null, map: null, camera: null, gl: undefined, layers: null, vehicles: null,
  roster: new Roster(0, 0), frame: null, live: null, line: new TimeLine(), world: 0,
  token: "", looksBack: false, chosen: null, wanted: null, following: false, told: null, shapes: null,
  coloring: "agent", theme: "light", ghosts: null,
  arrived: 0, between: 100, dirty: true, socket: null, over: false,
  times: [], takes: [], firstPicture: 0, calls: 0, stillDrawn: 0,
};
window.viewer = page; // for tests and measurements

const ask = (request) => {
  if (page.socket?.readyState === WebSocket.OPEN) page.socket.send(JSON.stringify(request));
};
const seat = new Seat(ask);
const placing = new Placing(ask);
const dirty = () => { page.dirty = true; };

// ---- messages

function connect(token) {
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  const socket = new WebSocket(`${scheme}://${location.host}/live`);
  socket.binaryType = "arraybuffer";
  page.socket = socket;
  page.token = token;
  const hello = { kind: "hello", token, world: page.world };
  socket.addEventListener("open", () => socket.send(JSON.stringify(hello)));
  socket.addEventListener("message", ({ data }) => {
    if (socket !== page.socket) return;
    if (typeof data === "string") take(JSON.parse(data));
    else takeBytes(data);
  });
  socket.addEventListener("close", ({ code, reason }) => {
    if (socket === page.socket) closed(code, reason, token);
  });
}

function closed(code, reason, token) {
  $("status").textContent = "not connected";
  seat.leave();
  if (code === 4401) {
    if (token) notice(reason);
    $("token-box").showModal();
    return;
  }
  if (code === 1013 || code === 1003) {
    notice(reason);
    return;
  }
  notice("The world has ended or cannot be reached; trying again.");
  setTimeout(() => connect(token), 2000);
}

// Switches to another world of the same server.
function goTo(world) {
  watch(null);
  page.world = world;
  page.line = new TimeLine();
  page.looksBack = false;
  page.live = page.frame = null;
  $("events").replaceChildren();
  const before = page.socket;
  connect(page.token);
  before.close();
}

function take(told) {
  if (told.kind === "hello") takeHello(told);
  else if (told.kind === "vehicle") takeVehicle(told);
  else if (told.kind === "events") takeEvents(told.events);
  else if (told.kind === "seat") takeSeat(told);
  else if (told.kind === "loads") showLoads(told.rows);
  else if (told.kind === "notice") briefly(told.text);
}

const may = (what) => page.hello.control && page.hello.may.includes(what);

function takeHello(hello) {
  page.hello = hello;
  placing.show(may);
  $("all").hidden = hello.worlds.length < 2 || small;
  notice("");
  $("title").textContent = small ? hello.worlds[hello.world] : hello.title;
  document.title = `${hello.title} – cavmarl`;
  for (const id of ["play", "step", "pace"]) $(id).disabled = !may(id === "play" ? "pause" : id);
  $("reset").hidden = !hello.may.includes("reset");
  $("reset").disabled = !may("reset");
  $("live").hidden = Boolean(hello.span);
  $("past").disabled = Boolean(hello.span) && !may("seek");
  page.line.span = hello.span ?? null;
  $("world-label").hidden = hello.worlds.length < 2;
  $("world").replaceChildren(...hello.worlds.map((name, k) => element("option", name, { value: k })));
  $("world").value = String(hello.world);
  $("ghosts-label").hidden = !hello.zones.length;
  $("ghosts").replaceChildren(element("option", "no zone", { value: "" }),
    ...hello.zones.map((_, k) => element("option", `zone ${k}`, { value: k })));
  if (hello.zones.length && !page.map) setColoring("zone");
}

function takeBytes(buffer) {
  const kind = kindOf(buffer);
  if (kind === MAP) takeMap(decodeMap(buffer));
  else if (kind === ROSTER) page.roster = page.roster.after(buffer);
  else if (kind === FRAME) {
    const begun = performance.now();
    takeFrame(decodeFrame(buffer, page.roster));
    page.takes.push(performance.now() - begun);
    if (page.takes.length > COUNTED) page.takes.shift();
  }
}

function takeMap(map) {
  const again = page.map !== null;
  page.map = map;
  page.roster = new Roster(0, 0);
  page.line.forget();
  if (!again) page.camera = new Camera($("scene"), map.extent);
  resize();
  if (!again) page.camera.home();
  if (page.gl) {
    page.layers = new MapLayers(page.gl, map);
    page.layers.setZones(page.hello.zones, map.zone_colors);
    page.vehicles = new VehicleLayer(page.gl, [...map.zone_colors, SELECTION]);
  }
  if (again) return;
  listenToPointers($("scene"), page.camera, {
    click(px, py) {
      if (placing.kind) placing.at(...page.camera.toMetres(px, py));
      else choose(px, py);
    },
    moved(byHand) {
      if (byHand) follow(false);
      dirty();
    },
  });
}

function takeFrame(frame) {
  const now = performance.now();
  if (page.arrived) {
    page.between = Math.min(Math.max(0.8 * page.between + 0.2 * (now - page.arrived), 30), 400);
  }
  page.arrived = now;
  const last = page.live;
  page.live = frame;
  page.line.add(frame);
  showClockControls(frame);
  if (page.looksBack) {
    showTimeLine();
    return;
  }
  const passed = last ? frame.time - last.time : -1;
  show(frame, passed >= 0 && passed < SMOOTH_S * Math.max(frame.pace, 1));
}

function takeVehicle(told) {
  if (told.id !== page.wanted) return;
  page.told = told;
  const row = page.roster.find(told.id);
  const agent = row >= 0 ? page.roster.agents[row] : -1;
  const name = agent >= 0 ? `${page.hello.agents[agent]} · vehicle ${told.id}` : `vehicle ${told.id}`;
  showVehicle(told, name);
  page.shapes = new Shapes(told);
  showPictures(page.shapes.pictures);
  $("sensors-label").hidden = !told.observation && !told.shapes;
  $("seat").hidden = !may("seat") || (agent < 0 && seat.agent === null);
  dirty();
}

function takeSeat(told) {
  if (told.agent === null && told.reason) {
    seat.leave();
    notice(told.reason);
  }
  showSeat();
}

function takeEvents(events) {
  page.line.addEvents(events);
  addEvents(events, timeText, (tick, vehicle) => {
    lookBack(tick);
    if (vehicle >= 0) watch(vehicle);
  });
  showTimeLine();
}

// ---- display

const secondsOf = (tick) => {
  const frame = page.live;
  if (page.hello?.tick_s) return tick * page.hello.tick_s;
  return frame && frame.tick ? (tick * frame.time) / frame.tick : tick * (page.hello?.step_s ?? 0.1);
};
const timeText = (tick) => `${secondsOf(tick).toFixed(1)} s`;

function show(frame, smooth) {
  page.frame = frame;
  $("clock").textContent = `${frame.time.toFixed(1)} s · ${frame.count} vehicles`;
  if (page.vehicles) {
    page.vehicles.take(frame, smooth);
    page.layers.setPhases(frame.signals);
    paint();
  }
  showTimeLine();
  if (page.coloring === "type" || !$("legend").children.length) showColors();
  dirty();
}

function paint() {
  if (!page.frame || !page.vehicles) return;
  const ghosts = page.ghosts === null ? null : page.frame.ghosts.get(page.ghosts);
  page.inkOf ??= inks(page.coloring, page.map.zone_colors);
  page.vehicles.paint(page.inkOf, page.chosen, ghosts, (page.ghosts ?? 0) % 7);
  dirty();
}

function showColors() {
  if (page.hello && page.map) {
    showLegend(legend(page.coloring, page.hello, page.map, page.roster));
  }
}

function setColoring(coloring) {
  page.coloring = coloring;
  page.inkOf = null;
  $("coloring").value = coloring;
  showColors();
  paint();
}

function showClockControls(frame) {
  if (page.wasPaused === frame.paused && page.wasPace === frame.pace) return;
  [page.wasPaused, page.wasPace] = [frame.paused, frame.pace];
  $("play").textContent = frame.paused ? "Play" : "Pause";
  const going = page.line.span ? "playing" : "live";
  $("status").textContent = frame.paused ? "paused" : going;
  $("pace").value = String(frame.pace);
}

function showTimeLine() {
  page.line.show($("past"), $("marks"), page.frame, page.looksBack, timeText);
}

function lookBack(tick) {
  if (page.line.span) ask({ kind: "seek", number: tick });
  else lookAt(page.line.placeOf(tick));
}

// Handles the time line: seeks a tick of a recording, or shows a stored frame.
function lookAt(at) {
  if (page.line.span) {
    ask({ kind: "seek", number: at });
    return;
  }
  const frame = page.line.frames[at];
  if (!frame) return;
  page.looksBack = at < page.line.frames.length - 1;
  $("live").disabled = !page.looksBack;
  $("past").value = String(at);
  $("status").textContent = page.looksBack ? `looking back to ${timeText(frame.tick)}` : "live";
  if (!page.looksBack) page.wasPaused = undefined;
  show(frame, false);
}

function watch(vehicle) {
  page.wanted = page.chosen = vehicle;
  page.shapes = null;
  askToWatch();
  if (vehicle === null) {
    $("vehicle").hidden = true;
    follow(false);
    seat.leave();
    showSeat();
  } else {
    takeVehicle({ id: vehicle, here: true, rows: [] });
  }
  paint();
}

const askToWatch = () =>
  ask({ kind: "watch", number: page.wanted, sensors: $("sensors").checked });

function follow(on) {
  page.following = on && page.chosen !== null;
  $("follow").setAttribute("aria-pressed", String(page.following));
  if (page.following && page.camera.scale < 4) page.camera.scale = 6;
  dirty();
}

function choose(px, py) {
  if (!page.vehicles || !page.frame) return;
  const [x, y] = page.camera.toMetres(px, py);
  const row = page.vehicles.nearest(x, y, Math.max(4, 14 / page.camera.scale), share());
  watch(row < 0 ? null : page.frame.roster.ids[row]);
}

function briefly(text) {
  notice(text);
  setTimeout(() => notice(""), 5000);
}

function showSeat() {
  const driving = seat.agent !== null;
  $("seat").setAttribute("aria-pressed", String(driving));
  $("seat").textContent = driving ? "Leave the seat" : "Drive";
  $("hint").hidden = !driving;
  $("hint").textContent = page.hello?.action !== "discrete"
    ? "Arrow keys or a gamepad: throttle, brake and steering. Escape leaves the seat."
    : "Arrow keys: faster, slower, lane to the left or right. Escape leaves the seat.";
}

// ---- drawing

const share = () => {
  if (page.looksBack) return 1;
  return Math.min((performance.now() - page.arrived) / page.between, 1);
};

function resize() {
  const scene = $("scene");
  const density = devicePixelRatio || 1;
  for (const canvas of page.gl === null ? [$("labels")] : [scene, $("labels")]) {
    const width = Math.max(1, Math.round(canvas.clientWidth * density));
    const height = Math.max(1, Math.round(canvas.clientHeight * density));
    if (canvas.width !== width) canvas.width = width; // setting it reallocates the canvas
    if (canvas.height !== height) canvas.height = height;
  }
  if (page.camera) page.camera.covered = innerWidth > 700 && !small ? 310 : 0;
  dirty();
}

function draw() {
  requestAnimationFrame(draw);
  if (!page.map || !page.camera) return;
  if (!page.gl) {
    stillPicture();
    return;
  }
  const part = share();
  if (!page.dirty && (part >= 1 && page.settled)) return;
  const begun = performance.now();
  page.settled = part >= 1;
  page.dirty = false;
  followChosen(part);
  const { gl, camera } = page;
  const theme = THEMES[page.theme];
  gl.viewport(0, 0, $("scene").width, $("scene").height);
  gl.clearColor(...theme.land, 1);
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  page.layers.draw(camera, theme);
  if (page.coloring === "zone") page.layers.drawZones(camera);
  const calls = page.frame ? page.vehicles.draw(camera, part, page.coloring === "speed") : 0;
  page.calls = page.layers.calls + calls;
  drawOver(part, theme);
  showScale(camera.scale);
  page.times.push(performance.now() - begun);
  if (page.times.length > COUNTED) page.times.shift();
  page.firstPicture ||= page.frame ? performance.now() : 0;
}

function drawOver(part, theme) {
  const pen = $("labels").getContext("2d");
  const density = devicePixelRatio || 1;
  pen.setTransform(density, 0, 0, density, 0, 0);
  pen.clearRect(0, 0, page.camera.width, page.camera.height);
  if (!page.frame) return;
  const row = page.chosen === null ? -1 : page.frame.roster.find(page.chosen);
  if (row >= 0 && page.shapes && !page.looksBack) {
    drawSensed(pen, page.camera, page.shapes, page.vehicles.poseOf(row, part), $("sensors").checked);
  }
  drawLabels(pen, page, part, theme);
}

function followChosen(part) {
  if (!page.following || !page.frame) return;
  const row = page.frame.roster.find(page.chosen);
  if (row < 0) {
    seatFollows();
    return;
  }
  const [x, y] = page.vehicles.placeOf(row, part);
  page.camera.x = x + page.camera.covered / 2 / page.camera.scale;
  page.camera.y = y;
}

// An agent with a seat gets another vehicle after its trip.
function seatFollows() {
  if (seat.agent === null) return;
  const row = page.frame.roster.agents.indexOf(seat.agent);
  if (row >= 0) watch(page.frame.roster.ids[row]);
}

function stillPicture() {
  const now = performance.now();
  if (now - page.stillDrawn < 1000 || !page.frame) return;
  page.stillDrawn = now;
  page.inkOf ??= inks(page.coloring, page.map.zone_colors);
  drawStill($("scene"), page.camera, page.map, page.frame, THEMES[page.theme], page.inkOf);
}

// ---- controls

function setTheme(theme) {
  page.theme = theme;
  document.documentElement.dataset.theme = theme;
  $("theme").setAttribute("aria-pressed", String(theme === "dark"));
  dirty();
}

function find(text) {
  const wanted = text.trim();
  const agent = page.hello.agents.indexOf(wanted);
  const row = agent >= 0 ? page.roster.agents.indexOf(agent) : page.roster.find(Number(wanted));
  if (!wanted || row < 0) {
    briefly(`There is no vehicle ${wanted} now.`);
    return;
  }
  watch(page.roster.ids[row]);
  follow(true);
}

function toggleSeat() {
  if (seat.agent !== null) {
    seat.leave();
  } else {
    const row = page.roster.find(page.chosen);
    if (row >= 0 && page.roster.agents[row] >= 0) {
      seat.take(page.roster.agents[row]);
      follow(true);
      $("scene").focus();
    }
  }
  showSeat();
}

function toggleClock() {
  ask({ kind: page.live?.paused ? "play" : "pause" });
}

const PAN = { ArrowUp: [0, 60], ArrowDown: [0, -60], ArrowLeft: [60, 0], ArrowRight: [-60, 0] };
const ACTIONS = {
  " ": toggleClock,
  ".": () => ask({ kind: "step" }),
  "+": () => page.camera.zoom(1.25),
  "=": () => page.camera.zoom(1.25),
  "-": () => page.camera.zoom(0.8),
  Home: () => { follow(false); page.camera.home(); },
  f: () => follow(!page.following),
  "/": () => $("wanted").focus(),
  Enter: () => {
    if (placing.kind) placing.at(page.camera.x - page.camera.covered / 2 / page.camera.scale, page.camera.y);
  },
  Escape: () => { if (placing.kind) placing.set(null); else if (seat.agent !== null) toggleSeat(); else watch(null); },
};

function onKey(event) {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const typing = event.target.matches("input, select, dialog *");
  const pressing = event.target.matches("button, summary") && (event.key === " " || event.key === "Enter");
  if (typing || pressing || !page.camera) return;
  if (seat.key(event, true)) {
    event.preventDefault();
    return;
  }
  if (event.key in PAN) {
    follow(false);
    page.camera.pan(...PAN[event.key]);
  } else if (event.key in ACTIONS) {
    ACTIONS[event.key]();
  } else {
    return;
  }
  event.preventDefault();
  dirty();
}

function wire() {
  const on = (id, event, act) => $(id).addEventListener(event, act);
  on("play", "click", toggleClock);
  on("step", "click", () => ask({ kind: "step" }));
  on("reset", "click", () => ask({ kind: "reset" }));
  on("pace", "change", () => ask({ kind: "pace", number: Number($("pace").value) }));
  on("past", "input", () => lookAt(Number($("past").value)));
  placing.wire();
  on("all", "click", () => toggleAll(page.hello.worlds));
  on("live", "click", () => lookAt(page.line.frames.length - 1));
  on("sensors", "change", askToWatch);
  on("world", "change", () => goTo(Number($("world").value)));
  on("nearer", "click", () => { page.camera?.zoom(1.4); dirty(); });
  on("farther", "click", () => { page.camera?.zoom(1 / 1.4); dirty(); });
  on("home", "click", () => { follow(false); page.camera?.home(); dirty(); });
  on("theme", "click", () => setTheme(page.theme === "dark" ? "light" : "dark"));
  on("follow", "click", () => follow(!page.following));
  on("seat", "click", toggleSeat);
  on("release", "click", () => watch(null));
  on("coloring", "change", () => setColoring($("coloring").value));
  on("search", "submit", (event) => { event.preventDefault(); find($("wanted").value); });
  on("ghosts", "change", () => {
    page.ghosts = $("ghosts").value === "" ? null : Number($("ghosts").value);
    ask({ kind: "ghosts", number: page.ghosts });
    paint();
  });
  on("token-box", "close", () => connect($("token").value));
  addEventListener("keydown", onKey);
  addEventListener("keyup", (event) => seat.key(event, false));
  addEventListener("blur", () => seat.held.clear());
  addEventListener("resize", resize);
  setInterval(() => {
    const frame = page.frame;
    if (!frame) return;
    const text = `The map of ${page.hello.title} with ${frame.count} vehicles`;
    $("scene").setAttribute("aria-label", text);
  }, 5000);
}

// Connect first: the world loads while the page sets up.
function begin() {
  const named = /^#world=(\d+)$/.exec(location.hash);
  if (named) page.world = Number(named[1]);
  document.documentElement.classList.toggle("small", small);
  connect(small ? parent.viewer.token : "");
  resize();
  page.gl = $("scene").getContext("webgl2", { antialias: true, alpha: false });
  if (page.gl) {
    page.gl.enable(page.gl.DEPTH_TEST);
    page.gl.depthFunc(page.gl.LEQUAL);
    page.gl.enable(page.gl.BLEND);
    page.gl.blendFunc(page.gl.ONE, page.gl.ONE_MINUS_SRC_ALPHA);
    $("scene").addEventListener("webglcontextlost", () => location.reload());
  } else {
    notice("This browser has no WebGL2: a still picture is shown, updated every second.", true);
  }
  setTheme(matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
  wire();
  requestAnimationFrame(draw);
}

begin();
