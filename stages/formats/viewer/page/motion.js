// Motions: poses at even times, in the clip's world, of one person or several.
import { quatsOf } from "hugs/skeleton";
import { slerp } from "hugs/turns";

export class Motion {
  /** Of each person `rotvecs` [72 a frame] rad, root first, and `steps` [3 a frame] m, at `fps` frames a second; where they have
   * some, `hands` [90 a frame] rad and `face` [52 a frame or more]. */
  constructor(name, fps, tracks) {
    Object.assign(this, { name, fps, tracks, known: tracks.map(() => []) });
    this.count = Math.max(...tracks.map(({ steps }) => steps.length / 3));
  }

  get seconds() { return this.count / this.fps; }

  /** The pose of a whole frame: a quaternion a joint, root first and fingers last, the step of the whole body in m, and a face. */
  frame(i, who) {
    const { rotvecs, steps, hands, face } = this.tracks[who];
    const shapes = face ? face.length / (steps.length / 3) : 0;
    const cut = (values, each) => (values ? Array.from(values.subarray(each * i, each * i + each)) : []);
    this.known[who][i] ??= { quats: quatsOf([...cut(rotvecs, 72), ...cut(hands, 90)]), step: cut(steps, 3), face: cut(face, shapes) };
    return this.known[who][i];
  }

  /** The pose of a person at a frame and a share of the way to the next. */
  at(position, who = 0) {
    const last = this.tracks[who].steps.length / 3 - 1;
    const low = Math.max(0, Math.min(last, Math.floor(position))), high = Math.min(last, low + 1);
    const share = Math.min(1, position - low), a = this.frame(low, who), b = this.frame(high, who);
    if (share < 1e-6 || low === high) return a;
    const between = (from, to) => from.map((part, k) => part + share * (to[k] - part));
    return {
      quats: a.quats.map((quat, k) => slerp(quat, b.quats[k], share)),
      step: between(a.step, b.step),
      face: between(a.face, b.face),
    };
  }
}
