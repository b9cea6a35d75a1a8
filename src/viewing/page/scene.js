// What is known of the recording beside the map: keyframes, loops, path, current camera; and what follows from it for the view.

import { add3, sub3, scale3, dot3, length3, unit3, axesOf, quatLooking, quatUnit, quantile, fittedCamera, viewOf, toPixel, toCamera, NEAR_METRES } from "./math.js";

// The camera of free views where the recording's is not known: 60 degrees wide.
const PLAIN_CAMERA = { width: 640, height: 480, fx: 554, fy: 554, cx: 319.5, cy: 239.5 };

export class Scene {
  constructor() {
    this.forget();
  }

  forget() {
    this.hello = null;
    this.keyframes = new Map();
    this.loops = [];
    this.current = null;
    this.path = [];
    this.truth = [];
    // Grows with each change of what lines are drawn from.
    this.revision = (this.revision || 0) + 1;
    this.measured = null;
  }

  get camera() {
    return (this.hello && this.hello.camera) || PLAIN_CAMERA;
  }

  get units() {
    return this.hello ? this.hello.units : "metres";
  }

  takePoses(message) {
    if (message.all) {
      this.keyframes.clear();
    }
    for (const { id, frame, t, p, q } of message.keyframes) {
      this.keyframes.set(id, { id, frame, t, p: p.slice(0, 3), q: quatUnit(q.slice(0, 4)) });
    }
    if (message.loops) {
      this.loops = message.loops;
    }
    if (message.current) {
      const { frame, p, q, lost } = message.current;
      // A lost frame may come without a pose: the last one stays in sight.
      const pose = p && q ? { p: p.slice(0, 3), q: quatUnit(q.slice(0, 4)) } : this.current;
      this.current = pose ? { frame, p: pose.p, q: pose.q, lost: lost === true } : null;
    }
    this.changed();
  }

  takePath(message) {
    this.path = message.poses;
    this.truth = message.truth || [];
    this.changed();
  }

  changed() {
    this.revision += 1;
    this.measured = null;
  }

  // Ids in order.
  ids() {
    return [...this.keyframes.keys()].sort((a, b) => a - b);
  }

  // Error that the colours' range ends at.
  errorRange() {
    const errors = this.path.map(p => p[4]).filter(e => Number.isFinite(e));
    return errors.length > 0 ? Math.max(quantile(errors, 0.98), 1e-4) : null;
  }

  // The direction upward, and the size of what the cameras have passed.
  measure() {
    if (this.measured) {
      return this.measured;
    }
    const keyframes = [...this.keyframes.values()];
    const poses = keyframes.length > 0 ? keyframes : this.current ? [this.current] : [];
    let up = [0, 0, 0];
    let ahead = [0, 0, 0];
    let middle = [0, 0, 0];
    for (const pose of poses) {
      const axes = axesOf(pose.q);
      up = sub3(up, axes.down);
      ahead = add3(ahead, axes.forward);
      middle = add3(middle, scale3(pose.p, 1 / poses.length));
    }
    const spread = quantile(poses.map(pose => length3(sub3(pose.p, middle))), 0.9) || 0;
    const ids = this.ids();
    const steps = ids.slice(1).map((id, i) => length3(sub3(this.keyframes.get(id).p, this.keyframes.get(ids[i]).p)));
    const step = quantile(steps, 0.5) || 0;
    this.measured = { up: unit3(up, [0, -1, 0]), ahead: unit3(ahead, [0, 0, 1]), middle, spread, step, poses };
    return this.measured;
  }

  // Middle and radius of the map and the cameras together.
  extent(store) {
    const key = `${this.revision} ${store.version}`;
    if (this.extentKey !== key) {
      this.extentKey = key;
      this.extentKnown = this.findExtent(store);
    }
    return this.extentKnown;
  }

  findExtent(store) {
    const { middle, spread, ahead } = this.measure();
    let sum = [0, 0, 0];
    let total = 0;
    const parts = [...store.centers()];
    for (const { center, count } of parts) {
      sum = add3(sum, scale3(center, count));
      total += count;
    }
    if (total === 0) {
      const radius = Math.max(spread, 1);
      return { center: add3(middle, scale3(ahead, radius)), radius };
    }
    const center = scale3(sum, 1 / total);
    // Far stragglers must not make the scene small: the distance that 80 of 100 Gaussians keep.
    const far = parts.map(part => ({ distance: length3(sub3(part.center, center)), count: part.count })).sort((a, b) => a.distance - b.distance);
    let seen = 0;
    const inside = far.find(part => (seen += part.count) >= 0.8 * total);
    return { center, radius: Math.max(inside.distance, spread, 0.1) };
  }

