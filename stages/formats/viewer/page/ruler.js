// A ruler: two places of the scene that are clicked on, how far they are apart, and the option that corrects it.
import { BufferAttribute, BufferGeometry, Group, Line, LineBasicMaterial, Points, PointsMaterial, Vector3 } from "three";
import { quaternions } from "hugs/arrays";

const SURFACE = 0.5; // of a ray's light, that a surface has stopped
const FAINT = 1 / 255;
const STILL = 4; // px that a mouse may move in a click

/** Where a ray from `eye` [3] along `way` [3], of length 1, meets the surface that Gaussians make: m from the eye; null if nowhere.
 * `shown(i, x, y, z)` is the share of Gaussian i that is seen. */
export function reach({ means, logscales, turns, opacities }, eye, way, shown) {
  const met = [];
  for (let i = 0; i < opacities.length; i++) {
    const [x, y, z, w] = turns.subarray(4 * i, 4 * i + 4), m = 3 * i;
    const axes = [
      [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
      [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
      [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
    ];
    let along = 0, square = 0, off = 0; // of the ray, where the Gaussian is a ball of radius 1
    for (let k = 0; k < 3; k++) {
      const [a, b, c] = axes[k], size = Math.exp(-logscales[m + k]);
      const from = size * (a * (eye[0] - means[m]) + b * (eye[1] - means[m + 1]) + c * (eye[2] - means[m + 2]));
      const go = size * (a * way[0] + b * way[1] + c * way[2]);
      along += from * go;
      square += go * go;
      off += from * from;
    }
    const far = -along / square;
    let alpha = far > 0 ? opacities[i] * Math.exp(-0.5 * Math.max(0, off - along * along / square)) : 0;
    if (alpha > FAINT) alpha *= shown(i, means[m], means[m + 1], means[m + 2]);
    if (alpha > FAINT) met.push([far, alpha]);
  }
  met.sort(([a], [b]) => a - b);
  let light = 1;
  for (const [far, alpha] of met) {
    light *= 1 - alpha;
    if (light < 1 - SURFACE) return far;
  }
  return null;
}

/** Let `button` switch a ruler on: clicks on the canvas take places of the scene, `output` shows what is between two of them.
 * `timesFit`: how much larger the scene is than the run's own fit made it; null where no run can be told another length. */
export function offerRuler(player, gaussians, timesFit, button, output) {
  button.hidden = !gaussians;
  if (!gaussians) return;
  const { stage, fading } = player, { canvas } = stage, scene = { ...gaussians, turns: quaternions(gaussians.quats) };
  const [distance, option] = output.children, mark = line();
  let places = [], on = false, down = [0, 0];
  stage.world.add(mark);

  const show = () => {
    output.hidden = !on;
    button.setAttribute("aria-pressed", on);
    mark.visible = on && places.length > 0;
    const apart = places.length === 2 ? places[0].distanceTo(places[1]) : null;
    distance.textContent = apart === null ? "Click on two places of the scene" : `${apart.toFixed(2)} m`;
    option.textContent = apart === null || timesFit === null ? "" : `--scale ${(apart / timesFit).toFixed(3)}=METRES`;
    option.title = "Give it to hugs run, with the true length, where this one is wrong";
    if (places.length) mark.draw([places[0], places.at(-1)]);
    stage.wake();
  };
  const take = (x, y) => {
    const { left, top, width, height } = canvas.getBoundingClientRect(), back = stage.world.matrix.clone().invert();
    const there = new Vector3(2 * (x - left) / width - 1, 1 - 2 * (y - top) / height, 0).unproject(stage.camera).applyMatrix4(back);
    const eye = stage.eye, way = there.sub(eye).normalize();
    const far = reach(scene, eye.toArray(), way.toArray(), (...at) => fading?.shown(...at) ?? 1);
    if (far === null) return;
    places = [...(places.length === 1 ? places : []), eye.addScaledVector(way, far)];
    show();
  };
  button.addEventListener("click", () => {
    [places, on] = [[], !on];
    if (on && player.show === "person") player.set({ show: "both" });
    if (on && stage.lens) player.orbit();
    show();
  });
  canvas.addEventListener("pointerdown", ({ clientX, clientY }) => { down = [clientX, clientY]; });
  canvas.addEventListener("pointerup", ({ button: which, clientX, clientY }) => {
    if (on && which === 0 && Math.hypot(clientX - down[0], clientY - down[1]) < STILL) take(clientX, clientY);
  });
}

/** A line with its ends, in front of all else. */
function line() {
  const material = { color: 0xffb020, depthTest: false, transparent: true }, shape = new BufferGeometry(), group = new Group();
  group.visible = false;
  shape.setAttribute("position", new BufferAttribute(new Float32Array(6), 3));
  for (const one of [new Line(shape, new LineBasicMaterial(material)), new Points(shape, new PointsMaterial({ ...material, size: 9, sizeAttenuation: false }))]) {
    group.add(Object.assign(one, { renderOrder: 10, frustumCulled: false }));
  }
  group.draw = (ends) => {
    ends.forEach((end, i) => shape.attributes.position.setXYZ(i, end.x, end.y, end.z));
    shape.attributes.position.needsUpdate = true;
  };
  return group;
}
