// People's shadows: soft ellipsoids, one a bone, take light from the scene's Gaussians behind them.
// The same as stages/avatar/effects/shadow.py.
import { add, apply, column, dot, mul, row, transpose } from "hugs/turns";

const REACH = 3; // standard deviations beyond which a bone casts nothing
const ABOVE = 0.05; // m: width of the sigmoid that tells before from behind

export class Shadow {
  /** light (a unit vector), darkness, softness, density, size. */
  constructor(facts) {
    Object.assign(this, facts);
    this.frame = frameTo(facts.light);
    this.shaded = [];
  }

  /** Light a scene as with people at these bones. What lies behind two of them is behind more. */
  cast(scene, people, bones) {
    for (const i of this.shaded) scene.dim(i, 1);
    const thick = new Map();
    people.forEach((person, who) => this.add(thick, scene, this.flatten(person, bones[who])));
    this.shaded = [];
    for (const [i, depth] of thick) {
      const share = 1 - this.darkness * (1 - Math.exp(-this.density * depth));
      if (share > 0.999) continue;
      scene.dim(i, share);
      this.shaded.push(i);
    }
    scene.send(1);
  }

  /** Of each part that casts: its middle along the axes of the light, and its ellipse across them. */
  flatten(person, { turns, shifts, step }) {
    const parts = [], back = transpose(this.frame), { middles, covariances } = person.parts, grown = person.stand.scale ** 2;
    for (let k = 0; k < 24; k++) {
      const spread = Array.from(covariances.subarray(9 * k, 9 * k + 9), (value) => grown * value);
      const turned = mul(mul(turns[k], spread), transpose(turns[k]));
      if (turned[0] + turned[4] + turned[8] <= 0) continue;
      const at = apply(back, person.placed(add(add(apply(turns[k], row(middles, k)), shifts[k]), step)));
      const flat = mul(mul(back, turned), this.frame);
      const a = this.size * flat[0] + this.softness ** 2, c = this.size * flat[4] + this.softness ** 2;
      const b = this.size * flat[1], det = a * c - b * b;
      parts.push({ at, xx: c / det, xy: -b / det, yy: a / det, wide: Math.max(a, c) });
    }
    return parts;
  }

  /** Add to the depth in shadow, by number, of all Gaussians behind the parts. */
  add(depths, scene, parts) {
    if (!parts.length) return;
    const reach = REACH * Math.sqrt(Math.max(...parts.map((part) => part.wide)));
    const [xs, ys, zs] = [0, 1, 2].map((axis) => parts.map((part) => part.at[axis]));
    const low = [Math.min(...xs) - reach, Math.min(...ys) - reach];
    const high = [Math.max(...xs) + reach, Math.max(...ys) + reach], top = Math.max(...zs) + REACH * ABOVE;
    const [ex, ey, ez] = [0, 1, 2].map((j) => column(this.frame, j)), means = scene.means;
    for (let i = 0; i < scene.count; i++) {
      const place = row(means, i), x = dot(ex, place), y = dot(ey, place);
      if (x <= low[0] || x >= high[0] || y <= low[1] || y >= high[1]) continue;
      const z = dot(ez, place);
      if (z >= top) continue;
      let thick = 0;
      for (const { at, xx, xy, yy } of parts) {
        const dx = at[0] - x, dy = at[1] - y;
        const before = 1 / (1 + Math.exp((z - at[2]) / ABOVE));
        thick += before * Math.exp(-0.5 * (xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy));
      }
      depths.set(i, (depths.get(i) ?? 0) + thick);
    }
  }
}

/** A rotation whose third column is the unit vector `to`. */
function frameTo(to) {
  const [x, y, z] = to, sign = z < 0 ? -1 : 1, a = -1 / (sign + z), b = x * y * a; // Duff et al. 2017
  return [1 + sign * x * x * a, b, x, sign * b, sign + y * y * a, y, -sign * x, -y, z];
}
