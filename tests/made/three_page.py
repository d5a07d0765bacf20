"""A GLB as three.js draws it, in Chromium: an independent program's picture of our mesh, skin, texture and motions."""

from __future__ import annotations

import base64
import contextlib
import json
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from stages.avatar.rasterize import Camera
from tests.made.devtools import SOFTWARE, Page
from tests.made.judges import modules

FINER = 3  # times as many pixels each way are drawn, and averaged
PAGE = """<!doctype html><script type="importmap">
{"imports": {"three": "ROOT/build/three.module.js", "three/addons/": "ROOT/examples/jsm/"}}
</script>
<script type="module">
import * as THREE from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
const renderer = new THREE.WebGLRenderer({ antialias: false, alpha: true, preserveDrawingBuffer: true });
renderer.setClearColor(0xffffff, 0);
const began = performance.now();
const bytes = await (await fetch("data:model/gltf-binary;base64,DATA")).arrayBuffer();
const gltf = await new GLTFLoader().parseAsync(bytes, "");
const scene = new THREE.Scene();
scene.add(gltf.scene);
const mixer = new THREE.AnimationMixer(gltf.scene);
const meshes = [];
gltf.scene.traverse((one) => { if (one.isSkinnedMesh) meshes.push(one); });
for (const mesh of meshes) {  // in even light, as the Gaussians are
  mesh.frustumCulled = false;
  mesh.material = new THREE.MeshBasicMaterial({ map: mesh.material.map });
}
const camera = new THREE.PerspectiveCamera();
camera.matrixAutoUpdate = false;
window.found = { seconds: (performance.now() - began) / 1000, motions: gltf.animations.map((a) => a.name), skinned: meshes.length,
  triangles: meshes.reduce((n, m) => n + m.geometry.index.count / 3, 0), map: meshes[0]?.material.map?.image?.width };
let playing = "";
window.draw = ({ motion, seconds, world, projection, size }) => {
  if (playing !== motion) {
    mixer.stopAllAction();
    mixer.clipAction(gltf.animations.find((a) => a.name === motion)).play();
    playing = motion;
  }
  mixer.setTime(seconds);
  renderer.setSize(...size, false);
  camera.matrixWorld.fromArray(world);
  camera.matrixWorldInverse.copy(camera.matrixWorld).invert();
  camera.projectionMatrix.fromArray(projection);
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  camera.matrixWorldAutoUpdate = false;
  renderer.render(scene, camera);
  return renderer.domElement.toDataURL("image/png").split(",")[1];
};
window.ready = true;
</script>"""


class Gltf:
    """A GLB that three.js opened; `found` says how long it took in s, its motions, skinned meshes and triangles."""

    def __init__(self, glb: Path, folder: Path, tab: Page):
        text = PAGE.replace("ROOT", (modules() / "three").as_uri())
        page = folder / f"{glb.stem}.html"
        page.write_text(text.replace("DATA", base64.b64encode(glb.read_bytes()).decode()))
        self.tab, self.folder = tab, folder
        tab.open(page, "window.ready === true", 60)
        self.found = tab.run("window.found")

    def picture(self, motion: str, seconds: float, camera: Camera) -> np.ndarray:
        """A motion at a time as a camera sees it: [H,W,4] in 0..1, colours over white and coverage; FINER times finer, averaged."""
        near, far = 0.05, 100.0
        K = np.diag([FINER, FINER, 1]) @ np.asarray(camera.K, float)
        width, height = FINER * camera.width, FINER * camera.height
        projection = np.zeros((4, 4))
        projection[0, 0], projection[0, 2] = 2 * K[0, 0] / width, 1 - 2 * K[0, 2] / width
        projection[1, 1], projection[1, 2] = 2 * K[1, 1] / height, 2 * K[1, 2] / height - 1
        projection[2, 2:] = -(far + near) / (far - near), -2 * far * near / (far - near)
        projection[3, 2] = -1
        world = np.linalg.inv(np.asarray(camera.viewmat, float)) @ np.diag([1.0, -1, -1, 1])
        asked = {
            "motion": motion,
            "seconds": seconds,
            "world": world.T.ravel().tolist(),
            "projection": projection.T.ravel().tolist(),
            "size": [width, height],
        }
        drawn = self.folder / "drawn.png"
        drawn.write_bytes(base64.b64decode(self.tab.run(f"window.draw({json.dumps(asked)})")))
        pixels = cv2.imread(str(drawn), cv2.IMREAD_UNCHANGED)[..., [2, 1, 0, 3]] / 255
        pixels[..., :3] = pixels[..., :3] * pixels[..., 3:] + 1 - pixels[..., 3:]
        return pixels.reshape(camera.height, FINER, camera.width, FINER, 4).mean((1, 3))


@contextlib.contextmanager
def opened(glb: Path, folder: Path) -> Iterator[Gltf]:
    """A GLB in a tab of its own."""
    with contextlib.closing(Page(folder / "profile", (640, 640), [*SOFTWARE, "--allow-file-access-from-files"])) as tab:
        yield Gltf(glb, folder, tab)
