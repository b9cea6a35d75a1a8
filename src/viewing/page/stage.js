// The picture of the scene: when to sort, to upload and to draw. Nothing is drawn while nothing changes.

import { fittedCamera, stretchedCamera, viewOf, sameView, add3, scale3 } from "./math.js";
import { openGl, blendsFloats, SplatRenderer, SHOWN_COLOR, SHOWN_DEPTH, SHOWN_SEEN } from "./splats.js";
import { Lines } from "./lines.js";
import { Sorter } from "./sorter.js";

// The picture is coarser while it moves on an adapter that takes longer than this for a frame.
const MOVING_FRAME_MS = 45;
const QUALITIES = [1, 0.7, 0.5, 0.3];
// A finer picture must promise this much room, so that the picture does not change size all the time.
const QUALITY_SLACK = 1.15;
const REST_MS = 140;
const MAX_PIXEL_RATIO = 2;
// Share of the picture beyond its edges that is sorted too: it comes into sight before the next order does.
const SORT_MARGIN = 0.12;

const BACKGROUNDS = { black: [0, 0, 0], panel: null };

export class Stage {
  // `hooks`: `advance(now, seconds)` moves the camera, `pose()` gives it, `drawn()` comes after each frame, `failed(text)`.
  constructor(canvas, scene, hooks) {
    this.canvas = canvas;
    this.scene = scene;
    this.hooks = hooks;
    this.layers = { keyframes: true, path: true, truth: true, loops: true, current: true };
    this.coloring = "color";
    this.background = "black";
    this.chosen = null;
    this.marked = null;
    this.range = [0, 1];
    this.most = 1;
    this.frameMs = null;
    this.quality = 1;
    this.drawnQuality = 1;
    this.tookMs = 0;
    this.movedAt = 0;
    this.drawing = false;
    this.again = false;
    this.waiting = 0;
    this.lastFrame = 0;
    this.gl = openGl(canvas);
    if (!this.gl) {
      throw new Error("This browser has no WebGL 2, which the picture of the map needs. Turn on hardware acceleration, or use another browser.");
    }
    this.sorter = new Sorter(!blendsFloats(this.gl), hooks.failed);
    this.main = { view: null, version: -1, flying: false };
    this.held = -1;
    this.reaching = [];
    this.lost = false;
    this.drawnKey = "";
    canvas.addEventListener("webglcontextlost", event => this.contextLost(event));
    canvas.addEventListener("webglcontextrestored", () => this.contextRestored());
    new ResizeObserver(() => this.invalidate()).observe(canvas);
  }

  useStore(store) {
    this.store = store;
    this.renderer = new SplatRenderer(this.gl, store);
    this.lines = new Lines(this.gl);
  }

  contextLost(event) {
    event.preventDefault();
    this.lost = true;
    this.reached(Infinity);
    this.hooks.failed("The graphics adapter was taken away. The picture comes back when the browser has it again.");
  }

  contextRestored() {
    this.renderer = new SplatRenderer(this.gl, this.store);
    this.lines.restore(this.gl);
    this.store.markAll();
    this.held = -1;
    this.drawing = false;
    this.main.view = null;
    this.main.version = -1;
    this.lost = false;
    this.hooks.failed(null);
    this.invalidate();
  }

  // Asks for a frame.
  invalidate() {
    if (!this.waiting && this.store) {
      this.waiting = requestAnimationFrame(now => this.frame(now));
    }
  }

  // Width and height of the canvas's pixels, after what the page gives it.
  measure() {
    const ratio = Math.min(devicePixelRatio || 1, MAX_PIXEL_RATIO);
    const pixels = length => Math.max(1, Math.round(length * ratio));
    return { width: pixels(this.canvas.clientWidth), height: pixels(this.canvas.clientHeight), ratio };
  }

  view() {
    const { width, height } = this.measure();
    return viewOf(this.hooks.pose(), fittedCamera(this.scene.camera, width, height));
  }

  frame(now) {
    this.waiting = 0;
    if (this.lost) {
      return;
    }
    // The adapter still draws: another frame now would only queue up.
    if (this.drawing) {
      this.again = true;
      return;
    }
    const elapsed = now - this.lastFrame;
    const continuous = this.wasMoving && elapsed < 1000;
    const moving = this.hooks.advance(now, continuous ? elapsed / 1000 : 1 / 60);
    this.lastFrame = now;
    this.began = performance.now();
    const view = this.view();
    if (this.canvas.width !== view.camera.width || this.canvas.height !== view.camera.height) {
      this.canvas.width = view.camera.width;
      this.canvas.height = view.camera.height;
      this.drawnKey = "";
    }
    this.chooseQuality(now, view, continuous);
    this.wasMoving = moving;
    this.requestSort(view);
    this.render(view);
    this.watch();
    this.hooks.drawn(view);
    if (moving) {
      this.invalidate();
    }
  }

