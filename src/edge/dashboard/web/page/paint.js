// Paints a strip: band, mean, samples, truth and markers of one quantity over a stretch of time. It only reads, and
// returns an account of what it painted.

import { bandOf, lineOf, strideOf } from "./outline.js";
import { runsOf, stretches } from "./runs.js";
import { shareInside } from "./truth.js";

/** Room at the left for the numbers of the scale [px]. */
const AXIS_WIDTH = 38;

/** A mark speaks for those that follow it so closely [px]. */
const CLUSTER_PX = 60;
const URGENCY = { high: 4, medium: 3, low: 2, note: 1 };
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
  const samples = () => (picture.showSamples ? paintSamples(ctx, at, history.samples.get(name), picture) : 0);
  const account = paintEstimate(ctx, at, history.estimate, name, picture, samples);
  account.truthInside = picture.showTruth ? paintTruth(ctx, at, history, name, picture) : null;
  if (picture.withLabels) paintLabels(ctx, at, picture);
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

/** Seconds between two vertical lines of a strip. */
export const secondsPerLine = (span) => (span <= 2 ? 0.2 : span <= 5 ? 0.5 : span <= 10 ? 1 : span <= 30 ? 2 : 5);

function paintMarkers(ctx, at, { height, markers, palette }) {
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
  }
}

// One line of labels, so that the waveform stays readable: of marks close to each other the most urgent is named, the
// others are counted, and each label is cut off where the next one begins.
function paintLabels(ctx, at, { markers, palette }) {
  ctx.font = FONT;
  ctx.textAlign = "left";
  ctx.textBaseline = "top";
  const clusters = clustersOf(at, markers);
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
  const account = { points: 0, low: null, high: null, bandPoints: 0, samples: 0 };
  if (!estimate.column(`${name}.mean`)) return account;
  const [from, to] = visible(estimate, picture);
  const stride = strideOf((to - from) / (picture.width - AXIS_WIDTH));
  const [mean, low, high] = ["mean", "low", "high"].map((part) => estimate.column(`${name}.${part}`));
  const runs = runsOf(estimate, name, from, to);
  for (const run of runs) paintBand(ctx, at, bandOf(estimate, low, high, run.from, run.to, stride), run.isForecast, picture.palette);
  account.samples = paintBetween();
  for (const run of runs) {
    paintMean(ctx, at, lineOf(estimate, mean, run.from, run.to, stride), run.isForecast, picture.palette);
    account.points += run.to - run.from;
    for (let i = run.from; i < run.to; i += 1) if (high[i] > low[i]) account.bandPoints += 1;
  }
  const newest = estimate.at(picture.right);
  if (newest >= from) {
    [account.low, account.high] = [low[newest], high[newest]];
  }
  return account;
}

// One row more on either side, so that lines run out of the picture instead of ending in it.
function visible(series, { left, right }) {
  return [Math.max(series.lower(left) - 1, series.first), Math.min(series.lower(right) + 1, series.end)];
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
  ctx.setLineDash(isForecast ? [6, 5] : []);
  tracePath(ctx, at, line);
  ctx.stroke();
  ctx.setLineDash([]);
}

function tracePath(ctx, at, line) {
  ctx.beginPath();
  for (let k = 0; k < line.length; k += 2) ctx.lineTo(at.x(line[k]), at.y(line[k + 1]));
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
    // On whole pixels, where a rectangle costs least.
    const [x, y] = [Math.round(at.x(series.times[i])), Math.round(at.y(value[i]))];
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
  // Dashes are dear: they make do with half the pixels.
  const stride = strideOf((2 * (to - from)) / (picture.width - AXIS_WIDTH));
  ctx.strokeStyle = picture.palette.truth;
  ctx.lineWidth = 1;
  ctx.setLineDash([4, 3]);
  for (const run of stretches(truth.times, value, from, to)) {
    tracePath(ctx, at, lineOf(truth, value, run.from, run.to, stride));
    ctx.stroke();
  }
  ctx.setLineDash([]);
  return shareInside(truth, value, estimate, name, from, to);
}
