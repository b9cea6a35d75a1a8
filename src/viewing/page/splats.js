// Draws Gaussians with WebGL2: textures of the map, projection, blending into a target, and the way from there to canvas or memory.

import { SCREEN_VERTEX, PROJECT_FRAGMENT, SPLAT_VERTEX, SPLAT_FRAGMENT, RESOLVE_FRAGMENT, BATCH_QUADS } from "./shaders.js";
import { TEXTURE_SLOTS } from "./map_store.js";

export const SHOWN_COLOR = 0;
export const SHOWN_DEPTH = 1;
export const SHOWN_SEEN = 2;
const FENCE_POLL_MS = 4;

export function openGl(canvas) {
  return canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false, stencil: false, powerPreference: "high-performance" });
}

// Whether pictures can be blended in half floats; then nearest first, else farthest first in bytes.
export function blendsFloats(gl) {
  return Boolean(gl.getExtension("EXT_color_buffer_float") || gl.getExtension("EXT_color_buffer_half_float"));
}

export function linkProgram(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
    gl.deleteShader(shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
    const logs = gl.getAttachedShaders(program).map(shader => gl.getShaderInfoLog(shader)).join(" ");
    throw new Error(`A shader does not build: ${gl.getProgramInfoLog(program)} ${logs}`);
  }
  const places = {};
  const count = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS) || 0;
  for (let i = 0; i < count; i++) {
    const name = gl.getActiveUniform(program, i).name.replace("[0]", "");
    places[name] = gl.getUniformLocation(program, name);
  }
  return { program, places };
}

export function useView(gl, places, view) {
  const c = view.camera;
  gl.uniform4fv(places.rows, view.rows);
  gl.uniform4f(places.intrinsics, c.fx, c.fy, c.cx, c.cy);
  gl.uniform2f(places.size, c.width, c.height);
}

export class SplatRenderer {
  constructor(gl, store) {
    this.gl = gl;
    this.store = store;
    this.floats = blendsFloats(gl);
    this.largest = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    this.project = linkProgram(gl, SCREEN_VERTEX, PROJECT_FRAGMENT);
    this.splat = linkProgram(gl, SPLAT_VERTEX, SPLAT_FRAGMENT);
    this.resolveProgram = linkProgram(gl, SCREEN_VERTEX, RESOLVE_FRAGMENT);
    this.orders = {};
    this.targets = {};
    this.lines = -1;
    this.degree = -1;
    this.emptyArray = gl.createVertexArray();
    this.batch = this.makeBatch();
    gl.disable(gl.DEPTH_TEST);
    gl.disable(gl.DITHER);
  }