  // Waits until the adapter has done the frame; takes its time.
  async watch() {
    this.drawing = true;
    const done = await this.renderer.signalled();
    this.drawing = false;
    if (!done) {
      return;
    }
    // A frame with new lines alone is no measure.
    if (this.blended) {
      this.blended = false;
      this.tookMs = performance.now() - this.began;
      this.frameMs = this.frameMs === null ? this.tookMs : 0.7 * this.frameMs + 0.3 * this.tookMs;
    }
    if (this.again) {
      this.again = false;
      this.invalidate();
    }
  }

  // Coarse while the camera or the map changes and frames are slow, full as soon as they rest.
  chooseQuality(now, view, continuous) {
    const moved = !this.lastView || this.lastHeld !== this.held || this.lastView.rows.some((v, i) => v !== view.rows[i]);
    this.lastView = view;
    this.lastHeld = this.held;
    clearTimeout(this.restTimer);
    if (moved) {
      this.movedAt = now;
      // The time goes with the number of pixels, that is with the square of the quality.
      const ideal = this.drawnQuality * Math.sqrt(MOVING_FRAME_MS / Math.max(this.tookMs, 1));
      const fits = quality => quality * (quality > this.quality ? QUALITY_SLACK : 1) <= ideal;
      this.quality = QUALITIES.find(fits) || QUALITIES[QUALITIES.length - 1];
      if (this.quality < 1) {
        this.restTimer = setTimeout(() => this.rest(), REST_MS);
      }
    } else if (now - this.movedAt >= REST_MS - 20 && !continuous) {
      this.quality = 1;
    } else if (this.quality < 1) {
      this.restTimer = setTimeout(() => this.rest(), REST_MS);
    }
  }

  rest() {
    this.quality = 1;
    this.invalidate();
  }

  // Has an order made where the camera or the map has changed. One is in flight at most.
  requestSort(view) {
    if (this.main.flying || (sameView(view, this.main.view) && this.main.version === this.store.version)) {
      return;
    }
    this.main.flying = true;
    this.sorter.sort(view, this.store.version, SORT_MARGIN).then(result => {
      this.main.flying = false;
      if (!this.lost && this.hold(result.version)) {
        this.renderer.setOrder("main", result.order, result.count);
        this.main.view = view;
        this.main.version = result.version;
        this.drawnKey = "";
        this.takeRange(result);
      }
      this.sorter.recycle(result.order);
      if (this.held !== this.store.version) {
        this.requestSort(this.view());
      }
      this.invalidate();
    });
  }

  // Sorts at once, seen or not, and resolves when the adapter has the newest map.
  reach() {
    if (this.lost) {
      return Promise.resolve();
    }
    this.requestSort(this.view());
    this.invalidate();
    return new Promise(resolve => this.reaching.push({ version: this.store.version, resolve }));
  }

  reached(version) {
    this.reaching = this.reaching.filter(waiting => {
      if (waiting.version <= version) {
        waiting.resolve();
      }
      return waiting.version > version;
    });
  }

  takeRange(result) {
    if (result.count > 0) {
      this.range = [result.near, Math.max(result.far, result.near * 1.01)];
    }
  }

  // Brings the adapter to a version of the map; false where an order for that version is of no use any more.
  hold(version) {
    if (version === this.held) {
      return true;
    }
    if (version !== this.store.version) {
      return false;
    }
    try {
      this.renderer.upload();
    } catch (error) {
      this.hooks.failed(error.message);
    }
    this.held = version;
    this.reached(version);
    return true;
  }

  get shown() {
    return { depth: SHOWN_DEPTH, seen: SHOWN_SEEN }[this.coloring] || SHOWN_COLOR;
  }

  valueRange() {
    return this.shown === SHOWN_SEEN ? [0, this.most] : this.range;
  }

