// SMPL's skeleton: which joint is which, and where the bones go in a pose.
import { add, apply, matrixOfQuat, mul, quatOfRotvec, row, sub } from "hugs/turns";

export const HIPS = [1, 2], SPINE = [3, 6, 9], KNEES = [4, 5], ANKLES = [7, 8], FEET = [10, 11], NECK = 12;
export const COLLARS = [13, 14], HEAD = 15, SHOULDERS = [16, 17], ELBOWS = [18, 19], WRISTS = [20, 21], HANDS = [22, 23];
export const PARTS = `pelvis left_hip right_hip spine1 left_knee right_knee spine2 left_ankle right_ankle spine3 left_foot
  right_foot neck left_collar right_collar head left_shoulder right_shoulder left_elbow right_elbow left_wrist right_wrist
  left_hand right_hand`.split(/\s+/);

/** Joint at which a limb's bone begins -> joint at its end. */
export const LIMBS = Object.fromEntries([0, 1].flatMap((side) => [
  [HIPS[side], KNEES[side]], [KNEES[side], ANKLES[side]],
  [SHOULDERS[side], ELBOWS[side]], [ELBOWS[side], WRISTS[side]],
]));

/** Quaternions of rotation vectors [3 each]. */
export const quatsOf = (rotvecs) => Array.from({ length: rotvecs.length / 3 }, (_, joint) => quatOfRotvec(row(rotvecs, joint)));

/** Of each bone its turn and shift from rest to the pose, without the step, and where its joint is. */
export function bonesOf(quats, joints, parents) {
  const turns = [], places = [], shifts = [];
  quats.forEach((quat, joint) => {
    const local = matrixOfQuat(quat), rest = row(joints, joint), parent = parents[joint];
    if (parent < 0) {
      turns.push(local);
      places.push(rest);
    } else {
      turns.push(mul(turns[parent], local));
      places.push(add(places[parent], apply(turns[parent], sub(rest, row(joints, parent)))));
    }
    shifts.push(sub(places[joint], apply(turns[joint], rest)));
  });
  return { turns, shifts, places };
}
