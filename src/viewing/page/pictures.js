// Pictures that keysplat sends: of the newest frame, beside a render at its pose, and exact renders over the canvas.

import { element, setText } from "./dom.js";
import { stretchedCamera } from "./math.js";

const RENDER_WIDTH = 320;
const RENDER_EVERY_MS = 600;

// Shows rows of bytes on a canvas of their size.
export function showBytes(canvas, picture) {
  canvas.width = picture.width;
  canvas.height = picture.height;
  const bytes = new Uint8ClampedArray(picture.rgba.buffer, picture.rgba.byteOffset, picture.rgba.byteLength);
  canvas.getContext("2d").putImageData(new ImageData(bytes, picture.width, picture.height), 0, 0);
}

// Shows a picture that must be decoded, unless it is not wanted any more by then; returns whether it did.
export async function showBlob(canvas, blob, wanted = () => true) {
  const bitmap = await createImageBitmap(blob);
  if (!wanted()) {
    return false;
  }
  canvas.width = bitmap.width;
  canvas.height = bitmap.height;
  canvas.getContext("2d", { willReadFrequently: true }).drawImage(bitmap, 0, 0);
  bitmap.close();
  return true;
}

// Calls `act` at most once in a while, and once more after the last call. An act that takes long comes the more seldom.
export class Throttle {
  constructor(act, ms) {
    this.act = act;
    this.ms = ms;
    this.timer = 0;
    this.next = 0;
    this.running = false;
    this.again = false;
  }

  ask() {
    if (this.running) {
      this.again = true;
    } else if (!this.timer) {
      this.timer = setTimeout(() => this.run(), Math.max(0, this.next - performance.now()));
    }
  }

  async run() {
    this.timer = 0;
    this.running = true;
    const began = performance.now();
    try {
      await this.act();
    } finally {
      this.running = false;
      const now = performance.now();
      this.next = now + Math.max(this.ms, 2 * (now - began));
    }
    if (this.again) {
      this.again = false;
      this.ask();
    }
  }
}

// The newest frame as recorded and as the map renders it.
export class CurrentPicture {
  constructor(parent, stage, scene) {
    this.stage = stage;
    this.scene = scene;
    this.recorded = element("canvas", { width: 4, height: 3, role: "img", "aria-label": "Newest frame as recorded" });
    this.rendered = element("canvas", { width: 4, height: 3, role: "img", "aria-label": "The map at the newest frame's pose" });
    this.caption = element("span", {}, "Recorded");
    this.second = element("span", {}, "Rendered here");
    const figure = element("figure", {}, this.recorded, element("figcaption", {}, this.caption));
    parent.append(element("div", { class: "two" }, figure, element("figure", {}, this.rendered, element("figcaption", {}, this.second))));
    this.open = true;
    this.throttle = new Throttle(() => this.render(), RENDER_EVERY_MS);
    this.clear();
  }

  clear() {
    this.recorded.width = 4;
    this.recorded.height = 3;
    setText(this.caption, "No picture yet");
  }

  async takeImage(image) {
    await showBlob(this.recorded, image.blob);
    setText(this.caption, `Recorded, frame ${image.frame}`);
  }

  // The pose or the map has changed.
  changed() {
    if (this.open && this.scene.current && !document.hidden) {
      this.throttle.ask();
    }
  }

  async render() {
    const { current, camera } = this.scene;
    if (!current) {
      return;
    }
    const width = Math.min(RENDER_WIDTH, camera.width);
    const height = Math.max(1, Math.round((width * camera.height) / camera.width));
    const picture = await this.stage.draw(current, stretchedCamera(camera, width, height));
    if (picture) {
      showBytes(this.rendered, picture);
      setText(this.second, current.lost ? "Rendered, last known pose" : `Rendered, frame ${current.frame}`);
    }
  }
}

// A picture by the mapper's own rasterizer, over the canvas until the camera moves.
export class ExactPicture {
  constructor(parent) {
    this.image = element("img", { class: "exact", alt: "Exact picture by keysplat", hidden: true });
    this.chip = element("p", { class: "chip exact-chip", hidden: true });
    parent.append(this.image, this.chip);
    this.wanted = null;
  }

  wait(request, text) {
    this.hide();
    this.wanted = request;
    setText(this.chip, text);
    this.chip.hidden = false;
  }

  async take(image) {
    if (image.request !== this.wanted) {
      return;
    }
    this.release();
    this.image.src = URL.createObjectURL(image.blob);
    await this.image.decode();
    if (image.request !== this.wanted) {
      return;
    }
    this.image.hidden = false;
    const range = Number.isFinite(image.near) && Number.isFinite(image.far) ? `, ${image.near.toFixed(1)} to ${image.far.toFixed(1)} m` : "";
    setText(this.chip, `Exact picture${image.kind === "depth" ? " of depths" : ""}${range}, until the camera moves`);
  }

  release() {
    if (this.image.src) {
      URL.revokeObjectURL(this.image.src);
      this.image.removeAttribute("src");
    }
  }

  hide() {
    if (this.wanted !== null) {
      this.wanted = null;
      this.image.hidden = true;
      this.chip.hidden = true;
      this.release();
    }
  }
}
