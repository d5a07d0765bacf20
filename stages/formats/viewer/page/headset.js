// The headset: where the browser has WebXR, the person stands before the viewer on the same floor.

/** Show `button` if there is a headset; `home` is called when it is taken off. Gaussians are sorted after each frame
 * there, so that none comes late. */
export async function offerHeadset(player, button, say, home) {
  const can = await navigator.xr?.isSessionSupported("immersive-vr").catch(() => false);
  button.hidden = !can;
  if (!can) return;
  const { stage } = player, { renderer, spark } = stage;
  renderer.xr.addEventListener("sessionend", () => { // after three.js has the canvas back; the session's own "end" is before
    renderer.setAnimationLoop(null);
    renderer.xr.enabled = spark.autoUpdate = false;
    stage.rig.position.set(0, 0, 0);
    home();
  });
  button.addEventListener("click", async () => {
    try {
      await stage.idle();
      const session = await navigator.xr.requestSession("immersive-vr", { requiredFeatures: ["local-floor"] });
      renderer.xr.enabled = true;
      renderer.xr.setReferenceSpaceType("local-floor");
      stage.lens = null;
      spark.autoUpdate = true;
      const { target } = stage.controls;
      stage.rig.position.set(target.x, 0, target.z + 2);
      await renderer.xr.setSession(session);
      renderer.setAnimationLoop(() => {
        player.step();
        renderer.render(stage.scene, stage.camera);
      });
    } catch (error) {
      say(`The headset did not start: ${error.message}`);
    }
  });
}
