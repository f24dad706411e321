// The 2D overlay above the vehicles: names of agents, and sensor data of a vehicle.

const LABEL_SCALE = 1.6; // pixels per metre from which agents have labels
const MOST_LABELS = 80;
const WAY = "rgb(255 80 200 / 85%)";
const RAY = "rgb(20 140 255 / 35%)";
const HIT = "rgb(235 60 30)";
const POINT = "rgb(20 140 255)";

export function drawLabels(pen, page, part, theme) {
  const { camera, frame, hello, vehicles } = page;
  pen.font = "600 12px system-ui, sans-serif";
  pen.textAlign = "center";
  pen.lineWidth = 3;
  pen.strokeStyle = theme.halo;
  const label = (text, x, y) => {
    pen.strokeText(text, x, y);
    pen.fillStyle = theme.ink;
    pen.fillText(text, x, y);
  };
  if (page.coloring === "zone") {
    hello.zones.forEach(([ax, ay, bx, by], k) => {
      label(`zone ${k}`, ...camera.toPixels((ax + bx) / 2, (ay + by) / 2));
    });
  }
  if (camera.scale < LABEL_SCALE || !hello.agents.length) return;
  let room = MOST_LABELS;
  for (let k = 0; k < frame.count && room; k++) {
    if (frame.roster.agents[k] < 0) continue;
    const [px, py] = vehicles.placeOf(k, part);
    const [x, y] = camera.toPixels(px, py);
    if (x < 0 || y < 0 || x > camera.width || y > camera.height) continue;
    room -= 1;
    const away = Math.max(14, frame.roster.sizes[2 * k + 1] * camera.scale * 0.5 + 8);
    label(hello.agents[frame.roster.agents[k]] ?? `car_${frame.roster.agents[k]}`, x, y - away);
  }
}

// `pose`: x, y, heading of the vehicle; `sensors`: whether to draw more than its path.
export function drawSensed(pen, camera, shapes, pose, sensors) {
  pen.save();
  drawWay(pen, camera, shapes.way, pose);
  if (sensors) {
    for (const shape of shapes.all) {
      const at = placer(camera, pose, shape.axes === "map");
      if (shape.kind === "grid") drawGrid(pen, shape, at);
      else if (shape.kind === "rays") drawRays(pen, shape, at);
      else if (shape.kind === "points") drawPoints(pen, shape.points, at, POINT);
      else if (shape.kind === "links") drawLinks(pen, shape.points, at);
      else if (shape.kind === "picture") drawCone(pen, shape.cone, at);
    }
  }
  pen.restore();
}

// Converts positions in the vehicle's frame, or with `onMap` in the map's axes, to pixels.
function placer(camera, [x, y, heading], onMap) {
  const [cos, sin] = onMap ? [1, 0] : [Math.cos(heading), Math.sin(heading)];
  return (px, py) => camera.toPixels(x + px * cos - py * sin, y + px * sin + py * cos);
}

function drawWay(pen, camera, way, [x, y]) {
  if (way.length < 4) return;
  pen.strokeStyle = WAY;
  pen.lineWidth = 3;
  pen.setLineDash([10, 6]);
  pen.beginPath();
  pen.moveTo(...camera.toPixels(x, y));
  for (let k = 2; k < way.length; k += 2) pen.lineTo(...camera.toPixels(way[k], way[k + 1]));
  pen.stroke();
  pen.setLineDash([]);
}

function drawRays(pen, { from, ends, hits }, at) {
  const start = at(...from);
  pen.strokeStyle = RAY;
  pen.lineWidth = 1;
  pen.beginPath();
  for (let k = 0; k < ends.length; k += 2) {
    pen.moveTo(...start);
    pen.lineTo(...at(ends[k], ends[k + 1]));
  }
  pen.stroke();
  const met = ends.filter((_, k) => hits[k >> 1]);
  drawPoints(pen, met, at, HIT);
}

function drawPoints(pen, points, at, ink) {
  pen.fillStyle = ink;
  for (let k = 0; k < points.length; k += 2) {
    const [x, y] = at(points[k], points[k + 1]);
    pen.fillRect(x - 2, y - 2, 4, 4);
  }
}

function drawLinks(pen, points, at) {
  pen.strokeStyle = POINT;
  pen.lineWidth = 1.5;
  pen.setLineDash([3, 4]);
  const start = at(0, 0);
  for (let k = 0; k < points.length; k += 2) {
    const end = at(points[k], points[k + 1]);
    pen.beginPath();
    pen.moveTo(...start);
    pen.lineTo(...end);
    pen.stroke();
    pen.beginPath();
    pen.arc(...end, 6, 0, 2 * Math.PI);
    pen.stroke();
  }
  pen.setLineDash([]);
}

function drawCone(pen, [x, y, yaw, opening, range], at) {
  pen.fillStyle = "rgb(255 200 60 / 14%)";
  pen.beginPath();
  pen.moveTo(...at(x, y));
  for (let k = 0; k <= 12; k++) {
    const turn = yaw + opening * (k / 12 - 0.5);
    pen.lineTo(...at(x + range * Math.cos(turn), y + range * Math.sin(turn)));
  }
  pen.fill();
}

// Draws a picture on the ground: `corners` of its top left, top right and bottom left.
function drawGrid(pen, { image, width, height, corners }, at) {
  const [a, b, c] = [0, 2, 4].map((k) => at(corners[k], corners[k + 1]));
  pen.save();
  pen.imageSmoothingEnabled = false;
  pen.transform((b[0] - a[0]) / width, (b[1] - a[1]) / width,
    (c[0] - a[0]) / height, (c[1] - a[1]) / height, a[0], a[1]);
  pen.drawImage(image, 0, 0);
  pen.restore();
}
