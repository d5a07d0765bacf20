// BVH motion capture: any skeleton, any order of channels. The same as stages/formats/motions/bvh.py.
import { IDENTITY, mul } from "hugs/turns";

const CHANNEL = /^([XYZ])(position|rotation)$/i;
const MOST = 4e6; // joints times frames
const SHORT = 0.05; // share of the frames promised that may be missing at the end, or one frame

/** Names, parents, and for each frame every joint's place in its parent's axes and its turn; frames a second; what is odd. */
export function parseBvh(text) {
  const lines = new Lines(text), skeleton = { names: [], parents: [], offsets: [], channels: [] };
  lines.keyword("HIERARCHY");
  joint(lines, skeleton, -1, lines.keyword("ROOT"));
  for (const open = [0]; open.length;) {
    const words = lines.take("JOINT, End Site or a closing brace"), kind = words[0].toLowerCase();
    if (kind === "}") open.pop();
    else if (kind === "joint") {
      joint(lines, skeleton, open.at(-1), words.slice(1));
      open.push(skeleton.names.length - 1);
    } else if (words.join(" ").toLowerCase() === "end site") end(lines, skeleton, open.at(-1));
    else throw lines.refuse("JOINT, End Site or a closing brace");
  }
  lines.keyword("MOTION");
  const [count] = lines.numbers(lines.keyword("Frames:"), 1);
  if (!Number.isInteger(count) || count < 1) throw lines.refuse("a whole number of frames, at least 1");
  const [seconds] = lines.numbers(lines.keyword("Frame", "Time:"), 1);
  if (seconds <= 0) throw lines.refuse("a time above 0 s from frame to frame");
  const width = skeleton.channels.reduce((sum, own) => sum + own.length, 0), frames = [];
  while (lines.more()) {
    frames.push(pose(skeleton, lines.numbers(lines.words, width)));
    if (frames.length * skeleton.names.length > MOST) throw new Error(`over ${MOST / 1e6} million places of joints are too many`);
  }
  const said = `${frames.length} frames of ${count}`;
  if (frames.length < count - Math.max(1, SHORT * count) || !frames.length) throw new Error(`the file ends too soon: ${said}`);
  return { names: skeleton.names, parents: skeleton.parents, frames, fps: 1 / seconds, said: frames.length === count ? "" : said };
}

class Lines {
  constructor(text) {
    this.rest = text.replace(/^\uFEFF/, "").split(/\r\n|\r|\n/);
    this.number = 0;
    this.parts = [];
  }

  more() {
    while (!this.parts.length && this.number < this.rest.length) {
      this.parts = this.rest[this.number++].split(/([{}])/).filter((part) => part.trim());
    }
    this.words = this.parts.length ? this.parts.shift().trim().split(/\s+/) : [];
    return this.words.length > 0;
  }

  take(expected) {
    if (!this.more()) throw new Error(`the file ends too soon: expected ${expected}`);
    return this.words;
  }

  keyword(...words) {
    const found = this.take(words.join(" "));
    if (words.some((word, i) => found[i]?.toLowerCase() !== word.toLowerCase())) throw this.refuse(words.join(" "));
    return found.slice(words.length);
  }

  numbers(words, count) {
    const values = words.map(Number);
    if (values.length !== count || !values.every(Number.isFinite)) throw this.refuse(`${count} numbers`);
    return values;
  }

  refuse(expected) {
    return new Error(`line ${this.number} is not as in a BVH: expected ${expected}, found "${this.words.join(" ").slice(0, 50)}"`);
  }
}

function joint(lines, skeleton, parent, words) {
  const name = words.join(" ");
  if (!name || skeleton.names.includes(name)) throw lines.refuse("a name of its own for each joint");
  lines.keyword("{");
  skeleton.names.push(name);
  skeleton.parents.push(parent);
  skeleton.offsets.push(lines.numbers(lines.keyword("OFFSET"), 3));
  const [count, ...channels] = lines.keyword("CHANNELS"), parts = channels.map((channel) => CHANNEL.exec(channel));
  const unlike = new Set(channels.map((channel) => channel.toLowerCase())).size === channels.length;
  if (Number(count) !== channels.length || !unlike || parts.includes(null)) throw lines.refuse("a count and as many channels");
  skeleton.channels.push(parts.map(([, axis, kind]) => ["XYZ".indexOf(axis.toUpperCase()), kind.toLowerCase()]));
}

function end(lines, skeleton, parent) {
  lines.keyword("{");
  skeleton.names.push("");
  skeleton.parents.push(parent);
  skeleton.offsets.push(lines.numbers(lines.keyword("OFFSET"), 3));
  skeleton.channels.push([]);
  lines.keyword("}");
}

/** One frame: a position channel replaces the offset along its axis; the rotation named first turns last. */
function pose(skeleton, values) {
  let at = 0;
  const places = [], turns = [];
  skeleton.channels.forEach((channels, i) => {
    const place = [...skeleton.offsets[i]];
    let turn = IDENTITY;
    for (const [axis, kind] of channels) {
      const value = values[at++];
      if (kind === "position") place[axis] = value;
      else turn = mul(turn, about(axis, value * Math.PI / 180));
    }
    places.push(place);
    turns.push(turn);
  });
  return { places, turns };
}

function about(axis, angle) {
  const c = Math.cos(angle), s = Math.sin(angle);
  return [[1, 0, 0, 0, c, -s, 0, s, c], [c, 0, s, 0, 1, 0, -s, 0, c], [c, -s, 0, s, c, 0, 0, 0, 1]][axis];
}
