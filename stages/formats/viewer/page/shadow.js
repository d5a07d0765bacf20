// The person's shadow: soft ellipsoids, one a bone, take light from the scene's Gaussians behind them.
// The same as stages/avatar/effects/shadow.py.
import { add, apply, column, dot, mul, row, transpose } from "hugs/turns";

const REACH = 3; // standard deviations beyond which a bone casts nothing
const ABOVE = 0.05; // m: width of the sigmoid that tells before from behind

export class Shadow {
  /** `facts`: light (a unit vector), darkness, softness, density, size; `parts`: middles [24,3], covariances [24,3,3]. */
  constructor(facts, parts) {
    Object.assign(this, facts, parts);
    this.frame = frameTo(facts.light);
    this.shaded = [];
  }

  /** Light a scene as with the body at these bones, or with nobody. */
  cast(scene, bones) {
    for (const i of this.shaded) scene.dim(i, 1);
    this.shaded = bones ? this.shade(scene, this.flatten(bones)) : [];
    scene.send(1);
  }

  /** Of each part that casts: its middle along the axes of the light, and its ellipse across them. */
  flatten({ turns, shifts, step }) {
    const parts = [], back = transpose(this.frame);
    for (let k = 0; k < 24; k++) {
      const spread = Array.from(this.covariances.subarray(9 * k, 9 * k + 9));
      const turned = mul(mul(turns[k], spread), transpose(turns[k]));
      if (turned[0] + turned[4] + turned[8] <= 0) continue;
      const at = apply(back, add(add(apply(turns[k], row(this.middles, k)), shifts[k]), step));
      const flat = mul(mul(back, turned), this.frame);
      const a = this.size * flat[0] + this.softness ** 2, c = this.size * flat[4] + this.softness ** 2;
      const b = this.size * flat[1], det = a * c - b * b;
      parts.push({ at, xx: c / det, xy: -b / det, yy: a / det, wide: Math.max(a, c) });
    }
    return parts;
  }

  /** Dim what lies behind the parts; returns which Gaussians that changed. */
  shade(scene, parts) {
    if (!parts.length) return [];
    const reach = REACH * Math.sqrt(Math.max(...parts.map((part) => part.wide)));
    const [xs, ys, zs] = [0, 1, 2].map((axis) => parts.map((part) => part.at[axis]));
    const low = [Math.min(...xs) - reach, Math.min(...ys) - reach];
    const high = [Math.max(...xs) + reach, Math.max(...ys) + reach], top = Math.max(...zs) + REACH * ABOVE;
    const [ex, ey, ez] = [0, 1, 2].map((j) => column(this.frame, j)), changed = [], means = scene.means;
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
      const share = 1 - this.darkness * (1 - Math.exp(-this.density * thick));
      if (share > 0.999) continue;
      scene.dim(i, share);
      changed.push(i);
    }
    return changed;
  }
}

/** A rotation whose third column is the unit vector `to`. */
function frameTo(to) {
  const [x, y, z] = to, sign = z < 0 ? -1 : 1, a = -1 / (sign + z), b = x * y * a; // Duff et al. 2017
  return [1 + sign * x * x * a, b, x, sign * b, sign + y * y * a, y, -sign * x, -y, z];
}
