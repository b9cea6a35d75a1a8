// Lines over the map: frusta, loop edges, path and truth, and the current camera.

import { LINE_VERTEX, LINE_FRAGMENT } from "./shaders.js";
import { linkProgram, useView } from "./splats.js";
import { frustumEdges } from "./scene.js";

export const LINE_COLORS = {
  keyframe: [122, 182, 255, 200],
  chosen: [255, 196, 64, 255],
  marked: [110, 231, 150, 255],
  loop: [232, 121, 200, 170],
  truth: [176, 182, 190, 190],
  plain: [240, 240, 240, 220],
  current: [255, 112, 67, 255],
  lost: [239, 68, 68, 255],
};

// From small to large errors.
export const ERROR_STOPS = [[64, 196, 140], [226, 214, 84], [238, 128, 56], [216, 48, 72]];

export function errorColor(share) {
  const at = Math.min(1, Math.max(0, share)) * (ERROR_STOPS.length - 1);
  const first = Math.min(ERROR_STOPS.length - 2, Math.floor(at));
  return ERROR_STOPS[first].map((v, i) => Math.round(v + (ERROR_STOPS[first + 1][i] - v) * (at - first)));
}

// Six numbers and a colour a segment, in one buffer that is used again.
const SEGMENT_BYTES = 28;

class Segments {
  constructor() {
    this.count = 0;
    this.room(256);
  }

  room(count) {
    const bytes = new Uint8Array(count * SEGMENT_BYTES);
    if (this.bytes) {
      bytes.set(this.bytes);
    }
    this.bytes = bytes;
    this.floats = new Float32Array(bytes.buffer);
  }

  add(a, b, color) {
    if ((this.count + 1) * SEGMENT_BYTES > this.bytes.length) {
      this.room(2 * this.count);
    }
    this.floats.set([a[0], a[1], a[2], b[0], b[1], b[2]], this.count * 7);
    this.bytes.set(color, this.count * SEGMENT_BYTES + 24);
    this.count += 1;
  }
}

export class Lines {
  constructor(gl) {
    this.segments = new Segments();
    this.restore(gl);
  }

  // Makes the GPU's part, at first and after a lost context.
  restore(gl) {
    this.gl = gl;
    this.line = linkProgram(gl, LINE_VERTEX, LINE_FRAGMENT);
    this.buffer = gl.createBuffer();
    this.array = gl.createVertexArray();
    gl.bindVertexArray(this.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffer);
    [[0, 3, gl.FLOAT, false, 0], [1, 3, gl.FLOAT, false, 12], [2, 4, gl.UNSIGNED_BYTE, true, 24]].forEach(([place, size, kind, unit, offset]) => {
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, size, kind, unit, SEGMENT_BYTES, offset);
      gl.vertexAttribDivisor(place, 1);
    });
    this.key = "";
  }

  // Gathers segments anew where what they show has changed. `layers` has which are on; `chosen` and `marked` name keyframes.
  update(scene, store, layers, chosen, marked) {
    const key = [scene.revision, store.gaussians > 0, chosen, marked ? [...marked].join() : "", ...Object.values(layers)].join(";");
    if (key === this.key) {
      return;
    }
    this.key = key;
    this.segments.count = 0;
    if (layers.truth) {
      this.addTrack(scene.truth, LINE_COLORS.truth);
    }
    if (layers.path) {
      this.addPath(scene);
    }
    if (layers.loops) {
      for (const [a, b] of scene.loops) {
        if (scene.keyframes.has(a) && scene.keyframes.has(b)) {
          this.segments.add(scene.keyframes.get(a).p, scene.keyframes.get(b).p, LINE_COLORS.loop);
        }
      }
    }
    this.addFrusta(scene, scene.frustumSize(store), layers, chosen, marked);
    const gl = this.gl;
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffer);
    gl.bufferData(gl.ARRAY_BUFFER, this.segments.bytes.subarray(0, this.segments.count * SEGMENT_BYTES), gl.DYNAMIC_DRAW);
  }

  addFrusta(scene, size, layers, chosen, marked) {
    const add = (pose, color, depth) => {
      for (const [a, b] of frustumEdges(pose, scene.camera, depth)) {
        this.segments.add(a, b, color);
      }
    };
    for (const keyframe of scene.keyframes.values()) {
      const isMarked = marked && marked.has(keyframe.id);
      if (layers.keyframes || isMarked) {
        const color = keyframe.id === chosen ? LINE_COLORS.chosen : isMarked ? LINE_COLORS.marked : LINE_COLORS.keyframe;
        add(keyframe, color, size);
      }
    }
    if (layers.current && scene.current) {
      add(scene.current, scene.current.lost ? LINE_COLORS.lost : LINE_COLORS.current, 1.5 * size);
    }
  }

  addTrack(points, color) {
    for (let i = 1; i < points.length; i++) {
      this.segments.add(points[i - 1], points[i], color);
    }
  }

  // A pose without a known error takes that of the last one with it.
  addPath(scene) {
    const range = scene.errorRange();
    let error = null;
    for (let i = 1; i < scene.path.length; i++) {
      const [, ax, ay, az] = scene.path[i - 1];
      const [, bx, by, bz, known] = scene.path[i];
      error = Number.isFinite(known) ? known : error;
      const color = range !== null && error !== null ? [...errorColor(error / range), 255] : LINE_COLORS.plain;
      this.segments.add([ax, ay, az], [bx, by, bz], color);
    }
  }

  draw(view, width, fade) {
    const gl = this.gl;
    if (this.segments.count === 0) {
      return;
    }
    const { program, places } = this.line;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, view.camera.width, view.camera.height);
    gl.useProgram(program);
    useView(gl, places, view);
    gl.uniform1f(places.width, width);
    gl.uniform1f(places.fade, fade);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ZERO, gl.ONE);
    gl.bindVertexArray(this.array);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.segments.count);
    gl.disable(gl.BLEND);
  }
}
