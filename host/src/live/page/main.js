// Puts the page together.

import { Camera } from "./camera.js";
import { watchCommands } from "./commands.js";
import { clock, roundLength, seconds } from "./format.js";
import { watchGestures } from "./gestures.js";
import { Link } from "./link.js";
import { Model } from "./model.js";
import { Painter } from "./paint.js";
import { onTheme, switchTheme } from "./palette.js";
import { watchSave } from "./save.js";
import { notice, watchStatus } from "./status.js";
import { Timeline } from "./timeline.js";
import { Tools } from "./tools.js";

/** Data older than this is called old, while the source should be sending, ms. */
const OLD_MS = 2500;
const BOUNDS_EVERY_MS = 200;

const element = (id) => document.getElementById(id);
const canvas = element("map");
const context = canvas.getContext("2d", { alpha: false });
const model = new Model();
const link = new Link();
const camera = new Camera();
const painter = new Painter();
const tools = new Tools(() => redraw());
const timeline = new Timeline(model, link);
const counts = { frames: 0, drawMs: 0 };

let isOld = true;
let isFirst = true;
let lastAt = 0;
let bounds = null;
let boundsAt = -Infinity;

function redraw() {
  isOld = true;
}

function resize() {
  const box = canvas.getBoundingClientRect();
  const ratio = devicePixelRatio;
  canvas.width = Math.round(box.width * ratio);
  canvas.height = Math.round(box.height * ratio);
  const small = matchMedia("(max-width: 720px), (max-height: 480px)").matches;
  camera.resize(box.width, box.height, small ? [72, 20, 100, 20] : [16, 76, 108, 336]);
  redraw();
}

function frame(now) {
  requestAnimationFrame(frame);
  const plays = timeline.step(now);
  const { pose } = model.shown;
  if (camera.mode === "fit" && now - boundsAt > BOUNDS_EVERY_MS) {
    bounds = grown(model.shown.bounds(), model.about?.blueprint, tools.layers.truth);
    boundsAt = now;
  }
  camera.aim(bounds, pose?.at);
  const moves = camera.step(Math.min(100, now - lastAt), isFirst && model.hasAny);
  if (model.hasAny) isFirst = false;
  lastAt = now;
  if (!isOld && !moves && !plays) return;
  const began = performance.now();
  isOld = painter.show(context, devicePixelRatio, { camera, picture: model.shown, about: model.about, layers: tools.layers, tool: tools });
  counts.drawMs += performance.now() - began;
  counts.frames += 1;
  showGround();
}

