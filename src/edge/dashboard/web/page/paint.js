// Paints a strip: band, mean, samples, truth and markers of one quantity over a stretch of time. It only reads, and
// returns an account of what it painted.

import { longestSpacing, runsOf } from "./runs.js";

/** Room at the left for the numbers of the scale [px]. */
export const AXIS_WIDTH = 38;

const FONT = "11px system-ui, sans-serif";

/** Where on the canvas a time and a value are. */
function frameOf({ width, height, left, right, scale }) {
  const perSecond = (width - AXIS_WIDTH) / (right - left);
  const perUnit = height / (scale.high - scale.low);
  return { x: (time) => AXIS_WIDTH + (time - left) * perSecond, y: (value) => height - (value - scale.low) * perUnit };
}

/**
 * Paints `name` out of `history` on `ctx`. `picture` says how: `width`, `height`, `left`, `right`, `scale`,
 * `palette` (colours by use), `showSamples`, `showTruth`, `markers`, `withLabels` (of markers).
 */
export function paintStrip(ctx, history, name, picture) {
  const at = frameOf(picture);
  const { width, height, left, right, palette } = picture;
  ctx.fillStyle = palette.ground;
  ctx.fillRect(0, 0, width, height);
  paintGrid(ctx, at, picture);
  ctx.save();
  ctx.beginPath();
  ctx.rect(AXIS_WIDTH, 0, width - AXIS_WIDTH, height);
  ctx.clip();
  paintMarkers(ctx, at, picture);
  const account = paintEstimate(ctx, at, history.estimate, name, picture);
  account.samples = picture.showSamples ? paintSamples(ctx, at, history.samples.get(name), picture) : 0;
  account.truthInside = picture.showTruth ? paintTruth(ctx, at, history, name, picture) : null;
  ctx.restore();
  return { ...account, left, right };
}

function paintGrid(ctx, at, { width, height, left, right, scale, palette }) {
  ctx.strokeStyle = palette.grid;
  ctx.fillStyle = palette.quiet;
  ctx.lineWidth = 1;
  ctx.font = FONT;
  ctx.textAlign = "right";
  ctx.textBaseline = "middle";
  ctx.beginPath();
  for (const tick of scale.ticks) {
    const y = Math.round(at.y(tick)) + 0.5;
    ctx.moveTo(AXIS_WIDTH, y);
    ctx.lineTo(width, y);
    if (y > 6 && y < height - 6) ctx.fillText(String(Number(tick.toPrecision(4))), AXIS_WIDTH - 5, y);
  }
  const step = secondsPerLine(right - left);
  for (let time = Math.ceil(left / step) * step; time < right; time += step) {
    const x = Math.round(at.x(time)) + 0.5;
    ctx.moveTo(x, 0);
    ctx.lineTo(x, height);
  }
  ctx.stroke();
}

const secondsPerLine = (span) => (span <= 2 ? 0.2 : span <= 5 ? 0.5 : span <= 10 ? 1 : span <= 30 ? 2 : 5);

function paintMarkers(ctx, at, { height, markers, withLabels, palette }) {
  ctx.font = FONT;
  ctx.textAlign = "left";
  ctx.textBaseline = "top";
  for (const marker of markers) {
    const x = Math.round(at.x(marker.time)) + 0.5;
    ctx.strokeStyle = palette.marker[marker.kind] ?? palette.quiet;
    ctx.lineWidth = marker.kind === "event" ? 1 : 1.5;
    ctx.setLineDash(marker.kind === "event" ? [2, 3] : []);
    ctx.beginPath();
    ctx.moveTo(x, 0);
    ctx.lineTo(x, height);
    ctx.stroke();
    ctx.setLineDash([]);
    if (!withLabels) continue;
    ctx.fillStyle = palette.ink;
    ctx.fillText(marker.label, x + 4, 3);
  }
}

function paintEstimate(ctx, at, estimate, name, picture) {
  const account = { points: 0, low: null, high: null, bandPoints: 0 };
  if (!estimate.column(`${name}.mean`)) return account;
  const [from, to] = visible(estimate, picture);
  const outline = new Outline(estimate, name, (to - from) / (picture.width - AXIS_WIDTH));
  for (const run of runsOf(estimate, name, from, to)) {
    outline.trace(run);
    account.points += run.to - run.from;
    account.bandPoints += outline.bandPoints;
    paintBand(ctx, at, outline, run.isForecast, picture.palette);
    paintMean(ctx, at, outline, run.isForecast, picture.palette);
  }
  const newest = estimate.at(picture.right);
  if (newest >= from) {
    account.low = estimate.column(`${name}.low`)[newest];
    account.high = estimate.column(`${name}.high`)[newest];
  }
  return account;
}

// One row more on either side, so that lines run out of the picture instead of ending in it.
function visible(series, { left, right }) {
  return [Math.max(series.lower(left) - 1, series.first), Math.min(series.lower(right) + 1, series.end)];
}

/**
 * Points of a run to be drawn. Where there are more rows than pixels, `perPixel` rows and more become one bucket: its
 * widest band, and its least and largest mean. Buckets begin at fixed rows, so that they do not flicker as time goes on.
 */