  backgroundColor() {
    if (BACKGROUNDS[this.background]) {
      return BACKGROUNDS[this.background];
    }
    const parts = getComputedStyle(this.canvas).backgroundColor.match(/[\d.]+/g) || ["0", "0", "0"];
    return parts.slice(0, 3).map(v => Number(v) / 255);
  }

  render(view) {
    const { width, height } = view.camera;
    const quality = this.renderer.floats ? this.quality : 1;
    const camera = quality < 1 ? stretchedCamera(view.camera, Math.ceil(width * quality), Math.ceil(height * quality)) : view.camera;
    const drawn = { ...view, camera };
    const range = this.valueRange();
    const key = [view.rows, camera.width, camera.height, camera.fx, this.held, this.shown, this.shown === SHOWN_COLOR ? "" : range].join();
    // Between an upload and the order that belongs to it, the last picture stays.
    if (key !== this.drawnKey && (this.main.version === this.held || !this.renderer.targets.main)) {
      this.renderer.blend("main", drawn, this.shown, range);
      this.drawnKey = key;
      this.drawnQuality = quality;
      this.blended = true;
    }
    this.renderer.resolve("main", null, width, height, this.backgroundColor(), this.shown !== SHOWN_COLOR);
    this.lines.update(this.scene, this.store, this.layers, this.chosen, this.marked);
    this.lines.draw(view, 1.4 * this.measure().ratio, this.scene.frustumSize(this.store));
  }

  // Whether the canvas shows all that was taken, in the right order.
  get settled() {
    return !this.store || this.lost || (!this.waiting && !this.drawing && !this.main.flying && this.quality === 1 && this.held === this.store.version
      && this.main.version === this.held && sameView(this.main.view, this.view()));
  }

  // Sorts for a view aside of the canvas's, and blends it into the target "side".
  async blendAside(view, shown, range) {
    for (let attempt = 0; attempt < 20; attempt++) {
      const result = await this.sorter.sort(view, this.store.version);
      const fits = !this.lost && this.hold(result.version);
      if (fits) {
        this.renderer.setOrder("side", result.order, result.count);
        this.renderer.blend("side", view, shown, range || [result.near, result.far]);
      }
      this.sorter.recycle(result.order);
      if (fits) {
        if (this.main.version !== this.held) {
          this.invalidate();
        }
        return true;
      }
    }
    return false;
  }

  // The map alone at a pose: {width, height, rgba}, rows from the top; or null where no picture can be had.
  async draw(pose, camera) {
    const { width, height } = camera;
    if (!this.store || !(await this.blendAside(viewOf(pose, camera), SHOWN_COLOR, [0, 1]))) {
      return null;
    }
    const rgba = await this.renderer.readBytes("side", width, height);
    return rgba && { width, height, rgba };
  }

  // Point of the map under a pixel of the canvas, in the world; null where there is nothing.
  async pointAt(x, y) {
    const view = this.view();
    const { ratio } = this.measure();
    // Half the size is enough, and quick.
    const camera = stretchedCamera(view.camera, Math.ceil(view.camera.width / 2), Math.ceil(view.camera.height / 2));
    const range = this.renderer.floats ? [0, 1] : this.range;
    if (!(await this.blendAside({ ...view, camera }, SHOWN_DEPTH, range))) {
      return null;
    }
    const px = Math.min(camera.width - 1, Math.round((x * ratio) / 2));
    const py = Math.min(camera.height - 1, Math.round((y * ratio) / 2));
    const [sum, , , light] = this.renderer.readPixel("side", px, py);
    if (light > 0.7) {
      return null;
    }
    const depth = range[0] + (sum / (1 - light)) * (range[1] - range[0]);
    const r = view.rows;
    const ray = [(px - camera.cx) / camera.fx, (py - camera.cy) / camera.fy, 1];
    const along = [0, 1, 2].map(i => r[i] * ray[0] + r[4 + i] * ray[1] + r[8 + i] * ray[2]);
    return add3(view.center, scale3(along, depth));
  }

  // Counts the keyframes that see each Gaussian, and shows that.
  async countSeen() {
    const views = [...this.scene.keyframes.values()].map(keyframe => viewOf(keyframe, this.scene.camera));
    const version = this.store.version;
    const result = await this.sorter.see(views, version);
    if (!result || this.lost) {
      return false;
    }
    this.most = result.counts.reduce((most, v) => Math.max(most, v), 1);
    this.renderer.uploadSeen(result.counts);
    this.seenVersion = version;
    this.drawnKey = "";
    this.invalidate();
    return true;
  }
}