  // Depth of a frustum as drawn, so that neighbours do not hide each other.
  frustumSize(store) {
    const { step } = this.measure();
    const { radius } = this.extent(store);
    return Math.min(Math.max(0.5 * step, 0.025 * radius), 0.07 * radius);
  }

  // A pose from which the scene is seen whole, from behind the cameras and a little above.
  overview(store, width, height) {
    const { up, ahead } = this.measure();
    const { center, radius } = this.extent(store);
    const level = unit3(sub3(ahead, scale3(up, dot3(ahead, up))), ahead);
    const forward = unit3(add3(scale3(level, 0.88), scale3(up, -0.42)));
    const camera = fittedCamera(this.camera, width, height);
    const q = quatLooking(forward, up);
    let distance = radius * 0.8 * Math.max(camera.fx / (0.5 * width), camera.fy / (0.5 * height)) + 0.35 * radius;
    // Farther, until the cameras are in sight too.
    for (let tries = 0; tries < 14; tries++) {
      const view = viewOf({ p: sub3(center, scale3(forward, distance)), q }, camera);
      if (this.measure().poses.every(pose => insidePicture(toPixel(view, pose.p), width, height))) {
        break;
      }
      distance *= 1.12;
    }
    return { p: sub3(center, scale3(forward, distance)), q, distance };
  }

  // Behind the current camera, so that its frustum is in sight.
  behindCurrent(store) {
    const { radius } = this.extent(store);
    const { up } = this.measure();
    const { forward } = axesOf(this.current.q);
    const back = Math.min(0.35 * radius, 4 * this.frustumSize(store) + 0.1 * radius);
    const p = add3(sub3(this.current.p, scale3(forward, back)), scale3(up, 0.25 * back));
    return { p, q: quatLooking(sub3(add3(this.current.p, scale3(forward, 2 * back)), p), up), distance: back };
  }

  // Keyframe whose frustum is nearest to a pixel, within `reach` pixels.
  pick(view, x, y, size, reach) {
    let best = null;
    let nearest = reach;
    for (const keyframe of this.keyframes.values()) {
      for (const [a, b] of frustumEdges(keyframe, this.camera, size)) {
        const pa = toPixel(view, a);
        const pb = toPixel(view, b);
        if (pa && pb) {
          const distance = distanceToSegment([x, y], pa, pb);
          if (distance < nearest) {
            nearest = distance;
            best = keyframe.id;
          }
        }
      }
    }
    return best;
  }

  // Ids of the keyframes whose frusta contain a point.
  containing(point) {
    const found = new Set();
    for (const keyframe of this.keyframes.values()) {
      const view = viewOf(keyframe, this.camera);
      const pixel = toPixel(view, point);
      if (toCamera(view, point)[2] > NEAR_METRES && pixel && pixel[0] >= -0.5 && pixel[1] >= -0.5
        && pixel[0] <= this.camera.width - 0.5 && pixel[1] <= this.camera.height - 0.5) {
        found.add(keyframe.id);
      }
    }
    return found;
  }
}

// Eight edges of a frustum of depth `size`, and one that marks the picture's upper side.
export function frustumEdges(pose, camera, size) {
  const { right, down, forward } = axesOf(pose.q);
  const corner = (px, py) => {
    const x = ((px - camera.cx) / camera.fx) * size;
    const y = ((py - camera.cy) / camera.fy) * size;
    return add3(pose.p, add3(scale3(forward, size), add3(scale3(right, x), scale3(down, y))));
  };
  const [w, h] = [camera.width - 0.5, camera.height - 0.5];
  const c = [corner(-0.5, -0.5), corner(w, -0.5), corner(w, h), corner(-0.5, h)];
  const tip = corner(0.5 * camera.width, -0.5 - 0.18 * camera.height);
  return [
    ...c.map(far => [pose.p, far]),
    ...c.map((far, i) => [far, c[(i + 1) % 4]]),
    [corner(0.35 * camera.width, -0.5), tip], [tip, corner(0.65 * camera.width, -0.5)],
  ];
}

function distanceToSegment(p, a, b) {
  const dx = b[0] - a[0];
  const dy = b[1] - a[1];
  const along = dx * dx + dy * dy > 0 ? ((p[0] - a[0]) * dx + (p[1] - a[1]) * dy) / (dx * dx + dy * dy) : 0;
  const t = Math.min(1, Math.max(0, along));
  return Math.hypot(p[0] - a[0] - t * dx, p[1] - a[1] - t * dy);
}

// Whether a pixel keeps some distance from the picture's edges.
function insidePicture(pixel, width, height) {
  return pixel !== null && pixel[0] > 0.05 * width && pixel[0] < 0.95 * width && pixel[1] > 0.08 * height && pixel[1] < 0.9 * height;
}
