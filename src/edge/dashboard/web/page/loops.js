// Pressure-volume loops of both ventricles over the last beat, with the 5-95 % band around.

import { axis } from "./charts.js";
import { byId } from "./dom.js";
import { color, veil } from "./theme.js";

const POINTS_LIMIT = 160;
const LEAST_POINTS = 8;
/** A loop with a gap longer than this share of the beat is not drawn. */
const GAP_SHARE = 0.15;
const USUAL_BEAT_S = 0.85;
const VENTRICLES = [
  { id: "loop-l", pressure: "p_l", volume: "v_l", hue: "hue-l" },
  { id: "loop-r", pressure: "p_r", volume: "v_r", hue: "hue-r" },
];

const NOTHING = {
  xaxis: { visible: false },
  yaxis: { visible: false },
  annotations: [{ text: "no whole beat here", showarrow: false, xref: "paper", yref: "paper", x: 0.5, y: 0.5 }],
};

/** Adds the loops to `charts`; `scene()` gives `{history, viewport}`. */
export function addLoops(charts, scene) {
  for (const ventricle of VENTRICLES) {
    charts.add(byId(ventricle.id), () => {
      const { history, viewport } = scene();
      const beat = lastBeat(history, viewport.right, ventricle);
      if (!beat) return null;
      return beat.length ? figureOf(beat, ventricle) : { data: [], layout: NOTHING };
    });
  }
}

// Points of the last beat before `right`: means and half widths of the bands. Its length is what the heart rate says.
function lastBeat(history, right, { pressure, volume }) {
  const { estimate } = history;
  const names = [pressure, volume].flatMap((name) => ["mean", "q05", "q95"].map((part) => `${name}.${part}`));
  const columns = names.map((name) => estimate.column(name));
  if (columns.some((column) => !column)) return null;
  const rate = (history.beatAt("heart_rate", right) ?? history.latest.beat?.heart_rate)?.mean;
  const length = rate > 20 && rate < 300 ? 60 / rate : USUAL_BEAT_S;
  const [from, to] = [estimate.lower(right - length), estimate.lower(right + 1e-6)];
  const stride = Math.max(Math.ceil((to - from) / POINTS_LIMIT), 1);
  const points = [];
  for (let i = from; i < to; i += stride) {
    const [p, pLow, pHigh, v, vLow, vHigh] = columns.map((column) => column[i]);
    if (Number.isFinite(p + pLow + pHigh + v + vLow + vHigh)) {
      points.push({ p, v, dp: Math.max((pHigh - pLow) / 2, 0), dv: Math.max((vHigh - vLow) / 2, 0) });
    }
  }
  const isWhole = points.length >= LEAST_POINTS && covers(estimate.times, from, to, right, length);
  return isWhole ? points : [];
}

// A loop closed over a gap would be a picture of nothing that ever was.
function covers(times, from, to, right, length) {
  let longest = Math.max(times[from] - (right - length), right - times[to - 1]);
  for (let i = from + 1; i < to; i += 1) longest = Math.max(longest, times[i] - times[i - 1]);
  return longest < GAP_SHARE * length;
}

// What an ellipse of the half widths sweeps along the loop: for every point the places where it is farthest out and
// farthest in across the loop, outwards in the one direction and back inwards in the other.
function tube(points) {
  const spread = (key) => Math.max(...points.map((q) => q[key])) - Math.min(...points.map((q) => q[key])) || 1;
  const [perV, perP] = [1 / spread("v"), 1 / spread("p")];
  const [outer, inner] = [[], []];
  points.forEach((point, k) => {
    const before = points[(k + points.length - 1) % points.length];
    const after = points[(k + 1) % points.length];
    // Across the loop as it looks on the screen, where both axes are about as long.
    const [nv, np] = [(after.p - before.p) * perP, -(after.v - before.v) * perV];
    const [a, b] = [point.dv * perV, point.dp * perP];
    const reach = Math.hypot(a * nv, b * np) || 1;
    const [dv, dp] = [(a * a * nv) / reach / perV, (b * b * np) / reach / perP];
    outer.push([point.v + dv, point.p + dp]);
    inner.push([point.v - dv, point.p - dp]);
  });
  const ring = [...outer, outer[0], inner[0], ...inner.reverse()];
  return { x: ring.map(([v]) => v), y: ring.map(([, p]) => p) };
}

function figureOf(points, { volume, pressure, hue }) {
  const closed = [...points, points[0]];
  const common = { type: "scatter", mode: "lines" };
  const band = {
    ...common, ...tube(points), fill: "toself", fillcolor: veil(hue, 0.28), hoverinfo: "skip",
    line: { width: 0, simplify: false },
  };
  const mean = {
    ...common, x: closed.map((q) => q.v), y: closed.map((q) => q.p),
    line: { color: color(hue), width: 2.5, simplify: false },
    hovertemplate: "%{x:.0f} mL, %{y:.0f} mmHg<extra></extra>",
  };
  const now = points[points.length - 1];
  const dot = {
    ...common, mode: "markers", x: [now.v], y: [now.p], hoverinfo: "skip",
    marker: { color: color("ink"), size: 8, line: { color: color("panel"), width: 1.5 } },
  };
  const layout = {
    margin: { l: 42, r: 8, t: 6, b: 36 },
    xaxis: axis({ title: { text: "volume [mL]", standoff: 4 }, nticks: 5 }),
    yaxis: axis({ title: { text: "pressure [mmHg]", standoff: 4 }, nticks: 5 }),
  };
  return { data: [band, mean, dot], layout };
}
