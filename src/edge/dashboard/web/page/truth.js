// The truth beside an estimate: how much of it lies within the band.

import { longestSpacing } from "./runs.js";

/** Share of the truth of `name` from time `left` to `right` that lies within the band of the estimate at that time,
 * between its rows in proportion; null where no row can be compared. */
export function shareInside({ truth, estimate }, name, left, right) {
  const value = truth.column(name);
  const [from, to] = [truth.lower(left), truth.lower(right)];
  const [low, high] = [estimate.column(`${name}.q05`), estimate.column(`${name}.q95`)];
  if (!value || !low || estimate.length < 2 || from >= to) return null;
  const { times } = estimate;
  const last = Math.min(estimate.lower(truth.times[to - 1]) + 1, estimate.end);
  let i = Math.max(estimate.lower(truth.times[from]), estimate.first + 1);
  const longest = longestSpacing(estimate, last);
  let [inside, compared] = [0, 0];
  for (let k = from; k < to; k += 1) {
    const time = truth.times[k];
    while (i < last && times[i] < time) i += 1;
    if (i >= last || times[i - 1] > time || times[i] - times[i - 1] > longest) continue;
    const share = (time - times[i - 1]) / (times[i] - times[i - 1]);
    const least = low[i - 1] + share * (low[i] - low[i - 1]);
    const most = high[i - 1] + share * (high[i] - high[i - 1]);
    if (Number.isNaN(least) || Number.isNaN(most) || Number.isNaN(value[k])) continue;
    compared += 1;
    if (least <= value[k] && value[k] <= most) inside += 1;
  }
  return compared ? inside / compared : null;
}
