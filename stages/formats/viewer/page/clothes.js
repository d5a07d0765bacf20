// Bones of clothes: carried by the skeleton's, they swing with the pose. The same as stages/avatar/effects/clothing.py.
import { ANKLES, FEET, HIPS, KNEES, SPINE } from "hugs/skeleton";
import { add, apply, cross, dot, IDENTITY, length, matrixOfRotvec, middle, mul, row, scale, sub, transpose } from "hugs/turns";

const UNITS = [0.3, 0.3, 0.3, 0.05, 0.05, 0.05];
const LEGS = [0, 1].map((side) => [HIPS, KNEES, ANKLES, FEET].map((pair) => pair[side]));
const UNLIKE = 0.5, PUSHED = 0.2, OVER = 1e-3, FOLDED = 0.3;

const directionOf = (v) => scale(v, 1 / Math.max(length(v), 1e-12)); // 0 has none

/** From between the ankles to the trunk, of where the joints are. */
const aboveAnkles = (at) => sub(middle(at[0], at[SPINE[2]]), middle(at[ANKLES[0]], at[ANKLES[1]]));

export class Clothes {
  constructor({ swings, centres, carriers, joints, mean, axes, low, high }) {
    Object.assign(this, { swings, carriers, mean, axes, low, high, kinds: low.length });
    this.count = centres.length / 3;
    this.joints = Array.from({ length: 24 }, (_, joint) => row(joints, joint));
    this.centres = Array.from({ length: this.count }, (_, k) => row(centres, k));
  }

  /** Features of a body pose, rotation vectors [69]: 1, then those that fade where one is beyond the limits of training. */
  features(pose) {
    let like = 1;
    const held = Array.from({ length: this.kinds }, (_, k) => {
      let sum = 0;
      for (let i = 0; i < 69; i++) sum += (pose[i] - this.mean[i]) * this.axes[i * this.kinds + k];
      const within = Math.min(this.high[k], Math.max(this.low[k], sum));
      const far = Math.max(1e-9, UNLIKE * (this.high[k] - this.low[k]));
      like = Math.min(like, Math.max(0, 1 - Math.abs(sum - within) / far));
      return within;
    });
    return [1, ...held.map((feature) => feature * like)];
  }

  /** How straight each leg moves towards the bone at a centre, from 0 to 1: cloth does not go where a leg goes away. */
  pushed(turns, centre) {
    return LEGS.map(([hip, knee]) => {
      const along = directionOf(sub(this.joints[knee], this.joints[hip]));
      const moved = sub(apply(transpose(turns[0]), apply(turns[hip], along)), along);
      const [x, , z] = sub(centre, this.joints[hip]), far = Math.max(PUSHED, Math.hypot(moved[0], moved[2]));
      return Math.min(1, Math.max(0, dot(moved, directionOf([x, 0, z])) / far));
    });
  }

  /** The pelvis, turned by the least so that it is upright: up is from between the ankles to the trunk. */
  upright({ turns, shifts }) {
    const at = this.joints.map((joint, i) => add(apply(turns[i], joint), shifts[i]));
    const points = apply(turns[0], directionOf(aboveAnkles(this.joints))), above = aboveAnkles(at);
    const far = length(above), own = Math.max(0, 1 - far / FOLDED);
    const up = directionOf(add(scale(points, own), scale(above, 1 / Math.max(far, FOLDED))));
    const [x, y, z] = cross(points, up), skew = [0, -z, y, z, 0, -x, -y, x, 0], twice = mul(skew, skew);
    const near = Math.max(OVER, 1 + dot(points, up));
    const turn = mul(IDENTITY.map((one, i) => one + skew[i] + twice[i] / near), turns[0]);
    return { turn, shift: sub(at[0], apply(turn, this.joints[0])) };
  }

  /** Turns and shifts of the bones here, where the skeleton's are so in a pose, rotation vectors [69]. */
  hang({ turns, shifts }, pose) {
    const features = this.features(pose), found = { turns: [], shifts: [] }, hanging = this.upright({ turns, shifts });
    for (let k = 0; k < this.count; k++) {
      const turn = IDENTITY.map(() => 0), shift = [0, 0, 0], centre = this.centres[k], legs = this.pushed(turns, centre);
      const carry = (share, bone, at) => {
        for (let i = 0; i < 9; i++) turn[i] += share * bone[i];
        for (let i = 0; i < 3; i++) shift[i] += share * at[i];
      };
      for (let joint = 0; joint < 24; joint++) {
        const share = this.carriers[24 * k + joint], side = LEGS.findIndex((leg) => leg.includes(joint));
        const own = side < 0 ? 1 : legs[side];
        carry(share * own, turns[joint], shifts[joint]);
        if (own < 1) carry(share * (1 - own), hanging.turn, hanging.shift);
      }
      const [x, y, z, ...moved] = UNITS.map((unit, i) => {
        let swing = 0;
        for (let q = 0; q <= this.kinds; q++) swing += this.swings[(6 * k + i) * (this.kinds + 1) + q] * features[q];
        return unit * swing;
      });
      const own = matrixOfRotvec([x, y, z]), off = add(sub(centre, apply(own, centre)), moved);
      found.turns.push(mul(turn, own));
      found.shifts.push(add(apply(turn, off), shift));
    }
    return found;
  }
}
