// The clip: the camera of each frame, and pictures of some.

export class Clip {
  /** `views` [16 a frame] camera from world, OpenCV's axes; `lenses` [4 a frame] fx, fy, cx, cy in px of `size`. */
  constructor({ names, size, pictures }, { views, lenses }) {
    Object.assign(this, { names, size, pictures, views, lenses }); // pictures: [frame, data: URL] each
  }

  /** The camera of a frame, as the stage takes it. */
  lens(frame) {
    const [fx, fy, cx, cy] = this.lenses.subarray(4 * frame, 4 * frame + 4), [width, height] = this.size;
    return { view: Array.from(this.views.subarray(16 * frame, 16 * frame + 16)), fx, fy, cx, cy, width, height };
  }

  /** Where the camera of a frame stands [3], in the clip's world. */
  eye(frame) {
    const v = this.views.subarray(16 * frame, 16 * frame + 12);
    return [0, 1, 2].map((j) => -(v[j] * v[3] + v[4 + j] * v[7] + v[8 + j] * v[11]));
  }

  /** The latest frame with a picture up to a frame, or the first. */
  pictured(frame) {
    return this.pictures.findLast(([at]) => at <= frame) ?? this.pictures[0];
  }

  /** The frame with a picture that is nearest; any frame where none has one. */
  nearest(frame) {
    if (!this.pictures.length) return Math.floor(frame);
    return this.pictures.reduce((best, [at]) => (Math.abs(at - frame) < Math.abs(best - frame) ? at : best), Infinity);
  }
}
