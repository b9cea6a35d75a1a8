// The panel beside the picture: status, control, figures, pictures, layers, keyframes, plots.

import { element, iconButton, changeIcon, checkbox, setText, countText, fixedText, bytesText, durationText } from "./dom.js";
import { LINE_COLORS } from "./lines.js";
import { Plots } from "./plots.js";

const FIGURES = [
  ["Frames", (s, hello) => hello && hello.frames ? `${countText(s.frames)} / ${countText(hello.frames)}` : countText(s.frames)],
  ["Keyframes", s => countText(s.keyframes)],
  ["Gaussians", s => countText(s.gaussians)],
  ["PSNR", s => fixedText(s.psnr_db, 2, " dB")],
  ["Time a frame", s => fixedText(s.frame_ms, 0, " ms")],
  ["Time a step", s => fixedText(s.step_ms, 0, " ms")],
  ["Steps", s => countText(s.steps)],
  ["Memory", s => bytesText(s.host_bytes)],
  ["Elapsed", s => durationText(s.s)],
  ["Time left", s => durationText(s.left_s)],
];

const LAYERS = [
  ["keyframes", "Keyframes", "keyframe"], ["current", "Camera now", "current"], ["path", "Path", "plain"],
  ["truth", "True path", "truth"], ["loops", "Loop edges", "loop"],
];

function rgb(color) {
  return `rgb(${color[0]} ${color[1]} ${color[2]})`;
}

export class Panel {
  // `hooks`: `control(what)`, `finish()`, `layer(name, on)`, `background(name)`, `keyframe(step)`, `pictures(open)`.
  constructor(parent, hooks) {
    this.hooks = hooks;
    // A report has these plots larger.
    const embedded = parent.classList.contains("embedded");
    this.title = element("h2", {}, "keysplat");
    this.dot = element("i", { class: "dot" });
    this.status = element("span", {}, "starting");
    this.root = element("aside", { class: "panel", "aria-label": "Figures and settings" },
      element("header", {}, this.title, element("p", { class: "status", role: "status" }, this.dot, this.status)));
    parent.append(this.root);
    this.buildControl();
    this.buildFigures();
    this.pictures = this.section("Newest frame", open => hooks.pictures(open));
    this.buildLayers();
    this.buildKeyframes();
    const plots = this.section("Over time");
    plots.details.open = !embedded;
    this.plots = new Plots(plots);
    this.figured = [this.figureBox, plots.details];
    this.showFigures(false);
  }

  section(title, toggled) {
    const body = element("div", { class: "body" });
    const details = element("details", { open: true }, element("summary", {}, title), body);
    if (toggled) {
      details.addEventListener("toggle", () => toggled(details.open));
    }
    this.root.append(details);
    body.details = details;
    return body;
  }

  buildControl() {
    const { hooks } = this;
    this.pause = iconButton("pause", "Pause (space)", () => hooks.control(this.paused ? "go" : "pause"), "Pause");
    this.step = iconButton("step", "Map one more keyframe or take one more round (n)", () => hooks.control("step"), "Step");
    this.refine = iconButton("refine", "Go on with the refinement after its end, until finished", () => hooks.control("refine"), "Keep refining");
    this.finish = iconButton("finish", "Finish the run", () => hooks.finish(), "Finish");
    this.buttons = element("div", { class: "control", hidden: true }, this.pause, this.step, this.refine, this.finish);
    this.readOnly = element("p", { class: "readonly", hidden: true }, "read only");
    this.root.append(this.buttons, this.readOnly);
  }

  buildFigures() {
    this.figures = FIGURES.map(([name]) => ({ name, value: element("b", {}, "–") }));
    const boxes = this.figures.map(({ name, value }) => element("div", {}, element("dt", {}, name), element("dd", {}, value)));
    this.figureBox = element("dl", { class: "figures" }, ...boxes);
    this.root.append(this.figureBox);
  }

  buildLayers() {
    const body = this.section("Layers");
    this.layerBoxes = {};
    const boxes = LAYERS.map(([name, label, tone]) => {
      const box = checkbox(label, true, on => this.hooks.layer(name, on), rgb(LINE_COLORS[tone]));
      this.layerBoxes[name] = box;
      return box;
    });
    const black = checkbox("Black background", true, on => this.hooks.background(on ? "black" : "panel"), "#000");
    body.append(element("div", { class: "checks" }, ...boxes, black));
    this.largestError = element("span", {});
    this.errorLegend = element("div", { class: "scale", hidden: true }, element("span", {}, "0"), element("i", { class: "bar errors" }),
      this.largestError, element("em", {}, "error of the path"));
    body.append(this.errorLegend);
  }

  buildKeyframes() {
    const body = this.section("Keyframes");
    this.keyframeText = element("span", { class: "grow" }, "none yet");
    body.append(element("div", { class: "row" },
      iconButton("previous", "Previous keyframe ([)", () => this.hooks.keyframe(-1)),
      iconButton("next", "Next keyframe (])", () => this.hooks.keyframe(1)), this.keyframeText));
  }

  setStatus(kind, text) {
    this.dot.dataset.kind = kind;
    setText(this.status, text);
  }

  setHello(hello) {
    this.hello = hello;
    setText(this.title, hello.name || "keysplat");
    this.buttons.hidden = !(hello.control && hello.live);
    this.readOnly.hidden = Boolean(hello.control) || !hello.live;
    this.pictures.details.hidden = !hello.live;
    this.plots.clear();
    this.latest = null;
    this.showFigures(hello.live);
  }

  // Figures and plots have no place where none will come.
  showFigures(on) {
    this.figured.forEach(node => {
      node.hidden = !on;
    });
  }

  takeStatistics(entries) {
    if (entries.length === 0) {
      return;
    }
    this.showFigures(true);
    this.plots.add(entries);
    this.latest = entries[entries.length - 1];
    this.figures.forEach(({ value }, i) => setText(value, FIGURES[i][1](this.latest, this.hello)));
    this.paused = this.latest.paused === true;
    changeIcon(this.pause, this.paused ? "go" : "pause");
    this.pause.setAttribute("aria-label", this.paused ? "Go on (space)" : "Pause (space)");
    setText(this.pause.querySelector("span"), this.paused ? "Go" : "Pause");
    this.finish.disabled = this.latest.phase === "done";
  }

  // Words on what the run does.
  phaseText() {
    if (!this.latest) {
      return "";
    }
    const words = [this.latest.phase];
    if (this.latest.paused) {
      words.push("paused");
    }
    if (this.latest.lost) {
      words.push("lost");
    }
    return words.filter(Boolean).join(", ");
  }

  setKeyframes(count, chosen) {
    const known = chosen === null ? `${countText(count)}; click one to compare` : `Keyframe ${chosen}, ${countText(count)} in all`;
    setText(this.keyframeText, count === 0 ? "none yet" : known);
  }

  setError(text) {
    this.errorLegend.hidden = text === null;
    setText(this.largestError, text || "");
  }
}
