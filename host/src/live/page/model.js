// What is known: as it is now, and as it was at the instant that is looked at.

import { Trail } from "./trail.js";

/** From how many sightings on a line is drawn how dark. */
const SURENESS = [3, 8, 25];
const MOST_NOTES = 400;
const MOST_STATES = 2000;

/** Everything that is drawn of one instant. */
export class Picture {
  pose = null;
  scan = null;
  lines = new Map();
  places = { at: [], loops: [] };
  trail = new Trail();
  status = null;
  /** Grows when anything but pose, scan and the end of the path has changed. */
  version = 0;
  #strokes = null;

  /** Takes all of it. */
  set(scene) {
    this.pose = scene.pose && poseOf(scene.pose);
    this.scan = scene.scan;
    this.lines = new Map(scene.lines.map((row) => [row[0], row]));
    this.places = scene.places;
    this.trail.set(scene.path);
    this.status = scene.status;
    this.version += 1;
    this.#strokes = null;
  }

  /** Takes what is new. */
  add(frame) {
    for (const row of frame.poses ?? []) {
      this.pose = poseOf(row);
      this.trail.add(row[0], row[1][0], row[1][1]);
    }
    if (frame.scan) this.scan = frame.scan;
    if (frame.changed || frame.removed) {
      for (const id of frame.removed ?? []) this.lines.delete(id);
      for (const row of frame.changed ?? []) this.lines.set(row[0], row);
      this.#strokes = null;
      this.version += 1;
    }
    if (frame.places) {
      this.places = frame.places;
      this.version += 1;
    }
    if (frame.status) this.status = frame.status;
  }

  /** Lines by how sure they are: tentative ones first, then one Path2D for each sureness. */
  get strokes() {
    if (!this.#strokes) {
      const tentative = new Path2D();
      const walls = Array.from({ length: SURENESS.length + 1 }, () => new Path2D());
      for (const [, [ax, ay, bx, by], hits, wall] of this.lines.values()) {
        const path = wall ? walls[SURENESS.filter((least) => hits >= least).length] : tentative;
        path.moveTo(ax, ay);
        path.lineTo(bx, by);
      }
      this.#strokes = { tentative, walls };
    }
    return this.#strokes;
  }

  walls() {
    return [...this.lines.values()].filter((row) => row[3]);
  }

  /** The box around walls and path (left, low, right, high), or null. */
  bounds() {
    let box = null;
    const grow = (x, y) => {
      box = box ? [Math.min(box[0], x), Math.min(box[1], y), Math.max(box[2], x), Math.max(box[3], y)] : [x, y, x, y];
    };
    for (const [, [ax, ay, bx, by]] of this.walls()) {
      grow(ax, ay);
      grow(bx, by);
    }
    for (let k = 0; k < this.trail.length; k += 1) grow(this.trail.xs[k], this.trail.ys[k]);
    if (this.pose) grow(this.pose.at[0], this.pose.at[1]);
    return box;
  }
}

function poseOf([stampUs, at, covariance, state]) {
  return { stampUs, at, covariance, state };
}

/** Everything, and who wants to know when it changes: "about", "scene", "picture", "status", "notes", "playback", "span". */
export class Model extends EventTarget {
  about = null;
  now = new Picture();
  /** The instant that is looked at, microseconds; null is now. */
  atUs = null;
  then = null;
  notes = [];
  playback = { speed: 1, ended: false };
  fromUs = 0;
  toUs = 0;
  states = [];
  newsAt = performance.now();

  get shown() {
    return this.then ?? this.now;
  }

  get hasAny() {
    return this.now.pose !== null;
  }

  hello({ about }) {
    this.about = about;
    this.#tell("about");
  }

  scene(scene) {
    this.now.set(scene);
    this.notes = scene.notes;
    this.playback = scene.playback;
    const { from_us: from = 0, to_us: to = 0, states = [] } = scene.timeline ?? {};
    [this.fromUs, this.toUs, this.states] = [from, to, states];
    this.newsAt = performance.now();
    this.#tell("scene", "picture", "status", "notes", "playback", "span");
  }

  frame(frame) {
    this.now.add(frame);
    for (const row of frame.poses ?? []) this.#span(row[0], row[3]);
    if (frame.notes) {
      this.notes.push(...frame.notes);
      this.notes.splice(0, this.notes.length - MOST_NOTES);
      this.#tell("notes");
    }
    if (frame.playback) {
      this.playback = frame.playback;
      this.#tell("playback");
    }
    if (frame.poses || frame.scan) this.newsAt = performance.now();
    if (frame.poses) this.#tell("span");
    if (this.then) return;
    this.#tell("picture");
    if (frame.status) this.#tell("status");
  }

  #span(stampUs, state) {
    if (!this.states.length) this.fromUs = stampUs;
    this.toUs = Math.max(this.toUs, stampUs);
    if (this.states.at(-1)?.[1] !== state) this.states.push([stampUs, state]);
    if (this.states.length > MOST_STATES) this.states.splice(1, 2);
  }

  /** What an instant that was asked for looked like. */
  view(view) {
    if (this.atUs === null) return;
    this.then ??= new Picture();
    this.then.set(view);
    this.#tell("picture", "status");
  }

  /** Looks at an instant; null is now. */
  look(atUs) {
    this.atUs = atUs;
    if (atUs === null && this.then) {
      this.then = null;
      this.#tell("picture", "status");
    }
    this.#tell("span");
  }

  #tell(...topics) {
    for (const topic of topics) this.dispatchEvent(new Event(topic));
  }
}
