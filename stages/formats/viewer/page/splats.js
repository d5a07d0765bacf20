// Gaussians as Spark draws them: full-precision centres, covariances that may shear; and how each is changed on its way.
import { Color, DataArrayTexture, LinearSRGBColorSpace, Quaternion, RGBAIntegerFormat, UnsignedByteType, Vector3 } from "three";
import { dyno, ExtSplats, SplatMesh, toHalf } from "@sparkjsdev/spark";
import { quaternions } from "hugs/arrays";

const ROW = 2048; // Spark's textures are so wide

/** A mesh of packed Gaussians, whose centres and colours may change. */
export class Splats {
  constructor({ means, logscales, quats, opacities, colors }) {
    this.count = opacities.length;
    this.means = means;
    this.colors = colors;
    const turns = quaternions(quats), size = 4 * ROW * Math.max(1, Math.ceil(this.count / ROW));
    const extArrays = [new Uint32Array(size), new Uint32Array(size)];
    const maxSplats = size / 4;
    this.splats = new ExtSplats({ extArrays, numSplats: this.count });
    const center = new Vector3(), scales = new Vector3(), quat = new Quaternion(), color = new Color();
    for (let i = 0; i < this.count; i++) {
      center.fromArray(means, 3 * i);
      scales.set(Math.exp(logscales[3 * i]), Math.exp(logscales[3 * i + 1]), Math.exp(logscales[3 * i + 2]));
      quat.fromArray(turns, 4 * i);
      color.setRGB(colors[3 * i], colors[3 * i + 1], colors[3 * i + 2], LinearSRGBColorSpace);
      this.splats.setSplat(i, center, scales, quat, opacities[i], color);
    }
    if (this.splats.maxSplats !== maxSplats) throw new Error("Spark's textures have another size than expected");
    this.centers = new Float32Array(this.splats.extArrays[0].buffer);
    this.mesh = new SplatMesh({ extSplats: this.splats, covSplats: true, raycastable: false, editable: false });
  }

  /** Move Gaussian i to a place [3] of the object. */
  place(i, x, y, z) {
    this.centers[4 * i] = x;
    this.centers[4 * i + 1] = y;
    this.centers[4 * i + 2] = z;
  }

  /** Show Gaussian i with this share of its colour. */
  dim(i, share) {
    const packed = this.splats.extArrays[1], at = 4 * i, c = 3 * i;
    packed[at] = toHalf(share * this.colors[c]) | (toHalf(share * this.colors[c + 1]) << 16);
    packed[at + 1] = (packed[at + 1] & 0xffff0000) | toHalf(share * this.colors[c + 2]);
  }

  /** Hand changed centres (0) or colours (1) to the graphics card. */
  send(which) {
    this.splats.textures[which].needsUpdate = true;
    this.mesh.needsUpdate = true;
  }
}

/** What Spark calls to change each Gaussian: `code` holds a struct `name` of which `value` is one, and functions; `lines` calls
 * them, in GLSL, by the names of the Gaussian and of the struct. */
export function eachSplat(name, code, value, lines) {
  const type = { type: name }, globals = () => [code], uniform = new dyno.DynoUniform({ key: name, type, globals, value });
  return (covsplat) => new dyno.Dyno({
    inTypes: { covsplat: dyno.CovSplat, more: type },
    outTypes: { covsplat: dyno.CovSplat },
    globals,
    inputs: { covsplat, more: uniform },
    statements: ({ inputs, outputs: { covsplat: out } }) => dyno.unindentLines(`
      ${out} = ${inputs.covsplat};${lines(out, inputs.more)}`),
  }).outputs.covsplat;
}

/** A texture of `each` bytes, at most 4, of each Gaussian, in the order of another: the centres'. */
export function bytesOf(values, each, { width, height, depth }) {
  const bytes = new Uint8Array(4 * width * height * depth);
  for (let i = 0; i < values.length; i++) bytes[4 * Math.floor(i / each) + (i % each)] = values[i];
  const format = { format: RGBAIntegerFormat, type: UnsignedByteType, internalFormat: "RGBA8UI", needsUpdate: true };
  return Object.assign(new DataArrayTexture(bytes, width, height, depth), format);
}
