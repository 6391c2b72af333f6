// Where on the screen the map lies. x of `map` goes right, y goes up.

const LEAST = 0.5;
const MOST = 2500;
/** How fast the camera comes to where it should be: what is left after this time is 1/e. */
const SETTLE_MS = 110;

export class Camera {
  /** "fit" shows everything, "follow" keeps the robot in the middle, "free" stays where it was put. */
  mode = "fit";
  x = 0;
  y = 0;
  scale = 40;
  width = 1;
  height = 1;
  /** What panels cover: top, right, bottom, left, px. */
  insets = [0, 0, 0, 0];
  #goal = null;

  resize(width, height, insets) {
    Object.assign(this, { width, height, insets });
  }

  /** The middle of what no panel covers, px. */
  get middle() {
    const [top, right, bottom, left] = this.insets;
    return [(left + this.width - right) / 2, (top + this.height - bottom) / 2];
  }

  toScreen(x, y) {
    const [mx, my] = this.middle;
    return [mx + (x - this.x) * this.scale, my - (y - this.y) * this.scale];
  }

  toMap(px, py) {
    const [mx, my] = this.middle;
    return [this.x + (px - mx) / this.scale, this.y - (py - my) / this.scale];
  }

  /** What is on the screen: left, low, right, high, metres. */
  get box() {
    const [left, high] = this.toMap(0, 0);
    const [right, low] = this.toMap(this.width, this.height);
    return [left, low, right, high];
  }

  /** Makes metres in `map` the units of a context. */
  apply(context, ratio) {
    const [mx, my] = this.middle;
    const s = this.scale * ratio;
    context.setTransform(s, 0, 0, -s, mx * ratio - this.x * s, my * ratio + this.y * s);
  }

  pan(dx, dy) {
    this.mode = "free";
    this.#goal = null;
    this.x -= dx / this.scale;
    this.y += dy / this.scale;
  }

  /** Zooms so that what is beneath the point stays there; while the robot is followed, it does. */
  zoom(factor, px, py) {
    const scale = Math.min(MOST, Math.max(LEAST, this.scale * factor));
    if (this.mode === "follow") {
      this.scale = scale;
      return;
    }
    this.mode = "free";
    this.#goal = null;
    const [x, y] = this.toMap(px, py);
    this.scale = scale;
    const [nx, ny] = this.toMap(px, py);
    this.x += x - nx;
    this.y += y - ny;
  }

  /** Sets what it should come to. Returns whether it is on its way. */
  aim(bounds, robot) {
    if (this.mode === "fit" && bounds) {
      const [top, right, bottom, left] = this.insets;
      const [width, height] = [this.width - left - right - 56, this.height - top - bottom - 56];
      const size = [Math.max(4, bounds[2] - bounds[0]), Math.max(4, bounds[3] - bounds[1])];
      const scale = Math.min(Math.max(60, width) / size[0], Math.max(60, height) / size[1], 90);
      this.#goal = { x: (bounds[0] + bounds[2]) / 2, y: (bounds[1] + bounds[3]) / 2, scale };
    } else if (this.mode === "follow" && robot) {
      this.#goal = { x: robot[0], y: robot[1], scale: this.scale };
    }
  }

  /** Moves on. Returns whether it has not yet come to where it should be. */
  step(ms, at_once = false) {
    const goal = this.#goal;
    if (!goal) return false;
    const share = at_once ? 1 : 1 - Math.exp(-ms / SETTLE_MS);
    this.x += (goal.x - this.x) * share;
    this.y += (goal.y - this.y) * share;
    this.scale *= (goal.scale / this.scale) ** share;
    const offPx = Math.hypot(goal.x - this.x, goal.y - this.y) * this.scale;
    if (offPx < 0.2 && Math.abs(goal.scale / this.scale - 1) < 1e-3) {
      Object.assign(this, goal);
      this.#goal = null;
      return false;
    }
    return true;
  }
}
