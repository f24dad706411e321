// The time line: stored frames, or the span of a recording; and events.

const MOST_FRAMES = 1200;
const MOST_BYTES = 64e6;
const MOST_EVENTS = 500;
const EVERY_MS = 250; // between two updates of the marks
const INSET = 8; // px, half of the slider's thumb
const BAD = new Set(["collision", "off_road", "wrong_way", "red_light"]);

export class TimeLine {
  constructor() {
    this.frames = [];
    this.bytes = 0;
    this.events = [];
    this.span = null; // first and last tick of a recording
    this.markedAt = 0;
  }

  forget() {
    this.frames = [];
    this.bytes = 0;
  }

  add(frame) {
    if (this.span) return;
    const last = this.frames.at(-1);
    if (last && frame.tick < last.tick) this.forget();
    if (last && frame.tick === last.tick) return;
    this.frames.push(frame);
    this.bytes += frame.bytes;
    while (this.frames.length > MOST_FRAMES || this.bytes > MOST_BYTES) {
      this.bytes -= this.frames.shift().bytes;
    }
  }

  addEvents(events) {
    this.events.push(...events);
    this.events.splice(0, Math.max(0, this.events.length - MOST_EVENTS));
    this.markedAt = 0;
  }

  // Returns the first frame at or after a tick.
  placeOf(tick) {
    return this.frames.findIndex((frame) => frame.tick >= tick);
  }

  show(range, marks, shown, looksBack, timeText) {
    if (this.span) {
      [range.min, range.max] = this.span.map(String);
      if (shown && document.activeElement !== range) range.value = String(shown.tick);
    } else {
      range.min = "0";
      range.max = String(Math.max(this.frames.length - 1, 0));
      if (!looksBack) range.value = range.max;
    }
    if (shown) range.setAttribute("aria-valuetext", timeText(shown.tick));
    if (performance.now() - this.markedAt < EVERY_MS) return;
    this.markedAt = performance.now();
    this.draw(marks);
  }

  draw(canvas) {
    canvas.width = canvas.clientWidth;
    canvas.height = 8;
    const pen = canvas.getContext("2d");
    const [from, to] = this.span ?? [this.frames[0]?.tick ?? 0, this.frames.at(-1)?.tick ?? 0];
    if (to <= from) return;
    for (const [tick, kind] of this.events) {
      if (tick < from) continue;
      const bad = BAD.has(kind);
      pen.fillStyle = bad ? "#d63030" : kind === "arrived" ? "#2e9e5b" : "#8a94a0";
      const at = INSET + ((tick - from) / (to - from)) * (canvas.width - 2 * INSET);
      pen.fillRect(at - 1, bad ? 0 : 3, 2, 8);
    }
  }
}
