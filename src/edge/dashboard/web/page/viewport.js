// Which stretch of time is on the screen. Live, the newest seconds are written over the oldest ones from left to right,
// as on a patient monitor: what stands there stands still, and only what is new costs anything. While paused it is a
// stretch of the past from edge to edge.

import { recall, remember } from "./dom.js";
import { Pace } from "./pace.js";

export const SPANS_S = [2, 5, 10, 30, 60];

/** Gap between the newest and the oldest that is left of the sweep before, as a share of the span. */
const GAP_SHARE = 0.025;

export class Viewport {
  constructor() {
    const stored = Number(recall("span", "10"));
    this.span = SPANS_S.includes(stored) ? stored : 10;
    this.edge = null;
    this.oldest = 0;
    this.newest = 0;
    this.shown = 0;
    this.pace = new Pace();
    this.listeners = [];
  }

  onChange(listener) {
    this.listeners.push(listener);
  }

  get isPaused() {
    return this.edge !== null;
  }

  /** The newest time shown. */
  get right() {
    return this.edge ?? this.shown;
  }

  /** The oldest time shown. */
  get left() {
    return this.right - this.span + this.gap;
  }

  /** Time between the newest and the oldest shown that is kept empty. */
  get gap() {
    return this.isPaused ? 0 : GAP_SHARE * this.span;
  }

  /** What is painted where: times `from` to `to`, where `origin` is the time at the left edge of the picture. The last
   * one is the newest. */
  regions() {
    if (this.isPaused) return this.stretch();
    const origin = Math.floor(this.right / this.span) * this.span;
    const current = { origin, from: origin, to: this.right };
    return this.left < origin ? [{ origin: origin - this.span, from: this.left, to: origin }, current] : [current];
  }

  /** The same time from edge to edge. */
  stretch() {
    const from = this.right - this.span;
    return [{ origin: from, from, to: this.right }];
  }

  /** Says what there is to look at, and when that was heard [ms]. */
  follow(oldest, newest, now) {
    this.oldest = oldest;
    this.newest = newest;
    this.pace.arrive(newest, now);
  }

  /** Goes on to what is to be shown at `now` [ms]. */
  advance(now) {
    this.shown = this.pace.at(this.newest, now);
  }

  /** Forgets another bed. */
  reset() {
    this.pace.reset();
    this.edge = null;
    [this.oldest, this.newest, this.shown] = [0, 0, 0];
    this.#changed();
  }

  setSpan(span) {
    this.span = span;
    remember("span", String(span));
    this.#changed();
  }

  toggle() {
    this.edge = this.isPaused ? null : this.shown;
    this.#changed();
  }

  live() {
    this.edge = null;
    this.#changed();
  }

  /** Pauses with `time` at the right edge. */
  scrubTo(time) {
    this.edge = Math.min(Math.max(time, Math.min(this.oldest + this.span, this.newest)), this.newest);
    this.#changed();
  }

  /** Goes back or on by so many spans. */
  step(spans) {
    this.scrubTo(this.right + spans * this.span);
  }

  #changed() {
    for (const listener of this.listeners) listener();
  }
}
