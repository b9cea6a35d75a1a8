// Orders the Gaussians that a camera may see by depth, and counts the keyframes that see each, in a worker.
//
// The functions named `worker…` run there alone: their text is the worker's source, so that a page from a file has one too.

// Row `row` has slots from row · 256 on. `posed` holds centre and radius of each: how far alpha reaches 1/255, before dilation.
function workerState() {
  return {
    rows: 0, counts: new Uint16Array(0), posed: new Float32Array(0), depths: new Float32Array(0), slots: new Uint32Array(0),
    keys: new Uint16Array(0), bins: new Uint32Array(65537), seen: null,
  };
}

function workerGrow(state, row) {
  if (row < state.rows) {
    return;
  }
  let rows = Math.max(64, state.rows);
  while (rows <= row) {
    rows *= 2;
  }
  const counts = new Uint16Array(rows);
  counts.set(state.counts);
  const posed = new Float32Array(rows * 256 * 4);
  posed.set(state.posed);
  Object.assign(state, { rows, counts, posed });
  state.depths = new Float32Array(rows * 256);
  state.slots = new Uint32Array(rows * 256);
  state.keys = new Uint16Array(rows * 256);
}

function workerPut(state, message) {
  const words = message.words;
  const floats = new Float32Array(words.buffer);
  workerGrow(state, Math.max(...message.rows));
  message.rows.forEach((row, index) => {
    const here = Math.min(256, message.count - index * 256);
    state.counts[row] = here;
    for (let i = 0; i < here; i++) {
      const from = (index * 256 + i) * 8;
      const to = (row * 256 + i) * 4;
      const opacity = (words[from + 3] & 0xffff) / 65535;
      const scale = Math.max(words[from + 3] >>> 16, words[from + 4] & 0xffff, words[from + 4] >>> 16);
      const cut = Math.log(Math.max(opacity * 255, 1e-9));
      state.posed[to] = floats[from];
      state.posed[to + 1] = floats[from + 1];
      state.posed[to + 2] = floats[from + 2];
      state.posed[to + 3] = cut >= 0 ? Math.exp((scale / 65535) * 24 - 16) * Math.sqrt(2 * cut) : -1;
    }
  });
}

// Slots, depths and keys of what may touch the picture; gives their number. The test is generous: the shader has the exact one.
function workerCull(state, view, margin) {
  const { posed, counts, depths, slots } = state;
  const [a, b, c, d, e, f, g, h, i, j, k, l] = view.rows;
  const { fx, fy, cx, cy, width, height } = view.camera;
  const left = -0.5 - margin * width;
  const right = width - 0.5 + margin * width;
  const top = -0.5 - margin * height;
  const bottom = height - 0.5 + margin * height;
  const slantX = fx * Math.hypot(1, Math.max(Math.abs(view.bounds[0]), Math.abs(view.bounds[1])));
  const slantY = fy * Math.hypot(1, Math.max(Math.abs(view.bounds[2]), Math.abs(view.bounds[3])));
  let found = 0;
  for (let row = 0; row < state.rows; row++) {
    const end = row * 256 + counts[row];
    for (let slot = row * 256; slot < end; slot++) {
      const x = posed[4 * slot];
      const y = posed[4 * slot + 1];
      const z = posed[4 * slot + 2];
      const radius = posed[4 * slot + 3];
      const depth = i * x + j * y + k * z + l;
      if (!(depth > 0.05 && depth < 1e5 && radius >= 0)) {
        continue;
      }
      // Two pixels more than the dilation's part of the extent.
      const u = (fx * (a * x + b * y + c * z + d)) / depth + cx;
      const v = (fy * (e * x + f * y + g * z + h)) / depth + cy;
      const ru = (slantX * radius) / depth + 2;
      const rv = (slantY * radius) / depth + 2;
      if (u + ru >= left && u - ru <= right && v + rv >= top && v - rv <= bottom) {
        depths[found] = depth;
        slots[found] = slot;
        found += 1;
      }
    }
  }
  return found;
}

// Counting sort by the mapper's own 16-bit keys: the bits of positive floats grow with them.
function workerSort(state, message) {
  const began = performance.now();
  const { slots, keys, bins, depths } = state;
  const found = workerCull(state, message.view, message.margin);
  const bits = new Uint32Array(depths.buffer);
  const limits = new Uint32Array(new Float32Array([0.05, 1e5]).buffer);
  const step = Math.ceil((limits[1] - limits[0]) / 65536);
  bins.fill(0);
  for (let n = 0; n < found; n++) {
    const key = ((bits[n] - limits[0]) / step) | 0;
    keys[n] = key;
    bins[key + 1] += 1;
  }
  const range = [0.02, 0.98].map(share => workerDepthAt(bins, found * share, limits[0], step));
  for (let key = 1; key < 65536; key++) {
    bins[key] += bins[key - 1];
  }
  // The page uploads whole lines of 1,024.
  const least = Math.ceil(found / 1024) * 1024;
  const order = message.buffer && message.buffer.byteLength >= 4 * least ? new Uint32Array(message.buffer) : new Uint32Array(Math.ceil(least * 1.25));
  for (let n = 0; n < found; n++) {
    const place = bins[keys[n]]++;
    order[message.reversed ? found - 1 - place : place] = slots[n];
  }
  const { job, version } = message;
  const ms = performance.now() - began;
  self.postMessage({ type: "order", job, version, order, count: found, near: range[0], far: range[1], ms }, [order.buffer]);
}

