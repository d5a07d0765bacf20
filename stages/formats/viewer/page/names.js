// Which joint of a BVH is which of SMPL's: limbs by their names, the trunk by what connects them.
// The same as stages/formats/motions/bvh_names.py.
import { PARTS } from "hugs/skeleton";

const SYNONYMS = {
  hip: "upleg upperleg thigh hip",
  knee: "lowerleg loleg shin calf knee leg",
  ankle: "ankle foot",
  foot: "toebase toe toes toe0 ball foot",
  shoulder: "upperarm uparm arm shldr shoulder",
  elbow: "forearm lowerarm lowarm loarm elbow",
  wrist: "wrist hand",
  collar: "collar clavicle shoulder",
};
const NEEDED = ["hip", "knee", "ankle", "shoulder", "elbow", "wrist"];

/** limbs: SMPL joint -> joint; the pelvis; the chains of the spine and of the neck. */
export function mapBody(bvh) {
  const words = {};
  bvh.names.forEach((name, i) => { if (name) words[wordsOf(name).join(" ")] ??= i; });
  const limbs = {}, missing = [];
  for (const side of ["left", "right"]) {
    for (const [part, names] of Object.entries(SYNONYMS)) {
      const taken = new Set(Object.values(limbs));
      const found = names.split(" ").map((name) => words[`${side} ${name}`]).find((i) => i !== undefined && !taken.has(i));
      if (found !== undefined) limbs[PARTS.indexOf(`${side}_${part}`)] = found;
      else if (NEEDED.includes(part)) missing.push(`${side} ${part}`);
    }
  }
  if (missing.length) throw new Error(`no person's legs and arms in it: missing ${missing.join(", ")}`);
  const up = bvh.names.map((_, i) => ancestors(bvh, i));
  const both = (part) => ["left", "right"].map((side) => up[limbs[PARTS.indexOf(`${side}_${part}`)]]);
  const pelvis = meet(...both("hip")), chest = meet(...both("shoulder"));
  const beyond = (start, end) => up[end].filter((i) => !up[start].includes(i));
  return { limbs, pelvis, spine: beyond(pelvis, chest), neck: beyond(chest, words[" head"] ?? chest) };
}

/** Side and what is left of a joint's name: "mixamorig:LeftUpLeg" -> ["left", "upleg"]. */
export function wordsOf(name) {
  name = name.slice(name.lastIndexOf(":") + 1).replace(/^(bip\d*|mixamorig\d*|def|org)[\s_.-]+/i, "");
  const plain = (text) => text.replace(/[\s_.-]/g, "").toLowerCase();
  for (const side of ["left", "right"]) {
    const l = side[0], patterns = [
      new RegExp(`^${side}[\\s_.-]*(.+)$`, "i"), new RegExp(`^(.+?)[\\s_.-]*${side}$`, "i"),
      new RegExp(`^${l}[\\s_.-]+(.+)$`, "i"), new RegExp(`^(.+?)[\\s_.-]+${l}$`, "i"),
      new RegExp(`^[${l}${l.toUpperCase()}]([A-Z].*)$`),
    ];
    for (const pattern of patterns) {
      const found = pattern.exec(name);
      if (found) return [side, plain(found[1])];
    }
  }
  return ["", plain(name)];
}

/** The line of a joint from the root on, itself included. */
export function ancestors(bvh, i) {
  const line = [];
  for (; i >= 0; i = bvh.parents[i]) line.unshift(i);
  return line;
}

const meet = (a, b) => a.filter((joint, i) => b[i] === joint).at(-1);
