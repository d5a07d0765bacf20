// Motions: poses at even times, in the clip's world.
import { poseOf } from "hugs/skeleton";
import { slerp } from "hugs/turns";

export class Motion {
  /** `rotvecs` [72 a frame] rad, root first, and `steps` [3 a frame] m, at `fps` frames a second. */
  constructor(name, fps, rotvecs, steps) {
    Object.assign(this, { name, fps, rotvecs, steps, known: [] });
    this.count = steps.length / 3;
  }

  get seconds() { return this.count / this.fps; }

  /** The pose of a whole frame. */
  frame(i) {
    this.known[i] ??= poseOf(this.rotvecs.subarray(72 * i, 72 * i + 72), Array.from(this.steps.subarray(3 * i, 3 * i + 3)));
    return this.known[i];
  }

  /** The pose at a frame and a share of the way to the next. */
  at(position) {
    const low = Math.max(0, Math.min(this.count - 1, Math.floor(position))), high = Math.min(this.count - 1, low + 1);
    const share = Math.min(1, position - low), a = this.frame(low), b = this.frame(high);
    if (share < 1e-6 || low === high) return a;
    return {
      quats: a.quats.map((quat, k) => slerp(quat, b.quats[k], share)),
      step: a.step.map((part, k) => part + share * (b.step[k] - part)),
    };
  }
}