// Depth that so many Gaussians do not exceed.
function workerDepthAt(bins, rank, first, step) {
  let sum = 0;
  let key = 0;
  while (key < 65535 && sum + bins[key + 1] < rank) {
    sum += bins[key + 1];
    key += 1;
  }
  return new Float32Array(new Uint32Array([first + key * step]).buffer)[0];
}

// Counts in slices of a few milliseconds, so that sorts come between.
function workerSee(state, job) {
  const began = performance.now();
  const { posed, counts } = state;
  while (job.row < state.rows && performance.now() - began < 12) {
    const end = job.row * 256 + counts[job.row];
    for (let slot = job.row * 256; slot < end; slot++) {
      let sum = 0;
      for (const view of job.views) {
        const r = view.rows;
        const x = posed[4 * slot];
        const y = posed[4 * slot + 1];
        const z = posed[4 * slot + 2];
        const depth = r[8] * x + r[9] * y + r[10] * z + r[11];
        const u = view.camera.fx * (r[0] * x + r[1] * y + r[2] * z + r[3]) + (view.camera.cx + 0.5) * depth;
        const v = view.camera.fy * (r[4] * x + r[5] * y + r[6] * z + r[7]) + (view.camera.cy + 0.5) * depth;
        sum += depth > 0.05 && u >= 0 && v >= 0 && u <= view.camera.width * depth && v <= view.camera.height * depth ? 1 : 0;
      }
      job.counts[slot] = sum;
    }
    job.row += 1;
  }
  if (job.row < state.rows) {
    setTimeout(() => state.seen === job && workerSee(state, job), 0);
  } else {
    state.seen = null;
    self.postMessage({ type: "seen", version: job.version, counts: job.counts }, [job.counts.buffer]);
  }
}

function workerTake(state, message) {
  if (message.type === "put") {
    workerPut(state, message);
  } else if (message.type === "drop") {
    message.rows.forEach(row => {
      state.counts[row] = 0;
    });
  } else if (message.type === "clear") {
    state.counts.fill(0);
  } else if (message.type === "sort") {
    workerSort(state, message);
  } else if (message.type === "see") {
    state.seen = { views: message.views, version: message.version, row: 0, counts: new Uint16Array(state.rows * 256) };
    workerSee(state, state.seen);
  }
}

const WORKER_FUNCTIONS = [workerState, workerGrow, workerPut, workerCull, workerSort, workerDepthAt, workerSee, workerTake];

// The page's end of the worker. One sort is in flight at a time; others wait in order.
export class Sorter {
  constructor(reversed, onFailure) {
    this.reversed = reversed;
    this.queue = [];
    this.flying = null;
    this.spare = null;
    this.jobs = 0;
    this.seenWaiting = null;
    const source = WORKER_FUNCTIONS.map(String).join("\n") + "\nconst held = workerState();\nself.onmessage = event => workerTake(held, event.data);";
    const address = URL.createObjectURL(new Blob([source], { type: "text/javascript" }));
    this.worker = new Worker(address);
    this.worker.onmessage = event => this.take(event.data);
    this.worker.onerror = () => onFailure("The sort worker failed. Load the page anew.");
  }

  post(message, transfer = []) {
    this.worker.postMessage(message, transfer);
  }

  // Resolves with {order, count, version, near, far, ms}; hand `order` back with `recycle`.
  sort(view, version, margin = 0) {
    return new Promise(resolve => {
      this.queue.push({ view, version, margin, resolve });
      this.next();
    });
  }

  next() {
    if (this.flying || this.queue.length === 0) {
      return;
    }
    const { view, version, margin, resolve } = this.queue.shift();
    this.jobs += 1;
    this.flying = { job: this.jobs, resolve };
    const buffer = this.spare;
    this.spare = null;
    this.post({ type: "sort", job: this.jobs, view, version, margin, reversed: this.reversed, buffer }, buffer ? [buffer] : []);
  }

  recycle(order) {
    if (!this.spare || this.spare.byteLength < order.buffer.byteLength) {
      this.spare = order.buffer;
    }
  }

  // Resolves with the number of `views` that contain each slot's centre, or null where a newer call took its place.
  see(views, version) {
    if (this.seenWaiting) {
      this.seenWaiting(null);
    }
    return new Promise(resolve => {
      this.seenWaiting = resolve;
      this.post({ type: "see", views, version });
    });
  }

  take(message) {
    if (message.type === "order" && this.flying && this.flying.job === message.job) {
      const { resolve } = this.flying;
      this.flying = null;
      resolve(message);
      this.next();
    } else if (message.type === "seen" && this.seenWaiting) {
      const resolve = this.seenWaiting;
      this.seenWaiting = null;
      resolve(message);
    }
  }
}
