// A motion that the user brings, performed where people stand.
import { parseBvh } from "hugs/bvh";
import { faceAhead, onFloor } from "hugs/floor";
import { Motion } from "hugs/motion";
import { mapBody } from "hugs/names";
import { retarget } from "hugs/retarget";
import { add, apply, matrixOfRotvec, mul, row, rotvecOfMatrix, sub } from "hugs/turns";

const LARGEST = 64e6; // bytes

/** The motion of a dropped file, performed by each of the people; Error in words that a user can act on. */
export async function readMotion(file, people) {
  if (!/\.bvh$/i.test(file.name)) throw new Error(`${file.name} is no BVH; hugs animate also takes .npz`);
  if (file.size > LARGEST) throw new Error(`${file.name} is larger than ${LARGEST / 1e6} MB`);
  try {
    const text = await file.text(), tracks = people.map((person) => performed(text, person));
    tracks.forEach(({ rotvecs, steps }, who) => stood(rotvecs, steps, people[who].stand, row(people[who].joints, 0)));
    const name = file.name.replace(/\.bvh$/i, ""), said = tracks[0].said;
    return new Motion(said ? `${name} (${said})` : name, tracks[0].fps, tracks);
  } catch (error) {
    throw new Error(`${file.name}: ${error.message}`);
  }
}

/** A BVH's motion by a body {joints, parents, soles}: y up, floor at 0, the first frame over the origin. */
export function performed(text, { joints, parents, soles }) {
  const bvh = parseBvh(text), performance = faceAhead(retarget(bvh, mapBody(bvh), joints, parents));
  return { ...onFloor(performance, bvh.fps, soles, joints, parents), fps: bvh.fps, said: bvh.said };
}

/** Take a motion, in place, to where the person stood: `turn` [9] to the clip's world, `spot` [3] m on its floor. */
function stood(rotvecs, steps, { turn, spot }, pelvis) {
  for (let f = 0; f < steps.length / 3; f++) {
    rotvecs.set(rotvecOfMatrix(mul(turn, matrixOfRotvec(row(rotvecs, 24 * f)))), 72 * f);
    steps.set(sub(add(spot, apply(turn, add(row(steps, f), pelvis))), pelvis), 3 * f);
  }
}
