// A person: Gaussians in the T-pose, skinned on the graphics card.
import { Clothes } from "hugs/clothes";
import { Face } from "hugs/face";
import { FINGERS, Hands } from "hugs/hands";
import { bonesOf } from "hugs/skeleton";
import { Skin } from "hugs/skin";
import { Splats } from "hugs/splats";
import { add, rotvecOfQuat, scale as mulScalar, sub } from "hugs/turns";

const REACH = 0.13; // of a person's height, from a joint to the skin around it: hands and the crown are farthest

export class Person {
  /** `stand`: `turn` [9] and `spot` [3] m take a motion to the clip's world, where they are `scale` times as large, in the light
   * of `bands` [8][3] or of itself. */
  constructor(arrays, { parents, stand, absent }, soles, bands) {
    Object.assign(this, { joints: arrays.joints, parents, stand, soles });
    this.absent = new Set(absent); // frames of the first motion that do not show them
    const { middles, covariances } = arrays;
    this.parts = middles ? { middles, covariances } : null; // what casts their shadow
    this.body = new Splats(arrays);
    this.clothes = arrays.centres ? new Clothes(arrays) : null;
    this.hands = arrays.fingers ? new Hands(arrays) : null;
    this.face = arrays.moves ? new Face(this.body, arrays) : null;
    const bones = parents.length + (this.clothes ? this.clothes.count : 0) + (this.hands ? FINGERS : 0);
    this.skin = new Skin(this.mesh, arrays, bones, this.body.splats.textures[0].image, bands);
    this.mesh.skinning = this.skin;
    this.mesh.updateGenerator();
    const heights = arrays.means.filter((_, i) => i % 3 === 1).sort();
    this.height = heights.at(-1) - heights[0]; // m, at rest
  }

  get mesh() { return this.body.mesh; }

  /** Take a pose, {quats [24, with fingers 54], step [3], face [K or none]}, its hands closed by `fist`, 0 to 1; returns where
   * its bones are. */
  take({ quats, step, face, fist }) {
    const body = quats.slice(0, 24), bones = bonesOf(body, this.joints, this.parents);
    const hung = this.clothes?.hang(bones, body.slice(1).flatMap(rotvecOfQuat));
    const all = [bones, hung, this.hands?.bones(bones, quats.slice(24), fist)].filter(Boolean);
    this.skin.take({ turns: all.flatMap(({ turns }) => turns), shifts: all.flatMap(({ shifts }) => shifts) });
    this.face?.take(face);
    this.mesh.position.fromArray(this.placed(step));
    this.mesh.scale.setScalar(this.stand.scale);
    return { ...bones, step };
  }

  /** Where their joints are in a pose, and how far they reach around each, in m: [x, y, z, reach]. */
  joined({ quats, step }) {
    const { places } = bonesOf(quats.slice(0, 24), this.joints, this.parents);
    return places.map((place) => [...this.placed(add(place, step)), REACH * this.height * this.stand.scale]);
  }

  /** A point [3] of the person as they would be if they were no larger, where it is. */
  placed(point) {
    const { spot, scale } = this.stand;
    return add(spot, mulScalar(sub(point, spot), scale));
  }
}
