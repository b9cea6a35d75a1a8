// The free camera: orbit, pan, zoom, fly, follow; by mouse, touch and keyboard.

import { add3, sub3, scale3, dot3, axesOf, clamp, quatAbout, quatMultiply, quatUnit, quatBlend, quatLooking } from "./math.js";

const TURN_A_SECOND = 1.2;
const FLIGHT_MS = 380;
const CLICK_PIXELS = 5;
// A click waits so long for a second one.
const DOUBLE_CLICK_MS = 280;
// Cosine to the upward direction that looking straight up or down keeps below.
const STEEPEST = 0.985;

const FLY_KEYS = {
  KeyW: [0, 0, 1], KeyS: [0, 0, -1], KeyA: [-1, 0, 0], KeyD: [1, 0, 0], KeyQ: [0, 1, 0], KeyE: [0, -1, 0],
};
const TURN_KEYS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };

// `hooks`: `changed()` after any movement, `taken()` when the user moves it, `clicked(x, y, touch)`, `doubled(x, y)`, `focalPixels()`.
export class Controls {
  constructor(canvas, hooks) {
    this.canvas = canvas;
    this.hooks = hooks;
    this.pose = { p: [0, 0, 0], q: [0, 0, 0, 1] };
    this.distance = 2;
    this.up = [0, -1, 0];
    this.radius = 2;
    this.flight = null;
    this.pressed = new Set();
    this.fast = false;
    this.pointers = new Map();
    this.listen();
  }

  get moving() {
    return this.flight !== null || this.pressed.size > 0;
  }

  // Stands at a pose at once.
  stand(pose, distance) {
    this.flight = null;
    this.pose = { p: [...pose.p], q: [...pose.q] };
    this.distance = distance || this.distance;
    this.hooks.changed();
  }

  // Moves to a pose in a moment, unless the user wants no motion.
  flyTo(pose, distance) {
    if (matchMedia("(prefers-reduced-motion: reduce)").matches) {
      this.stand(pose, distance);
      return;
    }
    this.flight = { from: this.pose, to: { p: [...pose.p], q: [...pose.q] }, began: performance.now() };
    this.distance = distance || this.distance;
    this.hooks.changed();
  }

  // One frame's movement; gives whether more is to come.
  advance(now, seconds) {
    if (this.flight) {
      const { from, to, began } = this.flight;
      const linear = clamp((now - began) / FLIGHT_MS, 0, 1);
      const share = linear * linear * (3 - 2 * linear);
      this.pose = linear === 1 ? to : { p: add3(from.p, scale3(sub3(to.p, from.p), share)), q: quatBlend(from.q, to.q, share) };
      this.flight = linear === 1 ? null : this.flight;
    }
    const axes = axesOf(this.pose.q);
    const speed = (this.fast ? 3 : 1) * 0.5 * this.radius * seconds;
    for (const code of this.pressed) {
      if (FLY_KEYS[code]) {
        const [x, y, z] = FLY_KEYS[code];
        const step = add3(scale3(axes.right, x), add3(scale3(axes.forward, z), scale3(this.up, -y)));
        this.pose = { p: add3(this.pose.p, scale3(step, speed)), q: this.pose.q };
      } else if (TURN_KEYS[code]) {
        const [x, y] = TURN_KEYS[code];
        this.turn(x * TURN_A_SECOND * seconds, y * TURN_A_SECOND * seconds, 0);
      }
    }
    return this.moving;
  }

  // Turns about a point so far ahead: 0 looks about, the distance orbits. Angles to the right and up.
  turn(yaw, pitch, distance) {
    const pivot = add3(this.pose.p, scale3(axesOf(this.pose.q).forward, distance));
    let q = quatUnit(quatMultiply(quatAbout(this.up, -yaw), this.pose.q));
    const axes = axesOf(q);
    const tilted = quatUnit(quatMultiply(quatAbout(axes.right, pitch), q));
    const steepness = dot3(axesOf(tilted).forward, this.up);
    if (Math.abs(steepness) < STEEPEST || Math.abs(steepness) < Math.abs(dot3(axes.forward, this.up))) {
      q = tilted;
    }
    // A camera that stood askew comes level little by little.
    q = quatBlend(q, quatLooking(axesOf(q).forward, this.up), 0.15);
    this.pose = { p: sub3(pivot, scale3(axesOf(q).forward, distance)), q };
  }

  orbit(dx, dy) {
    this.flight = null;
    const perPixel = 3.2 / Math.max(300, Math.min(this.canvas.clientWidth, this.canvas.clientHeight));
    this.turn(dx * perPixel * -1, dy * perPixel * -1, this.distance);
    this.moved();
  }

