// Puts the parts together and lends `window.hugs` to the console and to tests.
import { unpack } from "hugs/arrays";
import { Clip } from "hugs/clip";
import { connect } from "hugs/controls";
import { Capture } from "hugs/capture";
import { performed, readDropped } from "hugs/dropped";
import { Fading } from "hugs/fading";
import { Motion } from "hugs/motion";
import { Person } from "hugs/person";
import { Player } from "hugs/player";
import { Shadow } from "hugs/shadow";
import { Splats } from "hugs/splats";
import { Stage } from "hugs/stage";

export async function start(facts, buffer) {
  const groups = {};
  for (const [name, values] of Object.entries(unpack(buffer, facts.arrays))) {
    const [group, part] = name.split("/");
    (groups[group] ??= {})[part] = values;
  }
  let player = null;
  const stage = new Stage(document.getElementById("canvas"), facts, () => player.step());
  const people = facts.people.map((own, i) => new Person(groups[`person${i}`], own, groups[`soles${i}`], facts.shading));
  const scene = groups.scene ? new Splats(groups.scene) : null;
  stage.world.add(...people.map(({ mesh }) => mesh));
  if (scene) stage.world.add(scene.mesh);
  const shadow = facts.shadow && scene ? new Shadow(facts.shadow) : null;
  const motions = facts.motions.map(({ name, fps }, i) => new Motion(name, fps, people.map((_, who) => groups[`motion${who}.${i}`])));
  const clip = new Clip(facts.clip, groups.clip), fading = scene ? new Fading(scene, groups.scene.marks, clip) : null;
  player = new Player(stage, people, scene, { shadow, fading }, clip, motions);
  connect(player, (file) => readDropped(file, people), facts, groups.scene);
  window.hugs = { player, facts, show: (wanted) => show(player, wanted), perform: (text) => performed(text, people[0]), capture: (text) => new Capture(text) };
  player.position = facts.clip.middle;
  player.home(facts.clip.middle);
  await stage.shown;
  const still = matchMedia("(prefers-reduced-motion: reduce)").matches || location.hash === "#still";
  if (!still) player.set({ playing: true });
}

/** Draw one exact frame: resolves to a PNG (data: URL) once it is sorted and painted.
 *
 * motion: name or number; frame: of the motion; camera: number of a frame of the clip, or {view, fx, fy, cx, cy, width,
 * height}; only: person, scene or both; background: 0xrrggbb; size: [width, height] px, the camera's own if none. */
async function show(player, { motion = 0, frame = 0, camera = 0, only = "both", background, size, shadow }) {
  const { stage } = player, lens = typeof camera === "number" ? player.clip.lens(camera) : camera;
  const chosen = typeof motion === "number" ? player.motions[motion] : player.motions.find(({ name }) => name === motion);
  if (!chosen) throw new Error(`no motion ${motion}`);
  player.set({ playing: false, view: "orbit", motion: chosen, position: frame, show: only, given: lens, plain: true });
  if (shadow !== undefined) player.set({ shaded: shadow });
  if (background !== undefined) stage.background = background;
  stage.size = size ?? [lens.width, lens.height];
  await stage.idle();
  return stage.still();
}
