// Trends over minutes: estimated parameters, and what each beat amounts to. A small chart for each.

import { axis } from "./charts.js";
import { byId, element, setAttribute, setText } from "./dom.js";
import { between } from "./markers.js";
import { BEAT_NAMES, describe } from "./names.js";
import { decimals, duration, NONE, number, range } from "./numbers.js";
import { color, veil } from "./theme.js";

const BEAT_TRENDS = ["cardiac_output", "heart_rate", "svr", "pvr", "p_a_mean", "p_pa_mean", "p_v_mean", "stroke_volume", "ejection_fraction"];
const CHARTS_LIMIT = 40;
/** The shortest axis of a trend [s]. */
const LEAST_SPAN_S = 60;
/** The longest: all that is kept. */
const LONGEST_SPAN_S = 600;
/** Rows drawn of one trend; more than a small chart has pixels. */
const POINTS_LIMIT = 600;

export class Trends {
  /** `scene()` gives `{history, viewport, markers}`. */
  constructor(charts, scene) {
    this.charts = charts;
    this.scene = scene;
    this.cards = new Map();
  }

  /** Adds cards for what has a trend by now and writes their numbers. */
  write(history, viewport) {
    for (const name of BEAT_TRENDS) {
      if (history.beats.has(name)) this.#card(`beat ${name}`, name, "beat-trends", history.beats).write(history, viewport);
    }
    for (const name of history.parameters.keys()) {
      this.#card(`parameter ${name}`, name, "parameter-trends", history.parameters)?.write(history, viewport);
    }
    byId("no-parameters").hidden = history.parameters.size > 0;
  }

  /** Forgets the cards of another bed. */
  reset() {
    for (const card of this.cards.values()) {
      this.charts.remove(card.chart);
      card.node.remove();
    }
    this.cards.clear();
  }

  #card(key, name, place, series) {
    if (!this.cards.has(key) && this.cards.size < CHARTS_LIMIT) {
      const card = new TrendCard(name, series);
      byId(place).append(card.node);
      card.chart = this.charts.add(card.plot, () => this.#figure(card));
      this.cards.set(key, card);
    }
    return this.cards.get(key);
  }

  #figure(card) {
    const { history, viewport, markers } = this.scene();
    const series = card.seriesOf(history);
    return series?.length ? figureOf(series, viewport, markers, card.hue) : null;
  }
}

class TrendCard {
  constructor(name, map) {
    this.name = name;
    this.isParameter = map !== null && !(name in BEAT_NAMES) && !/_(systolic|diastolic|mean)$/.test(name);
    const about = this.isParameter ? { label: name, text: name, color: "hue-parameter" } : beatAbout(name);
    this.hue = about.color;
    this.value = element("span", { class: "trend-value" });
    this.band = element("span", { class: "trend-band" });
    this.state = element("span", { class: "trend-state" });
    this.plot = element("div", { class: "trend-plot", role: "img", "aria-label": `trend of ${about.text}` });
    const label = element("span", { class: "trend-label", text: about.label, title: about.text });
    const head = element("div", { class: "trend-head", style: `--hue: var(--${this.hue})` }, label, this.value, this.state);
    this.node = element("div", { class: "trend" }, head, this.band, this.plot);
  }

  seriesOf(history) {
    return (this.isParameter ? history.parameters : history.beats).get(this.name);
  }

  write(history, viewport) {
    const series = this.seriesOf(history);
    const row = series ? series.at(viewport.right) : -1;
    const at = (part) => (row < 0 ? NaN : (series.column(part)?.[row] ?? NaN));
    const digits = decimals(at("mean"), (at("high") - at("low")) / 2);
    setText(this.value, number(at("mean"), digits));
    setText(this.band, row < 0 ? NONE : `${range(at("low"), at("high"), digits)} ${history.units.get(this.name) ?? ""}`);
    setText(this.state, this.isParameter ? informedText(history, this.name, at("informed")) : "");
    setAttribute(this.node, "data-informed", String(!this.isParameter || at("informed") >= 0.5));
  }
}

function beatAbout(name) {
  if (Object.hasOwn(BEAT_NAMES, name)) return BEAT_NAMES[name];
  const [, quantity, part] = /^(.*)_(systolic|diastolic|mean)$/.exec(name);
  const about = describe(quantity);
  return { label: `${about.label} ${part}`, text: `${part} ${about.text}`, color: about.color };
}

function informedText(history, name, informed) {
  if (informed >= 0.5) return "";
  const since = history.latest.parameters?.find((parameter) => parameter.name === name)?.since_informed_s;
  return since == null ? "not informed" : `not informed for ${duration(since)}`;
}

function figureOf(series, viewport, markers, hue) {
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
    const outline = [...stretch.map((i) => [i, "high"]), ...stretch.toReversed().map((i) => [i, "low"])];
    for (const [i, part] of outline) {
      x.push(series.times[i] - right);
      y.push(series.column(part)[i]);
    }
    x.push(null);
    y.push(null);
  }
  const band = { type: "scatter", mode: "lines", x, y, fill: "toself", fillcolor: veil(hue, 0.25), line: { width: 0 }, hoverinfo: "skip" };
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
