// What changes seldom, drawn once on a canvas larger than the screen, and then only moved: map, path, places, grid.

import { Camera } from "./camera.js";

/** How far it reaches beyond the screen, as a share of it. */
const BEYOND = 0.3;
/** It is not drawn anew more often than this while it still covers the screen, ms. */
const EVERY_MS = 160;
/** Scaled by more than this it is drawn anew at once. */
const MOST_SCALED = 2.2;
/** A tail of the path longer than this goes into it. */
const LONGEST_TAIL = 300;

export class Layer {
  #canvas = document.createElement("canvas");
  #context = this.#canvas.getContext("2d", { alpha: false });
  #camera = new Camera();
  #margin = 0;
  #key = "";
  #picture = null;
  #version = -1;
  #generation = -1;
  #drawnAt = -Infinity;
  /** Points of the path that are on it. */
  points = 0;

  /**
   * Puts it on a context as the camera sees it; `paint(context, ratio, camera)` draws it where that must be. `key` is whatever
   * else it looks different by. Returns whether it is not yet as it should be.
   */
  put(context, ratio, { camera, picture, key }, paint) {
    const now = performance.now();
    const size = `${key} ${ratio} ${camera.width} ${camera.height} ${camera.insets}`;
    const { trail } = picture;
    const isOther = this.#key !== size || this.#picture !== picture || this.#generation !== trail.generation;
    const isBehind = this.#version !== picture.version || trail.length - this.points > LONGEST_TAIL;
    const scaled = camera.scale / this.#camera.scale;
    const isScaled = Math.abs(scaled - 1) > 1e-9;
    const mayWait = now - this.#drawnAt < EVERY_MS && this.#covers(camera) && scaled < MOST_SCALED && scaled > 1 / MOST_SCALED;
    if (isOther || ((isBehind || isScaled || !this.#covers(camera)) && !mayWait)) {
      this.#draw(ratio, camera, picture, paint);
      [this.#key, this.#picture, this.#drawnAt] = [size, picture, now];
    }
    const [x, y, factor] = this.#place(camera);
    context.setTransform(1, 0, 0, 1, 0, 0);
    const whole = factor === 1 ? Math.round : (v) => v;
    context.drawImage(this.#canvas, whole(x * ratio), whole(y * ratio), this.#canvas.width * factor, this.#canvas.height * factor);
    return this.#version !== picture.version || factor !== 1;
  }

  #draw(ratio, camera, picture, paint) {
    const margin = Math.round(BEYOND * Math.max(camera.width, camera.height));
    this.#margin = margin;
    const own = this.#camera;
    own.resize(camera.width + 2 * margin, camera.height + 2 * margin, camera.insets);
    [own.x, own.y, own.scale] = [camera.x, camera.y, camera.scale];
    const [width, height] = [Math.round(own.width * ratio), Math.round(own.height * ratio)];
    if (this.#canvas.width !== width || this.#canvas.height !== height) {
      [this.#canvas.width, this.#canvas.height] = [width, height];
    }
    paint(this.#context, ratio, own);
    this.#version = picture.version;
    this.#generation = picture.trail.generation;
    this.points = picture.trail.length;
  }

  /** Where its corner comes to lie, and what it is scaled by. */
  #place(camera) {
    const own = this.#camera;
    const factor = Math.abs(camera.scale / own.scale - 1) > 1e-9 ? camera.scale / own.scale : 1;
    const [mx, my] = camera.middle;
    const x = mx - factor * (mx + this.#margin) + (own.x - camera.x) * camera.scale;
    const y = my - factor * (my + this.#margin) - (own.y - camera.y) * camera.scale;
    return [x, y, factor];
  }

  #covers(camera) {
    const [x, y, factor] = this.#place(camera);
    return x <= 0 && y <= 0 && x + this.#camera.width * factor >= camera.width && y + this.#camera.height * factor >= camera.height;
  }
}
