// Numbers as text: as long as their band is wide, and of the same width from one second to the next.

/** Stands in place of a number that is not there. */
export const NONE = "–";

const MINUS = "−";

const isNumber = (value) => typeof value === "number" && Number.isFinite(value);

const magnitude = (value) => (isNumber(value) && value !== 0 ? Math.floor(Math.log10(Math.abs(value))) : 0);

/** Digits after the point that make `value` readable to two digits of `resolution`, and no longer than needed. */
export function decimals(value, resolution) {
  const byResolution = isNumber(resolution) && resolution > 0 ? 1 - magnitude(resolution) : 3;
  const byLength = Math.max(3 - magnitude(value), 0);
  return Math.min(Math.max(Math.min(byResolution, byLength), 0), 5);
}

/** A number with so many digits after the point. */
export function number(value, digits) {
  if (!isNumber(value)) return NONE;
  if (Math.abs(value) >= 1e6) return value.toExponential(1).replace("-", MINUS);
  const text = value.toFixed(digits);
  // A minus before nothing but zeros says nothing.
  return Number(text) === 0 ? text.replace("-", "") : text.replace("-", MINUS);
}

/** A band: `71–73`, or `−1 to 3` where a dash would be taken for a minus. */
export function range(low, high, digits) {
  if (!isNumber(low) || !isNumber(high)) return NONE;
  return number(low, digits) + (low < 0 ? " to " : "–") + number(high, digits);
}

/** A band under a number that is shown with so many digits: `71–73`; where it is narrower than the last of them its half
 * width, `±0.3`; nothing where it has no width. */
export function spread(low, high, digits) {
  return high - low < 10 ** -digits ? halfWidth(low, high) : range(low, high, digits);
}

/** Half the width of a band: `±0.3`; nothing where it has none. */
export function halfWidth(low, high) {
  if (!isNumber(low) || !isNumber(high)) return NONE;
  return high > low ? `±${Number(((high - low) / 2).toPrecision(1))}` : "";
}

/** A duration [s] in a few characters. */
export function duration(seconds) {
  if (!isNumber(seconds)) return NONE;
  if (seconds < 10) return `${seconds.toFixed(1)} s`;
  if (seconds < 120) return `${seconds.toFixed(0)} s`;
  if (seconds < 7200) return `${(seconds / 60).toFixed(0)} min`;
  return `${(seconds / 3600).toFixed(0)} h`;
}

/** A count, with thin spaces between thousands. */
export function count(value) {
  return isNumber(value) ? Math.round(value).toString().replace(/\B(?=(\d{3})+$)/g, "\u2009") : NONE;
}

/** Bounds and step of an axis from about `low` to about `high` with about `parts` lines. */
export function niceTicks(low, high, parts) {
  const rough = Math.max(high - low, 1e-9) / parts;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((candidate) => candidate >= rough) ?? rough;
  const ticks = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k += 1) ticks.push(k * step);
  return { step, ticks };
}
