// Light or dark: what the system prefers, unless the user said otherwise. Colours live in `style.css`; canvases and
// charts ask for them here.

import { recall, remember } from "./dom.js";

const CHOICES = ["auto", "light", "dark"];
const WORDS = { auto: "Theme: as the system", light: "Theme: light", dark: "Theme: dark" };
const SIGNS = { auto: "◐", light: "☀", dark: "☾" };

const systemIsDark = matchMedia("(prefers-color-scheme: dark)");
const listeners = [];
let cache = new Map();

/** Starts the theme and its button; call once. */
export function startTheme(button) {
  const stored = recall("theme", "auto");
  let choice = CHOICES.includes(stored) ? stored : "auto";
  const apply = () => {
    const isDark = choice === "dark" || (choice === "auto" && systemIsDark.matches);
    document.documentElement.dataset.theme = isDark ? "dark" : "light";
    button.textContent = SIGNS[choice];
    button.title = `${WORDS[choice]} (t)`;
    button.setAttribute("aria-label", WORDS[choice]);
    cache = new Map();
    for (const listener of listeners) listener();
  };
  button.addEventListener("click", () => {
    choice = CHOICES[(CHOICES.indexOf(choice) + 1) % CHOICES.length];
    remember("theme", choice);
    apply();
  });
  systemIsDark.addEventListener("change", apply);
  apply();
}

/** Calls `listener` whenever colours have changed. */
export function onTheme(listener) {
  listeners.push(listener);
}

/** A colour of the style sheet by its name there (`--NAME`). */
export function color(name) {
  if (!cache.has(name)) {
    cache.set(name, getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim());
  }
  return cache.get(name);
}

/** A colour `#rrggbb` of the style sheet, so much of it opaque. */
export function veil(name, opacity) {
  const hex = color(name);
  const [r, g, b] = [1, 3, 5].map((from) => Number.parseInt(hex.slice(from, from + 2), 16));
  return `rgba(${r},${g},${b},${opacity})`;
}
