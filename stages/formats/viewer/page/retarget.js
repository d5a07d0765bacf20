// A BVH's motion on SMPL's skeleton: limbs point where they pointed, the rest turns as it turned.
// The same as stages/avatar/motion/retarget.py, which says why.
import { bend, mapFingers } from "hugs/fingers";
import { ANKLES, COLLARS, ELBOWS, FEET, HANDS, HEAD, HIPS, KNEES, LIMBS, NECK, SHOULDERS, SPINE, WRISTS } from "hugs/skeleton";
import * as t from "hugs/turns";

const STANDING = 0.7;
const FOLLOWERS = [...COLLARS, ...HIPS, ...SHOULDERS, ...KNEES, ...ELBOWS, ...ANKLES, ...WRISTS, ...FEET, ...HANDS];

/** Local turns of SMPL's joints a frame [F][24], the middle of the hips [F][3], how long the legs are, and of a body with `fingers`
 * what these do; without, how many of the file are `left` out. */
export function retarget(bvh, { limbs, pelvis, spine, neck }, joints, parents, fingers) {
  const rest = Array.from({ length: 24 }, (_, i) => t.row(joints, i));
  const still = { places: bvh.frames[0].places, turns: bvh.names.map(() => t.IDENTITY) };
  const frames = [still, ...bvh.frames].map((frame) => inTheWorld(frame, bvh.parents)); // the first: nothing is turned
  const at = frames.map(({ places }) => Object.fromEntries(Object.entries(limbs).map(([own, other]) => [own, places[other]])));
  check(at.slice(1), frames, bvh, limbs);
  const reference = referenceOf(at), standing = trunkOf(rest), bodies = at.map(trunkOf);
  const own = (joint) => {
    if (reference === 0) return bodies[0];
    const sum = new Array(9).fill(0);
    frames.slice(1).forEach(({ turns }, f) => {
      t.mul(t.transpose(turns[joint]), bodies[f + 1]).forEach((value, k) => { sum[k] += value; });
    });
    return squared(sum);
  };
  const trunk = Object.fromEntries([pelvis, ...spine, ...neck].map((joint) => [joint, t.mul(own(joint), t.transpose(standing))]));
  const world = frames.map(({ turns }) => {
    const of = (joint) => t.mul(turns[joint], trunk[joint]), out = [];
    out[0] = of(pelvis);
    const spines = [out[0], ...spine.map(of)];
    spread(spines, SPINE.length).forEach((turn, k) => { out[SPINE[k]] = turn; });
    [out[NECK], out[HEAD]] = spread([spines.at(-1), ...neck.map(of)], 2);
    return out;
  });
  const start = startOf(at[reference], world[reference], rest, parents);
  const back = Object.fromEntries(Object.entries(limbs).map(([joint, source]) =>
    [joint, t.mul(t.transpose(frames[reference].turns[source]), start[joint])]));
  world.forEach((out, f) => {
    for (const joint of FOLLOWERS) {
      const mapped = joint in limbs && !FEET.includes(joint);
      out[joint] = mapped ? t.mul(frames[f].turns[limbs[joint]], back[joint]) : out[parents[joint]];
      if (joint in LIMBS) {
        const bone = t.sub(rest[LIMBS[joint]], rest[joint]), aim = t.sub(at[f][LIMBS[joint]], at[f][joint]);
        out[joint] = t.mul(t.turnBetween(t.apply(out[joint], bone), aim), out[joint]);
      }
    }
  });
  const turns = world.slice(1).map((out) =>
    out.map((turn, joint) => (joint ? t.mul(t.transpose(out[parents[joint]]), turn) : turn)));
  const hips = at.slice(1).map((place) => t.middle(place[HIPS[0]], place[HIPS[1]]));
  const chains = mapFingers(bvh, limbs), palms = world.map((out) => HANDS.map((hand) => out[hand]));
  const bent = fingers && chains.size ? bend(frames, reference, chains, palms, fingers) : { left: chains.size };
  return { turns, hips, leg: legOf(at[reference]), ...bent };
}

/** Hip to knee to ankle, mean of both sides. */
export function legOf(at) {
  return [...HIPS, ...KNEES].reduce((sum, joint) => sum + t.length(t.sub(at[LIMBS[joint]], at[joint])), 0) / 2;
}

