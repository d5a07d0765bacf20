// Fingers on the hands of a skeleton. The same as stages/avatar/body/fingers.py, from where they lie in the avatar on.
import { bonesOf, HANDS, quatsOf } from "hugs/skeleton";
import { add, apply, mul, scale, slerp, transpose } from "hugs/turns";

export const FINGERS = 30;
const PARENTS = Array.from({ length: FINGERS }, (_, bone) => (bone % 3 ? bone - 1 : -1)); // those of -1 hang on a hand

export class Hands {
  /** Joints and tips `fingers` [40][3] m at rest, and rotation vectors [30][3] rad of hands as they lie, and closed. */
  constructor({ fingers, lying, fist }) {
    this.joints = fingers.slice(0, 3 * FINGERS);
    this.tips = fingers.slice(3 * FINGERS);
    [this.lying, this.fist] = [lying, fist].map(quatsOf);
    const { turns, shifts } = bonesOf(this.lying, this.joints, PARENTS);
    this.back = turns.map((turn, bone) => {
      const turned = transpose(turn);
      return { turn: turned, shift: scale(apply(turned, shifts[bone]), -1) };
    });
  }

  /** Turns and shifts of the fingers from where they lie, on a skeleton's bones; `quats` [30, or none: as they lie]. */
  bones({ turns, shifts }, quats, fist = 0) {
    const own = quats.length ? quats : this.lying;
    const bent = bonesOf(fist ? own.map((quat, bone) => slerp(quat, this.fist[bone], fist)) : own, this.joints, PARENTS);
    const found = { turns: [], shifts: [] };
    this.back.forEach(({ turn, shift }, bone) => {
      const hand = HANDS[Math.floor(2 * bone / FINGERS)];
      const local = add(apply(bent.turns[bone], shift), bent.shifts[bone]);
      found.turns.push(mul(turns[hand], mul(bent.turns[bone], turn)));
      found.shifts.push(add(apply(turns[hand], local), shifts[hand]));
    });
    return found;
  }
}
