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
  /** `moves` [3][52 each] m of the Gaussians `mien` of a body at rest for coefficient 1 of each shape. */
  constructor(body, { mien, moves }) {
    Object.assign(this, { body, rows: mien, moves, last: [] });
  }

  /** Take coefficients [52], or none for a face at rest. */
  take(face = []) {
    if (face.length === this.last.length && face.every((value, k) => value === this.last[k])) return;
    this.last = face;
    const shapes = FACE_NAMES.map((_, k) => k).filter((k) => face[k]), { means } = this.body, { length } = FACE_NAMES;
    const place = [0, 0, 0];
    this.rows.forEach((row, i) => {
      for (let axis = 0; axis < 3; axis++) {
        const first = length * (3 * i + axis);
        place[axis] = means[3 * row + axis];
        for (const k of shapes) place[axis] += face[k] * this.moves[first + k];
      }
      this.body.place(row, ...place);
    });
    this.body.send(0);
  }
}
