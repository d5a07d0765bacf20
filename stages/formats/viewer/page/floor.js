// Where a motion stands: which way is up, facing ahead, feet on the floor. As stages/avatar/motion/placing.py.
import { bonesOf, HIPS } from "hugs/skeleton";
import { legOf } from "hugs/retarget";
import * as t from "hugs/turns";

const UPS = [[0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]];
const BACK = [[0, 0, 0], [Math.PI, 0, 0], [-Math.PI / 2, 0, 0], [Math.PI / 2, 0, 0]];
const SURE = 0.8;
const FLIGHT = 0.7; // s: nobody is in the air for longer

/** The performance with y up, its first frame over the origin and looking along z; Error where none is clearly up. */
export function faceAhead({ turns, hips, leg }) {
  const mean = [0, 0, 0];
  turns.forEach((frame) => t.column(frame[0], 1).forEach((part, k) => { mean[k] += part / turns.length; }));
  const scores = UPS.map((up) => t.dot(up, mean)), best = scores.indexOf(Math.max(...scores));
  if (scores[best] <= SURE) throw new Error("it does not tell which way is up: hugs animate has --up for that");
  const upright = t.matrixOfRotvec(BACK[best]), pelvis = t.mul(upright, turns[0][0]);
  let ahead = t.cross(t.column(pelvis, 0), [0, 1, 0]);
  if (t.length(ahead) < 0.1) ahead = t.column(pelvis, 2);
  const turn = t.mul(t.matrixOfRotvec([0, -Math.atan2(ahead[0], ahead[2]), 0]), upright);
  const moved = hips.map((place) => t.apply(turn, place)), [x, , z] = moved[0];
  return {
    turns: turns.map(([root, ...rest]) => [t.mul(turn, root), ...rest]),
    hips: moved.map((place) => [place[0] - x, place[1], place[2] - z]),
    leg,
  };
}

/** Rotation vectors [72 a frame] and steps of the body [3 a frame] m, y up, a sole on the floor or over it.
 * `soles`: points at rest [3 each] and their weights [24 each]. */
export function onFloor({ turns, hips, leg }, fps, soles, joints, parents) {
  const rest = Array.from({ length: 24 }, (_, i) => t.row(joints, i)), grown = legOf(rest) / leg;
  const rotvecs = new Float32Array(72 * turns.length), steps = new Float32Array(3 * turns.length), lowest = [];
  turns.forEach((frame, f) => {
    const quats = frame.map(t.quatOfMatrix);
    quats.forEach((quat, k) => rotvecs.set(t.rotvecOfQuat(quat), 72 * f + 3 * k));
    const bones = bonesOf(quats, joints, parents);
    const step = t.sub(t.scale(hips[f], grown), t.middle(bones.places[HIPS[0]], bones.places[HIPS[1]]));
    steps.set(step, 3 * f);
    lowest.push(soleOf(bones, soles) + step[1]);
  });
  opening(lowest, 1 + 2 * Math.floor(FLIGHT * fps / 2)).forEach((height, f) => { steps[3 * f + 1] -= height; });
  return { rotvecs, steps };
}

/** The height of the lowest point of the posed soles. */
function soleOf({ turns, shifts }, { points, weights }) {
  let low = Infinity;
  for (let i = 0; i < points.length / 3; i++) {
    const [x, y, z] = t.row(points, i);
    let height = 0;
    for (let k = 0; k < 24; k++) {
      const w = weights[24 * i + k];
      if (w) height += w * (turns[k][3] * x + turns[k][4] * y + turns[k][5] * z + shifts[k][1]);
    }
    low = Math.min(low, height);
  }
  return low;
}

/** Grey opening: the lowest of each window, then the highest of those; the ends go on as they are. */
export function opening(values, size) {
  const half = (size - 1) / 2, end = values.length - 1;
  const slide = (from, pick) => from.map((_, i) => {
    let best = from[i];
    for (let k = i - half; k <= i + half; k++) best = pick(best, from[Math.max(0, Math.min(end, k))]);
    return best;
  });
  return slide(slide(values, Math.min), Math.max);
}
