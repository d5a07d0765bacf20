// What fades of the scene as one orbits: what no camera of the clip had in its picture, and what none looked at from there.
// What nobody saw and was filled in is darkened when asked.
import { MathUtils, Vector3, Vector4 } from "three";
import { bytesOf, eachSplat } from "hugs/splats";

const EYES = 16; // of the clip's cameras
const NEARBY = 15, ASIDE = 35; // degrees, as a Gaussian sees it, between the eye and the nearest of them: all, and nothing
const DARK = 0.7; // of its light, what is invented loses when dimmed
const cosine = (degrees) => Math.cos(degrees * Math.PI / 180);
const glsl = (eyes) => `
const vec3 hugsEyes[${eyes.length}] = vec3[](${eyes.map((eye) => `vec3(${eye.map((x) => x.toExponential(8))})`)});
struct HugsFading {
  usampler2DArray marks;
  vec4 eye;
  float dimmed;
};

vec4 hugsFaded(usampler2DArray marks, vec4 eye, float dimmed, int index, vec3 center) {
  vec3 mark = vec3(texelFetch(marks, splatTexCoord(index), 0).xyz) / 15.0;
  vec4 light = vec4(vec3(1.0 - ${DARK} * dimmed * mark.z), 1.0);
  if (eye.w == 0.0) return light;
  float near = -1.0;
  for (int k = 0; k < ${eyes.length}; k++) near = max(near, dot(normalize(hugsEyes[k] - center), normalize(eye.xyz - center)));
  light.a = mark.x * max(mark.y, smoothstep(${cosine(ASIDE).toFixed(6)}, ${cosine(NEARBY).toFixed(6)}, near));
  return light;
}`;

/** What Spark asks of a scene's skinning: `marks` [3 a Gaussian], how much of it was seen, is floor and is invented, 0 to 15. */
export class Fading {
  constructor(scene, marks, clip) {
    this.mesh = scene.mesh;
    this.eye = new Vector4(); // in the clip's world; w 0: nothing fades
    this.marks = marks;
    const count = clip.names.length, chosen = Array.from({ length: EYES }, (_, k) => Math.round(k * (count - 1) / (EYES - 1)));
    this.eyes = [...new Set(chosen)].map((frame) => clip.eye(frame));
    this.invented = marks.some((mark, i) => i % 3 === 2 && mark);
    this.value = { marks: bytesOf(marks, 3, scene.splats.textures[0].image), eye: this.eye, dimmed: 0 };
    this.modifyCov = eachSplat("HugsFading", glsl(this.eyes), this.value, (out, fading) => `
      ${out}.rgba *= hugsFaded(${fading}.marks, ${fading}.eye, ${fading}.dimmed, ${out}.index, ${out}.center);`);
    this.mesh.skinning = this;
    this.mesh.updateGenerator();
  }

  /** How much of Gaussian i is left, at its place [3]: as above, for one that is asked about. */
  shown(i, ...place) {
    if (this.eye.w === 0) return 1;
    const center = new Vector3(...place), way = new Vector3().copy(this.eye).sub(center).normalize();
    const near = Math.max(...this.eyes.map((eye) => new Vector3(...eye).sub(center).normalize().dot(way)));
    return this.marks[3 * i] / 15 * Math.max(this.marks[3 * i + 1] / 15, MathUtils.smoothstep(near, cosine(ASIDE), cosine(NEARBY)));
  }

  /** Look from a place in the clip's world, or through a camera, for which all is there; what is invented is `dimmed` or not. */
  look({ x, y, z }, free, dimmed) {
    const eye = new Vector4(x, y, z, free ? 1 : 0);
    if (eye.equals(this.eye) && this.value.dimmed === Number(dimmed)) return;
    this.eye.copy(eye);
    this.value.dimmed = Number(dimmed);
    this.mesh.needsUpdate = true;
  }
}
