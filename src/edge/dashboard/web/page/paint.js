// Paints a strip: band, mean, samples, truth and markers of one quantity over a stretch of time. It only reads, and
// returns an account of what it painted. A stretch painted after another looks as if both were painted at once.

import { between } from "./markers.js";
import { bandOf, dashes, lineOf, strideOf } from "./outline.js";
import { runsOf, stretches, usualSpacing } from "./runs.js";

/** Room at the left for the numbers of the scale [px]. */
const AXIS_WIDTH = 38;

/** A mark speaks for those that follow it so closely [px]. */
const CLUSTER_PX = 60;
const URGENCY = { high: 4, medium: 3, low: 2, note: 1 };
const FONT = "11px system-ui, sans-serif";

/** Dashes of truth, and of the mean of a forecast: on, and off [px]. Times decide where they are, so that a picture
 * painted bit by bit has them where a whole one has. */
const TRUTH_DASH = [2, 5];
const FORECAST_DASH = [6, 5];
/** What is painted reaches so far to either side of its time [px]. */
const REACH_PX = 3;

/** Where on the canvas a time and a value are. */
function frameOf({ width, height, span, scale }, origin) {
  const perSecond = (width - AXIS_WIDTH) / span;
  const perUnit = height / (scale.high - scale.low);
  return {
    perSecond,
    x: (time) => AXIS_WIDTH + (time - origin) * perSecond,
    y: (value) => height - (value - scale.low) * perUnit,
  };
}

/** Paints the numbers of the scale at the left. */
export function paintAxis(ctx, picture) {
  const { height, scale, palette } = picture;
  const at = frameOf(picture, 0);
  ctx.fillStyle = palette.ground;
  ctx.fillRect(0, 0, AXIS_WIDTH, height);
  ctx.fillStyle = palette.quiet;
  ctx.font = FONT;
  ctx.textAlign = "right";
  ctx.textBaseline = "middle";
  for (const tick of scale.ticks) {
    const y = Math.round(at.y(tick)) + 0.5;
    if (y > 6 && y < height - 6) ctx.fillText(String(Number(tick.toPrecision(4))), AXIS_WIDTH - 5, y);
  }
}

/**
 * Paints `name` out of `history` over a region `{origin, from, to}`, and clears `gap` seconds behind it. `picture` says
 * how: `width`, `height`, `span`, `scale`, `palette` (colours by use), `showSamples`, `showTruth`, `markers`,
 * `withLabels` (of markers), `ratio` of pixels. What stands outside of the region is left as it is.
 */
export function paintRegion(ctx, history, name, region, picture) {
  const { width, height, palette, ratio } = picture;
  const at = frameOf(picture, region.origin);
  // On whole pixels: half covered ones would be painted twice.
  const snap = (x) => Math.min(Math.max(Math.floor(x * ratio) / ratio, AXIS_WIDTH), width);
  const [begin, end] = [snap(at.x(region.from) - REACH_PX), snap(at.x(region.to))];
  ctx.fillStyle = palette.ground;
  ctx.fillRect(begin, 0, snap(at.x(region.to + picture.gap)) - begin, height);
  ctx.save();
  ctx.beginPath();
  ctx.rect(begin, 0, end - begin, height);
  ctx.clip();
  const reach = (2 * REACH_PX) / at.perSecond;
  const seen = { ...picture, left: region.from - reach, right: region.to, origin: region.origin };
  paintGrid(ctx, at, seen);
  paintMarkers(ctx, at, seen);
  const samples = () => (picture.showSamples ? paintSamples(ctx, at, history.samples.get(name), seen) : 0);
  const account = paintEstimate(ctx, at, history.estimate, name, seen, samples);
  if (picture.showTruth) paintTruth(ctx, at, history.truth, name, seen);
  if (picture.withLabels) paintLabels(ctx, at, seen);
  ctx.restore();
  return account;
}

function paintGrid(ctx, at, { width, height, span, origin, left, right, scale, palette }) {
  ctx.strokeStyle = palette.grid;
  ctx.lineWidth = 1;
  ctx.beginPath();
  for (const tick of scale.ticks) {
    const y = Math.round(at.y(tick)) + 0.5;
    ctx.moveTo(AXIS_WIDTH, y);
    ctx.lineTo(width, y);
  }
  const step = secondsPerLine(span);
  for (let time = Math.ceil(Math.max(left, origin) / step) * step; time < right; time += step) {
    const x = Math.round(at.x(time)) + 0.5;
    ctx.moveTo(x, 0);
    ctx.lineTo(x, height);
  }
  ctx.stroke();
}

/** Seconds between two vertical lines of a strip. */
export const secondsPerLine = (span) => (span <= 2 ? 0.2 : span <= 5 ? 0.5 : span <= 10 ? 1 : span <= 30 ? 2 : 5);

function paintMarkers(ctx, at, { height, left, right, markers, palette }) {
  for (const marker of between(markers, left, right)) {
    const x = Math.round(at.x(marker.time)) + 0.5;
    ctx.strokeStyle = palette.marker[marker.kind] ?? palette.quiet;
    ctx.lineWidth = marker.kind === "event" ? 1 : 1.5;
    ctx.setLineDash(marker.kind === "event" ? [2, 3] : []);
    ctx.beginPath();
    ctx.moveTo(x, 0);
    ctx.lineTo(x, height);
    ctx.stroke();
    ctx.setLineDash([]);
  }
}

