// Motions: poses at even times, in the clip's world, of one person or several.
import { poseOf } from "hugs/skeleton";
import { slerp } from "hugs/turns";

export class Motion {
  /** Of each person `rotvecs` [72 a frame] rad, root first, and `steps` [3 a frame] m, at `fps` frames a second. */
  constructor(name, fps, tracks) {
    Object.assign(this, { name, fps, tracks, known: tracks.map(() => []) });
    this.count = Math.max(...tracks.map(({ steps }) => steps.length / 3));
  }

  get seconds() { return this.count / this.fps; }

  /** The pose of a whole frame. */
  frame(i, who) {
    const { rotvecs, steps } = this.tracks[who];
    this.known[who][i] ??= poseOf(rotvecs.subarray(72 * i, 72 * i + 72), Array.from(steps.subarray(3 * i, 3 * i + 3)));
    return this.known[who][i];
  }

  /** The pose of a person at a frame and a share of the way to the next. */
  at(position, who = 0) {
    const last = this.tracks[who].steps.length / 3 - 1;
    const low = Math.max(0, Math.min(last, Math.floor(position))), high = Math.min(last, low + 1);
    const share = Math.min(1, position - low), a = this.frame(low, who), b = this.frame(high, who);
    if (share < 1e-6 || low === high) return a;
    return {
      quats: a.quats.map((quat, k) => slerp(quat, b.quats[k], share)),
      step: a.step.map((part, k) => part + share * (b.step[k] - part)),
    };
  }
}
