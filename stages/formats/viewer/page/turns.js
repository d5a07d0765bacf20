// Rotations as arrays of nine numbers, row by row; vectors as arrays of three. Plain numbers, no library.

export const IDENTITY = [1, 0, 0, 0, 1, 0, 0, 0, 1];

export const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
export const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const scale = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const length = (a) => Math.hypot(a[0], a[1], a[2]);
export const unit = (a) => scale(a, 1 / length(a));
export const middle = (a, b) => scale(add(a, b), 0.5);
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
/** From the least to the largest of numbers. */
export const span = (values) => values.reduce((a, b) => Math.max(a, b)) - values.reduce((a, b) => Math.min(a, b));
/** The i-th row of three in a flat array. */
export const row = (flat, i) => [flat[3 * i], flat[3 * i + 1], flat[3 * i + 2]];

export function mul(a, b) {
  const out = new Array(9);
  for (let i = 0; i < 9; i += 3) {
    for (let j = 0; j < 3; j++) out[i + j] = a[i] * b[j] + a[i + 1] * b[3 + j] + a[i + 2] * b[6 + j];
  }
  return out;
}

export const transpose = (m) => [m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]];
export const apply = (m, v) => [
  m[0] * v[0] + m[1] * v[1] + m[2] * v[2],
  m[3] * v[0] + m[4] * v[1] + m[5] * v[2],
  m[6] * v[0] + m[7] * v[1] + m[8] * v[2],
];
export const column = (m, j) => [m[j], m[3 + j], m[6 + j]];
export const fromColumns = (a, b, c) => [a[0], b[0], c[0], a[1], b[1], c[1], a[2], b[2], c[2]];

/** Quaternion x y z w of a rotation vector in radians. */
export function quatOfRotvec([x, y, z]) {
  const angle = Math.hypot(x, y, z);
  const s = angle < 1e-6 ? 0.5 : Math.sin(angle / 2) / angle;
  return [x * s, y * s, z * s, Math.cos(angle / 2)];
}

/** Rotation vector of length at most pi of a unit quaternion. */
export function rotvecOfQuat(q) {
  const [x, y, z, w] = q[3] < 0 ? q.map((part) => -part) : q;
  const sine = Math.hypot(x, y, z);
  const s = sine < 1e-9 ? 2 : 2 * Math.atan2(sine, w) / sine;
  return [x * s, y * s, z * s];
}

export function matrixOfQuat([x, y, z, w]) {
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
    2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
  ];
}

export function quatOfMatrix(m) {
  const squares = [1 + m[0] - m[4] - m[8], 1 - m[0] + m[4] - m[8], 1 - m[0] - m[4] + m[8], 1 + m[0] + m[4] + m[8]];
  const largest = squares.indexOf(Math.max(...squares));
  const rows = [
    [squares[0], m[1] + m[3], m[2] + m[6], m[7] - m[5]],
    [m[1] + m[3], squares[1], m[5] + m[7], m[2] - m[6]],
    [m[2] + m[6], m[5] + m[7], squares[2], m[3] - m[1]],
    [m[7] - m[5], m[2] - m[6], m[3] - m[1], squares[3]],
  ];
  const q = rows[largest], norm = Math.hypot(...q);
  return q.map((part) => part / norm);
}

export const matrixOfRotvec = (v) => matrixOfQuat(quatOfRotvec(v));
export const rotvecOfMatrix = (m) => rotvecOfQuat(quatOfMatrix(m));

/** Between two quaternions, turning evenly and the short way. */
export function slerp(a, b, share) {
  let cosine = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3];
  const sign = cosine < 0 ? -1 : 1;
  cosine *= sign;
  const angle = Math.acos(Math.min(1, cosine));
  const near = angle < 1e-6;
  const s = near ? 1 - share : Math.sin((1 - share) * angle) / Math.sin(angle);
  const t = sign * (near ? share : Math.sin(share * angle) / Math.sin(angle));
  const q = a.map((part, i) => s * part + t * b[i]), norm = Math.hypot(...q);
  return q.map((part) => part / norm);
}

/** The smallest rotation that takes direction `a` to direction `b`; a half turn about some axis across where they oppose. */
export function turnBetween(a, b) {
  a = unit(a);
  b = unit(b);
  const sum = add(a, b), long = length(sum);
  let between;
  if (long < 1e-9) {
    const axis = [0, 0, 0];
    axis[a.map(Math.abs).indexOf(Math.min(...a.map(Math.abs)))] = 1;
    between = unit(cross(a, axis));
  } else between = scale(sum, 1 / long);
  return mul(halfTurn(between), halfTurn(a));
}

const halfTurn = (v) => [
  2 * v[0] * v[0] - 1, 2 * v[0] * v[1], 2 * v[0] * v[2],
  2 * v[1] * v[0], 2 * v[1] * v[1] - 1, 2 * v[1] * v[2],
  2 * v[2] * v[0], 2 * v[2] * v[1], 2 * v[2] * v[2] - 1,
];
