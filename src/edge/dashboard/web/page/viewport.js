// Which stretch of time is on the screen: the newest seconds, or a stretch of the past while paused.

import { recall, remember } from "./dom.js";

export const SPANS_S = [2, 5, 10, 30, 60];

export class Viewport {
  constructor() {
    const stored = Number(recall("span", "10"));
    this.span = SPANS_S.includes(stored) ? stored : 10;
    this.edge = null;
    this.oldest = 0;
    this.newest = 0;
    this.listeners = [];
  }

  onChange(listener) {
    this.listeners.push(listener);
  }

  get isPaused() {
    return this.edge !== null;
  }

  /** Time at the right edge. */
  get right() {
    return this.edge ?? this.newest;
  }

  get left() {
    return this.right - this.span;
  }

  /** Says what there is to look at. */
  follow(oldest, newest) {
    this.oldest = oldest;
    this.newest = newest;
  }

  setSpan(span) {
    this.span = span;
    remember("span", String(span));
    this.#changed();
  }

  toggle() {
    this.edge = this.isPaused ? null : this.newest;
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
