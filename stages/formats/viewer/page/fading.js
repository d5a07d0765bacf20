// What fades of the scene as one orbits: what no camera of the clip had in its picture, and what none looked at from there.
import { Vector4 } from "three";
import { bytesOf, eachSplat } from "hugs/splats";

const EYES = 16; // of the clip's cameras
const NEARBY = 15, ASIDE = 35; // degrees, as a Gaussian sees it, between the eye and the nearest of them: all, and nothing
const cosine = (degrees) => Math.cos(degrees * Math.PI / 180).toFixed(6);
const glsl = (eyes) => `
const vec3 hugsEyes[${eyes.length}] = vec3[](${eyes.map((eye) => `vec3(${eye.map((x) => x.toExponential(8))})`)});
struct HugsFading {
  usampler2DArray marks;
  vec4 eye;
};

float hugsFaded(usampler2DArray marks, vec4 eye, int index, vec3 center) {
  if (eye.w == 0.0) return 1.0;
  vec2 mark = vec2(texelFetch(marks, splatTexCoord(index), 0).xy) / 15.0;
  float near = -1.0;
  for (int k = 0; k < ${eyes.length}; k++) near = max(near, dot(normalize(hugsEyes[k] - center), normalize(eye.xyz - center)));
  return mark.x * max(mark.y, smoothstep(${cosine(ASIDE)}, ${cosine(NEARBY)}, near));
}`;

/** What Spark asks of a scene's skinning: `marks` [2 a Gaussian], how much of it was seen and how much is floor, 0 to 15. */
export class Fading {
  constructor(scene, marks, clip) {
    this.mesh = scene.mesh;
    this.eye = new Vector4(); // in the clip's world; w 0: nothing fades
    const count = clip.names.length, chosen = Array.from({ length: EYES }, (_, k) => Math.round(k * (count - 1) / (EYES - 1)));
    const value = { marks: bytesOf(marks, 2, scene.splats.textures[0].image), eye: this.eye };
    this.modifyCov = eachSplat("HugsFading", glsl([...new Set(chosen)].map((frame) => clip.eye(frame))), value, (out, fading) => `
      ${out}.rgba.a *= hugsFaded(${fading}.marks, ${fading}.eye, ${out}.index, ${out}.center);`);
    this.mesh.skinning = this;
    this.mesh.updateGenerator();
  }

  /** Look from a place in the clip's world, or through a camera, for which all is there. */
  look({ x, y, z }, free) {
    const eye = new Vector4(x, y, z, free ? 1 : 0);
    if (eye.equals(this.eye)) return;
    this.eye.copy(eye);
    this.mesh.needsUpdate = true;
  }
}
