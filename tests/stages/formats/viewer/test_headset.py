"""The headset: a session of WebXR begins, and the page goes on when it ends. A made-up device in a real browser."""

from __future__ import annotations

import pytest

from tests.made import exhibits
from tests.made.devtools import Page

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
UNTIL = """(until) => new Promise((resolve, reject) => {
  const end = Date.now() + 20000;
  (function look() {
    if (until()) resolve(true);
    else if (Date.now() > end) reject(new Error(`never ${until}`));
    else setTimeout(look, 20);
  })();
})"""


@pytest.mark.slow
def test_a_headset_is_put_on_and_taken_off(tmp_path):
    folders = exhibits.make(tmp_path / "made")
    page = Page(tmp_path / "profile")
    try:
        page.ask("Page.addScriptToEvaluateOnNewDocument", source=DEVICE)
        page.open(folders["export"] / "viewer.html", "document.body?.matches('.open, .stuck')")
        page.run("document.getElementById('headset').click()")
        page.run(f"({UNTIL})(() => window.session?.asked)")
        stage = "hugs.player.stage"
        assert page.run(f"[session.space, {stage}.renderer.xr.isPresenting, {stage}.spark.autoUpdate]") == [
            "local-floor",
            True,
            True,
        ]
        before = page.run(f"{stage}.rig.position.z - {stage}.controls.target.z")
        assert before == pytest.approx(2), "the viewer stands 2 m before the person, who looks along z"
        page.run(
            f"{stage}.canvas.dataset.drawn = ''; {stage}.paint = () => {{ {stage}.canvas.dataset.drawn = 'yes'; }}"
        )
        page.run("session.end()")
        page.run(f"({UNTIL})(() => {stage}.canvas.dataset.drawn)")
        assert page.run(f"[{stage}.renderer.xr.isPresenting, {stage}.spark.autoUpdate, {stage}.rig.position.z]") == [
            False,
            False,
            0,
        ]
        assert page.said == []
    finally:
        page.close()
