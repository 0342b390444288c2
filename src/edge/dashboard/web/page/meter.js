// Counts what was drawn, for whoever wants to know how smooth the page is.

const WINDOW_MS = 2000;
const TIMES_LIMIT = 1000;

export class Meter {
  constructor() {
    this.frames = 0;
    this.times = [];
  }

  /** A frame with something new in it was drawn. */
  tick(now) {
    this.frames += 1;
    this.times.push(now);
    this.#forget(now);
  }

  /** Frames per second over the last two seconds. */
  fps() {
    this.#forget(performance.now());
    return (this.times.length * 1000) / WINDOW_MS;
  }

  #forget(now) {
    const stale = this.times.findIndex((time) => time > now - WINDOW_MS);
    this.times.splice(0, stale < 0 ? this.times.length : stale);
    if (this.times.length > TIMES_LIMIT) this.times.shift();
  }
}
