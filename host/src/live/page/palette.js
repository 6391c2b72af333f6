// The map's colours, as the style sheet has them for the theme in use.

const NAMES = ["paper", "ink", "soft", "wall", "path", "robot", "scan", "truth", "place", "grid", "good", "warn", "bad", "accent"];

const KEY = "lineslam.theme";
const dark = matchMedia("(prefers-color-scheme: dark)");
const listeners = new Set();
export const palette = {};

function resolve() {
  const probe = document.createElement("span");
  probe.hidden = true;
  document.body.append(probe);
  for (const name of NAMES) {
    probe.style.color = `var(--${name})`;
    palette[name] = getComputedStyle(probe).color;
  }
  probe.remove();
  for (const listener of listeners) listener();
}

/** Calls back whenever colours have changed. */
export function onTheme(listener) {
  listeners.add(listener);
}

export function isDark() {
  const chosen = document.documentElement.dataset.theme;
  return chosen ? chosen === "dark" : dark.matches;
}

/** The other theme. What the system prefers is not stored, so that the page follows it again. */
export function switchTheme() {
  const next = isDark() ? "light" : "dark";
  const root = document.documentElement;
  if ((next === "dark") === dark.matches) {
    delete root.dataset.theme;
    store(null);
  } else {
    root.dataset.theme = next;
    store(next);
  }
  resolve();
}

// Storage may be turned off; then the choice lasts as long as the page.
function store(theme) {
  try {
    if (theme) localStorage.setItem(KEY, theme);
    else localStorage.removeItem(KEY);
  } catch { /* as said */ }
}

function stored() {
  try {
    return localStorage.getItem(KEY);
  } catch {
    return null;
  }
}

const chosen = stored();
if (chosen === "dark" || chosen === "light") document.documentElement.dataset.theme = chosen;
dark.addEventListener("change", resolve);
resolve();
