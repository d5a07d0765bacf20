// Skinning with all bones: Spark's own takes four, which a person's shoulders and hips are not done with. And their light.
import { DataArrayTexture, DataTexture, FloatType, RGBAFormat, RGBAIntegerFormat, UnsignedIntType } from "three";
import { FINGERS } from "hugs/hands";
import { glslOf } from "hugs/shading";
import { bytesOf, eachSplat } from "hugs/splats";

const PER_WORD = 3, PER_TEXEL = 12, BITS = 10; // the roots of weights in 10 bits each, three in each of a texel's four words
const SLOPES = 12, PER_SLOPE = 4; // bones at most that draw a Gaussian of cloth, and how many of them lie in a texel
const LARGEST_SLOPE = 8; // 1/m: no part of a slope is larger; stages/formats/viewer/packing.py has it, too
const texels = (bones) => Math.ceil(bones / PER_TEXEL);
const GROWTH = `
  ivec3 further = ivec3(0, 0, textureSize(slopes, 0).z / ${SLOPES / PER_SLOPE});
  for (int m = 0; m < ${SLOPES}; m++) {
    uint word = texelFetch(slopes, at + further * (m / ${PER_SLOPE}), 0)[m % ${PER_SLOPE}];
    if (word == 0u) break;
    vec3 slope = (vec3((uvec3(word) >> uvec3(8u, 16u, 24u)) & 255u) - 128.0) * ${(LARGEST_SLOPE / 127).toFixed(8)};
    int k = int(word & 255u);
    vec4 x = texelFetch(bones, ivec2(0, k), 0), y = texelFetch(bones, ivec2(1, k), 0), z = texelFetch(bones, ivec2(2, k), 0);
    blend += outerProduct(vec3(dot(x, from), dot(y, from), dot(z, from)) - center, slope);
  }`;
const LIT = "  color *= hugsLight(normalize(blend * (vec3(texelFetch(facing, at, 0).xyz) / 127.5 - 1.0)));";
const glsl = (bones, bands, grows) => `${bands ? glslOf(bands) : ""}
struct HugsSkin {
  usampler2DArray weights;
  ${grows ? "usampler2DArray slopes;" : ""}
  ${bands ? "usampler2DArray facing;" : ""}
  sampler2D bones;
};

void hugsSkin(
  usampler2DArray weights, ${grows ? "usampler2DArray slopes, " : ""}${bands ? "usampler2DArray facing, " : ""}sampler2D bones,
  int index, inout vec3 center, inout vec3 xxyyzz, inout vec3 xyxzyz, inout vec3 color
) {
  ivec3 at = splatTexCoord(index);
  ivec3 next = ivec3(0, 0, textureSize(weights, 0).z / ${texels(bones)});
  float total = 0.0;
  vec4 x = vec4(0.0), y = vec4(0.0), z = vec4(0.0);
  for (int texel = 0; texel < ${texels(bones)}; texel++) {
    uvec4 words = texelFetch(weights, at + texel * next, 0);
    if (words == uvec4(0u)) continue;
    for (int i = 0; i < ${PER_TEXEL}; i++) {
      float root = float((words[i / ${PER_WORD}] >> uint(${BITS} * (i % ${PER_WORD}))) & 1023u);
      if (root > 0.0) {
        int k = ${PER_TEXEL} * texel + i;
        float weight = root * root;
        total += weight;
        x += weight * texelFetch(bones, ivec2(0, k), 0);
        y += weight * texelFetch(bones, ivec2(1, k), 0);
        z += weight * texelFetch(bones, ivec2(2, k), 0);
      }
    }
  }
  vec4 from = vec4(center, 1.0);
  center = vec3(dot(x, from), dot(y, from), dot(z, from)) / total;
  mat3 blend = transpose(mat3(x.xyz, y.xyz, z.xyz)) / total;
${bands ? LIT : ""}
${grows ? GROWTH : ""}
  mat3 cov = mat3(xxyyzz.x, xyxzyz.x, xyxzyz.y, xyxzyz.x, xxyyzz.y, xyxzyz.z, xyxzyz.y, xyxzyz.z, xxyyzz.z);
  cov = blend * cov * transpose(blend);
  xxyyzz = vec3(cov[0][0], cov[1][1], cov[2][2]);
  xyxzyz = vec3(cov[0][1], cov[0][2], cov[1][2]);
}`;

/** What Spark asks of a mesh's skinning: roots of weights in 10 bits, in the order of the mesh's texture: `weights` of all bones but
 * fingers, which come last and have `shares` [FINGERS each] of the Gaussians `gloved`, if any.
 *
 * The Gaussians `cloth`, if any, grow by `slopes` [SLOPES each]: a bone, and three parts of its slope. In a light of `bands` [8][3],
 * if any: `facing` [3 a Gaussian] is where each faces at rest, 0 to 255. */
export class Skin {
  constructor(mesh, { weights, gloved, shares, cloth, slopes, facing }, bones, image, bands) {
    this.mesh = mesh;
    const { width, height, depth } = image;
    const size = 4 * width * height * depth;
    const roots = new Uint32Array(texels(bones) * size), limbs = bones - (shares ? FINGERS : 0);
    const put = (row, k, root) => {
      const word = Math.floor((k % PER_TEXEL) / PER_WORD);
      roots[Math.floor(k / PER_TEXEL) * size + 4 * row + word] |= root << (BITS * (k % PER_WORD));
    };
    weights.forEach((root, i) => put(Math.floor(i / limbs), i % limbs, root));
    shares?.forEach((root, i) => put(gloved[Math.floor(i / FINGERS)], limbs + (i % FINGERS), root));
    const texture = (values, layers) => Object.assign(
      new DataArrayTexture(values, width, height, layers),
      { format: RGBAIntegerFormat, type: UnsignedIntType, internalFormat: "RGBA32UI", needsUpdate: true },
    );
    this.rows = new Float32Array(12 * bones);
    this.bones = new DataTexture(this.rows, 3, bones, RGBAFormat, FloatType);
    this.bones.needsUpdate = true;
    const code = glsl(bones, bands, slopes), value = { weights: texture(roots, texels(bones) * depth) };
    if (slopes) {
      const words = new Uint32Array(SLOPES / PER_SLOPE * size), each = slopes.length / cloth.length;
      for (let i = 0; i < slopes.length; i++) {
        const m = i % each;
        words[Math.floor(m / PER_SLOPE) * size + 4 * cloth[Math.floor(i / each)] + (m % PER_SLOPE)] = slopes[i];
      }
      value.slopes = texture(words, SLOPES / PER_SLOPE * depth);
    }
    if (bands) value.facing = bytesOf(facing, 3, image);
    value.bones = this.bones;
    const given = (skin) => Object.keys(value).map((name) => `${skin}.${name}`).join(", ");
    this.modifyCov = eachSplat("HugsSkin", code, value, (out, skin) => `
      vec3 color = ${out}.rgba.rgb;
      hugsSkin(${given(skin)}, ${out}.index, ${out}.center, ${out}.xxyyzz, ${out}.xyxzyz, color);
      ${out}.rgba.rgb = color;`);
  }

  /** Of each bone its turn [9] and shift [3] from rest. */
  take({ turns, shifts }) {
    turns.forEach((turn, k) => {
      for (let i = 0; i < 3; i++) this.rows.set([turn[3 * i], turn[3 * i + 1], turn[3 * i + 2], shifts[k][i]], 12 * k + 4 * i);
    });
    this.bones.needsUpdate = true;
    this.mesh.needsUpdate = true;
  }
}
