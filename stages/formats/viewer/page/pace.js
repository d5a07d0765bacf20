// How fine to draw, so that slow machines stay responsive: the time of a frame goes with its pixels.

const COARSEST = 0.25; // of the screen's own resolution
const STEPS = 8;

export class Pace {
  cost = null; // ms a pixel, as measured

  /** The share of full resolution that draws `pixels` within `budget` ms; the first frame ever is the coarsest. */
  share(pixels, budget) {
    if (this.cost === null) return COARSEST;
    const fits = Math.sqrt(budget / (this.cost * pixels));
    return Math.min(1, Math.max(COARSEST, Math.floor(fits * STEPS) / STEPS));
  }

  /** Wait until the card has painted what it was told; remember how long `pixels` took since `begun`. */
  async painted(gl, pixels, begun) {
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    while (!gl.isContextLost() && gl.clientWaitSync(fence, 0, 0) === gl.TIMEOUT_EXPIRED) {
      await new Promise((resolve) => setTimeout(resolve, 2));
    }
    gl.deleteSync(fence);
    const cost = (performance.now() - begun) / pixels;
    this.cost = this.cost === null ? cost : (this.cost + cost) / 2;
  }
}
