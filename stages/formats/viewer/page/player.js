// What is shown: which motion, at what time, through which camera. All else follows from it.
import { FACE_NAMES } from "hugs/face";
import { add, matrixOfQuat, matrixOfRotvec, mul, quatOfMatrix } from "hugs/turns";

export class Player {
  constructor(stage, people, scene, { shadow, fading }, clip, motions) {
    Object.assign(this, { stage, people, scene, shadow, fading, clip, motions });
    this.motion = motions[0];
    this.position = 0; // in frames of the motion
    this.playing = false;
    this.speed = 1;
    this.show = scene ? "both" : "person";
    this.view = "orbit"; // or "clip": through the camera of each frame
    this.given = null; // or a camera to look through
    this.plain = false; // or nothing but the Gaussians
    this.shaded = shadow !== null;
    this.dimmed = false; // what is invented of the scene
    this.bends = new Map(); // joint -> angles about x, y, z in degrees, on top of the motion
    this.shapes = new Map(); // shape of the face, or the fist -> how much of it, on top of the motion
    this.capture = null; // or the face that all have in place of the motion's
    this.laps = 0; // how often the motion has begun again
    this.changed = () => {};
    this.posed = "";
    this.last = null;
  }

  /** Change what is shown, and draw it. */
  set(values) {
    Object.assign(this, values);
    if ("motion" in values && !("position" in values)) this.position = 0;
    if ("motion" in values || "position" in values) this.laps = 0;
    if (this.motion !== this.motions[0]) this.view = "orbit";
    this.position = Math.max(0, Math.min(this.motion.count - 1, this.position));
    if (this.view === "clip" && !this.playing) this.position = this.clip.nearest(this.position); // pairs that belong together
    this.last = null;
    this.stage.wake();
    this.changed();
  }

  bend(joint, angles) {
    if (angles.some(Boolean)) this.bends.set(joint, angles);
    else this.bends.delete(joint);
    this.set({});
  }

  /** Add so much of shapes of the face, or of a fist, 0 to 1. */
  shape(names, share) {
    for (const name of names) {
      if (share) this.shapes.set(name, share);
      else this.shapes.delete(name);
    }
    this.set({});
  }

  /** No bends, no shapes and no capture on top of the motion. */
  reset() {
    this.bends.clear();
    this.shapes.clear();
    this.set({ capture: null });
  }

  /** Called by the stage before each frame: go on in time, take the pose, choose the camera. */
  step() {
    const now = performance.now();
    if (this.playing) {
      const frames = this.last === null ? 0 : Math.min(0.25, (now - this.last) / 1000) * this.speed * this.motion.fps;
      this.laps += Math.floor((this.position + frames) / this.motion.count);
      this.position = (this.position + frames) % this.motion.count;
      this.last = now;
      this.changed();
      this.stage.dirty = true;
    }
    const { stage, people, scene } = this, frame = Math.floor(this.position);
    for (const { mesh, absent } of people) mesh.visible = this.show !== "scene" && !(this.motion === this.motions[0] && absent.has(frame));
    const seen = people.map(({ mesh }) => mesh.visible);
    if (scene) scene.mesh.visible = this.show !== "person";
    stage.floor.visible = this.show === "person" && this.view === "orbit" && !this.plain;
    stage.lens = this.view === "clip" ? this.clip.lens(Math.floor(this.position)) : this.given;
    this.fading?.look(stage.eye, !stage.lens, this.dimmed);
    const at = this.view === "clip" ? Math.floor(this.position) : this.position;
    const wanted = JSON.stringify([this.motions.indexOf(this.motion), at, seen, this.show, this.shaded, [...this.bends],
      [...this.shapes], this.capture && this.seconds]);
    if (wanted === this.posed) return;
    this.posed = wanted;
    const bones = people.map((person, who) => person.take(this.bent(this.motion.at(at, who))));
    const casting = (_, who) => this.shaded && seen[who];
    if (scene && this.shadow && this.show !== "person") this.shadow.cast(scene, people.filter(casting), bones.filter(casting));
  }

  /** s since the motion began, however often it began again. */
  get seconds() { return (this.laps * this.motion.count + this.position) / this.motion.fps; }

  /** A pose of the motion with what comes on top of it. */
  bent(pose) {
    const quats = [...pose.quats];
    for (const [joint, angles] of this.bends) {
      const [x, y, z] = angles.map((angle, axis) => {
        const turn = [0, 0, 0];
        turn[axis] = angle * Math.PI / 180;
        return matrixOfRotvec(turn);
      });
      quats[joint] = quatOfMatrix(mul(matrixOfQuat(quats[joint]), mul(z, mul(y, x))));
    }
    const face = this.capture?.at(this.seconds) ?? pose.face, more = this.shapes;
    const named = FACE_NAMES.map((name, k) => Math.min(1, (face[k] ?? 0) + (more.get(name) ?? 0)));
    const moved = [...named, ...face.slice(named.length)]; // with the body's own expressions
    return { ...pose, quats, face: moved, fist: more.get("fist") };
  }

  /** Orbit about where the people are now, from where the camera stands, with all of them in sight. */
  orbit() {
    Object.assign(this, { view: "orbit", given: null, plain: false });
    this.changed();
    this.stage.orbit(this.people.flatMap((person, who) => person.joined(this.bent(this.motion.at(this.position, who)))));
  }

  /** Orbit from the clip's camera of a frame. */
  home(frame) {
    this.stage.lens = this.clip.lens(frame);
    this.orbit();
  }
}
