// A path of many points that is cheap to draw at any zoom.
//
// Level k leaves out points nearer than 0.02 * 2^k m to the last one kept, and is cut into pieces, each a Path2D that is made once.
// Only pieces in view are stroked, of the finest level that the screen can show. So a frame costs as much as what is on the screen,
// however long the path is.

const FINEST_M = 0.02;
const LEVELS = 12;
const PIECE = 256;
/** The whole path has no more points than this: then those go that are nearer together than some way, and twice that the next time. */
const MOST_POINTS = 20000;

class Level {
  constructor(spacing) {
    this.spacing = spacing;
    this.clear();
  }

  clear() {
    this.pieces = [];
    this.last = null;
    this.count = 0;
  }

  add(x, y) {
    if (this.last && Math.hypot(x - this.last[0], y - this.last[1]) < this.spacing) return;
    let piece = this.pieces.at(-1);
    if (!piece || piece.points >= PIECE) {
      piece = { path: new Path2D(), points: 0, box: [x, y, x, y] };
      this.pieces.push(piece);
      // It begins where the one before ends.
      if (this.last) this.#line(piece, ...this.last);
    }
    this.#line(piece, x, y);
    this.last = [x, y];
    this.count += 1;
  }

  #line(piece, x, y) {
    if (piece.points === 0) piece.path.moveTo(x, y);
    else piece.path.lineTo(x, y);
    piece.points += 1;
    const box = piece.box;
    piece.box = [Math.min(box[0], x), Math.min(box[1], y), Math.max(box[2], x), Math.max(box[3], y)];
  }
}

export class Trail {
  stamps = [];
  xs = [];
  ys = [];
  /** Grows whenever it is another path. */
  generation = 0;
  #spacing = 0;
  #levels = Array.from({ length: LEVELS }, (_, k) => new Level(FINEST_M * 2 ** k));

  /** Takes a whole path, by columns. */
  set({ stamp_us: stamps, x, y }) {
    this.#spacing = 0;
    this.stamps = stamps.slice();
    this.xs = x.slice();
    this.ys = y.slice();
    this.#build();
  }

  add(stampUs, x, y) {
    if (this.xs.length >= MOST_POINTS) this.#thin();
    const n = this.xs.length;
    // Where points are thinned the last one moves on until it is far enough from the one before.
    const replaces = this.#spacing > 0 && n > 1 && Math.hypot(this.xs[n - 1] - this.xs[n - 2], this.ys[n - 1] - this.ys[n - 2]) < this.#spacing;
    const at = replaces ? n - 1 : n;
    [this.stamps[at], this.xs[at], this.ys[at]] = [stampUs, x, y];
    for (const level of this.#levels) level.add(x, y);
  }

  get length() {
    return this.xs.length;
  }

  #thin() {
    while (this.xs.length > 0.75 * MOST_POINTS) {
      this.#spacing = Math.max(FINEST_M, 2 * this.#spacing);
      const kept = [0];
      for (let k = 1; k < this.xs.length; k += 1) {
        const last = kept.at(-1);
        if (Math.hypot(this.xs[k] - this.xs[last], this.ys[k] - this.ys[last]) >= this.#spacing) kept.push(k);
      }
      for (const column of ["stamps", "xs", "ys"]) this[column] = kept.map((k) => this[column][k]);
    }
    this.#build();
  }

  #build() {
    this.generation += 1;
    for (const level of this.#levels) {
      level.clear();
      for (let k = 0; k < this.xs.length; k += 1) level.add(this.xs[k], this.ys[k]);
    }
  }

  /** Strokes the path from before a point to its end. */
  strokeTail(context, from) {
    if (from >= this.length + 1 || this.length < 2) return;
    context.beginPath();
    for (let k = Math.max(0, from - 2); k < this.length; k += 1) context.lineTo(this.xs[k], this.ys[k]);
    context.stroke();
  }

  /** Strokes what lies in the box (left, low, right, high, metres); the context has metres as units. */
  stroke(context, box, pxPerM) {
    if (!this.length) return;
    const coarsest = this.#levels.findLastIndex((level) => level.spacing * pxPerM <= 0.8);
    const level = this.#levels[Math.max(0, coarsest)];
    const margin = level.spacing;
    for (const piece of level.pieces) {
      const [left, low, right, high] = piece.box;
      if (right + margin < box[0] || left - margin > box[2] || high + margin < box[1] || low - margin > box[3]) continue;
      context.stroke(piece.path);
    }
    // What the level left out at its end.
    const [x, y] = [this.xs.at(-1), this.ys.at(-1)];
    if (level.last && (level.last[0] !== x || level.last[1] !== y)) {
      context.beginPath();
      context.moveTo(...level.last);
      context.lineTo(x, y);
      context.stroke();
    }
  }
}
