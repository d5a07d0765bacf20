// The face of an avatar: shapes that move the Gaussians of the head, and add up.
export const FACE_NAMES = `browDownLeft browDownRight browInnerUp browOuterUpLeft browOuterUpRight cheekPuff cheekSquintLeft
  cheekSquintRight eyeBlinkLeft eyeBlinkRight eyeLookDownLeft eyeLookDownRight eyeLookInLeft eyeLookInRight
  eyeLookOutLeft eyeLookOutRight eyeLookUpLeft eyeLookUpRight eyeSquintLeft eyeSquintRight eyeWideLeft
  eyeWideRight jawForward jawLeft jawOpen jawRight mouthClose mouthDimpleLeft mouthDimpleRight mouthFrownLeft
  mouthFrownRight mouthFunnel mouthLeft mouthLowerDownLeft mouthLowerDownRight mouthPressLeft mouthPressRight
  mouthPucker mouthRight mouthRollLower mouthRollUpper mouthShrugLower mouthShrugUpper mouthSmileLeft
  mouthSmileRight mouthStretchLeft mouthStretchRight mouthUpperUpLeft mouthUpperUpRight noseSneerLeft
  noseSneerRight tongueOut`.split(/\s+/);

export class Face {
  /** `moves` [3][K each] m of the Gaussians `mien` of a body at rest for coefficient 1 of each of K shapes, FACE_NAMES first. */
  constructor(body, { mien, moves }) {
    const count = moves.length / (3 * mien.length), shapes = Array.from({ length: count }, () => []); // of each: a number in `far`, how far it moves that, and so on
    moves.forEach((move, i) => { if (move) shapes[i % count].push(Math.floor(i / count), move); });
    Object.assign(this, { body, rows: mien, shapes, far: new Float32Array(3 * mien.length), last: [] });
  }

  /** Take coefficients of the first shapes, or none for a face at rest. */
  take(face = []) {
    if (face.length === this.last.length && face.every((share, k) => share === this.last[k])) return;
    this.last = face;
    const { body, far, shapes } = this, { means } = body;
    far.fill(0);
    shapes.forEach((moved, k) => {
      const share = face[k];
      if (share) for (let j = 0; j < moved.length; j += 2) far[moved[j]] += share * moved[j + 1];
    });
    this.rows.forEach((row, i) => {
      body.place(row, means[3 * row] + far[3 * i], means[3 * row + 1] + far[3 * i + 1], means[3 * row + 2] + far[3 * i + 2]);
    });
    body.send(0);
  }
}
