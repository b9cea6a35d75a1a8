// A keyframe as recorded and as rendered at its pose, under one slider.

import { element, iconButton, setText } from "./dom.js";
import { stretchedCamera } from "./math.js";
import { showBlob, showBytes, Throttle } from "./pictures.js";

const COMPARE_EVERY_MS = 700;
// Recorded pictures that are kept; more in files, which cannot be asked again.
const KEPT_PICTURES = 24;
const DIFFERENCE_GAIN = 4;

export class Compare {
  // `hooks`: `ask(id)` requests a recorded picture, `closed()`, `step(by)` goes to another keyframe, `exact(id, camera)` or null.
  constructor(parent, stage, scene, hooks) {
    Object.assign(this, { stage, scene, hooks, id: null, pictures: new Map(), camera: null, kept: KEPT_PICTURES });
    this.rendered = element("canvas", { class: "rendered", role: "img", "aria-label": "Rendered from the map", hidden: true });
    this.recorded = element("canvas", { class: "recorded", role: "img", "aria-label": "As recorded", hidden: true });
    this.difference = element("canvas", { class: "difference", role: "img", "aria-label": "Difference, four times brighter", hidden: true });
    this.exact = element("img", { class: "exact", alt: "Error by keysplat", hidden: true });
    this.title = element("b", {});
    this.figure = element("span", { class: "figure" });
    this.hint = element("p", { class: "hint", hidden: true });
    const label = "Share that shows the recorded picture";
    this.slider = element("input", { type: "range", min: 0, max: 100, value: 50, "aria-label": label, oninput: () => this.slide() });
    this.toggle = element("input", { type: "checkbox", onchange: () => this.showDifference(this.toggle.checked) });
    this.exactButton = iconButton("exact", "Error by the mapper's own rasterizer", () => this.askExact(), "Exact error");
    this.pair = element("div", { class: "pair" }, this.rendered, this.recorded, this.difference, this.exact, this.hint);
    this.section = element("section", { class: "compare", "aria-label": "Comparison of a keyframe", hidden: true },
      element("header", {}, this.title, this.figure,
        iconButton("previous", "Previous keyframe ([)", () => hooks.step(-1)), iconButton("next", "Next keyframe (])", () => hooks.step(1)),
        iconButton("close", "Close the comparison (Escape)", () => this.close())),
      element("div", { class: "frame" }, this.pair),
      element("footer", {}, element("span", {}, "Recorded"), this.slider, element("span", {}, "Rendered"),
        element("label", { class: "check" }, this.toggle, element("span", {}, "Difference ×4")), this.exactButton));
    parent.append(this.section);
    this.throttle = new Throttle(() => this.render(), COMPARE_EVERY_MS);
  }

  get isOpen() {
    return this.id !== null;
  }

  forget() {
    this.pictures.clear();
  }

  async open(id) {
    const keyframe = this.scene.keyframes.get(id);
    if (!keyframe) {
      return;
    }
    this.id = id;
    this.camera = null;
    this.setShown({ recorded: false, rendered: false });
    this.hideExact();
    this.section.hidden = false;
    this.exactButton.hidden = !(this.scene.hello && this.scene.hello.exact);
    setText(this.title, `Keyframe ${id}`);
    this.caption = keyframe.frame === undefined ? "" : `frame ${keyframe.frame}`;
    setText(this.figure, this.caption);
    const known = this.pictures.get(id);
    this.difference.hidden = true;
    const asked = !known && this.hooks.ask(id);
    this.say(known ? "" : asked ? "The recorded picture is on its way." : "The recorded picture is not at hand.");
    if (known) {
      await this.showRecorded(known);
    }
    this.throttle.ask();
  }

  close() {
    this.id = null;
    this.hideExact();
    this.section.hidden = true;
    this.hooks.closed();
    // Else the focus, and with it the keys, would be lost.
    this.stage.canvas.focus({ preventScroll: true });
  }

  say(text) {
    setText(this.hint, text);
    this.hint.hidden = text === "";
  }

  // A recorded picture; it is kept, the longest unused goes first.
  async takeImage(image) {
    this.pictures.delete(image.id);
    this.pictures.set(image.id, image);
    if (this.pictures.size > this.kept) {
      this.pictures.delete(this.pictures.keys().next().value);
    }
    if (image.id === this.id) {
      await this.showRecorded(image);
      this.throttle.ask();
    }
  }

