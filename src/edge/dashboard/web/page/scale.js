// The vertical scale of a strip. It widens at once and narrows only when much of it is empty, so that it does not
// breathe with every beat.

import { niceTicks } from "./numbers.js";

/** Part of the scale that has to be in use. */
const LEAST_USE = 0.5;
/** A forecast's band may be far wider than the pressure moves; so much of the mean's span is shown of it on each side. */
const BAND_SHARE = 0.6;
const LEAST_SPAN = 4;
const TICKS = 4;

/** Smallest and largest of the values to be shown of rows `[from, to)`; null if there is none. */
export function extent(estimate, name, from, to) {
  const [mean, low, high] = ["mean", "q05", "q95"].map((part) => estimate.column(`${name}.${part}`));
  let [least, most, lowest, highest] = [Infinity, -Infinity, Infinity, -Infinity];
  for (let i = from; i < to; i += 1) {
    if (mean[i] < least) least = mean[i];
    if (mean[i] > most) most = mean[i];
    if (low[i] < lowest) lowest = low[i];
    if (high[i] > highest) highest = high[i];
  }
  if (least > most) return null;
  const room = Math.max(BAND_SHARE * (most - least), LEAST_SPAN);
  return { low: Math.max(Math.min(lowest, least), least - room), high: Math.min(Math.max(highest, most), most + room) };
}

export class Scale {
  constructor() {
    this.low = 0;
    this.high = 1;
    this.ticks = [];
    this.isSet = false;
  }

  /** Whether an extent has room. */
  holds(wanted) {
    return this.isSet && (!wanted || (wanted.low >= this.low && wanted.high <= this.high));
  }

  /** Makes room for an extent. */
  fit(wanted) {
    if (!wanted) return;
    const isEmpty = wanted.high - wanted.low < LEAST_USE * (this.high - this.low);
    if (this.holds(wanted) && !isEmpty) return;
    const margin = 0.08 * Math.max(wanted.high - wanted.low, LEAST_SPAN);
    [this.low, this.high] = [wanted.low - margin, wanted.high + margin];
    this.ticks = niceTicks(this.low, this.high, TICKS).ticks;
    this.isSet = true;
  }

  /** Forgets what it was; the next extent is fitted tightly. */
  reset() {
    this.isSet = false;
  }
}
