// What the user brings: a motion, performed where people stand, or a face.
import { parseBvh } from "hugs/bvh";
import { Capture } from "hugs/capture";
import { faceAhead, onFloor } from "hugs/floor";
import { Motion } from "hugs/motion";
import { mapBody } from "hugs/names";
import { retarget } from "hugs/retarget";
import { add, apply, matrixOfRotvec, mul, row, rotvecOfMatrix, sub } from "hugs/turns";

const LARGEST = 64e6; // bytes

/** What a dropped file holds: a motion, performed by each of the people, or a Capture of a face; Error in words that a user can act on. */
export async function readDropped(file, people) {
  const face = /\.csv$/i.test(file.name);
  if (!face && !/\.bvh$/i.test(file.name)) throw new Error(`${file.name} is no BVH; hugs animate also takes .npz`);
  if (file.size > LARGEST) throw new Error(`${file.name} is larger than ${LARGEST / 1e6} MB`);
  try {
    if (face && !people.some((person) => person.face)) throw new Error("nobody here has a face that moves");
    const text = await file.text();
    if (face) return new Capture(text);
    const tracks = people.map((person) => performed(text, person));
    tracks.forEach(({ rotvecs, steps }, who) => stood(rotvecs, steps, people[who].stand, row(people[who].joints, 0)));
    const name = file.name.replace(/\.bvh$/i, ""), said = tracks[0].said;
    return new Motion(said ? `${name} (${said})` : name, tracks[0].fps, tracks);
  } catch (error) {
    throw new Error(`${file.name}: ${error.message}`);
  }
}

/** A BVH's motion by a body {joints, parents, soles, hands}: y up, floor at 0, the first frame over the origin. */
export function performed(text, { joints, parents, soles, hands: fingers }) {
  const bvh = parseBvh(text), { hands, broken, left, ...body } = retarget(bvh, mapBody(bvh), joints, parents, fingers);
  const lost = left ? "fingers left out: this avatar has none" : broken ? `${broken} finger bones left out` : "";
  const said = [bvh.said, lost].filter(Boolean).join(", ");
  return { ...onFloor(faceAhead(body), bvh.fps, soles, joints, parents), hands, fps: bvh.fps, said };
}

/** Take a motion, in place, to where the person stood: `turn` [9] to the clip's world, `spot` [3] m on its floor. */
function stood(rotvecs, steps, { turn, spot }, pelvis) {
  for (let f = 0; f < steps.length / 3; f++) {
    rotvecs.set(rotvecOfMatrix(mul(turn, matrixOfRotvec(row(rotvecs, 24 * f)))), 72 * f);
    steps.set(sub(add(spot, apply(turn, add(row(steps, f), pelvis))), pelvis), 3 * f);
  }
}
