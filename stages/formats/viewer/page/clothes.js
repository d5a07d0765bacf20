// Bones of clothes: carried by the skeleton's, they swing with the pose and on springs.
// The same as stages/avatar/effects/clothing.py and spring.py.
import { add, apply, IDENTITY, matrixOfRotvec, mul, row, scale, sub, transpose } from "hugs/turns";

const UNITS = [0.3, 0.3, 0.3, 0.05, 0.05, 0.05], NONE = [0, 0, 0];
const LONGEST = 0.25; // s between two poses of one motion; after more, springs are at rest

export class Clothes {
  constructor({ swings, centres, carriers, mean, axes, low, high, sways, spring, reach }) {
    Object.assign(this, { swings, carriers, mean, axes, low, high, sways, spring, reach, kinds: low.length });
    this.count = centres.length / 3;
    this.centres = Array.from({ length: this.count }, (_, k) => row(centres, k));
    this.rest();
  }

  /** Let the springs come to rest. */
  rest() {
    this.time = null;
    this.springs = this.centres.map(() => ({ sway: NONE, rate: NONE, speed: null, place: null }));
  }

  /** Features of a body pose, rotation vectors [69]: 1, then those held within what training saw. */
  features(pose) {
    return [1, ...Array.from({ length: this.kinds }, (_, k) => {
      let sum = 0;
      for (let i = 0; i < 69; i++) sum += (pose[i] - this.mean[i]) * this.axes[i * this.kinds + k];
      return Math.min(this.high[k], Math.max(this.low[k], sum));
    })];
  }

  /** Turns and shifts of the bones here, where the skeleton's are so at a `time` in s; null: at rest. */
  hang({ turns, shifts }, pose, step, time) {
    const features = this.features(pose), found = { turns: [], shifts: [] };
    const seconds = time === null || this.time === null ? 0 : time - this.time;
    if (time === null || seconds < 0 || seconds > LONGEST) this.rest();
    this.time = time;
    for (let k = 0; k < this.count; k++) {
      const turn = IDENTITY.map(() => 0), shift = [0, 0, 0];
      for (let joint = 0; joint < 24; joint++) {
        const share = this.carriers[24 * k + joint];
        for (let i = 0; i < 9; i++) turn[i] += share * turns[joint][i];
        for (let i = 0; i < 3; i++) shift[i] += share * shifts[joint][i];
      }
      const centre = this.centres[k], place = add(add(apply(turn, centre), shift), step);
      const sway = apply(transpose(turn), this.sway(this.springs[k], place, seconds));
      const held = scale(sway, Math.min(1, this.reach[k] / Math.max(Math.hypot(...sway), 1e-9)));
      const [x, y, z, ...moved] = UNITS.map((unit, i) => {
        let swing = 0;
        for (let q = 0; q <= this.kinds; q++) swing += this.swings[(6 * k + i) * (this.kinds + 1) + q] * features[q];
        for (let c = 0; c < 3; c++) swing += this.sways[3 * (6 * k + i) + c] * held[c];
        return unit * swing;
      });
      const own = matrixOfRotvec([x, y, z]), off = add(sub(centre, apply(own, centre)), moved);
      found.turns.push(mul(turn, own));
      found.shifts.push(add(apply(turn, off), shift));
    }
    return found;
  }

  /** How far a spring is off, in the world, after `seconds` in which its bone was carried to `place`. */
  sway(spring, place, seconds) {
    if (spring.place && seconds > 0) {
      const speed = scale(sub(place, spring.place), 1 / seconds);
      if (spring.speed) spring.rate = sub(spring.rate, sub(speed, spring.speed));
      spring.speed = speed;
      const [free, damping] = this.spring, fade = free * damping, turn = free * Math.sqrt(1 - damping * damping);
      const decay = Math.exp(-fade * seconds), cos = Math.cos(turn * seconds), sin = Math.sin(turn * seconds);
      const { sway, rate } = spring;
      spring.sway = scale(add(scale(sway, cos + fade / turn * sin), scale(rate, sin / turn)), decay);
      spring.rate = scale(sub(scale(rate, cos - fade / turn * sin), scale(sway, free * free / turn * sin)), decay);
    }
    spring.place = place;
    return spring.sway;
  }
}
