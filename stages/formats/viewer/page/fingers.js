// Fingers of a BVH: which joints they are, and how ours bend as they do.
// The same as stages/formats/motions/bvh_fingers.py and stages/avatar/motion/hands.py, which say why.
import { FINGERS } from "hugs/hands";
import { ancestors, wordsOf } from "hugs/names";
import { PARTS } from "hugs/skeleton";
import * as t from "hugs/turns";

const ORDER = ["index", "middle", "pinky", "ring", "thumb"];
const NUMBERED = ["thumb", "index", "middle", "ring", "pinky"];
const NAMES = { thumb: "thumb", index: "index", middle: "middle", mid: "middle", ring: "ring", pinky: "pinky", pinkie: "pinky", little: "pinky" };
const FINGER = new RegExp(`finger(\\d)|(${Object.keys(NAMES).join("|")})`), PALM = /inhand|metacarpal|palm/i;
const NONE = 1e-6, FARTHEST = 130 * Math.PI / 180;

/** Our bones, 0 to 29 -> the joints [start, end] of theirs. */
export function mapFingers(bvh, limbs) {
  const found = new Map(), chains = new Map();
  bvh.names.forEach((name, joint) => {
    const [side, plain] = wordsOf(name), match = FINGER.exec(plain);
    if (!side || !match || !ancestors(bvh, bvh.parents[joint]).includes(limbs[PARTS.indexOf(`${side}_wrist`)])) return;
    const key = `${side} ${match[1] ?? NAMES[match[2]]}`;
    found.set(key, [...(found.get(key) ?? []), joint]);
  });
  const first = [...found.keys()].some((key) => key.endsWith(" 0")) ? 0 : 1;
  for (const [key, joints] of found) {
    const [side, called] = key.split(" "), finger = /\d/.test(called) ? NUMBERED[called - first] : called;
    if (!finger) continue;
    const outside = joints.filter((joint) => finger === "thumb" || !PALM.test(bvh.names[joint]));
    outside.slice(0, 3).forEach((joint, part) => {
      const end = bvh.parents.indexOf(joint);
      if (end >= 0) chains.set((side === "left" ? 0 : 15) + 3 * ORDER.indexOf(finger) + part, [joint, end]);
    });
  }
  return chains;
}

/** Rotation vectors [90 a frame] of our fingers where those of a BVH stand in `frames`, the zero pose first, and how many were left
 * out. `palms` [frame][2]: turns of our hands in the world. */
export function bend(frames, reference, chains, palms, { joints, tips }) {
  const { places } = frames[reference], size = Math.max(...[0, 1, 2].map((axis) => t.span(places.map((place) => place[axis]))));
  const local = [], world = [];
  let broken = 0;
  for (let bone = 0; bone < FINGERS; bone++) {
    const above = bone % 3 ? world[bone - 1] : palms.map((both) => both[Math.floor(2 * bone / FINGERS)]);
    world[bone] = above;
    if (chains.has(bone)) {
      const [start, end] = chains.get(bone), way = t.sub(places[end], places[start]);
      const to = bone % 3 < 2 ? t.row(joints, bone + 1) : t.row(tips, (bone - 2) / 3);
      let aimed = above[reference];
      if (t.length(way) > NONE * size) aimed = t.mul(t.turnBetween(t.apply(aimed, t.sub(to, t.row(joints, bone))), way), aimed);
      const back = t.mul(t.transpose(frames[reference].turns[start]), aimed);
      world[bone] = frames.map(({ turns }) => t.mul(turns[start], back));
    }
    local[bone] = world[bone].map((turn, f) => t.rotvecOfMatrix(t.mul(t.transpose(above[f]), turn))).slice(1);
    if (median(local[bone].map(t.length)) > FARTHEST) {
      world[bone] = above;
      local[bone].fill([0, 0, 0]);
      broken++;
    }
  }
  return { hands: Float32Array.from(local[0].flatMap((_, f) => local.flatMap((turns) => turns[f]))), broken };
}

function median(values) {
  const sorted = [...values].sort((a, b) => a - b), half = sorted.length / 2;
  return (sorted[Math.ceil(half) - 1] + sorted[Math.floor(half)]) / 2;
}
