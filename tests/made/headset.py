"""A made-up headset, for a browser that has none: WebXR as far as three.js asks for it."""

DEVICE = """
class Session extends EventTarget {
  constructor() { super(); Object.assign(this, { inputSources: [], renderState: {}, visibilityState: "visible" }); }
  updateRenderState(state) { Object.assign(this.renderState, state); }
  async requestReferenceSpace(kind) { this.space = kind; return new EventTarget(); }
  requestAnimationFrame(draw) {
    const frame = { session: this, getViewerPose: () => { this.asked = true; return null; } };
    return setTimeout(() => draw(performance.now(), frame), 10);
  }
  cancelAnimationFrame(number) { clearTimeout(number); }
  async end() { this.dispatchEvent(new Event("end")); }
}
WebGL2RenderingContext.prototype.makeXRCompatible = async () => {};
window.XRWebGLBinding = undefined;
window.XRWebGLLayer = class { framebuffer = null; framebufferWidth = 64; framebufferHeight = 48; };
const requestSession = async () => (window.session = new Session());
const isSessionSupported = async (kind) => kind === "immersive-vr";
Object.defineProperty(navigator, "xr", { value: Object.assign(new EventTarget(), { isSessionSupported, requestSession }) });
"""
"""What a page runs before all else. `session` is what it began, `session.asked` that it asked for eyes to draw for."""
