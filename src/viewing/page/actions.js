// What the user can have done: move and colour the view, open keyframes, ask for exact pictures, control the run.

import { fittedCamera, clamp } from "./math.js";
import { askDialog } from "./help.js";

const LARGEST_EXACT = 1920;
const PICK_PIXELS = 8;
const PICK_PIXELS_TOUCH = 18;
const COUNT_AGAIN_MS = 2500;

const EFFECTS = new Map([["KeyF", "follow"], ["KeyC", "nextColoring"], ["KeyX", "askExact"], ["KeyP", "togglePanel"], ["KeyN", "stepOnce"], ["KeyM", "markCentre"]]);

// The viewer's half that acts for the user; the other half takes messages.
export class Actions {
  fit(atOnce) {
    const { canvas } = this.overlay;
    const { p, q, distance } = this.scene.overview(this.store, canvas.clientWidth || 1, canvas.clientHeight || 1);
    if (atOnce) {
      this.controls.stand({ p, q }, distance);
    } else {
      this.setFollowing(false);
      this.controls.flyTo({ p, q }, distance);
    }
  }

  cameraChanged() {
    this.exact?.hide();
    this.stage?.invalidate();
  }

  // The user moves the camera: nothing else does from now on.
  cameraTaken() {
    this.untouched = false;
    this.setFollowing(false);
  }

  setFollowing(on) {
    this.following = on;
    this.overlay.setFollowing(on);
  }

  follow() {
    this.setFollowing(!this.following);
    if (this.following && this.scene.current) {
      const { p, q, distance } = this.scene.behindCurrent(this.store);
      this.controls.flyTo({ p, q }, distance);
    } else if (this.following) {
      this.overlay.note("The view follows the camera as soon as its pose is known.");
    }
  }

  setLayer(name, on) {
    this.stage.layers[name] = on;
    this.stage.invalidate();
  }

  setBackground(name) {
    this.stage.background = name;
    this.stage.invalidate();
  }

  setPictures(open) {
    if (!this.current) {
      return;
    }
    this.current.open = open;
    if (this.scene.hello?.live) {
      this.send({ type: "images", current: open });
    }
    this.current.changed();
  }

  async setColoring(name) {
    this.overlay.setColoring(name);
    if (name === "error") {
      this.stage.coloring = "color";
      const ids = this.scene.ids();
      if (ids.length === 0) {
        this.overlay.note("There is no keyframe to compare with yet.");
        this.setColoring("color");
        return;
      }
      this.openKeyframe(this.stage.chosen ?? this.nearestKeyframe(), true);
    } else {
      if (this.compare.isOpen) {
        this.compare.close();
        this.overlay.setColoring(name);
      }
      this.stage.coloring = name;
      if (name === "seen" && this.stage.seenVersion !== this.store.version) {
        await this.stage.countSeen();
      }
    }
    this.stage.invalidate();
  }

  nextColoring() {
    const names = ["color", "depth", "seen", "error"];
    this.setColoring(names[(names.indexOf(this.overlay.coloring) + 1) % names.length]);
  }

  // Counts anew a while after the map has changed, where the numbers are shown.
  countAgain() {
    if (this.stage.coloring === "seen" && !this.countTimer) {
      this.countTimer = setTimeout(async () => {
        this.countTimer = 0;
        if (this.stage.coloring === "seen" && this.stage.seenVersion !== this.store.version) {
          await this.stage.countSeen();
        }
      }, COUNT_AGAIN_MS);
    }
  }

  clicked(x, y, touch) {
    const { ratio } = this.stage.measure();
    const reach = (touch ? PICK_PIXELS_TOUCH : PICK_PIXELS) * ratio;
    if (!this.stage.layers.keyframes) {
      return;
    }
    const id = this.scene.pick(this.stage.view(), x * ratio, y * ratio, this.scene.frustumSize(this.store), reach);
    if (id !== null) {
      this.openKeyframe(id, false);
    }
  }

  // The point in the middle, for those without a pointer.
  markCentre() {
    const { canvas } = this.overlay;
    this.doubled(canvas.clientWidth / 2, canvas.clientHeight / 2);
  }

  async doubled(x, y) {
    const point = await this.stage.pointAt(x, y);
    if (!point) {
      this.stage.marked = null;
      this.overlay.note("There is no Gaussian at this point.");
    } else {
      this.stage.marked = this.scene.containing(point);
      const place = point.map(v => v.toFixed(2)).join(", ");
      this.overlay.note(`${this.stage.marked.size} of ${this.scene.keyframes.size} keyframes see the point (${place}).`);
    }
    this.stage.invalidate();
  }

