// When what came in is shown. It comes in bursts, as the sensors send it; a waveform that stood still between them and
// then leapt could not be followed by the eye. It is shown as evenly as it happened, one burst late.

/** Arrivals looked back at [ms]. */
const MEMORY_MS = 2000;
/** Lag kept, in bursts: a little more than one, or the next would come too late. */
const BURSTS_BEHIND = 1.2;
/** A lag that is not the wanted one is mended within about so long [s]. */
const MEND_S = 0.5;
/** Further behind than this nothing is caught up with: it is leapt over [s]. */
const LEAP_S = 2;

export class Pace {
  constructor() {
    this.reset();
  }

  /** Forgets what it knew of another bed. */
  reset() {
    this.shown = null;
    this.lookedAt = 0;
    this.arrivals = [];
  }

  /** Says that event time `newest` [s] was known at `now` [ms]. */
  arrive(newest, now) {
    const last = this.arrivals[this.arrivals.length - 1];
    if (last && newest < last.newest) this.reset();
    if (last && newest === last.newest) return;
    this.arrivals.push({ newest, now });
    this.#forget(now);
  }

  /** The event time to be shown at `now` [ms], never beyond `newest`. */
  at(newest, now) {
    this.#forget(now);
    const passed = Math.max(now - this.lookedAt, 0) / 1000;
    const behind = BURSTS_BEHIND * this.#burst();
    this.lookedAt = now;
    if (this.shown === null || newest < this.shown || newest - this.shown > LEAP_S + behind) {
      this.shown = newest;
    } else {
      const mended = (newest - this.shown - behind) * Math.min(passed / MEND_S, 1);
      this.shown = Math.min(Math.max(this.shown + passed * this.#rate() + mended, this.shown), newest);
    }
    return this.shown;
  }

  // Seconds of event time per second: another number than one where a recording is replayed faster.
  #rate() {
    if (this.arrivals.length < 2) return 0;
    const [first, last] = [this.arrivals[0], this.arrivals[this.arrivals.length - 1]];
    return (last.newest - first.newest) / Math.max((last.now - first.now) / 1000, 0.001);
  }

  #burst() {
    let burst = 0;
    for (let k = 1; k < this.arrivals.length; k += 1) {
      burst = Math.max(burst, this.arrivals[k].newest - this.arrivals[k - 1].newest);
    }
    return burst;
  }

  #forget(now) {
    while (this.arrivals.length && this.arrivals[0].now < now - MEMORY_MS) this.arrivals.shift();
  }
}
