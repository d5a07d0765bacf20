// Skinning with all bones: Spark's own takes four, which a person's shoulders and hips are not done with.
import { DataArrayTexture, DataTexture, FloatType, RGBAFormat, RGBAIntegerFormat, UnsignedIntType } from "three";
import { dyno } from "@sparkjsdev/spark";

const BONES = 24, PER_WORD = 3, BITS = 10; // the roots of 24 weights in 10 bits each: two texels of four words
const SKIN = { type: "HugsSkin" };
const GLSL = `
struct HugsSkin {
  usampler2DArray first;
  usampler2DArray second;
  sampler2D bones;
};

void hugsSkin(
  usampler2DArray first, usampler2DArray second, sampler2D bones,
  int index, inout vec3 center, inout vec3 xxyyzz, inout vec3 xyxzyz
) {
  ivec3 at = splatTexCoord(index);
  uvec4 words[2];
  words[0] = texelFetch(first, at, 0);
  words[1] = texelFetch(second, at, 0);
  float total = 0.0;
  vec4 x = vec4(0.0), y = vec4(0.0), z = vec4(0.0);
  for (int k = 0; k < ${BONES}; k++) {
    uint word = words[k / 12][(k % 12) / ${PER_WORD}];
    float root = float((word >> uint(${BITS} * (k % ${PER_WORD}))) & 1023u);
    if (root > 0.0) {
      float weight = root * root;
      total += weight;
      x += weight * texelFetch(bones, ivec2(0, k), 0);
      y += weight * texelFetch(bones, ivec2(1, k), 0);
      z += weight * texelFetch(bones, ivec2(2, k), 0);
    }
  }
  vec4 from = vec4(center, 1.0);
  center = vec3(dot(x, from), dot(y, from), dot(z, from)) / total;
  mat3 blend = transpose(mat3(x.xyz, y.xyz, z.xyz)) / total;
  mat3 cov = mat3(xxyyzz.x, xyxzyz.x, xyxzyz.y, xyxzyz.x, xxyyzz.y, xyxzyz.z, xyxzyz.y, xyxzyz.z, xxyyzz.z);
  cov = blend * cov * transpose(blend);
  xxyyzz = vec3(cov[0][0], cov[1][1], cov[2][2]);
  xyxzyz = vec3(cov[0][1], cov[0][2], cov[1][2]);
}`;

/** What Spark asks of a mesh's skinning: `weights` [24 a Gaussian], their roots in 10 bits, in the order of the mesh's texture. */
export class Skin {
  constructor(mesh, weights, { width, height, depth }) {
    this.mesh = mesh;
    const halves = [0, 1].map(() => new Uint32Array(4 * width * height * depth));
    for (let i = 0; i < weights.length; i++) {
      const row = Math.floor(i / BONES), k = i % BONES;
      halves[Math.floor(k / 12)][4 * row + Math.floor((k % 12) / PER_WORD)] |= weights[i] << (BITS * (k % PER_WORD));
    }
    const [first, second] = halves.map((half) => {
      const texture = new DataArrayTexture(half, width, height, depth);
      Object.assign(texture, { format: RGBAIntegerFormat, type: UnsignedIntType, internalFormat: "RGBA32UI", needsUpdate: true });
      return texture;
    });
    this.rows = new Float32Array(12 * BONES);
    this.bones = new DataTexture(this.rows, 3, BONES, RGBAFormat, FloatType);
    this.bones.needsUpdate = true;
    this.uniform = new dyno.DynoUniform({ key: "skin", type: SKIN, globals: () => [GLSL], value: { first, second, bones: this.bones } });
  }

  /** Of each bone its turn [9] and shift [3] from rest. */
  take({ turns, shifts }) {
    turns.forEach((turn, k) => {
      for (let i = 0; i < 3; i++) this.rows.set([turn[3 * i], turn[3 * i + 1], turn[3 * i + 2], shifts[k][i]], 12 * k + 4 * i);
    });
    this.bones.needsUpdate = true;
    this.mesh.needsUpdate = true;
  }

  modifyCov(covsplat) {
    const step = new dyno.Dyno({
      inTypes: { covsplat: dyno.CovSplat, skin: SKIN },
      outTypes: { covsplat: dyno.CovSplat },
      globals: () => [GLSL],
      inputs: { covsplat, skin: this.uniform },
      statements: ({ inputs, outputs }) => {
        const { skin } = inputs, out = outputs.covsplat;
        return dyno.unindentLines(`
          ${out} = ${inputs.covsplat};
          hugsSkin(${skin}.first, ${skin}.second, ${skin}.bones, ${out}.index, ${out}.center, ${out}.xxyyzz, ${out}.xyxzyz);
        `);
      },
    });
    return step.outputs.covsplat;
  }
}