function inTheWorld({ places, turns }, parents) {
  const out = { places: [], turns: [] };
  parents.forEach((parent, i) => {
    out.turns.push(parent < 0 ? turns[i] : t.mul(out.turns[parent], turns[i]));
    out.places.push(parent < 0 ? places[i] : t.add(out.places[parent], t.apply(out.turns[parent], places[i])));
  });
  return out;
}

function check(at, frames, bvh, limbs) {
  let size = 0;
  for (const { places } of frames) {
    for (const axis of [0, 1, 2]) size = Math.max(size, t.span(places.map((place) => place[axis])));
  }
  for (const [a, b] of [...Object.entries(LIMBS), HIPS]) {
    if (at.some((place) => t.length(t.sub(place[b], place[a])) < 1e-6 * size)) {
      throw new Error(`${bvh.names[limbs[a]]} and ${bvh.names[limbs[b]]} stand in one place`);
    }
  }
}

/** Axes of the trunk as columns: left along the hips, up from them to the shoulders, ahead. */
function trunkOf(at) {
  const left = t.unit(t.sub(at[HIPS[0]], at[HIPS[1]]));
  const rise = t.sub(t.middle(at[SHOULDERS[0]], at[SHOULDERS[1]]), t.middle(at[HIPS[0]], at[HIPS[1]]));
  const up = t.unit(t.sub(rise, t.scale(left, t.dot(rise, left))));
  return t.fromColumns(left, up, t.cross(left, up));
}

/** The frame in which both skeletons are compared: 0, the zero pose, if it is a stand, else the most upright one. */
function referenceOf(at) {
  const scores = at.map((place) => {
    const up = t.column(trunkOf(place), 1), bone = (joint) => t.unit(t.sub(place[LIMBS[joint]], place[joint]));
    const legs = [...HIPS, ...KNEES].reduce((sum, joint) => sum - t.dot(bone(joint), up), 0) / 4;
    const arms = [0, 1].reduce((sum, side) => sum + t.dot(bone(SHOULDERS[side]), bone(ELBOWS[side])), 0) / 2;
    return { legs, both: legs + 0.5 * arms };
  });
  if (scores[0].legs > STANDING) return 0;
  let best = 1;
  scores.forEach(({ both }, f) => { if (f > 0 && both > scores[best].both) best = f; });
  return best;
}

/** How SMPL's joints are turned in the reference pose: the trunk as given, limbs without any twist. */
function startOf(at, world, rest, parents) {
  const start = {};
  for (const joint of [0, ...SPINE, NECK, HEAD]) start[joint] = world[joint];
  for (let joint = 1; joint < 24; joint++) {
    const above = start[parents[joint]], toe = FEET[ANKLES.indexOf(joint)];
    if (joint in LIMBS) {
      const bone = t.sub(rest[LIMBS[joint]], rest[joint]);
      start[joint] = t.mul(t.turnBetween(t.apply(above, bone), t.sub(at[LIMBS[joint]], at[joint])), above);
    } else if (ANKLES.includes(joint) && at[toe]) {
      const level = ([x, , z]) => [x, 0, z], seen = t.apply(t.transpose(above), t.sub(at[toe], at[joint]));
      start[joint] = t.mul(above, t.turnBetween(level(t.sub(rest[toe], rest[joint])), level(seen)));
    } else start[joint] ??= above;
  }
  return start;
}

/** The rotation by right angles nearest to a matrix. */
function squared(m) {
  let best = null, most = -Infinity;
  for (const [a, b] of [[0, 1], [0, 2], [1, 0], [1, 2], [2, 0], [2, 1]]) {
    for (const [sa, sb] of [[1, 1], [1, -1], [-1, 1], [-1, -1]]) {
      const x = [0, 0, 0], y = [0, 0, 0];
      x[a] = sa;
      y[b] = sb;
      const turn = t.fromColumns(x, y, t.cross(x, y)), score = turn.reduce((sum, value, k) => sum + value * m[k], 0);
      if (score > most) [best, most] = [turn, score];
    }
  }
  return best;
}

/** The bend of a chain of turns, its base first, over `count` joints; the last is as its last. */
function spread(turns, count) {
  return Array.from({ length: count }, (_, k) => {
    const place = (k + 1) * (turns.length - 1) / count, below = Math.floor(place + 1e-12);
    const low = turns[below], high = turns[Math.min(below + 1, turns.length - 1)];
    const bend = t.rotvecOfMatrix(t.mul(t.transpose(low), high));
    return t.mul(low, t.matrixOfRotvec(t.scale(bend, place - below)));
  });
}