  nearestKeyframe() {
    const { p } = this.controls.pose;
    const far = id => Math.hypot(...this.scene.keyframes.get(id).p.map((v, i) => v - p[i]));
    return this.scene.ids().reduce((best, id) => (far(id) < far(best) ? id : best));
  }

  // Stands in a keyframe and compares it.
  openKeyframe(id, difference) {
    const keyframe = this.scene.keyframes.get(id);
    if (!keyframe) {
      return;
    }
    this.cameraTaken();
    this.choose(id);
    this.controls.flyTo(keyframe, 0.6 * this.controls.radius);
    this.compare.open(id);
    this.compare.showDifference(difference || this.compare.toggle.checked);
  }

  choose(id) {
    this.stage.chosen = id;
    this.panel.setKeyframes(this.scene.keyframes.size, id);
    if (id === null) {
      this.compare.toggle.checked = false;
      this.overlay.setColoring(this.stage.coloring);
    }
    this.stage.invalidate();
  }

  stepKeyframe(by) {
    const ids = this.scene.ids();
    if (ids.length === 0) {
      return;
    }
    const at = ids.indexOf(this.stage.chosen);
    const next = at < 0 ? (by > 0 ? 0 : ids.length - 1) : clamp(at + by, 0, ids.length - 1);
    this.openKeyframe(ids[next], false);
  }

  askKeyframe(id) {
    return Boolean(this.scene.hello?.images) && this.send({ type: "keyframe", id });
  }

  askRender(kind, pose, camera, id) {
    this.requests += 1;
    const { width, height, fx, fy, cx, cy } = camera;
    const view = { p: pose.p, q: pose.q, width, height, fx, fy, cx, cy };
    this.send({ type: "render", request: this.requests, kind, ...view, ...(id === undefined ? {} : { id }) });
    return this.requests;
  }

  askExact() {
    if (!this.scene.hello?.exact) {
      return;
    }
    const kind = this.overlay.coloring === "depth" ? "depth" : "color";
    const { width, height } = this.stage.measure();
    const share = Math.min(1, LARGEST_EXACT / Math.max(width, height));
    const camera = fittedCamera(this.scene.camera, Math.round(width * share), Math.round(height * share));
    this.exact.wait(this.askRender(kind, this.controls.pose, camera), "The exact picture is on its way.");
  }

  control(what) {
    if (this.scene.hello?.control && this.scene.hello.live) {
      if (!this.send({ type: "control", do: what })) {
        this.overlay.note("There is no connection to keysplat now.");
      }
    }
  }

  stepOnce() {
    this.control("step");
  }

  askFinish() {
    askDialog(this.root, "Finish the run? keysplat writes its results; the view stays open.", "Finish", () => this.control("finish"));
  }

  togglePanel() {
    this.overlay.togglePanel();
  }

  listenToKeys() {
    const embedded = this.root.classList.contains("embedded");
    const heard = embedded ? this.root : document;
    heard.addEventListener("keydown", event => this.keyDown(event));
    document.addEventListener("keyup", event => this.controls.keyUp(event));
    this.root.addEventListener("toggle", () => this.stage?.invalidate(), true);
  }

  keyDown(event) {
    const kind = event.target.tagName;
    const typing = kind === "INPUT" && event.target.type !== "checkbox";
    // On many keyboards the brackets need AltGr.
    const bracket = event.key === "[" || event.key === "]";
    const modified = !bracket && (event.ctrlKey || event.metaKey || event.altKey);
    if (this.fatal || modified || event.defaultPrevented || this.root.querySelector("dialog[open]")) {
      return;
    }
    // Space and enter press a button that has the focus.
    const pressing = (event.key === " " || event.key === "Enter") && event.target !== this.overlay.canvas && event.target !== document.body;
    if (pressing || (typing && event.key.startsWith("Arrow"))) {
      return;
    }
    if (this.answer(event) || this.controls.keyDown(event)) {
      event.preventDefault();
    }
  }

  // Whether the key has an effect of its own.
  answer(event) {
    if (event.key === "?") {
      this.help.showModal();
    } else if (event.key === "Escape" && this.compare.isOpen) {
      this.compare.close();
    } else if (event.key === "[" || event.key === "]") {
      this.stepKeyframe(event.key === "[" ? -1 : 1);
    } else if (event.key === "0") {
      this.fit(false);
    } else if (event.key === " ") {
      this.control(this.panel.paused ? "go" : "pause");
    } else if (EFFECTS.has(event.code)) {
      this[EFFECTS.get(event.code)]();
    } else {
      return false;
    }
    return true;
  }
}
