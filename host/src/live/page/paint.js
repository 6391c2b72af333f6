// Draws one instant.

import { metres, roundLength } from "./format.js";
import { Layer } from "./layer.js";
import { palette } from "./palette.js";

/** Of a normal distribution in the plane, 95 % lie within so many standard deviations. */
const SIGMAS_95 = 2.448;
const ROBOT_M = 0.2;
const TURN = 2 * Math.PI;

/** What can be turned off, with its key in the menu. */
export const LAYERS = [
  { id: "truth", name: "True walls", colour: "truth" },
  { id: "walls", name: "Walls", colour: "wall" },
  { id: "tentative", name: "Lines not yet sure", colour: "soft" },
  { id: "path", name: "Path", colour: "path" },
  { id: "scan", name: "Scan", colour: "scan" },
  { id: "robot", name: "Robot, 95 % ellipse", colour: "robot" },
  { id: "places", name: "Places and loops", colour: "place" },
  { id: "grid", name: "Grid", colour: "soft" },
];

/** Width of walls, px: to scale where that is neither too thin nor too bold. */
function wallPx(camera) {
  return Math.min(5, Math.max(2.4, 0.06 * camera.scale));
}

export class Painter {
  #truth = null;
  #truthOf = null;
  #layer = new Layer();

  /** Draws a scene (camera, picture, about, layers, tool) on a context with so many pixels for one of the style sheet. */
  draw(context, ratio, scene) {
    this.#base(context, ratio, scene);
    this.#overlay(context, ratio, scene, scene.picture.trail.length);
  }

  /** The same, fast, for the screen. Returns whether it is to be drawn again soon. */
  show(context, ratio, scene) {
    const key = `${palette.paper} ${JSON.stringify(scene.layers)} ${scene.about?.blueprint.length}`;
    const isBehind = this.#layer.put(context, ratio, { ...scene, key }, (own, ownRatio, camera) => this.#base(own, ownRatio, { ...scene, camera }));
    this.#overlay(context, ratio, scene, this.#layer.points);
    return isBehind;
  }

