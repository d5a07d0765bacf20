// Clothes that leave the body as the pose changes: offsets at rest, linear in features of the pose.
// The same as stages/avatar/effects/clothing.py.

const REACH = 0.07; // m: a node's Gaussian sigma
const FLOOR = 1e-6;

export class Clothes {
  /** For Gaussians at rest `means`: every offset of every Gaussian for a feature of one. */
  constructor({ nodes, mean, axes, low, high, offsets }, means) {
    Object.assign(this, { mean, axes, low, high, kinds: low.length });
    const count = means.length / 3, wide = 3 * this.kinds;
    this.basis = new Float32Array(count * wide);
    for (let i = 0; i < count; i++) {
      let total = FLOOR;
      const near = [];
      for (let node = 0; node < nodes.length / 3; node++) {
        const x = means[3 * i] - nodes[3 * node], y = means[3 * i + 1] - nodes[3 * node + 1];
        const z = means[3 * i + 2] - nodes[3 * node + 2];
        const bell = Math.exp(-0.5 * (x * x + y * y + z * z) / (REACH * REACH));
        total += bell;
        if (bell > 1e-9) near.push([node, bell]);
      }
      for (const [node, bell] of near) {
        for (let k = 0; k < wide; k++) this.basis[i * wide + k] += (bell / total) * offsets[node * wide + k];
      }
    }
  }

  /** Features of a body pose, rotation vectors [69], held within what training saw. */
  features(pose) {
    return Array.from({ length: this.kinds }, (_, k) => {
      let sum = 0;
      for (let i = 0; i < 69; i++) sum += (pose[i] - this.mean[i]) * this.axes[i * this.kinds + k];
      return Math.min(this.high[k], Math.max(this.low[k], sum));
    });
  }

  /** Place all Gaussians of `splats` at rest as the clothes hang with these features. */
  hang(splats, features) {
    const { means, count } = splats, kinds = this.kinds, basis = this.basis;
    for (let i = 0, at = 0; i < count; i++) {
      let x = means[3 * i], y = means[3 * i + 1], z = means[3 * i + 2];
      for (let k = 0; k < kinds; k++) x += basis[at++] * features[k];
      for (let k = 0; k < kinds; k++) y += basis[at++] * features[k];
      for (let k = 0; k < kinds; k++) z += basis[at++] * features[k];
      splats.place(i, x, y, z);
    }
    splats.send(0);
  }
}