  texture(format, width, height, filter = this.gl.NEAREST) {
    const gl = this.gl;
    const made = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, made);
    gl.texStorage2D(gl.TEXTURE_2D, 1, format, Math.max(1, width), Math.max(1, height));
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) {
      gl.texParameteri(gl.TEXTURE_2D, side, filter);
    }
    for (const axis of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) {
      gl.texParameteri(gl.TEXTURE_2D, axis, gl.CLAMP_TO_EDGE);
    }
    return made;
  }

  framebuffer(...textures) {
    const gl = this.gl;
    const made = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, made);
    textures.forEach((texture, i) => gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + i, gl.TEXTURE_2D, texture, 0));
    gl.drawBuffers(textures.map((_, i) => gl.COLOR_ATTACHMENT0 + i));
    return made;
  }

  // Makes the textures as large as the store, and drops the old ones.
  fitTextures() {
    const gl = this.gl;
    const { lines, degree } = this.store;
    if (lines === this.lines && degree === this.degree) {
      return;
    }
    if (lines > this.largest || TEXTURE_SLOTS * degree > this.largest) {
      throw new Error(`The map has more Gaussians than this graphics adapter's textures hold (${this.largest * TEXTURE_SLOTS}).`);
    }
    for (const old of [this.base, this.harmonics, this.seen, this.shapes, this.paints]) {
      gl.deleteTexture(old || null);
    }
    gl.deleteFramebuffer(this.projected || null);
    this.base = this.texture(gl.RGBA32UI, TEXTURE_SLOTS * 2, lines);
    this.harmonics = this.texture(gl.RGBA32UI, degree > 0 ? TEXTURE_SLOTS * degree : 1, degree > 0 ? lines : 1);
    this.seen = this.texture(gl.R16UI, TEXTURE_SLOTS, lines);
    this.shapes = this.texture(gl.RGBA32UI, TEXTURE_SLOTS, lines);
    this.paints = this.texture(gl.RGBA32UI, TEXTURE_SLOTS, lines);
    this.projected = this.framebuffer(this.shapes, this.paints);
    this.lines = lines;
    this.degree = degree;
    this.store.markAll();
  }

  // Brings changed lines of the store onto the adapter.
  upload() {
    const gl = this.gl;
    const store = this.store;
    this.fitTextures();
    const send = (texture, words, texels, first, end) => {
      const width = TEXTURE_SLOTS * texels;
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, first, width, end - first, gl.RGBA_INTEGER, gl.UNSIGNED_INT, words, first * width * 4);
    };
    this.linesUsed = store.linesUsed;
    store.takeDirty((first, end) => {
      send(this.base, store.base, 2, first, end);
      if (store.degree > 0) {
        send(this.harmonics, store.harmonics, store.degree, first, end);
      }
    });
  }

  uploadSeen(counts) {
    const gl = this.gl;
    const lines = Math.min(this.lines, Math.floor(counts.length / TEXTURE_SLOTS));
    if (lines > 0) {
      gl.bindTexture(gl.TEXTURE_2D, this.seen);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, TEXTURE_SLOTS, lines, gl.RED_INTEGER, gl.UNSIGNED_SHORT, counts);
    }
  }

  // Holds an order of slots under a name, in a texture as wide as the others.
  setOrder(name, slots, count) {
    const gl = this.gl;
    const lines = Math.ceil(count / TEXTURE_SLOTS);
    let order = this.orders[name];
    if (!order || order.lines < lines) {
      gl.deleteTexture(order ? order.texture : null);
      const room = Math.ceil(lines * 1.25) + 1;
      order = { texture: this.texture(gl.R32UI, TEXTURE_SLOTS, room), lines: room, count: 0 };
      this.orders[name] = order;
    }
    gl.bindTexture(gl.TEXTURE_2D, order.texture);
    if (lines > 0) {
      // Whole lines: the worker's arrays have room for them.
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, TEXTURE_SLOTS, lines, gl.RED_INTEGER, gl.UNSIGNED_INT, slots);
    }
    order.count = count;
  }

  // Corners of a batch of quads as two triangles each.
  makeBatch() {
    const gl = this.gl;
    const indices = new Uint16Array(6 * BATCH_QUADS);
    for (let quad = 0; quad < BATCH_QUADS; quad++) {
      indices.set([0, 1, 2, 2, 1, 3].map(corner => 4 * quad + corner), 6 * quad);
    }
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, indices, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    return array;
  }

  target(name, width, height) {
    const gl = this.gl;
    const old = this.targets[name];
    if (old && old.width === width && old.height === height) {
      return old;
    }
    if (old) {
      gl.deleteTexture(old.texture);
      gl.deleteFramebuffer(old.framebuffer);
    }
    const bytes = name === "bytes" || !this.floats;
    const texture = this.texture(bytes ? gl.RGBA8 : gl.RGBA16F, width, height, gl.LINEAR);
    this.targets[name] = { texture, framebuffer: this.framebuffer(texture), width, height };
    return this.targets[name];
  }

  // Blends the order `name` into the target `name`; the first row is the topmost.
  blend(name, view, shown, range) {
    const gl = this.gl;
    const order = this.orders[name];
    const { width, height } = view.camera;
    const target = this.target(name, width, height);
    if (order && order.count > 0) {
      this.projectAll(view, shown, range);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.framebuffer);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    if (!order || order.count === 0) {
      return;
    }
    const { program, places } = this.splat;
    gl.useProgram(program);
    gl.uniform2f(places.size, width, height);
    this.bind(0, this.shapes, places.shapes);
    this.bind(1, this.paints, places.paints);
    this.bind(2, order.texture, places.order);
    gl.uniform1i(places.count, order.count);
    gl.enable(gl.BLEND);
    // The target's alpha is the transmittance: half floats keep its small values, where 1 - α would drown.
    gl.blendFuncSeparate(this.floats ? gl.DST_ALPHA : gl.ONE, this.floats ? gl.ONE : gl.ONE_MINUS_SRC_ALPHA, gl.ZERO, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(this.batch);
    gl.drawElementsInstanced(gl.TRIANGLES, 6 * BATCH_QUADS, gl.UNSIGNED_SHORT, 0, Math.ceil(order.count / BATCH_QUADS));
    gl.disable(gl.BLEND);
  }

  bind(unit, texture, place) {
    const gl = this.gl;
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.uniform1i(place, unit);
    gl.activeTexture(gl.TEXTURE0);
  }

  projectAll(view, shown, range) {
    const gl = this.gl;
    const { program, places } = this.project;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.projected);
    gl.viewport(0, 0, TEXTURE_SLOTS, Math.min(this.lines, this.linesUsed));
    gl.useProgram(program);
    useView(gl, places, view);
    gl.uniform3fv(places.center, view.center);
    gl.uniform4fv(places.bounds, view.bounds);
    gl.uniform1i(places.degree, this.degree);
    gl.uniform1f(places.antialiased, this.store.antialiased ? 1 : 0);
    gl.uniform1i(places.shown, shown);
    gl.uniform2f(places.range, range[0], 1 / Math.max(range[1] - range[0], 1e-6));
    this.bind(0, this.base, places.base);
    this.bind(1, this.harmonics, places.harmonics);
    this.bind(2, this.seen, places.seen);
    gl.bindVertexArray(this.emptyArray);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // Puts a target onto the canvas (`to` null) or into bytes.
  resolve(name, to, width, height, background, ramped) {
    const gl = this.gl;
    const { program, places } = this.resolveProgram;
    const target = this.targets[name];
    gl.bindFramebuffer(gl.FRAMEBUFFER, to ? to.framebuffer : null);
    gl.viewport(0, 0, width, height);
    gl.useProgram(program);
    gl.uniform2f(places.size, width, height);
    gl.uniform3fv(places.background, background);
    gl.uniform1i(places.flipped, to ? 0 : 1);
    gl.uniform1i(places.ramped, ramped ? 1 : 0);
    this.bind(0, target.texture, places.blended);
    gl.bindVertexArray(this.emptyArray);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // The target's colours as bytes, rows from the top; null where the context is lost meanwhile. The page goes on while the adapter draws.
  async readBytes(name, width, height) {
    const gl = this.gl;
    const bytes = this.target("bytes", width, height);
    this.resolve(name, bytes, width, height, [0, 0, 0], false);
    const rgba = new Uint8Array(4 * width * height);
    const buffer = gl.createBuffer();
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, buffer);
    gl.bufferData(gl.PIXEL_PACK_BUFFER, rgba.length, gl.STREAM_READ);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, 0);
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, null);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    const done = await this.signalled();
    if (done) {
      gl.bindBuffer(gl.PIXEL_PACK_BUFFER, buffer);
      gl.getBufferSubData(gl.PIXEL_PACK_BUFFER, 0, rgba);
      gl.bindBuffer(gl.PIXEL_PACK_BUFFER, null);
    }
    gl.deleteBuffer(buffer);
    return done ? rgba : null;
  }

  // Whether the adapter has done all that was asked up to now; false where its context is lost first.
  async signalled() {
    const gl = this.gl;
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    while (!gl.isContextLost()) {
      await new Promise(resolve => setTimeout(resolve, FENCE_POLL_MS));
      if (fence === null || gl.getSyncParameter(fence, gl.SYNC_STATUS) === gl.SIGNALED) {
        gl.deleteSync(fence);
        return !gl.isContextLost();
      }
    }
    return false;
  }

  // Sum and transmittance of one pixel of a target.
  readPixel(name, x, y) {
    const gl = this.gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.targets[name].framebuffer);
    const four = this.floats ? new Float32Array(4) : new Uint8Array(4);
    gl.readPixels(x, y, 1, 1, gl.RGBA, this.floats ? gl.FLOAT : gl.UNSIGNED_BYTE, four);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    return this.floats ? Array.from(four) : Array.from(four, v => v / 255);
  }
}
