// The clip's light on a person, by the direction that each Gaussian faces. The same as stages/avatar/effects/shading.py.
const STEEPEST = 1.5; // bounds the log of the light
const C1 = Math.sqrt(3 / (4 * Math.PI)), C2 = Math.sqrt(15 / (4 * Math.PI)), C2Z = Math.sqrt(5 / (16 * Math.PI));
const AROUND = 64; // directions over which the light has the mean 1

/** Spherical harmonics of degree 1 and 2. */
const harmonics = (x, y, z) => [
  -C1 * y, C1 * z, -C1 * x, C2 * x * y, -C2 * y * z, C2Z * (3 * z * z - 1), -C2 * x * z, 0.5 * C2 * (x * x - y * y),
];

/** The log of the mean light [3] of `bands` [8][3] over all directions. */
function mean(bands) {
  const sums = [0, 0, 0];
  for (let i = 0; i < AROUND; i++) {
    const z = 1 - (2 * i + 1) / AROUND, around = (i + 0.5) * Math.PI * (1 + Math.sqrt(5)), level = Math.sqrt(1 - z * z);
    const basis = harmonics(Math.cos(around) * level, Math.sin(around) * level, z);
    for (let c = 0; c < 3; c++) {
      const steep = basis.reduce((sum, value, k) => sum + value * bands[k][c], 0);
      sums[c] += Math.exp(steep / Math.hypot(1, steep / STEEPEST));
    }
  }
  return sums.map((sum) => Math.log(sum / AROUND));
}

const float = (value) => value.toExponential(8);
const vec3 = (values) => `vec3(${values.map(float).join(", ")})`;

/** `vec3 hugsLight(vec3 n)`: the light on what faces n, in GLSL. */
export function glslOf(bands) {
  const names = ["-C1 * n.y", "C1 * n.z", "-C1 * n.x", "C2 * n.x * n.y", "-C2 * n.y * n.z", "C2Z * (3.0 * n.z * n.z - 1.0)",
    "-C2 * n.x * n.z", "0.5 * C2 * (n.x * n.x - n.y * n.y)"];
  const constants = { C1, C2, C2Z };
  const terms = names.map((name, k) => `(${name.replace(/C2Z|C2|C1/g, (one) => float(constants[one]))}) * ${vec3(bands[k])}`);
  return `
vec3 hugsLight(vec3 n) {
  vec3 steep = ${terms.join(" + ")};
  return exp(steep / sqrt(1.0 + steep * steep / ${float(STEEPEST ** 2)}) - ${vec3(mean(bands))});
}`;
}
