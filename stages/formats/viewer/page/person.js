// The person: Gaussians in the T-pose, skinned on the graphics card, clothes hung before.
import { Clothes } from "hugs/clothes";
import { bonesOf } from "hugs/skeleton";
import { Skin } from "hugs/skin";
import { Splats } from "hugs/splats";
import { rotvecOfQuat } from "hugs/turns";

export class Person {
  constructor(arrays, parents) {
    this.joints = arrays.joints;
    this.parents = parents;
    this.body = new Splats(arrays);
    this.skin = new Skin(this.mesh, arrays.weights, this.body.splats.textures[0].image);
    this.mesh.skinning = this.skin;
    this.mesh.updateGenerator();
    const { nodes, mean, axes, low, high, offsets } = arrays;
    this.clothes = nodes ? new Clothes({ nodes, mean, axes, low, high, offsets }, arrays.means) : null;
    const heights = arrays.means.filter((_, i) => i % 3 === 1).sort();
    this.height = heights.at(-1) - heights[0]; // m, at rest
  }

  get mesh() { return this.body.mesh; }

  /** Take a pose, {quats [24], step [3]}; returns where its bones are. */
  take({ quats, step }) {
    const bones = bonesOf(quats, this.joints, this.parents);
    this.skin.take(bones);
    if (this.clothes) this.clothes.hang(this.body, this.clothes.features(quats.slice(1).flatMap(rotvecOfQuat)));
    this.mesh.position.fromArray(step);
    return { ...bones, step };
  }
}
