// The drive on one line: scrub, play, and back to what happens now.

import { clock } from "./format.js";
import { onTheme, palette } from "./palette.js";
import { toast } from "./status.js";

const element = (id) => document.getElementById(id);
const SPEEDS = [0.5, 1, 2, 5, 10, 30];
const FASTEST = "max";

export class Timeline {
  #model;
  #link;
  #playing = false;
  #speed = 1;
  #lastPace = 1;
  #shownAt = 0;
  #bandIsOld = true;

  constructor(model, link) {
    this.#model = model;
    this.#link = link;
    element("scrub").addEventListener("input", (event) => this.#scrub(Number(event.target.value)));
    element("play").addEventListener("click", () => this.toggle());
    element("live").addEventListener("click", () => this.goLive());
    element("speed").addEventListener("change", (event) => this.#choose(event.target.value));
    for (const topic of ["span", "notes", "scene"]) model.addEventListener(topic, () => { this.#bandIsOld = true; });
    for (const topic of ["playback", "about", "span"]) model.addEventListener(topic, () => this.#showControls());
    onTheme(() => { this.#bandIsOld = true; });
    new ResizeObserver(() => { this.#bandIsOld = true; }).observe(element("track"));
  }

  get isLive() {
    return this.#model.atUs === null;
  }

  /** A source that goes as fast as it is told. */
  get #isPaced() {
    return this.#model.about?.paced && !this.#model.playback.ended;
  }

  #scrub(thousandths) {
    this.#playing = false;
    const { fromUs, toUs } = this.#model;
    this.#look(fromUs + (thousandths / 1000) * (toUs - fromUs));
  }

  #look(atUs) {
    const { fromUs, toUs } = this.#model;
    const at = Math.min(toUs, Math.max(fromUs, atUs));
    this.#model.look(at);
    this.#link.view(at);
    this.#showControls();
  }

  goLive() {
    this.#playing = false;
    this.#link.dropView();
    this.#model.look(null);
    this.#showControls();
  }

  /** Forward or back by seconds. */
  skip(seconds) {
    this.#playing = false;
    this.#look((this.#model.atUs ?? this.#model.toUs) + seconds * 1e6);
  }

  toBegin() {
    this.#playing = false;
    this.#look(this.#model.fromUs);
  }

  /** Plays or pauses: a source that can be told so is told, else only the look back. */
  toggle() {
    const { playback, fromUs, toUs, atUs } = this.#model;
    if (!this.isLive) {
      this.#playing = !this.#playing;
    } else if (this.#isPaced) {
      this.#pace(playback.speed === 0 ? this.#lastPace : 0);
    } else if (playback.ended) {
      this.#playing = true;
      this.#look(fromUs);
    } else {
      this.#look(atUs ?? toUs);
    }
    this.#shownAt = performance.now();
    this.#showControls();
  }

  async #pace(speed) {
    const { done, words } = await this.#link.order({ pace: { speed } });
    if (!done) toast(words, "warning");
  }

  #choose(value) {
    const speed = value === FASTEST ? null : Number(value);
    if (this.isLive && this.#isPaced) {
      this.#lastPace = speed;
      this.#pace(speed);
    } else if (speed !== null) {
      this.#speed = speed;
    }
  }

  #showControls() {
    const { playback, atUs, about } = this.#model;
    if (playback.speed !== 0) this.#lastPace = playback.speed;
    const paced = this.isLive && this.#isPaced;
    const runs = this.isLive ? !playback.ended && playback.speed !== 0 : this.#playing;
    element("play").querySelector("use").setAttribute("href", runs ? "#i-pause" : "#i-play");
    element("play").setAttribute("aria-label", runs ? "Pause" : "Play");
    const live = element("live");
    live.setAttribute("aria-pressed", String(atUs === null));
    live.dataset.news = String(atUs !== null);
    const name = about && about.kind !== "robot" && playback.ended ? "End" : "Live";
    if (live.textContent !== name) live.textContent = name;
    this.#showSpeeds(paced ? this.#lastPace : this.#speed, paced);
  }

  #showSpeeds(speed, paced) {
    const chosen = speed === null ? FASTEST : String(speed);
    const all = SPEEDS.map(String);
    if (!all.includes(chosen) && chosen !== FASTEST) all.push(chosen);
    if (paced) all.push(FASTEST);
    const select = element("speed");
    if (select.dataset.all !== String(all)) {
      select.dataset.all = String(all);
      select.replaceChildren(...all.map((value) => new Option(value === FASTEST ? "max" : `${value}×`, value)));
    }
    if (select.value !== chosen) select.value = chosen;
  }

  /** Called each frame. Returns whether it goes on by itself. */
  step(now) {
    const model = this.#model;
    const since = now - this.#shownAt;
    this.#shownAt = now;
    if (this.#playing && !this.isLive) {
      const next = model.atUs + since * 1000 * this.#speed;
      if (next >= model.toUs) this.goLive();
      else this.#look(next);
    }
    this.#show();
    return this.#playing;
  }

  #show() {
    const { fromUs, toUs, atUs } = this.#model;
    const at = atUs ?? toUs;
    const length = toUs - fromUs;
    const time = clock(at - fromUs, !this.isLive);
    if (element("time").textContent !== time) element("time").textContent = time;
    const whole = clock(length);
    if (element("length").textContent !== whole) element("length").textContent = whole;
    const value = length > 0 ? (1000 * (at - fromUs)) / length : 1000;
    if (document.activeElement !== element("scrub") || this.#playing || this.isLive) element("scrub").value = value;
    if (this.#bandIsOld) this.#band();
  }

  /** States in colours, and marks where loops were closed. */
  #band() {
    this.#bandIsOld = false;
    const canvas = element("band");
    const { clientWidth: width, clientHeight: height } = canvas;
    const ratio = devicePixelRatio;
    [canvas.width, canvas.height] = [width * ratio, height * ratio];
    const context = canvas.getContext("2d");
    context.scale(ratio, ratio);
    const { fromUs, toUs, atUs, states, notes } = this.#model;
    const inset = 7;
    const x = (us) => inset + ((width - 2 * inset) * (us - fromUs)) / Math.max(1, toUs - fromUs);
    const [top, thick] = [height / 2 - 3, 6];
    context.beginPath();
    context.roundRect(inset, top, width - 2 * inset, thick, 3);
    context.fillStyle = palette.soft;
    context.globalAlpha = 0.22;
    context.fill();
    context.globalAlpha = 1;
    context.clip();
    context.fillStyle = palette.accent;
    context.globalAlpha = 0.45;
    context.fillRect(inset, top, x(atUs ?? toUs) - inset, thick);
    context.globalAlpha = 1;
    states.forEach(([stampUs, state], k) => {
      if (state === "tracking") return;
      context.fillStyle = state === "lost" ? palette.bad : palette.warn;
      const from = x(stampUs);
      context.fillRect(from, top, Math.max(2, x(states[k + 1]?.[0] ?? toUs) - from), thick);
    });
    context.fillStyle = palette.place;
    for (const note of notes) {
      if (note.is_loop) context.fillRect(x(note.stamp_us) - 1, top, 3, thick);
    }
  }
}
