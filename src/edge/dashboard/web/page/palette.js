// Colours of a strip in the theme of the moment.

import { color, onTheme, veil } from "./theme.js";

const cache = new Map();
onTheme(() => cache.clear());

/** Colours by use for a quantity whose colour in the style sheet is `hue`. */
export function paletteOf(hue) {
  if (!cache.has(hue)) cache.set(hue, makePalette(hue));
  return cache.get(hue);
}

function makePalette(hue) {
  return {
    ground: color("panel"),
    plate: veil("panel", 0.8),
    grid: color("grid"),
    ink: color("ink"),
    quiet: color("quiet"),
    line: color(hue),
    band: veil(hue, 0.28),
    hatch: hatchOf(hue),
    sample: veil("ink", 0.55),
    truth: veil("ink", 0.85),
    marker: { note: color("note"), high: color("alarm-high"), medium: color("alarm-medium"), low: color("alarm-low") },
  };
}

function hatchOf(hue) {
  const size = 8;
  const tile = document.createElement("canvas");
  [tile.width, tile.height] = [size, size];
  const ctx = tile.getContext("2d");
  ctx.fillStyle = veil(hue, 0.08);
  ctx.fillRect(0, 0, size, size);
  ctx.strokeStyle = veil(hue, 0.55);
  ctx.lineWidth = 1.2;
  ctx.beginPath();
  // The corners too, so that the lines go on in the neighbouring tiles.
  for (const shift of [-size, 0, size]) {
    ctx.moveTo(shift - 1, size + 1);
    ctx.lineTo(shift + size + 1, -1);
  }
  ctx.stroke();
  return ctx.createPattern(tile, "repeat");
}