class Outline {
  constructor(estimate, name, perPixel) {
    this.estimate = estimate;
    [this.mean, this.low, this.high] = ["mean", "low", "high"].map((part) => estimate.column(`${name}.${part}`));
    this.stride = perPixel > 1.5 ? Math.ceil(perPixel) : 1;
  }

  trace({ from, to }) {
    this.band = [];
    this.line = [];
    this.bandPoints = 0;
    for (let i = from; i < to; ) {
      const past = this.stride - ((i + this.estimate.dropped) % this.stride);
      const next = Math.min(i + past, to);
      this.#bucket(i, next);
      i = next;
    }
  }

  #bucket(from, to) {
    const { times } = this.estimate;
    let [least, most, low, high] = [from, from, Infinity, -Infinity];
    for (let i = from; i < to; i += 1) {
      if (this.mean[i] < this.mean[least]) least = i;
      if (this.mean[i] > this.mean[most]) most = i;
      if (this.low[i] < low) low = this.low[i];
      if (this.high[i] > high) high = this.high[i];
      if (this.high[i] > this.low[i]) this.bandPoints += 1;
    }
    if (low <= high) this.band.push(times[from], low, high);
    const order = least === most ? [least] : [Math.min(least, most), Math.max(least, most)];
    for (const i of order) this.line.push(times[i], this.mean[i]);
  }
}

function paintBand(ctx, at, { band }, isForecast, palette) {
  ctx.fillStyle = isForecast ? palette.hatch : palette.band;
  ctx.beginPath();
  for (let k = 0; k < band.length; k += 3) ctx.lineTo(at.x(band[k]), at.y(band[k + 2]));
  for (let k = band.length - 3; k >= 0; k -= 3) ctx.lineTo(at.x(band[k]), at.y(band[k + 1]));
  ctx.fill();
}

function paintMean(ctx, at, { line }, isForecast, palette) {
  ctx.strokeStyle = palette.line;
  ctx.lineWidth = isForecast ? 1.5 : 2;
  ctx.lineJoin = "round";
  ctx.setLineDash(isForecast ? [6, 5] : []);
  ctx.beginPath();
  for (let k = 0; k < line.length; k += 2) ctx.lineTo(at.x(line[k]), at.y(line[k + 1]));
  ctx.stroke();
  ctx.setLineDash([]);
}

// A sample beyond the scale is a small bar at the edge: an artefact must not squeeze the waveform, nor go unseen.
function paintSamples(ctx, at, series, picture) {
  if (!series) return 0;
  const [from, to] = visible(series, picture);
  const value = series.column("value");
  const stride = Math.max(Math.ceil((to - from) / (picture.width - AXIS_WIDTH)), 1);
  ctx.fillStyle = picture.palette.sample;
  let painted = 0;
  for (let i = from + ((stride - ((from + series.dropped) % stride)) % stride); i < to; i += stride) {
    const [x, y] = [at.x(series.times[i]), at.y(value[i])];
    if (y < 0) ctx.fillRect(x - 1, 0, 2, 4);
    else if (y > picture.height) ctx.fillRect(x - 1, picture.height - 4, 2, 4);
    else ctx.fillRect(x - 1, y - 1, 2, 2);
    painted += 1;
  }
  return painted;
}

// Returns the share of the points within the band, null where no point can be compared with one.
function paintTruth(ctx, at, history, name, picture) {
  const { truth, estimate } = history;
  const value = truth.column(name);
  const [from, to] = visible(truth, picture);
  if (!value || to <= from) return null;
  const longest = longestSpacing(truth.times, from, to);
  ctx.strokeStyle = picture.palette.truth;
  ctx.lineWidth = 1;
  ctx.setLineDash([4, 3]);
  ctx.beginPath();
  for (let i = from; i < to; i += 1) {
    const isBreak = i === from || Number.isNaN(value[i - 1]) || truth.times[i] - truth.times[i - 1] > longest;
    if (isBreak) ctx.moveTo(at.x(truth.times[i]), at.y(value[i]));
    else if (!Number.isNaN(value[i])) ctx.lineTo(at.x(truth.times[i]), at.y(value[i]));
  }
  ctx.stroke();
  ctx.setLineDash([]);
  return shareInside(truth, value, estimate, name, from, to);
}

function shareInside(truth, value, estimate, name, from, to) {
  const [low, high] = [estimate.column(`${name}.low`), estimate.column(`${name}.high`)];
  if (!low || estimate.length < 2 || from >= to) return null;
  const { times } = estimate;
  const last = Math.min(estimate.lower(truth.times[to - 1]) + 1, estimate.end);
  let i = Math.max(estimate.lower(truth.times[from]), estimate.first + 1);
  const longest = longestSpacing(times, i - 1, last);
  let [inside, compared] = [0, 0];
  for (let k = from; k < to; k += 1) {
    const time = truth.times[k];
    while (i < last && times[i] < time) i += 1;
    if (i >= last || times[i - 1] > time || times[i] - times[i - 1] > longest) continue;
    const share = (time - times[i - 1]) / (times[i] - times[i - 1]);
    const between = (column) => column[i - 1] + share * (column[i] - column[i - 1]);
    const [least, most] = [between(low), between(high)];
    if (Number.isNaN(least) || Number.isNaN(most) || Number.isNaN(value[k])) continue;
    compared += 1;
    if (least <= value[k] && value[k] <= most) inside += 1;
  }
  return compared ? inside / compared : null;
}
