// What the page remembers of the bed it shows: at most ten minutes, in memory of limited size.

import { partsOf } from "./frame.js";
import { Series } from "./series.js";
import { secondsOf } from "./time.js";

/** Seconds of the past that are kept. */
const KEPT_S = 600;

const ESTIMATE_LIMIT = 75_000;
const TRUTH_LIMIT = 75_000;
const SAMPLES_LIMIT = 150_000;
const TREND_LIMIT = 4_000;
const NAMES_LIMIT = 64;
const EVENTS_LIMIT = 500;
/** Event time that goes back by more than this began anew [s]. */
const JUMP_BACK_S = 1;

/** Parts that strips are painted of. */
const WAVEFORMS = ["estimate", "truth", "samples"];

/** A beat that ended longer ago is not the present one; the server thinks the same. */
const PRESENT_BEAT_S = 4;
const BAND = ["mean", "q05", "q95"];

export class History {
  #changedFrom;

  constructor(quantities) {
    this.now = null;
    this.estimate = new Series([], ESTIMATE_LIMIT);
    this.truth = new Series([], TRUTH_LIMIT);
    this.samples = new Map();
    this.parameters = new Map();
    this.beats = new Map();
    this.units = new Map();
    this.events = [];
    /** What came last of the things sent twice a second: quantities, parameters, beat, alarms, status. */
    this.latest = {};
    this.#changedFrom = Infinity;
    this.show(quantities);
  }

  /** Time from which on waveforms are not what they were when this was last asked; infinite if nothing has changed. */
  takeChange() {
    const from = this.#changedFrom;
    this.#changedFrom = Infinity;
    return from;
  }

  /** Quantities whose waveforms are kept from now on. */
  show(quantities) {
    this.estimate.setColumns(["since_data", ...quantities.flatMap((q) => BAND.map((part) => `${q}.${part}`))]);
    this.truth.setColumns(quantities);
    this.#changedFrom = -Infinity;
  }

  /** Takes in a bed frame. Throws if it is not laid out as the protocol says. */
  take(head, numbers) {
    const parts = partsOf(head, numbers);
    const now = secondsOf(head.now_ns);
    if (head.reset) this.#restart(now);
    for (const part of parts) this.#takePart(part, head.reset === true);
    if (now !== null) {
      this.now = now;
      this.#forget(now - KEPT_S);
    }
    for (const key of ["quantities", "parameters", "beat", "alarms", "status"]) {
      if (head[key] != null) this.latest[key] = head[key];
    }
    this.#takeEvents(head.events ?? []);
  }

  /** Oldest and newest time of which there is a waveform; null without one. */
  get oldest() {
    return this.estimate.oldest;
  }

  /** Mean and band of a clinical quantity in the beat that was the last one at `time`; null if none is known, or if it was
   * long ago by then: what does not beat has no output. */
  beatAt(name, time) {
    const series = this.beats.get(name);
    const index = series ? series.at(time) : -1;
    if (index < 0 || time - series.times[index] > PRESENT_BEAT_S) return null;
    const value = (part) => series.column(part)[index];
    return { mean: value("mean"), q05: value("q05"), q95: value("q95"), unit: this.units.get(name) ?? "" };
  }

  // An answer to a new question repeats a part of the past that is known already; only where event time went back does
  // what is known belong to another run.
  #restart(now) {
    this.events = [];
    this.latest = {};
    if (now !== null && this.now !== null && now > this.now - JUMP_BACK_S) return;
    this.now = null;
    this.#changedFrom = -Infinity;
    for (const series of this.#all()) series.clear();
  }

  *#all() {
    yield* [this.estimate, this.truth];
    for (const map of [this.samples, this.parameters, this.beats]) yield* map.values();
  }

  #forget(time) {
    for (const series of this.#all()) series.dropBefore(time);
  }

  #takePart(part, isReset) {
    const origin = secondsOf(part.t0_ns);
    if (origin === null || part.n === 0) return;
    const [series, values] = this.#target(part);
    if (!series) return;
    const offsets = part.rows[0];
    if (isReset) series.truncateFrom(origin + offsets[0]);
    if (WAVEFORMS.includes(part.part)) {
      // A line goes on from the row before.
      this.#changedFrom = Math.min(this.#changedFrom, series.newest ?? -Infinity, origin + offsets[0]);
    }
    series.append(origin, offsets, values);
  }

  #target(part) {
    const rows = part.rows;
    switch (part.part) {
      case "estimate":
        return [this.estimate, estimateColumns(part)];
      case "truth":
        return [this.truth, Object.fromEntries(part.quantities.map((name, k) => [name, rows[1 + k]]))];
      case "samples":
        return [named(this.samples, part.channel, ["value"], SAMPLES_LIMIT), { value: rows[1] }];
      case "parameters": {
        this.units.set(part.name, part.unit);
        const columns = { mean: rows[1], q05: rows[2], q95: rows[3], informed: rows[4], truth: rows[5] };
        return [named(this.parameters, part.name, Object.keys(columns), TREND_LIMIT), columns];
      }
      default: {
        this.units.set(part.name, part.unit);
        return [named(this.beats, part.name, BAND, TREND_LIMIT), { mean: rows[1], q05: rows[2], q95: rows[3] }];
      }
    }
  }

  #takeEvents(events) {
    for (const event of events) this.events.push({ ...event, time: secondsOf(event.time_ns) });
    if (this.events.length > EVENTS_LIMIT) this.events.splice(0, this.events.length - EVENTS_LIMIT);
  }
}

function estimateColumns(part) {
  const columns = { since_data: part.rows[1] };
  part.quantities.forEach((name, k) => {
    BAND.forEach((statistic, s) => {
      columns[`${name}.${statistic}`] = part.rows[2 + 3 * k + s];
    });
  });
  return columns;
}

// Names come from the network; more of them than any bed has are not kept.
function named(map, name, columns, limit) {
  if (!map.has(name) && map.size < NAMES_LIMIT) map.set(name, new Series(columns, limit));
  return map.get(name);
}
