// Charts by plotly: fetched when the first one is needed, then drawn in turns, one at a time, so that no redraw holds up
// the strips. Charts that nobody sees are not drawn.

import { isInSight, unwatch, watch } from "./sight.js";
import { color, onTheme } from "./theme.js";

/** Between two charts; on a fast machine with six charts in sight each is a second old at most. */
const TURN_MS = 160;
/** A chart is not drawn more often than this. */
const LEAST_AGE_MS = 1000;

/** After a chart the strips have the machine for so many times as long as it took. */
const REST = 30;

let plotly = null;

function load() {
  plotly ??= new Promise((resolve, reject) => {
    const script = document.createElement("script");
    script.src = "/plotly.js";
    script.onload = () => resolve(window.Plotly);
    script.onerror = () => reject(new Error("/plotly.js cannot be loaded"));
    document.head.append(script);
  });
  return plotly;
}

export class Charts {
  constructor() {
    this.charts = new Set();
    this.isOn = false;
    this.restUntil = 0;
    onTheme(() => {
      for (const chart of this.charts) chart.drawnAt = -Infinity;
    });
    setInterval(() => this.#turn(), TURN_MS);
  }

  /** Adds a chart: `figure()` gives `{data, layout}` to be drawn in `node`, or null while there is nothing. */
  add(node, figure) {
    const chart = { node, figure, drawnAt: -Infinity };
    this.charts.add(chart);
    watch(node);
    return chart;
  }

  /** Takes a chart away. */
  remove(chart) {
    this.charts.delete(chart);
    unwatch(chart.node);
    if (chart.isDrawn) window.Plotly.purge(chart.node);
  }

  /** Whether turns are taken: not while the view is hidden or nothing new can be shown. */
  run(isOn) {
    this.isOn = isOn;
  }

  #turn() {
    const now = performance.now();
    if (!this.isOn || document.hidden || now < this.restUntil) return;
    const due = [...this.charts].filter((chart) => isInSight(chart.node) && now - chart.drawnAt > LEAST_AGE_MS);
    if (!due.length) return;
    const chart = due.reduce((one, other) => (other.drawnAt < one.drawnAt ? other : one));
    chart.drawnAt = now;
    load().then(
      (Plotly) => this.#draw(Plotly, chart),
      (error) => (chart.node.textContent = error.message),
    );
  }

  #draw(Plotly, chart) {
    const begin = performance.now();
    draw(Plotly, chart);
    const end = performance.now();
    // A chart that was never drawn is an empty frame; the strips can wait for these few.
    const isBlank = [...this.charts].some((c) => isInSight(c.node) && !c.isDrawn && c.drawnAt === -Infinity);
    this.restUntil = isBlank ? 0 : end + REST * (end - begin);
  }
}

function draw(Plotly, chart) {
  const figure = chart.figure();
  if (!figure) return;
  chart.isDrawn = true;
  Plotly.react(chart.node, figure.data, { ...baseLayout(), ...figure.layout }, { displayModeBar: false, responsive: true });
}

function baseLayout() {
  return {
    paper_bgcolor: "rgba(0,0,0,0)",
    plot_bgcolor: "rgba(0,0,0,0)",
    font: { family: "system-ui, sans-serif", size: 11, color: color("quiet") },
    margin: { l: 40, r: 6, t: 6, b: 30 },
    showlegend: false,
    hovermode: "closest",
    dragmode: false,
  };
}

/** An axis in the colours of the page. */
export function axis(more) {
  return { gridcolor: color("grid"), zeroline: false, linecolor: color("line"), fixedrange: true, ...more };
}
