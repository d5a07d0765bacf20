// Face captures: a CSV with a row a frame. The same as stages/formats/motions/face_csv.py.
import { FACE_NAMES } from "hugs/face";

const TIMES = { time: 1, timestamp: 1, seconds: 1, time_ms: 1e-3, timestamp_ms: 1e-3, timecode: 1 };
const RATES = [24, 25, 30, 48, 50, 60, 100, 120], DEFAULT_FPS = 60;
const PERCENT = 5, CODE = /^(\d+):(\d+):(\d+)[:;](\d+(?:\.\d+)?)$/;

export class Capture {
  /** `times` of rows in s, from 0 on, `face` [row][52], and `said`: how the file was taken; Error with the row of what cannot be read. */
  constructor(text) {
    const cells = (line) => line.split(",").map((cell) => cell.trim().replace(/^"(.*)"$/, "$1"));
    const [names, ...rows] = text.replace(/^\uFEFF/, "").split(/\r\n|\r|\n/).map(cells).filter((row) => row.some(Boolean));
    const header = (names ?? []).map((name) => name.toLowerCase());
    const columns = FACE_NAMES.map((name) => header.indexOf(name.toLowerCase())), found = columns.filter((column) => column >= 0);
    if (!found.length || !rows.length) throw new Error("no face capture: it has no columns such as jawOpen, or no rows");
    const told = rows.map((row, i) => columns.map((column) => (column < 0 ? 0 : number(row, column, header[column], i))));
    const beyond = told.flat().filter((value) => value < 0 || value > 1);
    if (beyond.some((value) => value > PERCENT)) throw new Error(`it does not hold coefficients of 0 to 1: ${Math.max(...beyond)} is one`);
    this.face = told.map((row) => row.map((value) => Math.min(1, Math.max(0, value))));
    this.said = [`${found.length} of ${FACE_NAMES.length} shapes of the face`];
    if (beyond.length) this.said.push(`${beyond.length} coefficients beyond 0 to 1 are held there`);
    this.times = this.clock(header, rows);
    const back = this.times.findIndex((time, i) => i > 0 && time <= this.times[i - 1]);
    if (back > 0) throw new Error(`its times do not rise in row ${back + 2}`);
  }

  /** Seconds of the rows. */
  clock(header, rows) {
    const key = Object.keys(TIMES).find((name) => header.includes(name)), column = header.indexOf(key);
    if (!key) {
      this.said.push(`no times in it: ${DEFAULT_FPS} rows a second taken`);
      return rows.map((_, i) => i / DEFAULT_FPS);
    }
    const codes = rows.map((row) => CODE.exec(row[column] ?? "")?.slice(1).map(Number));
    const last = Math.max(...codes.map((code) => code?.[3] ?? 0)), rate = RATES.find((one) => one > last) ?? RATES.at(-1);
    const whole = codes.every(Boolean);
    if (whole) this.said.push(`time codes of ${rate} frames a second`);
    const times = whole ? codes.map(([h, m, s, frames]) => 3600 * h + 60 * m + s + frames / rate)
      : rows.map((row, i) => number(row, column, key, i) * TIMES[key]);
    return times.map((time) => time - times[0]);
  }

  /** Coefficients [52] at a time in s; it begins again where it ends. */
  at(seconds) {
    const { times, face } = this, end = times.at(-1), at = end > 0 ? seconds % end : 0;
    const row = times.findLastIndex((time) => time <= at), next = Math.min(row + 1, times.length - 1);
    const share = next > row ? (at - times[row]) / (times[next] - times[row]) : 0;
    return face[row].map((value, k) => value + share * (face[next][k] - value));
  }
}

function number(row, column, name, i) {
  const value = row[column] ? Number(row[column]) : NaN;
  if (!Number.isFinite(value)) throw new Error(`row ${i + 2} has no number for ${name}`);
  return value;
}
