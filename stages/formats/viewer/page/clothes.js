// Bones of clothes: carried by the skeleton's, they swing with the pose. The same as stages/avatar/effects/clothing.py.
import { add, apply, IDENTITY, matrixOfRotvec, mul, row, sub } from "hugs/turns";

const UNITS = [0.3, 0.3, 0.3, 0.05, 0.05, 0.05];

export class Clothes {
  constructor({ swings, centres, carriers, mean, axes, low, high }) {
    Object.assign(this, { swings, carriers, mean, axes, low, high, kinds: low.length });
    this.count = centres.length / 3;
    this.centres = Array.from({ length: this.count }, (_, k) => row(centres, k));
  }

  /** Features of a body pose, rotation vectors [69]: 1, then those held within what training saw. */
  features(pose) {
    return [1, ...Array.from({ length: this.kinds }, (_, k) => {
      let sum = 0;
      for (let i = 0; i < 69; i++) sum += (pose[i] - this.mean[i]) * this.axes[i * this.kinds + k];
      return Math.min(this.high[k], Math.max(this.low[k], sum));
    })];
  }

  /** Turns and shifts of the bones here, where the skeleton's are so in a pose, rotation vectors [69]. */
  hang({ turns, shifts }, pose) {
    const features = this.features(pose), found = { turns: [], shifts: [] };
    for (let k = 0; k < this.count; k++) {
      const turn = IDENTITY.map(() => 0), shift = [0, 0, 0];
      for (let joint = 0; joint < 24; joint++) {
        const share = this.carriers[24 * k + joint];
        for (let i = 0; i < 9; i++) turn[i] += share * turns[joint][i];
        for (let i = 0; i < 3; i++) shift[i] += share * shifts[joint][i];
      }
      const centre = this.centres[k];
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
