// Trends over minutes: estimated parameters, and what each beat amounts to. A small chart for each.

import { byId, element, setAttribute, setHidden, setText } from "./dom.js";
import { describeBeat, describeParameter } from "./names.js";
import { decimals, duration, NONE, number, spread } from "./numbers.js";
import { trendFigure } from "./trendfigure.js";

const BEAT_TRENDS = [
  "cardiac_output", "heart_rate", "svr", "pvr", "p_a_mean", "p_pa_mean", "p_v_mean", "stroke_volume", "ejection_fraction",
];
const CHARTS_LIMIT = 40;
const PLACES = { beats: "beat-trends", parameters: "parameter-trends" };

export class Trends {
  /** `scene()` gives `{history, viewport, markers}`. */
  constructor(charts, scene) {
    this.charts = charts;
    this.scene = scene;
    this.cards = new Map();
  }

  /** Adds cards for what has a trend by now and writes their numbers; `kind` is `beats` or `parameters`. */
  write(kind, history, viewport) {
    const isBeats = kind === "beats";
    const names = isBeats ? BEAT_TRENDS.filter((name) => history.beats.has(name)) : history.parameters.keys();
    for (const name of names) this.#card(kind, name)?.write(history, viewport);
    if (!isBeats) setHidden(byId("no-parameters"), history.parameters.size > 0);
  }

  /** Forgets the cards of another bed. */
  reset() {
    for (const card of this.cards.values()) {
      this.charts.remove(card.chart);
      card.node.remove();
    }
    this.cards.clear();
  }

  // `kind` is where the history keeps the series: a parameter and what beats amount to may have the same name.
  #card(kind, name) {
    const key = `${kind} ${name}`;
    if (!this.cards.has(key) && this.cards.size < CHARTS_LIMIT) {
      const card = new TrendCard(kind, name);
      byId(PLACES[kind]).append(card.node);
      card.chart = this.charts.add(card.plot, () => this.#figure(card));
      this.cards.set(key, card);
    }
    return this.cards.get(key);
  }

  #figure(card) {
    const { history, viewport, markers } = this.scene();
    const series = card.seriesOf(history);
    return series?.length ? trendFigure(series, viewport, markers, card.hue) : null;
  }
}

class TrendCard {
  constructor(kind, name) {
    this.kind = kind;
    this.name = name;
    this.isParameter = kind === "parameters";
    const about = this.isParameter ? describeParameter(name) : describeBeat(name);
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
    return history[this.kind].get(this.name);
  }

  write(history, viewport) {
    const series = this.seriesOf(history);
    const row = series ? series.at(viewport.right) : -1;
    const at = (part) => (row < 0 ? NaN : (series.column(part)?.[row] ?? NaN));
    const digits = decimals(at("mean"), (at("q95") - at("q05")) / 2);
    setText(this.value, number(at("mean"), digits));
    setText(this.band, row < 0 ? NONE : `${spread(at("q05"), at("q95"), digits)} ${history.units.get(this.name) ?? ""}`);
    setText(this.state, this.isParameter ? informedText(history, this.name, at("informed")) : "");
    setAttribute(this.node, "data-informed", String(!this.isParameter || at("informed") >= 0.5));
  }
}

function informedText(history, name, informed) {
  if (informed >= 0.5) return "";
  const since = history.latest.parameters?.find((parameter) => parameter.name === name)?.since_informed_s;
  return since == null ? "not informed" : `not informed for ${duration(since)}`;
}
