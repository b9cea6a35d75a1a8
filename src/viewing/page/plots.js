// Statistics over time, as small plots.

import { element, setText, fixedText, countText, bytesText, durationText, isNumber } from "./dom.js";

// At this many entries every other one of the older half goes.
const MOST_ENTRIES = 2000;
const REDRAW_MS = 250;

const PLOTS = [
  { title: "PSNR of the views", lines: [{ field: "psnr_db", tone: "--accent", text: v => fixedText(v, 1, " dB") }] },
  { title: "Gaussians", zero: true, lines: [{ field: "gaussians", tone: "--accent", text: countText }] },
  { title: "Time a frame and a step", zero: true, lines: [
    { field: "frame_ms", tone: "--accent", text: v => fixedText(v, 0, " ms") },
    { field: "step_ms", tone: "--second", text: v => fixedText(v, 0, " ms") }] },
  { title: "Memory", zero: true, lines: [{ field: "host_bytes", tone: "--accent", text: bytesText }] },
];

export class Plots {
  constructor(parent) {
    this.entries = [];
    this.timer = 0;
    this.at = null;
    this.plots = PLOTS.map(plot => this.build(plot, parent));
    this.observer = new ResizeObserver(() => this.later());
    this.plots.forEach(plot => this.observer.observe(plot.canvas));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.later());
  }

  build(plot, parent) {
    const canvas = element("canvas", { role: "img", "aria-label": `${plot.title} over time` });
    const values = plot.lines.map(line => element("b", { style: `color: var(${line.tone})` }));
    parent.append(element("figure", { class: "plot" },
      element("figcaption", {}, element("span", {}, plot.title), element("span", { class: "values" }, ...values)), canvas));
    canvas.addEventListener("pointermove", event => {
      const box = canvas.getBoundingClientRect();
      this.at = (event.clientX - box.left) / box.width;
      this.later();
    });
    canvas.addEventListener("pointerleave", () => {
      this.at = null;
      this.later();
    });
    return { ...plot, canvas, values };
  }

  clear() {
    this.entries.length = 0;
    this.later();
  }

  add(entries) {
    for (const entry of entries) {
      this.entries.push(entry);
    }
    while (this.entries.length > MOST_ENTRIES) {
      const half = this.entries.length >> 1;
      this.entries = this.entries.filter((_, i) => i >= half || i % 2 === 0);
    }
    this.later();
  }

  later() {
    if (!this.timer) {
      this.timer = setTimeout(() => {
        this.timer = 0;
        this.plots.forEach(plot => this.draw(plot));
      }, REDRAW_MS);
    }
  }

  // The entry under the pointer, or the newest.
  marked() {
    const { entries } = this;
    if (this.at === null || entries.length === 0) {
      return entries[entries.length - 1];
    }
    const first = entries[0].s;
    const s = first + this.at * (entries[entries.length - 1].s - first);
    return entries.find(entry => entry.s >= s) || entries[entries.length - 1];
  }

  draw(plot) {
    const { canvas } = plot;
    const [w, h] = [canvas.clientWidth, canvas.clientHeight];
    if (w === 0 || h === 0) {
      return;
    }
    const ratio = Math.min(devicePixelRatio || 1, 2);
    canvas.width = Math.round(w * ratio);
    canvas.height = Math.round(h * ratio);
    const pen = canvas.getContext("2d");
    pen.scale(ratio, ratio);
    const marked = this.marked();
    plot.lines.forEach((line, i) => setText(plot.values[i], marked ? line.text(marked[line.field]) : "–"));
    const style = getComputedStyle(canvas);
    const scale = this.scaleOf(plot, w, h);
    pen.font = "10.5px system-ui, sans-serif";
    pen.fillStyle = style.getPropertyValue("--faint");
    if (!scale) {
      pen.fillText("no figures yet", 2, h / 2);
      return;
    }
    this.drawFrame(pen, plot, scale, style, w, h);
    for (const line of plot.lines) {
      this.drawLine(pen, line, scale, style.getPropertyValue(line.tone));
    }
    if (this.at !== null && marked) {
      pen.strokeStyle = style.getPropertyValue("--faint");
      pen.lineWidth = 0.5;
      pen.beginPath();
      pen.moveTo(scale.x(marked.s), 0);
      pen.lineTo(scale.x(marked.s), scale.bottom);
      pen.stroke();
    }
  }

  scaleOf(plot, w, h) {
    const { entries } = this;
    let low = plot.zero ? 0 : Infinity;
    let high = -Infinity;
    for (const entry of entries) {
      for (const { field } of plot.lines) {
        if (isNumber(entry[field])) {
          low = Math.min(low, entry[field]);
          high = Math.max(high, entry[field]);
        }
      }
    }
    if (!(high >= low)) {
      return null;
    }
    const span = high - low || Math.abs(high) * 0.1 || 1;
    const [first, last] = [entries[0].s, entries[entries.length - 1].s];
    const bottom = h - 14;
    return {
      low, high, first, last, bottom,
      x: s => 1 + ((s - first) / (last - first || 1)) * (w - 2),
      y: v => bottom - 2 - ((v - low) / span) * (bottom - 6),
    };
  }

  drawFrame(pen, plot, scale, style, w, h) {
    pen.strokeStyle = style.getPropertyValue("--edge");
    pen.lineWidth = 1;
    pen.beginPath();
    for (const y of [4.5, Math.round(scale.bottom) - 1.5]) {
      pen.moveTo(0, y);
      pen.lineTo(w, y);
    }
    pen.stroke();
    const { text } = plot.lines[0];
    pen.textAlign = "left";
    pen.fillText(durationText(scale.first), 0, h - 2);
    pen.textAlign = "center";
    pen.fillText(scale.high > scale.low ? `${text(scale.low)} – ${text(scale.high)}` : "", w / 2, h - 2);
    pen.textAlign = "right";
    pen.fillText(durationText(scale.last), w, h - 2);
  }

  drawLine(pen, line, scale, color) {
    pen.strokeStyle = color;
    pen.lineWidth = 1.5;
    pen.lineJoin = "round";
    pen.beginPath();
    let down = false;
    for (const entry of this.entries) {
      const v = entry[line.field];
      if (!isNumber(v)) {
        continue;
      }
      if (down) {
        pen.lineTo(scale.x(entry.s), scale.y(v));
      } else {
        pen.moveTo(scale.x(entry.s), scale.y(v));
      }
      down = true;
    }
    pen.stroke();
  }
}
