// Vectors, rotations and cameras. Vectors are arrays of 3, quaternions arrays [x, y, z, w]; a pose {p, q} is world-from-camera.

export const NEAR_METRES = 0.05;
const TANGENT_MARGIN = 0.15;

export function add3(a, b) {
  return [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
}

export function sub3(a, b) {
  return [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
}

export function scale3(a, s) {
  return [a[0] * s, a[1] * s, a[2] * s];
}

export function dot3(a, b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

export function cross3(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

export function length3(a) {
  return Math.hypot(a[0], a[1], a[2]);
}

// The vector at unit length, or the fallback where it has none.
export function unit3(a, fallback = [0, 0, 1]) {
  const length = length3(a);
  return length > 1e-12 ? scale3(a, 1 / length) : fallback;
}

export function quatMultiply(a, b) {
  return [
    a[3] * b[0] + a[0] * b[3] + a[1] * b[2] - a[2] * b[1],
    a[3] * b[1] - a[0] * b[2] + a[1] * b[3] + a[2] * b[0],
    a[3] * b[2] + a[0] * b[1] - a[1] * b[0] + a[2] * b[3],
    a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2],
  ];
}

export function quatUnit(q) {
  const length = Math.hypot(q[0], q[1], q[2], q[3]);
  return length > 1e-12 ? q.map(v => v / length) : [0, 0, 0, 1];
}

export function quatAbout(axis, angle) {
  const s = Math.sin(angle / 2);
  return [axis[0] * s, axis[1] * s, axis[2] * s, Math.cos(angle / 2)];
}

export function quatRotate(q, v) {
  const u = [q[0], q[1], q[2]];
  const t = scale3(cross3(u, v), 2);
  return add3(add3(v, scale3(t, q[3])), cross3(u, t));
}

export function quatBlend(a, b, share) {
  let cosine = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3];
  const sign = cosine < 0 ? -1 : 1;
  cosine *= sign;
  let wa = 1 - share;
  let wb = share;
  if (cosine < 0.9995) {
    const angle = Math.acos(cosine);
    wa = Math.sin(wa * angle) / Math.sin(angle);
    wb = Math.sin(wb * angle) / Math.sin(angle);
  }
  return quatUnit(a.map((v, i) => wa * v + sign * wb * b[i]));
}

// Columns are the camera's axes in the world.
export function quatOfAxes(x, y, z) {
  const trace = x[0] + y[1] + z[2];
  if (trace > 0) {
    const s = 2 * Math.sqrt(trace + 1);
    return quatUnit([(y[2] - z[1]) / s, (z[0] - x[2]) / s, (x[1] - y[0]) / s, s / 4]);
  }
  if (x[0] > y[1] && x[0] > z[2]) {
    const s = 2 * Math.sqrt(1 + x[0] - y[1] - z[2]);
    return quatUnit([s / 4, (y[0] + x[1]) / s, (z[0] + x[2]) / s, (y[2] - z[1]) / s]);
  }
  if (y[1] > z[2]) {
    const s = 2 * Math.sqrt(1 + y[1] - x[0] - z[2]);
    return quatUnit([(y[0] + x[1]) / s, s / 4, (z[1] + y[2]) / s, (z[0] - x[2]) / s]);
  }
  const s = 2 * Math.sqrt(1 + z[2] - x[0] - y[1]);
  return quatUnit([(z[0] + x[2]) / s, (z[1] + y[2]) / s, s / 4, (x[1] - y[0]) / s]);
}

// Rotation of a level camera that looks along `forward`.
export function quatLooking(forward, up) {
  const z = unit3(forward);
  let x = cross3(z, up);
  if (length3(x) < 1e-4) {
    x = cross3(z, Math.abs(z[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0]);
  }
  x = unit3(x);
  return quatOfAxes(x, cross3(z, x), z);
}

export function axesOf(q) {
  return { right: quatRotate(q, [1, 0, 0]), down: quatRotate(q, [0, 1, 0]), forward: quatRotate(q, [0, 0, 1]) };
}

// The camera for a picture of another size: the centre of the top-left pixel stays (0, 0), and the whole old picture stays inside.
export function fittedCamera(camera, width, height) {
  const s = Math.min(width / camera.width, height / camera.height);
  return {
    width,
    height,
    fx: camera.fx * s,
    fy: camera.fy * s,
    cx: (camera.cx + 0.5) * s - 0.5 + (width - camera.width * s) / 2,
    cy: (camera.cy + 0.5) * s - 0.5 + (height - camera.height * s) / 2,
  };
}

export function stretchedCamera(camera, width, height) {
  const sx = width / camera.width;
  const sy = height / camera.height;
  return {
    width,
    height,
    fx: camera.fx * sx,
    fy: camera.fy * sy,
    cx: (camera.cx + 0.5) * sx - 0.5,
    cy: (camera.cy + 0.5) * sy - 0.5,
  };
}

// What a picture needs: rows of camera-from-world (rotation, translation), the centre, the camera, and the bounds on x/z and y/z.
export function viewOf(pose, camera) {
  const { right, down, forward } = axesOf(quatUnit(pose.q));
  const rows = [right, down, forward].flatMap(axis => [...axis, -dot3(axis, pose.p)]);
  const mx = TANGENT_MARGIN * camera.width;
  const my = TANGENT_MARGIN * camera.height;
  const bounds = [
    (-mx - camera.cx) / camera.fx,
    (camera.width + mx - camera.cx) / camera.fx,
    (-my - camera.cy) / camera.fy,
    (camera.height + my - camera.cy) / camera.fy,
  ];
  return { rows, center: [...pose.p], camera: { ...camera }, bounds };
}

export function sameView(a, b) {
  if (!a || !b) {
    return a === b;
  }
  return a.rows.every((v, i) => v === b.rows[i]) && Object.keys(a.camera).every(k => a.camera[k] === b.camera[k]);
}

export function toCamera(view, v) {
  const r = view.rows;
  return [
    r[0] * v[0] + r[1] * v[1] + r[2] * v[2] + r[3],
    r[4] * v[0] + r[5] * v[1] + r[6] * v[2] + r[7],
    r[8] * v[0] + r[9] * v[1] + r[10] * v[2] + r[11],
  ];
}

// Pixel of a point, or null behind the near plane.
export function toPixel(view, v) {
  const [x, y, z] = toCamera(view, v);
  const c = view.camera;
  return z > NEAR_METRES ? [(c.fx * x) / z + c.cx, (c.fy * y) / z + c.cy] : null;
}

export function clamp(v, low, high) {
  return Math.min(high, Math.max(low, v));
}

// The value below which `share` of the numbers lie; sorts them.
export function quantile(numbers, share) {
  if (numbers.length === 0) {
    return null;
  }
  numbers.sort((a, b) => a - b);
  return numbers[Math.floor(clamp(share, 0, 1) * (numbers.length - 1))];
}
