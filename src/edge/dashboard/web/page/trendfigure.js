// The chart of one trend: mean and band over minutes, grey and dotted where data say nothing, and what happened.

import { axis } from "./charts.js";
import { between } from "./markers.js";
import { color, veil } from "./theme.js";

/** The shortest axis of a trend [s]. */
const LEAST_SPAN_S = 60;
/** The longest: all that is kept. */
const LONGEST_SPAN_S = 600;
/** Rows drawn of one trend; more than a small chart has pixels. */
const POINTS_LIMIT = 600;

/** Figure of a series up to the right edge of the viewport: mean, band, truth where there is one, marks. */
export function trendFigure(series, viewport, markers, hue) {
  const { right } = viewport;
  const left = Math.min(Math.max(series.oldest, right - LONGEST_SPAN_S), right - LEAST_SPAN_S);
  const rows = pick(series, left, right);
  const data = [];
  for (const informed of [true, false]) {
    // The row before a stretch belongs to it too, so that stretches meet.
    const shown = rows.map(([i, isInformed], k) => (isInformed === informed || rows[k + 1]?.[1] === informed ? i : -1));
    if (shown.some((i) => i >= 0)) data.push(...bandTraces(series, shown, right, informed ? hue : "quiet", informed));
  }
  const truth = series.column("truth");
  if (truth && rows.some(([i]) => Number.isFinite(truth[i]))) {
    const line = { color: color("ink"), width: 1, dash: "dash" };
    data.push({ ...points(series, rows.map(([i]) => i), right, truth), line, hovertemplate: "truth %{y:.4~g}<extra></extra>" });
  }
  const layout = { xaxis: timeAxis(left - right), yaxis: axis({ nticks: 4 }), shapes: shapesOf(between(markers, left, right), right) };
  return { data, layout };
}

// Rows to be drawn and whether the data informed each; what a beat amounts to always is.
function pick(series, left, right) {
  const informed = series.column("informed");
  const [from, to] = [series.lower(left), series.lower(right + 1e-6)];
  const stride = Math.max(Math.ceil((to - from) / POINTS_LIMIT), 1);
  const rows = [];
  for (let i = from; i < to; i += stride) rows.push([i, informed ? informed[i] >= 0.5 : true]);
  return rows;
}

// Rows of -1 are breaks.
function points(series, rows, right, column) {
  return {
    type: "scatter", mode: "lines", connectgaps: false,
    x: rows.map((i) => (i < 0 ? null : series.times[i] - right)),
    y: rows.map((i) => (i < 0 || Number.isNaN(column[i]) ? null : column[i])),
  };
}

// A band is one outline for each stretch without a break: plotly fills to the next trace over breaks otherwise.
function bandTraces(series, rows, right, hue, informed) {
  const [x, y] = [[], []];
  for (const stretch of stretches(rows)) {
    const outline = [...stretch.map((i) => [i, "q95"]), ...stretch.toReversed().map((i) => [i, "q05"])];
    for (const [i, part] of outline) {
      x.push(series.times[i] - right);
      y.push(series.column(part)[i]);
    }
    x.push(null);
    y.push(null);
  }
  const outline = { x, y, fill: "toself", fillcolor: veil(hue, 0.25), line: { width: 0 } };
  const band = { type: "scatter", mode: "lines", ...outline, hoverinfo: "skip" };
  const line = { color: color(hue), width: 2, dash: informed ? "solid" : "dot" };
  const mean = { ...points(series, rows, right, series.column("mean")), line, hovertemplate: "%{y:.4~g}<extra></extra>" };
  return [band, mean];
}

function stretches(rows) {
  const found = [];
  rows.forEach((i, k) => {
    if (i < 0) return;
    if (k === 0 || rows[k - 1] < 0) found.push([]);
    found[found.length - 1].push(i);
  });
  return found;
}

function timeAxis(left) {
  const step = left < -300 ? 120 : left < -90 ? 60 : 30;
  const ticks = [];
  for (let tick = 0; tick >= left; tick -= step) ticks.push(tick);
  const text = (tick) => (tick === 0 ? "0" : step < 60 ? `${tick} s` : `${tick / 60} min`).replace("-", "−");
  return axis({ range: [left, 0], tickvals: ticks, ticktext: ticks.map(text), tickangle: 0 });
}

function shapesOf(markers, right) {
  const colors = { note: "note", high: "alarm-high", medium: "alarm-medium", low: "alarm-low" };
  return markers.map(({ time, kind }) => ({
    type: "line", x0: time - right, x1: time - right, y0: 0, y1: 1, yref: "paper",
    line: { color: color(colors[kind] ?? "quiet"), width: kind === "event" ? 0.5 : 1.5, dash: kind === "event" ? "dot" : "solid" },
  }));
}
