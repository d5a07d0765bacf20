// Buttons, keys, dropped files: each changes the player, and the player's changes are shown on them.
import { Capture } from "hugs/capture";
import { PARTS } from "hugs/skeleton";
import { offerHeadset } from "hugs/headset";
import { offerRuler } from "hugs/ruler";

const SPEEDS = [0.25, 0.5, 1, 2];

export function connect(player, read, facts, scene) {
  const faced = player.people.some(({ face }) => face);
  const $ = (id) => document.getElementById(id);
  const press = (id, act) => $(id).addEventListener("click", act);
  const list = (id, rows) => $(id).replaceChildren(...rows.map(([value, text]) => new Option(text, value)));
  const say = (text) => {
    $("message").textContent = text;
    document.body.classList.toggle("told", Boolean(text));
    clearTimeout(say.later);
    if (text) say.later = setTimeout(() => say(""), 8000);
  };
  const names = () => list("motion", [...player.motions.map(({ name }, i) => [i, name]), ["open", faced ? "Open a BVH or CSV…" : "Open a BVH…"]]);
  const go = (frames) => player.set({ playing: false, position: Math.round(player.position) + frames });

  async function bring(file) {
    if (!file) return;
    say(`Reading ${file.name}…`);
    try {
      const brought = await read(file);
      if (brought instanceof Capture) {
        player.set({ capture: brought, position: 0, playing: true });
        return say(`${file.name}: ${brought.said.join("; ")}`);
      }
      player.motions.push(brought);
      names();
      player.set({ motion: brought, playing: true });
      say("");
    } catch (error) {
      say(error.message);
    }
  }

  names();
  list("speed", SPEEDS.map((speed) => [speed, `${speed}×`]));
  list("joint", PARTS.map((name, i) => [i, name.replaceAll("_", " ")]));
  $("speed").value = 1;
  $("joint").value = 18;
  press("play", () => player.set({ playing: !player.playing }));
  $("time").addEventListener("input", () => player.set({ playing: false, position: Number($("time").value) }));
  $("motion").addEventListener("change", () => {
    if ($("motion").value === "open") return $("file").click();
    player.set({ motion: player.motions[$("motion").value] });
  });
  $("file").addEventListener("change", () => bring($("file").files[0]));
  $("speed").addEventListener("change", () => player.set({ speed: Number($("speed").value) }));
  for (const show of ["person", "both", "scene"]) press(show, () => player.set({ show }));
  const look = () => {
    if (player.view === "clip") return player.home(Math.floor(player.position));
    player.set({ view: "clip", motion: player.motions[0], position: player.motion === player.motions[0] ? player.position : 0 });
  };
  press("clip", look);
  press("shade", () => player.set({ shaded: !player.shaded }));
  press("dim", () => player.set({ dimmed: !player.dimmed }));
  const home = () => player.home(facts.clip.middle);
  press("home", home);
  press("still", () => save(player, facts));
  const whole = () => (document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen());
  press("full", whole);
  press("about", () => $("facts-of").showModal());
  const toggle = () => { $("joints").hidden = !$("joints").hidden; };
  press("bend", toggle);
  const axes = ["x", "y", "z"].map((axis) => $(`turn-${axis}`));
  axes.forEach((slider) => slider.addEventListener("input", () => {
    player.bend(Number($("joint").value), axes.map(({ value }) => Number(value)));
  }));
  $("joint").addEventListener("change", () => player.changed());
  const sliders = [...document.querySelectorAll("[data-shapes]")].map((slider) => [slider, slider.dataset.shapes.split(" ")]);
  for (const [slider, names] of sliders) slider.addEventListener("input", () => player.shape(names, slider.value / 100));
  press("unbend", () => player.reset());
  player.stage.controls.addEventListener("start", () => {
    if (player.stage.lens) player.orbit();
  });

  const keys = {
    " ": () => player.set({ playing: !player.playing }), ArrowLeft: () => go(-1), ArrowRight: () => go(1),
    1: () => player.set({ show: "person" }), 2: () => $("both").click(), 3: () => $("scene").click(),
    c: look, s: () => $("shade").click(), i: () => $("dim").click(), j: toggle, r: () => $("home").click(), p: () => save(player, facts), f: whole, m: () => $("ruler").click(),
    "?": () => $("about").click(),
  };
  addEventListener("keydown", (event) => {
    if (event.target.matches("select, input, dialog *") && event.key !== " " || event.ctrlKey || event.metaKey || event.altKey) return;
    const act = keys[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!act || (event.key === " " && event.target.matches("button, select"))) return;
    event.preventDefault();
    act();
  });
  addEventListener("dragover", (event) => {
    event.preventDefault();
    document.body.classList.add("over");
  });
  addEventListener("dragleave", () => document.body.classList.remove("over"));
  addEventListener("drop", (event) => {
    event.preventDefault();
    document.body.classList.remove("over");
    bring(event.dataTransfer.files[0]);
  });

  for (const id of ["both", "scene"]) $(id).disabled = !player.scene;
  $("shade").hidden = !player.shadow;
  $("dim").hidden = !player.fading?.invented;
  if (!facts.clip.pictures.length) Object.assign($("clip"), { textContent: "Camera", title: "Through the film's camera (C)" });
  if (player.people.length > 1) Object.assign($("person"), { textContent: "People", title: "The people alone (1)" });
  $("full").hidden = !document.fullscreenEnabled;
  offerHeadset(player, $("headset"), say, home);
  offerRuler(player, scene, facts.timesFit, $("ruler"), $("distance"));

  document.body.style.setProperty("--stage", `#${facts.background.toString(16)}`);
  document.body.style.setProperty("--shape", facts.clip.size[0] / facts.clip.size[1]);
  player.changed = () => {
    const { motion, position } = player, at = Math.floor(position);
    $("time").max = motion.count - 1;
    $("time").value = position;
    $("time").style.setProperty("--at", motion.count > 1 ? position / (motion.count - 1) : 0);
    $("clock").textContent = `${(position / motion.fps).toFixed(1)} / ${motion.seconds.toFixed(1)} s`;
    $("motion").value = player.motions.indexOf(motion);
    document.body.classList.toggle("playing", player.playing);
    $("play").setAttribute("aria-label", player.playing ? "Pause" : "Play");
    for (const show of ["person", "both", "scene"]) $(show).setAttribute("aria-pressed", player.show === show);
    $("clip").setAttribute("aria-pressed", player.view === "clip");
    $("shade").disabled = player.show !== "both";
    $("shade").setAttribute("aria-pressed", player.shaded);
    $("dim").disabled = player.show === "person";
    $("dim").setAttribute("aria-pressed", player.dimmed);
    $("bend").setAttribute("aria-pressed", player.bends.size + player.shapes.size > 0 || player.capture !== null);
    for (const [slider, [name]] of sliders) {
      slider.value = 100 * (player.shapes.get(name) ?? 0);
      slider.nextElementSibling.textContent = slider.value;
    }
    const angles = player.bends.get(Number($("joint").value)) ?? [0, 0, 0];
    axes.forEach((slider, i) => {
      slider.value = angles[i];
      slider.nextElementSibling.textContent = `${angles[i]}°`;
    });
    const paired = player.view === "clip" && player.clip.pictures.length > 0;
    document.body.classList.toggle("paired", paired);
    if (!paired) return;
    const [frame, picture] = player.clip.pictured(at);
    if ($("picture").dataset.frame !== String(frame)) {
      $("picture").dataset.frame = frame;
      $("picture").src = picture;
    }
    $("caption").textContent = `the clip, frame ${player.clip.names[frame]}`;
    $("ours").textContent = `ours, frame ${player.clip.names[at]}`;
  };
}

async function save(player, facts) {
  const link = document.createElement("a");
  link.href = await player.stage.still();
  link.download = `${facts.title}-${player.motion.name}-${Math.round(player.position)}.png`.replace(/[^\w.-]+/g, "_");
  link.click();
}
