// The visible part of an estimate cut into runs that can be drawn in one go: without a gap, and either an estimate or
// a forecast as a whole.

/** Longer without data than this, an estimate is a forecast [s]. */
const FORECAST_AFTER_S = 0.25;

/** Spacing that is never taken for a gap [s]. */
const LEAST_GAP_S = 0.06;
const SPACINGS_LOOKED_AT = 33;
/** Spacing of a series that has none yet [s]. */
const FIRST_SPACING_S = 0.02;

/** Usual spacing of the rows of `series` before row `to` [s]. */
export function usualSpacing({ times, first }, to) {
  const spacings = [];
  for (let i = Math.max(first + 1, to - SPACINGS_LOOKED_AT); i < to; i += 1) spacings.push(times[i] - times[i - 1]);
  spacings.sort((one, other) => one - other);
  return spacings[spacings.length >> 1] ?? FIRST_SPACING_S;
}

/** Longest spacing of neighbouring rows before row `to` that is not a gap [s]: three times the usual one. */
export function longestSpacing(series, to) {
  return Math.max(3 * usualSpacing(series, to), LEAST_GAP_S);
}

/** Stretches `{from, to}` of rows `[from, to)` without a gap and without a missing value in `column`. */
export function stretches(series, column, from, to) {
  return split(series, column, from, to, () => false);
}

/** Runs `{from, to, isForecast}` of rows `[from, to)` of quantity `name`; where an estimate becomes a forecast both
 * share a row, so that the line does not break there. */
export function runsOf(estimate, name, from, to) {
  const since = estimate.column("since_data");
  return split(estimate, estimate.column(`${name}.mean`), from, to, (i) => since[i] > FORECAST_AFTER_S);
}

function split(series, column, from, to, isForecastAt) {
  const { times } = series;
  const longest = longestSpacing(series, to);
  const runs = [];
  let run = null;
  for (let i = from; i < to; i += 1) {
    if (Number.isNaN(column[i])) {
      run = null;
      continue;
    }
    const isForecast = isForecastAt(i);
    const isGap = run !== null && times[i] - times[i - 1] > longest;
    if (run === null || isGap || run.isForecast !== isForecast) {
      const shares = run !== null && !isGap;
      run = { from: shares ? i - 1 : i, to: i, isForecast };
      runs.push(run);
    }
    run.to = i + 1;
  }
  return runs;
}
