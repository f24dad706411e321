// A still picture on a 2D canvas, for browsers without WebGL2.

import { decodePlaces, PIECE_BYTES } from "./protocol.js";

const css = (inks, k) => `rgb(${[0, 1, 2].map((c) => Math.round(inks[3 * k + c] * 255)).join(" ")})`;

export function drawStill(canvas, camera, map, frame, theme, inkOf) {
  const density = devicePixelRatio || 1;
  canvas.width = camera.width * density;
  canvas.height = camera.height * density;
  const pen = canvas.getContext("2d");
  pen.scale(density, density);
  pen.fillStyle = css(theme.land, 0);
  pen.fillRect(0, 0, camera.width, camera.height);
  pen.lineCap = "round";
  const view = new DataView(map.roads.bytes.buffer, map.roads.bytes.byteOffset);
  for (let k = 0; k < map.roads.count; k++) {
    const at = k * PIECE_BYTES;
    const [ax, ay, bx, by, half] = [0, 4, 8, 12, 16].map((c) => view.getFloat32(at + c, true));
    pen.strokeStyle = css(theme.surfaces, view.getUint8(at + 20));
    pen.lineWidth = Math.max(2 * half * camera.scale, 1);
    pen.beginPath();
    pen.moveTo(...camera.toPixels(ax, ay));
    pen.lineTo(...camera.toPixels(bx, by));
    pen.stroke();
  }
  if (!frame) return;
  const places = new Float32Array(4 * frame.count);
  decodePlaces(frame, places, new Uint8Array(frame.count));
  for (let k = 0; k < frame.count; k++) {
    const [x, y] = camera.toPixels(places[4 * k], places[4 * k + 1]);
    const ink = inkOf(frame.roster, k);
    const length = Math.max(frame.roster.sizes[2 * k] * camera.scale, 5);
    const width = Math.max(frame.roster.sizes[2 * k + 1] * camera.scale, 3);
    pen.save();
    pen.translate(x, y);
    pen.rotate(-places[4 * k + 2]);
    pen.fillStyle = `rgb(${ink & 255} ${(ink >> 8) & 255} ${(ink >> 16) & 255})`;
    pen.fillRect(-length / 2, -width / 2, length, width);
    pen.restore();
  }
}
