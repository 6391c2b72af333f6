// State, facts, troubles, counters and what happened.

import { clock, stateName } from "./format.js";

const element = (id) => document.getElementById(id);
/** More of the last notes are not shown. */
const SHOWN_NOTES = 60;

function make(tag, text, data = {}) {
  const made = document.createElement(tag);
  if (text !== undefined) made.textContent = text;
  Object.assign(made.dataset, data);
  return made;
}

export function watchStatus(model) {
  model.addEventListener("about", () => {
    const { title, subtitle } = model.about;
    element("name").textContent = title;
    element("badge").querySelector("b").textContent = title;
    element("subtitle").textContent = subtitle;
    document.title = `${title} – lineslam`;
  });
  model.addEventListener("picture", () => showState(model.shown.pose?.state));
  model.addEventListener("status", () => model.shown.status && showStatus(model.shown.status));
  model.addEventListener("notes", () => showNotes(model));
}

function showState(state) {
  for (const pill of [element("state"), element("badge").querySelector(".pill")]) {
    if (pill.dataset.state === (state ?? "none")) continue;
    pill.dataset.state = state ?? "none";
    pill.textContent = stateName(state);
  }
}

function showStatus({ facts, troubles, counters }) {
  const rows = facts.flatMap(({ name, value }) => [make("dt", name), make("dd", value)]);
  element("facts").replaceChildren(...rows);
  element("troubles").replaceChildren(...troubles.map(({ weight, what, remedy }) => {
    const item = make("li", undefined, { weight });
    item.append(make("b", what), remedy);
    return item;
  }));
  element("counters").replaceChildren(...counters.map(({ name, count, meaning }) => {
    const row = make("tr");
    const what = make("td", name);
    what.append(make("small", meaning));
    row.append(make("td", count.toLocaleString("en").replaceAll(",", " ")), what);
    return row;
  }));
}

function showNotes({ notes, fromUs }) {
  const last = notes.slice(-SHOWN_NOTES).reverse();
  element("notes").replaceChildren(...last.map(({ stamp_us: stampUs, weight, text }) => {
    const item = make("li", undefined, { weight });
    item.append(make("time", clock(stampUs - fromUs)), make("span", text));
    return item;
  }));
}

/** Says something for a moment. */
export function toast(words, weight = "info") {
  const toasts = element("toasts");
  const made = make("div", words, { weight });
  made.className = "toast";
  toasts.append(made);
  while (toasts.children.length > 2) toasts.firstChild.remove();
  setTimeout(() => made.remove(), weight === "info" ? 3500 : 6500);
}

/** Says what stands above the map until it is called again; nothing hides it. */
export function notice(words, weight = "warning") {
  const shown = element("notice");
  shown.hidden = !words;
  if (!words) return;
  shown.dataset.weight = weight;
  if (shown.textContent !== words) shown.textContent = words;
}
