// A seat: throttle and steering from arrow keys, touch buttons or a gamepad.

const KEYS = {
  ArrowUp: ["throttle", 1], ArrowDown: ["throttle", -1],
  ArrowLeft: ["steering", 1], ArrowRight: ["steering", -1],
  w: ["throttle", 1], s: ["throttle", -1], a: ["steering", 1], d: ["steering", -1],
};
const EVERY_MS = 50;
const STEERING_PER_S = 1.6;
const BACK_PER_S = 3;
const DEAD = 0.12; // dead zone of a gamepad's sticks

export class Seat {
  constructor(ask) {
    this.ask = ask;
    this.agent = null;
    this.held = new Set();
    this.steering = 0;
    this.timer = null;
  }

  take(agent) {
    this.leave();
    this.agent = agent;
    this.ask({ kind: "seat", number: agent });
    this.timer = setInterval(() => this.tell(), EVERY_MS);
  }

  leave() {
    if (this.agent === null) return;
    this.agent = null;
    this.held.clear();
    this.steering = 0;
    clearInterval(this.timer);
    this.ask({ kind: "seat", number: null });
  }

  key(event, down) {
    if (this.agent === null || !(event.key in KEYS)) return false;
    if (down) this.held.add(event.key);
    else this.held.delete(event.key);
    return true;
  }

  // Returns throttle and steering; keys turn the wheel gradually.
  control(seconds) {
    const pressed = { throttle: 0, steering: 0 };
    for (const key of this.held) pressed[KEYS[key][0]] += KEYS[key][1];
    const pad = [...(navigator.getGamepads?.() ?? [])].find((one) => one?.connected);
    if (pad) {
      const stick = -(pad.axes[0] ?? 0);
      const pedals = (pad.buttons[7]?.value ?? 0) - (pad.buttons[6]?.value ?? 0);
      if (Math.abs(stick) > DEAD || Math.abs(pedals) > DEAD) {
        this.steering = Math.abs(stick) > DEAD ? stick ** 3 : 0;
        return { throttle: clamp(pedals), steering: clamp(this.steering) };
      }
    }
    const wanted = clamp(pressed.steering);
    const most = seconds * (wanted === 0 || wanted * this.steering < 0 ? BACK_PER_S : STEERING_PER_S);
    this.steering += Math.max(-most, Math.min(most, wanted - this.steering));
    return { throttle: clamp(pressed.throttle), steering: clamp(this.steering) };
  }

  tell() {
    this.ask({ kind: "drive", ...this.control(EVERY_MS / 1000) });
  }
}

const clamp = (value) => Math.max(-1, Math.min(1, value));
