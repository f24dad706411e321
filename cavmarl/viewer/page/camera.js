// The view: a centre in metres and a scale; and the pointers that move it.

const NEAREST = 60; // pixels per metre
const CLICK_PX = 6;

export class Camera {
  constructor(canvas, extent) {
    this.canvas = canvas;
    this.extent = extent;
    this.x = 0;
    this.y = 0;
    this.scale = 1;
    this.covered = 0; // pixels at the right covered by panels
    this.home();
  }

  get width() { return Math.max(this.canvas.clientWidth, 1); }

  get height() { return Math.max(this.canvas.clientHeight, 1); }

  home() {
    const [minX, minY, maxX, maxY] = this.extent;
    const room = Math.max(this.width - this.covered - 40, 100);
    const least = Math.min(room / (maxX - minX || 1), (this.height - 40) / (maxY - minY || 1));
    this.scale = Math.min(least, NEAREST);
    this.x = (minX + maxX) / 2 + this.covered / 2 / this.scale;
    this.y = (minY + maxY) / 2;
  }

  view() {
    return [this.x, this.y, (2 * this.scale) / this.width, (2 * this.scale) / this.height];
  }

  toPixels(x, y) {
    return [
      (x - this.x) * this.scale + this.width / 2,
      this.height / 2 - (y - this.y) * this.scale,
    ];
  }

  toMetres(px, py) {
    return [
      (px - this.width / 2) / this.scale + this.x,
      (this.height / 2 - py) / this.scale + this.y,
    ];
  }

  zoom(factor, px = this.width / 2, py = this.height / 2) {
    const [x, y] = this.toMetres(px, py);
    const [minX, minY, maxX, maxY] = this.extent;
    const farthest = 100 / Math.max(maxX - minX, maxY - minY, 100);
    this.scale = Math.min(Math.max(this.scale * factor, farthest), NEAREST);
    const [nx, ny] = this.toMetres(px, py);
    this.x += x - nx;
    this.y += y - ny;
  }

  pan(dx, dy) {
    this.x -= dx / this.scale;
    this.y += dy / this.scale;
  }
}

// Handles drags, wheels and pinches; calls `on.click(px, py)` and `on.moved(byHand)`.
export function listenToPointers(canvas, camera, on) {
  const down = new Map();
  let travelled = 0;
  const at = (event) => {
    const box = canvas.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    down.set(event.pointerId, at(event));
    if (down.size === 1) travelled = 0;
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!down.has(event.pointerId)) return;
    const last = down.get(event.pointerId);
    const here = at(event);
    if (down.size === 1) {
      travelled += Math.hypot(here[0] - last[0], here[1] - last[1]);
      if (travelled > CLICK_PX) {
        camera.pan(here[0] - last[0], here[1] - last[1]);
        on.moved(true);
      }
    } else if (down.size === 2) {
      travelled = Infinity;
      const [other] = [...down].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
      const before = Math.hypot(last[0] - other[0], last[1] - other[1]);
      const after = Math.hypot(here[0] - other[0], here[1] - other[1]);
      camera.pan((here[0] - last[0]) / 2, (here[1] - last[1]) / 2);
      if (before > 1) camera.zoom(after / before, (here[0] + other[0]) / 2, (here[1] + other[1]) / 2);
      on.moved(true);
    }
    down.set(event.pointerId, here);
  });
  const up = (event) => {
    if (!down.delete(event.pointerId)) return;
    if (event.type === "pointerup" && travelled <= CLICK_PX) on.click(...at(event));
  };
  canvas.addEventListener("pointerup", up);
  canvas.addEventListener("pointercancel", up);
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    camera.zoom(Math.exp(-event.deltaY * (event.deltaMode ? 0.05 : 0.0015)), ...at(event));
    on.moved(false);
  }, { passive: false });
}
