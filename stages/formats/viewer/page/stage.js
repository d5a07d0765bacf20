// The stage: camera, light table, one frame at a time. A frame is drawn when the last one is, never before.
import { Box3, CanvasTexture, Color, Group, Matrix4, Mesh, MeshBasicMaterial, PerspectiveCamera, PlaneGeometry, Scene, SRGBColorSpace, Vector2, Vector3, WebGLRenderer } from "three";
import { SparkRenderer } from "@sparkjsdev/spark";
import { Light } from "hugs/light";
import { Pace } from "hugs/pace";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

const NEAR = 0.01, FAR = 1e5; // m
const MOVING = 60, STILL = 1500; // ms that a frame may take
const REST = 250; // ms without a change until a frame is drawn as fine as it can be
const WIDEST = 75; // degrees
const BAR = 42; // px by which the middle of the picture lies above the middle of the window, to clear the controls
const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

export class Stage {
  /** `world` [16], row by row, takes the clip's world to one with y up and the floor at 0; both in metres. */
  constructor(canvas, { world, antialias, background }, pose) {
    this.canvas = canvas;
    this.pose = pose;
    this.renderer = new WebGLRenderer({ canvas, antialias: false, powerPreference: "high-performance" });
    this.scene = new Scene();
    this.camera = new PerspectiveCamera(40, 1, NEAR, FAR);
    this.rig = new Group(); // in a headset, where the viewer stands
    this.rig.add(this.camera);
    this.world = new Group();
    this.world.matrixAutoUpdate = false;
    this.world.matrix.set(...world);
    this.spark = new SparkRenderer({
      renderer: this.renderer, autoUpdate: false, enableLod: false, lodRaycast: 0,
      covSplats: true, accumExtSplats: true, sortRadial: false, maxStdDev: 3.33, minAlpha: 1 / 255, // as ours
      preBlurAmount: antialias ? 0 : 0.3, blurAmount: antialias ? 0.1 : 0,
    });
    this.floor = floor();
    this.scene.add(this.world, this.spark, this.rig, this.floor);
    this.controls = new OrbitControls(this.camera, canvas);
    Object.assign(this.controls, { enableDamping: false, zoomToCursor: true, minDistance: 0.2, maxDistance: 60 });
    this.controls.addEventListener("change", () => this.wake());
    this.lens = null; // a frame's camera, {view [16], fx, fy, cx, cy, width, height}, in place of the orbit's
    this.size = null; // px, in place of the window's
    this.background = this.backdrop = background;
    this.dirty = this.busy = false;
    this.pace = new Pace();
    this.light = new Light(this.renderer);
    this.shown = new Promise((resolve) => { this.drawn = resolve; }); // the first frame is on screen
    new ResizeObserver(() => this.wake()).observe(canvas);
    canvas.addEventListener("webglcontextrestored", () => this.wake());
  }

  /** Ask for a frame. */
  wake() {
    this.dirty = true;
    if (!this.busy && !this.renderer.xr.isPresenting) this.run();
  }

  async run() {
    this.busy = true;
    try {
      while (this.dirty && !this.renderer.xr.isPresenting) {
        await new Promise((resolve) => requestAnimationFrame(resolve));
        this.dirty = false;
        let share = await this.draw(MOVING);
        for (let waited = 0; waited < REST && share < 1 && !this.dirty; waited += 20) await pause(20);
        if (share < 1 && !this.dirty) share = await this.draw(STILL);
      }
    } finally {
      this.busy = false;
    }
  }

  /** Draw one frame within about `budget` ms: pose, sort, then paint in the order of depth. Returns how fine it is. */
  async draw(budget) {
    const begun = performance.now();
    this.pose();
    this.measure();
    this.aim();
    this.scene.updateMatrixWorld();
    await this.spark.update({ scene: this.scene, camera: this.camera });
    const full = this.size ? 1 : Math.min(devicePixelRatio, 2), pixels = this.width * this.height * full * full;
    const share = this.size ? 1 : this.pace.share(pixels, budget);
    this.paint(full * share);
    await this.pace.painted(this.renderer.getContext(), pixels * share * share, begun);
    this.drawn();
    return share;
  }

  /** Resolves once nothing waits to be drawn. */
  async idle() {
    while (this.busy) await pause(10);
  }