  /** What changes seldom. */
  #base(context, ratio, { camera, picture, about, layers }) {
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.fillStyle = palette.paper;
    context.fillRect(0, 0, camera.width * ratio + 1, camera.height * ratio + 1);
    context.lineCap = "round";
    context.lineJoin = "round";
    if (layers.grid) this.#grid(context, ratio, camera);
    camera.apply(context, ratio);
    const px = 1 / camera.scale;
    if (layers.truth && about) this.#blueprint(context, about, Math.max(5, 0.16 * camera.scale) * px);
    if (layers.places) this.#loops(context, picture, px);
    if (layers.tentative) this.#stroke(context, picture.strokes.tentative, palette.wall, 1.2 * px, 0.42);
    if (layers.walls) this.#walls(context, picture, camera);
    if (layers.path) this.#path(context, picture, camera);
    if (layers.places) this.#places(context, picture, px);
  }

  /** What changes with each scan, and the path from a point on. */
  #overlay(context, ratio, { camera, picture, layers, tool }, from) {
    camera.apply(context, ratio);
    context.lineJoin = "round";
    if (layers.path) {
      context.strokeStyle = palette.path;
      context.lineWidth = 2 / camera.scale;
      picture.trail.strokeTail(context, from);
    }
    if (layers.scan && picture.scan) this.#scan(context, picture.scan, camera);
    if (layers.robot && picture.pose) {
      this.#ellipse(context, picture.pose, 1 / camera.scale);
      this.#robot(context, picture.pose.at, camera, palette[{ lost: "bad", uncertain: "warn" }[picture.pose.state] ?? "robot"]);
    }
    if (tool?.ghost) {
      context.globalAlpha = 0.75;
      this.#robot(context, tool.ghost, camera, palette.accent);
      context.globalAlpha = 1;
    }
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    if (tool?.measured.length) this.#measure(context, camera, tool);
  }

  #stroke(context, path, colour, width, alpha = 1) {
    context.globalAlpha = alpha;
    context.strokeStyle = colour;
    context.lineWidth = width;
    context.stroke(path);
    context.globalAlpha = 1;
  }

  #grid(context, ratio, camera) {
    const step = roundLength(camera.scale, 130).metres;
    const [left, low, right, high] = camera.box;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.strokeStyle = palette.grid;
    context.lineWidth = 1;
    context.globalAlpha = 0.055;
    context.beginPath();
    for (let k = Math.ceil(left / step); k * step <= right; k += 1) {
      const x = Math.round(camera.toScreen(k * step, 0)[0]) + 0.5;
      context.moveTo(x, 0);
      context.lineTo(x, camera.height);
    }
    for (let k = Math.ceil(low / step); k * step <= high; k += 1) {
      const y = Math.round(camera.toScreen(0, k * step)[1]) + 0.5;
      context.moveTo(0, y);
      context.lineTo(camera.width, y);
    }
    context.stroke();
    context.globalAlpha = 1;
  }

  #blueprint(context, about, width) {
    if (this.#truthOf !== about) {
      this.#truthOf = about;
      this.#truth = new Path2D();
      for (const [ax, ay, bx, by] of about.blueprint) {
        this.#truth.moveTo(ax, ay);
        this.#truth.lineTo(bx, by);
      }
    }
    this.#stroke(context, this.#truth, palette.truth, width);
  }

  #walls(context, picture, camera) {
    const width = wallPx(camera) / camera.scale;
    const { walls } = picture.strokes;
    walls.forEach((path, sureness) => {
      const share = (sureness + 1) / walls.length;
      this.#stroke(context, path, palette.wall, width * (0.7 + 0.3 * share), 0.4 + 0.6 * share);
    });
  }

  #path(context, picture, camera) {
    context.strokeStyle = palette.path;
    context.lineWidth = 2 / camera.scale;
    context.lineJoin = "bevel";
    picture.trail.stroke(context, camera.box, camera.scale);
    context.lineJoin = "round";
    if (!picture.trail.length) return;
    context.beginPath();
    context.arc(picture.trail.xs[0], picture.trail.ys[0], 4.5 / camera.scale, 0, TURN);
    context.fillStyle = palette.paper;
    context.fill();
    context.stroke();
  }

  #loops(context, { places }, px) {
    context.beginPath();
    for (const [from, to] of places.loops) {
      const [a, b] = [places.at[from], places.at[to]];
      if (!a || !b) continue;
      context.moveTo(...a);
      context.lineTo(...b);
    }
    context.strokeStyle = palette.place;
    context.lineWidth = 5 * px;
    context.globalAlpha = 0.35;
    context.stroke();
    context.globalAlpha = 1;
  }

  #places(context, { places }, px) {
    const tied = new Set(places.loops.flat());
    context.fillStyle = palette.place;
    places.at.forEach(([x, y], k) => {
      context.beginPath();
      context.arc(x, y, (tied.has(k) ? 4.5 : 2.8) * px, 0, TURN);
      context.fill();
    });
  }

  #scan(context, scan, camera) {
    const [x, y, theta] = scan.at;
    const [c, s] = [Math.cos(theta) / 1000, Math.sin(theta) / 1000];
    const size = Math.min(3.6, Math.max(2, 0.045 * camera.scale)) / camera.scale;
    context.fillStyle = palette.scan;
    context.beginPath();
    for (const [u, v] of scan.points_mm) {
      context.rect(x + c * u - s * v - size / 2, y + s * u + c * v - size / 2, size, size);
    }
    context.fill();
  }

  #ellipse(context, { at, covariance: [xx, xy, yy, tt] }, px) {
    const middle = (xx + yy) / 2;
    const apart = Math.hypot((xx - yy) / 2, xy);
    const axes = [middle + apart, Math.max(0, middle - apart)].map((v) => SIGMAS_95 * Math.sqrt(v));
    if (!axes.every(Number.isFinite)) return;
    context.fillStyle = palette.robot;
    context.globalAlpha = 0.2;
    context.beginPath();
    context.ellipse(at[0], at[1], axes[0], axes[1], Math.atan2(2 * xy, xx - yy) / 2, 0, TURN);
    context.fill();
    // How sure the heading is: a wedge that reaches beyond the robot.
    const half = Math.min(Math.PI, 1.96 * Math.sqrt(Math.max(0, tt)));
    const reach = Math.max(0.7, 44 * px);
    context.beginPath();
    context.moveTo(at[0], at[1]);
    context.arc(at[0], at[1], reach, at[2] - half, at[2] + half);
    context.closePath();
    context.fill();
    context.globalAlpha = 0.8;
    context.strokeStyle = palette.robot;
    context.lineWidth = px;
    context.beginPath();
    context.ellipse(at[0], at[1], axes[0], axes[1], Math.atan2(2 * xy, xx - yy) / 2, 0, TURN);
    context.stroke();
    context.globalAlpha = 1;
  }

  #robot(context, [x, y, theta], camera, colour) {
    const r = Math.max(ROBOT_M, 9 / camera.scale);
    context.save();
    context.translate(x, y);
    context.rotate(theta);
    context.beginPath();
    context.moveTo(1.5 * r, 0);
    context.lineTo(0.5 * r, 0.87 * r);
    context.arc(0, 0, r, Math.PI / 3, -Math.PI / 3);
    context.closePath();
    context.fillStyle = colour;
    context.strokeStyle = palette.paper;
    context.lineWidth = 2.5 / camera.scale;
    context.stroke();
    context.fill();
    context.beginPath();
    context.arc(0, 0, 0.3 * r, 0, TURN);
    context.fillStyle = palette.paper;
    context.fill();
    context.restore();
  }

  #measure(context, camera, { measured, cursor }) {
    const ends = measured.length === 2 || !cursor ? measured : [measured[0], cursor];
    const points = ends.map(([x, y]) => camera.toScreen(x, y));
    context.strokeStyle = palette.accent;
    context.fillStyle = palette.accent;
    context.lineWidth = 2;
    if (points.length === 2) {
      context.setLineDash(measured.length === 2 ? [] : [6, 5]);
      context.beginPath();
      context.moveTo(...points[0]);
      context.lineTo(...points[1]);
      context.stroke();
      context.setLineDash([]);
    }
    for (const point of points.slice(0, measured.length)) {
      context.beginPath();
      context.arc(...point, 4.5, 0, TURN);
      context.fill();
    }
    if (points.length < 2) return;
    const [[ax, ay], [bx, by]] = ends;
    label(context, metres(Math.hypot(bx - ax, by - ay)), (points[0][0] + points[1][0]) / 2, (points[0][1] + points[1][1]) / 2 - 20);
  }
}

function label(context, text, x, y) {
  context.font = "600 13px ui-sans-serif, system-ui, sans-serif";
  context.textAlign = "center";
  context.textBaseline = "middle";
  const width = context.measureText(text).width + 20;
  context.fillStyle = palette.ink;
  context.beginPath();
  context.roundRect(x - width / 2, y - 13, width, 26, 13);
  context.fill();
  context.fillStyle = palette.paper;
  context.fillText(text, x, y + 0.5);
}
