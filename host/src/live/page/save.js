// The map as a file: SVG to scale, PNG of what is seen, DXF from the server.

import { Camera } from "./camera.js";
import { clock, roundLength } from "./format.js";
import { palette } from "./palette.js";

const element = (id) => document.getElementById(id);
/** Longer edge of an SVG, px. */
const LONG_PX = 1400;
const MARGIN_PX = 40;
const HEAD_PX = 64;

export function watchSave(model, camera, painter, tools) {
  const name = () => (model.about?.title ?? "map").replace(/[^\w.-]+/g, "_");
  const save = {
    svg: () => download(new Blob([svg(model, tools.layers)], { type: "image/svg+xml" }), `${name()}.svg`),
    png: async () => download(await png(model, camera, painter, tools), `${name()}.png`),
    dxf: () => follow(model.atUs === null ? "map.dxf" : `map.dxf?at_us=${Math.round(model.atUs)}`, `${name()}.dxf`),
  };
  for (const button of document.querySelectorAll("[data-save]")) {
    button.addEventListener("click", () => {
      tools.closeMenus();
      save[button.dataset.save]();
    });
  }
  element("save-menu").addEventListener("keydown", (event) => event.key === "Escape" && tools.closeMenus());
}

function follow(href, file) {
  const link = Object.assign(document.createElement("a"), { href, download: file });
  document.body.append(link);
  link.click();
  link.remove();
}

function download(blob, file) {
  const url = URL.createObjectURL(blob);
  follow(url, file);
  setTimeout(() => URL.revokeObjectURL(url), 10000);
}

function png(model, camera, painter, tools) {
  const ratio = 2 * devicePixelRatio;
  const canvas = Object.assign(document.createElement("canvas"), {
    width: Math.round(camera.width * ratio),
    height: Math.round(camera.height * ratio),
  });
  // The same view; panels cover nothing.
  const own = Object.assign(new Camera(), { x: camera.x, y: camera.y, scale: camera.scale });
  own.resize(camera.width, camera.height, camera.insets);
  painter.draw(canvas.getContext("2d"), ratio, { camera: own, picture: model.shown, about: model.about, layers: tools.layers, tool: tools });
  return new Promise((resolve) => { canvas.toBlob(resolve, "image/png"); });
}

const escaped = (text) => text.replace(/[&<>"]/g, (c) => ({ "&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;" })[c]);

/** The whole map as a drawing. */
export function svg(model, layers) {
  const picture = model.shown;
  const bounds = picture.bounds() ?? [-1, -1, 1, 1];
  const size = [Math.max(1, bounds[2] - bounds[0]), Math.max(1, bounds[3] - bounds[1])];
  const scale = LONG_PX / Math.max(...size);
  const px = (x, y) => `${(MARGIN_PX + (x - bounds[0]) * scale).toFixed(1)} ${(HEAD_PX + MARGIN_PX + (bounds[3] - y) * scale).toFixed(1)}`;
  const [width, height] = [Math.max(520, size[0] * scale + 2 * MARGIN_PX), size[1] * scale + HEAD_PX + 2 * MARGIN_PX + 36];
  const stroke = (d, colour, thick, opacity = 1) =>
    d && `<path d="${d}" fill="none" stroke="${colour}" stroke-width="${thick}" stroke-opacity="${opacity}" stroke-linecap="round" stroke-linejoin="round"/>`;
  const segments = (rows) => rows.map(([ax, ay, bx, by]) => `M${px(ax, ay)}L${px(bx, by)}`).join("");
  const lines = [...picture.lines.values()];
  const polyline = picture.trail.xs.map((x, k) => `${k ? "L" : "M"}${px(x, picture.trail.ys[k])}`).join("");
  const bar = roundLength(scale, 160);
  const text = (x, y, of, style) => `<text x="${x}" y="${y}" fill="${palette.ink}" ${style}>${escaped(of)}</text>`;
  const about = model.about ?? { title: "", subtitle: "", blueprint: [] };
  const facts = `${about.subtitle} · ${lines.filter((row) => row[3]).length} walls · ${clock((model.atUs ?? model.toUs) - model.fromUs)}`;
  return [
    `<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 ${width.toFixed(0)} ${height.toFixed(0)}" font-family="Helvetica, Arial, sans-serif">`,
    `<rect width="100%" height="100%" fill="${palette.paper}"/>`,
    text(MARGIN_PX, 46, about.title, 'font-size="24" font-weight="700"'),
    text(MARGIN_PX, 70, facts, 'font-size="14" fill-opacity="0.7"'),
    layers.truth && stroke(segments(about.blueprint), palette.truth, 8),
    layers.tentative && stroke(segments(lines.filter((row) => !row[3]).map((row) => row[1])), palette.wall, 1.2, 0.4),
    layers.walls && stroke(segments(picture.walls().filter((row) => row[2] < 8).map((row) => row[1])), palette.wall, 3, 0.65),
    layers.walls && stroke(segments(picture.walls().filter((row) => row[2] >= 8).map((row) => row[1])), palette.wall, 3.6),
    layers.path && stroke(polyline, palette.path, 2),
    stroke(`M${MARGIN_PX} ${height - 42}v8h${bar.px.toFixed(1)}v-8`, palette.ink, 1.5),
    text((MARGIN_PX + bar.px + 10).toFixed(1), (height - 33).toFixed(1), bar.name, 'font-size="14"'),
    "</svg>",
  ].filter(Boolean).join("\n");
}
