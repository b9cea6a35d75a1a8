// What lies over the picture: colourings and their legend, tools, banners and notes.

import { element, iconButton, setText, countText, lengthText } from "./dom.js";
import { RAMP } from "./shaders.js";

const COLORINGS = [["color", "Colour"], ["depth", "Depth"], ["seen", "Seen by"], ["error", "Error"]];
const NOTE_MS = 6000;

export class Overlay {
  constructor(root, viewer) {
    this.root = root;
    this.coloring = "color";
    const label = "The map. Drag to orbit; the question mark lists the keys.";
    this.canvas = element("canvas", { class: "scene", tabIndex: 0, role: "application", "aria-label": label });
    this.banners = element("div", { class: "banners", role: "alert" });
    this.noteText = element("p", { class: "chip note", role: "status", hidden: true });
    this.empty = element("p", { class: "empty" }, "Waiting for the first keyframe");
    this.buildColorings(viewer);
    this.buildTools(viewer);
    this.stage = element("div", { class: "stage" }, this.canvas, this.empty, this.top, this.tools, this.noteText, this.banners);
    root.append(this.stage);
    this.shown = new Map();
  }

  buildColorings(viewer) {
    this.radios = COLORINGS.map(([name, label]) => {
      const change = () => viewer.setColoring(name);
      const radio = element("input", { type: "radio", name: "viewer-coloring", value: name, checked: name === "color", onchange: change });
      return element("label", {}, radio, element("span", {}, label));
    });
    this.low = element("span", {});
    this.high = element("span", {});
    const stops = RAMP.map(c => `rgb(${c.join(" ")})`).join(", ");
    const bar = element("i", { class: "bar", style: `background: linear-gradient(90deg, ${stops})` });
    this.legend = element("div", { class: "scale chip", hidden: true }, this.low, bar, this.high);
    this.progress = element("p", { class: "chip", hidden: true });
    const choices = element("div", { class: "choices", role: "radiogroup", "aria-label": "Colouring" }, ...this.radios);
    this.top = element("div", { class: "top" }, choices, this.legend, this.progress);
  }

  buildTools(viewer) {
    this.followButton = iconButton("follow", "Follow the camera (f)", () => viewer.follow());
    this.followButton.setAttribute("aria-pressed", "false");
    this.exactButton = iconButton("exact", "Exact picture by the mapper's own rasterizer (x)", () => viewer.askExact(), "Exact picture");
    this.exactButton.hidden = true;
    this.panelButton = iconButton("panel", "Hide or show the panel (p)", () => this.togglePanel());
    this.tools = element("div", { class: "tools", role: "toolbar", "aria-label": "View" },
      iconButton("fit", "Whole scene (0)", () => viewer.fit(false)), this.followButton,
      iconButton("minus", "Farther (−)", () => viewer.controls.zoom(1.25)), iconButton("plus", "Nearer (+)", () => viewer.controls.zoom(0.8)),
      this.exactButton, element("span", { class: "grow" }),
      iconButton("help", "Keys (?)", () => viewer.help.showModal()), iconButton("full", "Whole screen", () => this.toggleScreen()), this.panelButton);
  }

  togglePanel() {
    const inPanel = this.root.querySelector(".panel")?.contains(document.activeElement);
    this.root.classList.toggle("bare");
    if (inPanel) {
      this.canvas.focus({ preventScroll: true });
    }
  }

  async toggleScreen() {
    try {
      await (document.fullscreenElement ? document.exitFullscreen() : this.root.requestFullscreen());
    } catch {
      this.note("This browser does not give the whole screen.");
    }
  }

  setHello(hello) {
    this.exactButton.hidden = !hello.exact;
  }

  setFollowing(on) {
    this.followButton.setAttribute("aria-pressed", String(on));
  }

  setColoring(name) {
    this.coloring = name;
    for (const label of this.radios) {
      label.firstChild.checked = label.firstChild.value === name;
    }
  }

  // How much of a map has come, while it is not whole.
  setProgress(held, whole, complete) {
    this.progress.hidden = complete || !(whole > 0);
    setText(this.progress, `${countText(held)} of ${countText(whole)} Gaussians`);
  }

  // Numbers at the ends of the legend.
  setRange(stage, scene) {
    const depth = stage.coloring === "depth";
    this.legend.hidden = !depth && stage.coloring !== "seen";
    if (!this.legend.hidden) {
      const [low, high] = stage.valueRange();
      setText(this.low, depth ? lengthText(low, scene.units) : "0");
      setText(this.high, depth ? lengthText(high, scene.units) : `${high} keyframe${high === 1 ? "" : "s"}`);
    }
  }

  // Shows a sentence under a name until it is taken away with null, or for a while.
  banner(name, text, retry, forMs) {
    const old = this.shown.get(name);
    if (old) {
      clearTimeout(old.timer);
    }
    if (text === null) {
      old?.node.remove();
      this.shown.delete(name);
      return;
    }
    const node = old ? old.node : element("div", { class: "banner" });
    node.replaceChildren(element("span", {}, text));
    if (retry) {
      node.append(element("button", { type: "button", onclick: retry }, "Try now"));
    }
    if (!old) {
      this.banners.append(node);
    }
    this.shown.set(name, { node, timer: forMs ? setTimeout(() => this.banner(name, null), forMs) : 0 });
  }

  note(text) {
    setText(this.noteText, text);
    this.noteText.hidden = false;
    clearTimeout(this.noteTimer);
    this.noteTimer = setTimeout(() => {
      this.noteText.hidden = true;
    }, NOTE_MS);
  }
}