  paint(ratio) {
    const { renderer } = this, now = renderer.getSize(new Vector2());
    if (now.x !== this.width || now.y !== this.height || renderer.getPixelRatio() !== ratio) {
      renderer.setPixelRatio(ratio);
      renderer.setSize(this.width, this.height, false);
    }
    renderer.setClearColor(new Color().setHex(this.background, SRGBColorSpace));
    this.light.paint(this.scene, this.camera);
  }

  /** The size of the picture in CSS px: as wanted, or as the canvas is on screen. */
  measure() {
    [this.width, this.height] = this.size ?? [this.canvas.clientWidth || 1, this.canvas.clientHeight || 1];
    this.camera.aspect = this.width / this.height;
  }

  /** Look through the frame's lens, with the whole frame in view, or through the orbit's. */
  aim() {
    const { camera, width: w, height: h } = this;
    camera.setViewOffset(w, h, 0, BAR, w, h); // updates the projection
    if (!this.lens) return;
    const { view, fx, fy, cx, cy, width, height } = this.lens;
    const s = Math.min(w / width, h / height), left = (w - s * width) / 2, top = (h - s * height) / 2;
    const flip = new Matrix4().makeScale(1, -1, -1); // OpenCV's y and z
    const there = new Matrix4().set(...view).invert().multiply(flip).premultiply(this.world.matrix);
    there.decompose(camera.position, camera.quaternion, new Vector3());
    const depth = (FAR + NEAR) / (NEAR - FAR), last = 2 * FAR * NEAR / (NEAR - FAR);
    camera.projectionMatrix.set(
      2 * s * fx / w, 0, 1 - 2 * (s * cx + left) / w, 0,
      0, 2 * s * fy / h, 2 * (s * cy + top) / h - 1, 0,
      0, 0, depth, last,
      0, 0, -1, 0,
    );
    camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  }

  /** Where the camera stands, in the clip's world. */
  get eye() {
    return this.camera.getWorldPosition(new Vector3()).applyMatrix4(this.world.matrix.clone().invert());
  }

  /** Stand where the lens stands and orbit about points of the clip's world from there, [x, y, z, reach] each: all fit into the
   * window above the controls, and where that would be too wide an angle the camera steps back. */
  orbit(points) {
    const { camera, controls } = this, places = points.map((point) => new Vector3(...point).applyMatrix4(this.world.matrix));
    if (this.lens) this.aim();
    Object.assign(this, { lens: null, size: null, background: this.backdrop });
    this.measure();
    new Box3().setFromPoints(places).getCenter(controls.target);
    controls.update();
    camera.updateMatrixWorld();
    const tall = Math.max(0.4, 1 - 4 * BAR / this.height), wide = 0.92 * camera.aspect;
    const needs = places.map((place, i) => {
      const { x, y, z } = place.applyMatrix4(camera.matrixWorldInverse), reach = points[i][3];
      return [Math.max((Math.abs(y) + reach) / tall, (Math.abs(x) + reach) / wide), -z];
    });
    const widest = Math.tan(WIDEST / 2 * Math.PI / 180), back = Math.max(0, ...needs.map(([half, z]) => half / widest - z));
    camera.translateZ(back);
    camera.fov = 2 * Math.atan(Math.max(...needs.map(([half, z]) => half / (z + back)))) * 180 / Math.PI;
    controls.update();
    this.wake();
  }

  /** The picture as it is now, a data: URL of a PNG. */
  async still() {
    await this.idle();
    await this.draw(Infinity);
    this.paint(this.renderer.getPixelRatio()); // a canvas can be read in the task that painted it, and no later
    return this.canvas.toDataURL("image/png");
  }
}

/** A soft round patch on the floor, for a person without a scene. */
function floor() {
  const side = 256, canvas = document.createElement("canvas");
  canvas.width = canvas.height = side;
  const pen = canvas.getContext("2d"), fade = pen.createRadialGradient(side / 2, side / 2, 0, side / 2, side / 2, side / 2);
  [[0, 0.16], [0.35, 0.1], [0.7, 0.03], [1, 0]].forEach(([at, light]) => fade.addColorStop(at, `rgba(255,255,255,${light})`));
  pen.fillStyle = fade;
  pen.fillRect(0, 0, side, side);
  const map = new CanvasTexture(canvas);
  const patch = new Mesh(new PlaneGeometry(5, 5), new MeshBasicMaterial({ map, transparent: true, depthWrite: false }));
  patch.rotation.x = -Math.PI / 2;
  patch.renderOrder = -1;
  return patch;
}
