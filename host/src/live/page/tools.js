// What the hand holds: nothing, the measure, or a pose for the robot; and the menus.

import { switchTheme } from "./palette.js";
import { LAYERS } from "./paint.js";
import { toast } from "./status.js";

const element = (id) => document.getElementById(id);
const LAYERS_KEY = "lineslam.layers";

export class Tools {
  /** "", "measure" or "pose". */
  tool = "";
  /** Ends of what is measured, in `map`; none, one or two. */
  measured = [];
  /** The pointer, in `map`. */
  cursor = null;
  /** The pose that is being given: x, y, θ. */
  ghost = null;
  layers = Object.fromEntries(LAYERS.map(({ id }) => [id, true]));
  #given = null;
  #changed;

  constructor(changed) {
    this.#changed = changed;
    this.#readLayers();
    this.#makeLayersMenu();
    this.#menu("layers", "layers-menu");
    this.#menu("save", "save-menu");
    element("measure").addEventListener("click", () => this.#take(this.tool === "measure" ? "" : "measure"));
    element("theme").addEventListener("click", switchTheme);
    for (const id of ["panel-open", "badge"]) element(id).addEventListener("click", () => this.panel());
    element("panel-close").addEventListener("click", () => this.panel(false));
  }

  /** Opens or closes the panel where the screen is small. */
  panel(open = document.body.dataset.panel !== "open") {
    if (open) document.body.dataset.panel = "open";
    else delete document.body.dataset.panel;
  }

  #take(tool) {
    this.tool = tool;
    element("map").dataset.tool = tool;
    element("measure").setAttribute("aria-pressed", String(tool === "measure"));
    [this.measured, this.ghost] = [[], null];
    this.closeMenus();
    if (tool === "measure") toast("Click two points to measure the distance between them.");
    this.#changed();
  }

  /** Lets the robot's pose be given; calls back with it. */
  setPose(given) {
    this.#given = given;
    this.#take("pose");
    toast("Press where the robot stands and drag to where it looks. Esc leaves it.");
  }

  /** Puts down what the hand holds. */
  drop() {
    this.#given = null;
    this.#take("");
  }

  click([x, y]) {
    if (this.tool !== "measure") {
      this.closeMenus();
      return;
    }
    if (this.measured.length === 2) this.measured = [];
    this.measured.push([x, y]);
    this.#changed();
  }

  hover(at) {
    this.cursor = at;
    if (this.tool === "measure" && this.measured.length === 1) this.#changed();
  }

  drag([x0, y0], [x, y]) {
    this.ghost = [x0, y0, Math.atan2(y - y0, x - x0)];
    this.#changed();
  }

  /** The pose is given; without a drag the robot looks as it did. */
  release(from, to, heading) {
    const moved = this.ghost !== null;
    if (moved) this.drag(from, to);
    const pose = moved ? this.ghost : [from[0], from[1], heading];
    const given = this.#given;
    this.drop();
    given?.(pose);
  }

  closeMenus() {
    for (const id of ["layers", "save"]) {
      element(`${id}-menu`).hidden = true;
      element(id).setAttribute("aria-expanded", "false");
    }
  }

  #menu(buttonId, menuId) {
    element(buttonId).addEventListener("click", () => {
      const opens = element(menuId).hidden;
      this.closeMenus();
      element(menuId).hidden = !opens;
      element(menuId).style.top = `${element(buttonId).getBoundingClientRect().top - 6}px`;
      element(buttonId).setAttribute("aria-expanded", String(opens));
    });
  }

  #makeLayersMenu() {
    element("layers-menu").replaceChildren(...LAYERS.map(({ id, name, colour }) => {
      const label = document.createElement("label");
      const box = Object.assign(document.createElement("input"), { type: "checkbox", checked: this.layers[id] });
      box.dataset.layer = id;
      const key = document.createElement("i");
      key.style.setProperty("--key", `var(--${colour})`);
      label.append(box, name, key);
      box.addEventListener("change", () => {
        this.layers[id] = box.checked;
        this.#storeLayers();
        this.#changed();
      });
      return label;
    }));
  }

  // Storage may be turned off; then the choice lasts as long as the page.
  #readLayers() {
    try {
      const off = JSON.parse(localStorage.getItem(LAYERS_KEY) ?? "[]");
      for (const id of off) if (id in this.layers) this.layers[id] = false;
    } catch { /* as said */ }
  }

  #storeLayers() {
    try {
      localStorage.setItem(LAYERS_KEY, JSON.stringify(LAYERS.map(({ id }) => id).filter((id) => !this.layers[id])));
    } catch { /* as said */ }
  }
}