  pan(dx, dy) {
    this.flight = null;
    const axes = axesOf(this.pose.q);
    const perPixel = this.distance / this.hooks.focalPixels();
    this.pose = { p: add3(this.pose.p, add3(scale3(axes.right, -dx * perPixel), scale3(axes.down, -dy * perPixel))), q: this.pose.q };
    this.moved();
  }

  // Nearer by a factor below 1. Very near, the pivot is pushed ahead, so that one can go on.
  zoom(factor) {
    this.flight = null;
    const least = 0.02 * this.radius;
    const step = this.distance * (1 - factor);
    this.pose = { p: add3(this.pose.p, scale3(axesOf(this.pose.q).forward, step)), q: this.pose.q };
    this.distance = clamp(this.distance - step, least, 50 * this.radius);
    this.moved();
  }

  moved() {
    this.hooks.taken();
    this.hooks.changed();
  }

  // Takes a key that moves; gives whether it did.
  keyDown(event) {
    this.fast = event.shiftKey;
    if (FLY_KEYS[event.code] || TURN_KEYS[event.code]) {
      this.flight = null;
      this.pressed.add(event.code);
      this.moved();
      return true;
    }
    if (event.key === "+" || event.key === "=" || event.key === "-") {
      this.zoom(event.key === "-" ? 1.25 : 0.8);
      return true;
    }
    return false;
  }

  keyUp(event) {
    this.fast = event.shiftKey;
    this.pressed.delete(event.code);
  }

  listen() {
    const canvas = this.canvas;
    canvas.addEventListener("pointerdown", event => this.down(event));
    canvas.addEventListener("pointermove", event => this.move(event));
    canvas.addEventListener("pointerup", event => this.lift(event, true));
    canvas.addEventListener("pointercancel", event => this.lift(event, false));
    canvas.addEventListener("contextmenu", event => event.preventDefault());
    canvas.addEventListener("wheel", event => this.wheel(event), { passive: false });
    canvas.addEventListener("dblclick", event => {
      const box = canvas.getBoundingClientRect();
      clearTimeout(this.clickTimer);
      this.hooks.doubled(event.clientX - box.left, event.clientY - box.top);
    });
    addEventListener("blur", () => this.pressed.clear());
  }

  wheel(event) {
    // Within a report the page scrolls, until the picture has the focus.
    if (this.canvas.closest(".embedded") && document.activeElement !== this.canvas && !event.ctrlKey) {
      return;
    }
    event.preventDefault();
    const pixels = event.deltaMode === 1 ? event.deltaY * 30 : event.deltaMode === 2 ? event.deltaY * 300 : event.deltaY;
    this.zoom(Math.exp(clamp(pixels, -300, 300) * 0.0015));
  }

  down(event) {
    this.canvas.focus({ preventScroll: true });
    this.canvas.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, { x: event.clientX, y: event.clientY, button: event.button, travelled: 0 });
    this.multiple = this.pointers.size > 1;
  }

  move(event) {
    const pointer = this.pointers.get(event.pointerId);
    if (!pointer) {
      return;
    }
    const dx = event.clientX - pointer.x;
    const dy = event.clientY - pointer.y;
    pointer.travelled += Math.abs(dx) + Math.abs(dy);
    if (this.pointers.size === 2) {
      this.pinch(pointer, event, dx, dy);
    } else if (pointer.travelled > CLICK_PIXELS) {
      if (pointer.button === 2 || pointer.button === 1 || event.shiftKey) {
        this.pan(dx, dy);
      } else {
        this.orbit(dx, dy);
      }
    }
    pointer.x = event.clientX;
    pointer.y = event.clientY;
  }

  pinch(pointer, event, dx, dy) {
    const other = [...this.pointers.values()].find(p => p !== pointer);
    const before = Math.hypot(pointer.x - other.x, pointer.y - other.y);
    const after = Math.hypot(event.clientX - other.x, event.clientY - other.y);
    this.pan(dx / 2, dy / 2);
    if (before > 10 && after > 10) {
      this.zoom(clamp(before / after, 0.5, 2));
    }
  }

  lift(event, done) {
    const pointer = this.pointers.get(event.pointerId);
    this.pointers.delete(event.pointerId);
    if (done && pointer && pointer.button === 0 && pointer.travelled <= CLICK_PIXELS && !this.multiple) {
      const box = this.canvas.getBoundingClientRect();
      const [x, y, touch] = [event.clientX - box.left, event.clientY - box.top, event.pointerType === "touch"];
      clearTimeout(this.clickTimer);
      this.clickTimer = setTimeout(() => this.hooks.clicked(x, y, touch), DOUBLE_CLICK_MS);
    }
  }
}
