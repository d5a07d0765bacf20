// Arrays as stages/formats/viewer/packing.py packs them: one block of bytes, each column's bytes in planes.

/** Named typed arrays of a packed block: {name: {kind, shape, at, low, step}} tells where each lies and what it means. */
export function unpack(buffer, table) {
  const found = {};
  for (const [name, entry] of Object.entries(table)) found[name] = read(buffer, entry);
  return found;
}

function read(buffer, { kind, shape, at, low, step }) {
  const size = shape.reduce((a, b) => a * b, 1);
  if (kind === "f32") return new Float32Array(buffer.slice(at, at + 4 * size));
  const width = { u8: 1, u16: 2, u24: 3, u32: 4 }[kind];
  const rows = shape[0], columns = size / (rows || 1);
  const bytes = new Uint8Array(buffer, at, size * width);
  const whole = new Uint32Array(size);
  for (let column = 0, plane = 0; column < columns; column++) {
    for (let byte = 0; byte < width; byte++, plane += rows) {
      const worth = 2 ** (8 * byte);
      for (let row = 0; row < rows; row++) whole[row * columns + column] += bytes[plane + row] * worth;
    }
  }
  if (step === undefined) return whole;
  return Float32Array.from(whole, (value, i) => low[i % columns] + step[i % columns] * value);
}

const HALF = Math.SQRT1_2;

/** Unit quaternions x y z w from 32 bits each: which part is largest, and the three others at 10 bits. */
export function quaternions(packed) {
  const out = new Float32Array(4 * packed.length);
  packed.forEach((bits, i) => {
    const largest = bits >>> 30;
    let rest = 1;
    for (let k = 0, shift = 20; k < 4; k++) {
      if (k === largest) continue;
      const part = (((bits >>> shift) & 1023) / 1023 * 2 - 1) * HALF;
      out[4 * i + k] = part;
      rest -= part * part;
      shift -= 10;
    }
    out[4 * i + largest] = Math.sqrt(Math.max(0, rest));
  });
  return out;
}