/** The box around the map, and the true walls where they are shown. */
function grown(box, blueprint, shown) {
  if (!shown || !blueprint?.length) return box;
  const xs = blueprint.flatMap(([ax, , bx]) => [ax, bx]);
  const ys = blueprint.flatMap(([, ay, , by]) => [ay, by]);
  const own = [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
  return box ? own.map((v, k) => (k < 2 ? Math.min(v, box[k]) : Math.max(v, box[k]))) : own;
}

function showGround() {
  const { px, name } = roundLength(camera.scale, 140);
  const [bar, words] = element("scale").children;
  bar.style.width = `${px.toFixed(1)}px`;
  if (words.textContent !== name) words.textContent = name;
  element("follow").setAttribute("aria-pressed", String(camera.mode === "follow"));
  element("fit").setAttribute("aria-pressed", String(camera.mode === "fit"));
}

function setMode(mode) {
  camera.mode = mode === "follow" && camera.mode === mode ? "free" : mode;
  if (camera.mode === "follow" && camera.scale < 25) camera.scale = 50;
  boundsAt = -Infinity;
  redraw();
}

function zoomMiddle(factor) {
  camera.zoom(factor, ...camera.middle);
  redraw();
}

watchGestures(canvas, () => tools.tool, {
  pan(dx, dy) {
    camera.pan(dx, dy);
    redraw();
  },
  zoom(factor, x, y) {
    camera.zoom(factor, x, y);
    redraw();
  },
  hover(x, y) {
    const at = camera.toMap(x, y);
    tools.hover(at);
    element("cursor").textContent = `x ${at[0].toFixed(2)} m   y ${at[1].toFixed(2)} m`;
  },
  leave() {
    tools.hover(null);
    element("cursor").textContent = "";
  },
  click(x, y) {
    tools.click(camera.toMap(x, y));
  },
  drag(x0, y0, x, y) {
    tools.drag(camera.toMap(x0, y0), camera.toMap(x, y));
  },
  drop(x0, y0, x, y) {
    tools.release(camera.toMap(x0, y0), camera.toMap(x, y), model.now.pose?.at[2] ?? 0);
  },
});

const keys = {
  f: () => setMode("fit"),
  r: () => setMode("follow"),
  m: () => element("measure").click(),
  l: () => element("layers").click(),
  s: () => element("save").click(),
  p: () => tools.panel(),
  t: switchTheme,
  "+": () => zoomMiddle(1.3),
  "=": () => zoomMiddle(1.3),
  "-": () => zoomMiddle(1 / 1.3),
  " ": () => timeline.toggle(),
  ArrowLeft: () => timeline.skip(-1),
  ArrowRight: () => timeline.skip(1),
  Home: () => timeline.toBegin(),
  End: () => timeline.goLive(),
  Escape() {
    tools.drop();
    tools.panel(false);
  },
};
addEventListener("keydown", (event) => {
  const { tagName } = event.target;
  if (event.ctrlKey || event.metaKey || event.altKey || element("confirm").open) return;
  if (tagName === "SELECT" || (event.key === " " && (tagName === "BUTTON" || tagName === "SUMMARY"))) return;
  const act = keys[event.key] ?? keys[event.key.toLowerCase()];
  if (!act) return;
  event.preventDefault();
  act();
});
element("fit").addEventListener("click", () => setMode("fit"));
element("follow").addEventListener("click", () => setMode("follow"));
element("zoom-in").addEventListener("click", () => zoomMiddle(1.4));
element("zoom-out").addEventListener("click", () => zoomMiddle(1 / 1.4));

for (const topic of ["hello", "scene", "frame", "view"]) {
  link.addEventListener(topic, ({ detail }) => model[topic](detail));
}
// What is looked at is asked for again after a new connection, or goes where the drive has begun anew.
model.addEventListener("scene", () => {
  if (model.atUs === null) return;
  if (model.atUs < model.fromUs || model.atUs > model.toUs) timeline.goLive();
  else link.view(model.atUs);
});
for (const topic of ["picture", "about", "scene"]) model.addEventListener(topic, redraw);
onTheme(redraw);

/** What is not as it should be with what is seen. */
function showNotice() {
  const age = performance.now() - model.newsAt;
  const { playback, about, atUs } = model;
  if (!link.connected) {
    const again = Math.max(0, Math.ceil((link.retryAt - performance.now()) / 1000));
    const old = model.hasAny && age > 1500 ? ` What you see is ${seconds(age)} old.` : "";
    const wait = link.retryAt && again > 0 ? `trying again in ${again} s` : "trying again";
    notice(`No connection to lineslam: ${wait}.${old}`, "error");
  } else if (atUs !== null) {
    notice(`Looking back: ${clock(atUs - model.fromUs, true)} of ${clock(model.toUs - model.fromUs)}`, "info");
  } else if (playback.ended || playback.speed === 0) {
    notice(playback.ended ? "" : "Paused", "info");
  } else if (!model.hasAny) {
    notice(age > OLD_MS ? "Waiting for the first scan." : "", "info");
  } else if (age > OLD_MS) {
    const robot = about?.kind === "robot";
    const remedy = robot ? "Check its supply and the cable." : "";
    notice(`No scan for ${seconds(age)}: what you see is old. ${remedy}`);
  } else {
    notice("");
  }
}
setInterval(showNotice, 250);
for (const topic of ["span", "playback"]) model.addEventListener(topic, showNotice);
link.addEventListener("lost", showNotice);

watchStatus(model);
watchCommands(model, link, tools);
watchSave(model, camera, painter, tools);
new ResizeObserver(resize).observe(canvas);
matchMedia(`(resolution: ${devicePixelRatio}dppx)`).addEventListener("change", resize);
resize();
requestAnimationFrame(frame);

// For the console, and for tests.
globalThis.lineslam = { model, camera, link, tools, timeline, counts, redraw };