// One line of labels, so that the waveform stays readable: of marks close to each other the most urgent is named, the
// others are counted, and each label is cut off where the next one begins.
function paintLabels(ctx, at, { origin, right, markers, palette }) {
  ctx.font = FONT;
  ctx.textAlign = "left";
  ctx.textBaseline = "top";
  const clusters = clustersOf(at, between(markers, origin, right));
  clusters.forEach(({ x, first, others }, k) => {
    const room = (clusters[k + 1]?.x ?? Infinity) - x - 8;
    const text = shortened(ctx, first.label, others ? ` +${others}` : "", room);
    ctx.fillStyle = palette.plate;
    ctx.fillRect(x + 2, 2, ctx.measureText(text).width + 4, 13);
    ctx.fillStyle = palette.ink;
    ctx.fillText(text, x + 4, 3);
  });
}

function clustersOf(at, markers) {
  const urgency = (marker) => URGENCY[marker.kind] ?? 0;
  const clusters = [];
  for (const marker of [...markers].sort((one, other) => one.time - other.time)) {
    const x = at.x(marker.time);
    const last = clusters[clusters.length - 1];
    if (!last || x - last.x > CLUSTER_PX) {
      clusters.push({ x, first: marker, others: 0 });
      continue;
    }
    last.others += 1;
    if (urgency(marker) > urgency(last.first)) last.first = marker;
  }
  return clusters;
}

function shortened(ctx, label, ending, room) {
  if (ctx.measureText(label + ending).width <= room) return label + ending;
  let length = label.length - 1;
  while (length > 1 && ctx.measureText(`${label.slice(0, length)}…${ending}`).width > room) length -= 1;
  return `${label.slice(0, length).trimEnd()}…${ending}`;
}

// Samples lie between band and mean: they hide neither.
function paintEstimate(ctx, at, estimate, name, picture, paintBetween) {
  const account = { points: 0, bandPoints: 0, samples: 0 };
  if (!estimate.column(`${name}.mean`)) return account;
  const stride = strideOf(rowsPerPixel(estimate, at));
  const [from, to] = visible(estimate, picture, stride);
  const [mean, low, high] = ["mean", "q05", "q95"].map((part) => estimate.column(`${name}.${part}`));
  const runs = runsOf(estimate, name, from, to);
  for (const run of runs) paintBand(ctx, at, bandOf(estimate, low, high, run.from, run.to, stride), run.isForecast, picture.palette);
  account.samples = paintBetween();
  for (const run of runs) {
    paintMean(ctx, at, lineOf(estimate, mean, run.from, run.to, stride), run.isForecast, picture.palette);
    account.points += run.to - run.from;
    for (let i = run.from; i < run.to; i += 1) if (high[i] > low[i]) account.bandPoints += 1;
  }
  return account;
}

const rowsPerPixel = (series, at) => 1 / (at.perSecond * usualSpacing(series, series.end));

// One bucket more on either side, so that lines run out of the picture instead of ending in it.
function visible(series, { left, right }, stride) {
  return [Math.max(series.lower(left) - stride, series.first), Math.min(series.lower(right) + stride, series.end)];
}

function paintBand(ctx, at, band, isForecast, palette) {
  ctx.fillStyle = isForecast ? palette.hatch : palette.band;
  ctx.beginPath();
  for (let k = 0; k < band.length; k += 3) ctx.lineTo(at.x(band[k]), at.y(band[k + 2]));
  for (let k = band.length - 3; k >= 0; k -= 3) ctx.lineTo(at.x(band[k]), at.y(band[k + 1]));
  ctx.fill();
}

function paintMean(ctx, at, line, isForecast, palette) {
  ctx.strokeStyle = palette.line;
  ctx.lineWidth = isForecast ? 1.5 : 2;
  ctx.lineJoin = "bevel";
  if (isForecast) traceDashes(ctx, at, line, FORECAST_DASH);
  else tracePath(ctx, at, line);
  ctx.stroke();
}

function tracePath(ctx, at, line) {
  ctx.beginPath();
  for (let k = 0; k < line.length; k += 2) ctx.lineTo(at.x(line[k]), at.y(line[k + 1]));
}

function traceDashes(ctx, at, line, [on, off]) {
  ctx.beginPath();
  for (const [t0, v0, t1, v1] of dashes(line, on / at.perSecond, off / at.perSecond)) {
    ctx.moveTo(at.x(t0), at.y(v0));
    ctx.lineTo(at.x(t1), at.y(v1));
  }
}

// A sample beyond the scale is a small bar at the edge: an artefact must not squeeze the waveform, nor go unseen.
function paintSamples(ctx, at, series, picture) {
  if (!series) return 0;
  const stride = strideOf(rowsPerPixel(series, at));
  const [from, to] = visible(series, picture, stride);
  const value = series.column("value");
  ctx.fillStyle = picture.palette.sample;
  let painted = 0;
  for (let i = from + ((stride - ((from + series.dropped) % stride)) % stride); i < to; i += stride) {
    // On whole pixels, where a rectangle costs least.
    const [x, y] = [Math.round(at.x(series.times[i])), Math.round(at.y(value[i]))];
    if (y < 0) ctx.fillRect(x - 1, 0, 2, 4);
    else if (y > picture.height) ctx.fillRect(x - 1, picture.height - 4, 2, 4);
    else ctx.fillRect(x - 1, y - 1, 2, 2);
    painted += 1;
  }
  return painted;
}

function paintTruth(ctx, at, truth, name, picture) {
  const value = truth.column(name);
  // A thin line makes do with half the pixels.
  const stride = strideOf(2 * rowsPerPixel(truth, at));
  const [from, to] = visible(truth, picture, stride);
  if (!value || to <= from) return;
  ctx.strokeStyle = picture.palette.truth;
  ctx.lineWidth = 1;
  for (const run of stretches(truth, value, from, to)) {
    traceDashes(ctx, at, lineOf(truth, value, run.from, run.to, stride), TRUTH_DASH);
    ctx.stroke();
  }
}