  async showRecorded(image) {
    if (await showBlob(this.recorded, image.blob, () => image.id === this.id)) {
      this.pair.style.setProperty("--shape", this.recorded.width / this.recorded.height);
      this.camera = image.camera || null;
      this.setShown({ recorded: true });
      this.say("");
      this.slide();
    }
  }

  // Which pictures of this keyframe are there. One alone is shown whole; there is nothing to slide or to subtract.
  setShown({ recorded = !this.recorded.hidden, rendered = !this.rendered.hidden }) {
    this.recorded.hidden = !recorded;
    this.rendered.hidden = !rendered;
    this.pair.classList.toggle("both", this.hasBoth);
    this.toggle.disabled = !this.hasBoth;
    this.slider.disabled = !this.hasBoth || this.toggle.checked;
  }

  get hasRecorded() {
    return !this.recorded.hidden;
  }

  get hasBoth() {
    return this.hasRecorded && !this.rendered.hidden;
  }

  refused({ what, why }) {
    if (this.isOpen && (what === "render" || (what === "keyframe" && !this.hasRecorded))) {
      this.say(why);
    }
  }

  slide() {
    this.pair.style.setProperty("--at", `${this.slider.value}%`);
  }

  showDifference(on) {
    this.toggle.checked = on;
    this.slider.disabled = on || !this.hasBoth;
    this.hideExact();
    this.difference.hidden = !on || !this.hasBoth;
  }

  // The pose or the map has changed.
  changed() {
    if (this.isOpen && !document.hidden) {
      this.throttle.ask();
    }
  }

  // Camera of the pictures: the keyframe's own, at the size of the recorded picture.
  pictureCamera() {
    const camera = this.camera || this.scene.camera;
    return this.hasRecorded ? stretchedCamera(camera, this.recorded.width, this.recorded.height) : camera;
  }

  async render() {
    const id = this.id;
    const keyframe = this.scene.keyframes.get(id);
    if (!keyframe) {
      return;
    }
    const picture = await this.stage.draw(keyframe, this.pictureCamera());
    if (!picture || id !== this.id) {
      return;
    }
    showBytes(this.rendered, picture);
    this.setShown({ rendered: true });
    this.pair.style.setProperty("--shape", picture.width / picture.height);
    if (this.hasRecorded && this.recorded.width === picture.width) {
      this.measure(picture);
    } else {
      this.throttle.again = this.hasRecorded;
    }
  }

  // Difference and PSNR of the two pictures.
  measure(picture) {
    const { width, height, rgba } = picture;
    const recorded = this.recorded.getContext("2d").getImageData(0, 0, width, height).data;
    const shown = new Uint8Array(rgba.length);
    let sum = 0;
    for (let i = 0; i < rgba.length; i++) {
      if (i % 4 === 3) {
        shown[i] = 255;
      } else {
        const d = Math.abs(recorded[i] - rgba[i]);
        sum += d * d;
        shown[i] = Math.min(255, DIFFERENCE_GAIN * d);
      }
    }
    const psnr = 10 * Math.log10((255 * 255) / Math.max(sum / (3 * width * height), 1e-9));
    setText(this.figure, [this.caption, `${psnr.toFixed(1)} dB`].filter(Boolean).join(" · "));
    showBytes(this.difference, { width, height, rgba: shown });
    this.difference.hidden = !this.toggle.checked;
  }

  askExact() {
    this.hideExact();
    this.wanted = this.hooks.exact(this.id, this.scene.keyframes.get(this.id), this.pictureCamera());
    setText(this.figure, [this.caption, "exact error is on its way"].filter(Boolean).join(" · "));
  }

  async takeExact(image) {
    if (image.request !== this.wanted) {
      return;
    }
    this.exact.src = URL.createObjectURL(image.blob);
    await this.exact.decode();
    this.exact.hidden = false;
    const db = Number.isFinite(image.psnr_db) ? `${image.psnr_db.toFixed(2)} dB by keysplat` : "error by keysplat";
    setText(this.figure, [this.caption, db].filter(Boolean).join(" · "));
  }

  hideExact() {
    this.wanted = null;
    if (this.exact.src) {
      URL.revokeObjectURL(this.exact.src);
      this.exact.removeAttribute("src");
    }
    this.exact.hidden = true;
  }
}
