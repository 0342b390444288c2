// Takes what is shown out of the page: as numbers (CSV) or as a picture (PNG).

import { element } from "./dom.js";
import { color } from "./theme.js";
import { clockText, nsOf } from "./time.js";

const BAND = ["mean", "q05", "q95"];

/** Offers `blob` as a file. */
export function save(blob, name) {
  const url = URL.createObjectURL(blob);
  const link = element("a", { href: url, download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(url), 10_000);
}

/** A file name out of a bed's name and what is in it. */
export function fileName(bed, time, ending) {
  const safe = (text) => text.replace(/[^\w.-]+/g, "_");
  return `${safe(bed)}-${safe(clockText(time))}.${ending}`;
}

/** The strips as CSV: a row per time, an empty cell where there is no number. Estimates, samples and truth have times of
 * their own; they are rows among each other in the order of time. */
export function stripsCsv(history, viewport, names) {
  const samples = names.filter((name) => history.samples.has(name));
  const truths = names.filter((name) => history.truth.column(name) && history.truth.length);
  const header = ["time_ns", "since_data_s", ...names.flatMap((n) => BAND.map((part) => `${n}_${part}`)),
    ...samples.map((n) => `${n}_sample`), ...truths.map((n) => `${n}_truth`)];
  const place = new Map(header.map((name, k) => [name, k]));
  const rows = [];
  const collect = (series, columns) => {
    const end = series.lower(viewport.right + 1e-6);
    for (let i = series.lower(viewport.left); i < end; i += 1) {
      rows.push({ time: series.times[i], cells: columns.map(([name, column]) => [place.get(name), column[i]]) });
    }
  };
  const { estimate, truth } = history;
  const bands = names.flatMap((n) => BAND.map((part) => [`${n}_${part}`, estimate.column(`${n}.${part}`)]));
  collect(estimate, [["since_data_s", estimate.column("since_data")], ...bands].filter(([, column]) => column));
  for (const name of samples) collect(history.samples.get(name), [[`${name}_sample`, history.samples.get(name).column("value")]]);
  collect(truth, truths.map((name) => [`${name}_truth`, truth.column(name)]));
  rows.sort((one, other) => one.time - other.time);
  return `${[header.join(","), ...joined(rows).map((row) => line(row, header.length))].join("\n")}\n`;
}

// Numbers of the same time share a row.
function joined(rows) {
  const all = [];
  for (const row of rows) {
    const last = all[all.length - 1];
    if (last && row.time - last.time < SAME_TIME_S) last.cells.push(...row.cells);
    else all.push(row);
  }
  return all;
}

function line({ time, cells }, width) {
  const texts = new Array(width).fill("");
  texts[0] = nsOf(time);
  for (const [k, value] of cells) if (Number.isFinite(value)) texts[k] = String(Number(value.toPrecision(7)));
  return texts.join(",");
}

/** Times that differ by less came apart in rounding. */
const SAME_TIME_S = 2e-5;
const HEAD_PX = 34;
const NUMBERS_PX = 190;

/** Strips and pictures of them on one picture, with the bed, the time and the numbers. */
export function stripsPng(bed, viewport, pictures) {
  const ratio = window.devicePixelRatio || 1;
  const width = Math.max(...pictures.map(([strip]) => strip.area.width)) + NUMBERS_PX;
  const height = HEAD_PX + pictures.reduce((sum, [strip]) => sum + strip.area.height + 6, 0);
  const canvas = element("canvas", { width: Math.round(width * ratio), height: Math.round(height * ratio) });
  const ctx = canvas.getContext("2d");
  ctx.scale(ratio, ratio);
  ctx.fillStyle = color("panel");
  ctx.fillRect(0, 0, width, height);
  const write = (text, x, y, font, ink) => {
    ctx.fillStyle = ink;
    ctx.font = `${font} system-ui, sans-serif`;
    ctx.fillText(text, x, y);
  };
  const when = `${clockText(viewport.right - viewport.span)} to ${clockText(viewport.right)}${viewport.isPaused ? ", paused" : ""}`;
  write(`${bed}   ${when}   lines: mean, bands: 5–95 %`, 10, 22, "600 14px", color("ink"));
  let y = HEAD_PX;
  for (const [strip, picture] of pictures) {
    const { width: across, height: down } = strip.area;
    ctx.drawImage(picture, 0, y, across, down);
    const x = across + 10;
    write(`${strip.about.label}  ${strip.origin.textContent}`, x, y + 16, "600 12px", color("ink"));
    write(`${strip.main.textContent} ${strip.side.textContent}`, x, y + 38, "600 18px", color(strip.about.color));
    write(strip.band.textContent, x, y + 55, "11px", color("quiet"));
    write(strip.instant.textContent, x, y + 70, "11px", color("quiet"));
    y += down + 6;
  }
  return new Promise((resolve) => canvas.toBlob(resolve, "image/png"));
}
