// A strip: the waveform of one quantity, and beside it what it is, where it comes from, and its value.

import { element, setAttribute, setText } from "./dom.js";
import { describe } from "./names.js";
import { decimals, NONE, number, spread } from "./numbers.js";
import { paintAxis, paintRegion } from "./paint.js";
import { paletteOf } from "./palette.js";
import { pressureReading } from "./readings.js";
import { extent, Scale } from "./scale.js";
import { shareInside } from "./truth.js";

const ORIGINS = { observed: "● observed", silent: "◌ sensor silent", inferred: "◇ inferred" };

/** Time between two looks whether the scale is too wide [s]. */
const FIT_EVERY_S = 1;

export class Strip {
  /** A strip on a sheet. */
  constructor(name, sheet) {
    this.name = name;
    this.sheet = sheet;
    this.area = null;
    this.about = describe(name);
    this.scale = new Scale();
    this.span = 0;
    this.paintedTo = -Infinity;
    this.lookOfPainted = null;
    this.fittedAt = -Infinity;
    this.plot = element("div", { class: "strip-plot", "data-testid": `strip-${name}`, role: "img" });
    this.origin = element("span", { class: "origin" });
    this.main = element("span", { class: "strip-main" });
    this.side = element("span", { class: "strip-side" });
    this.band = element("span", { class: "strip-band" });
    this.instant = element("span", { class: "strip-now" });
    const label = element("span", { class: "strip-label", text: this.about.label, title: this.about.text });
    const value = element("span", { class: "strip-value" }, this.main, this.side);
    const numbers = element(
      "div",
      { class: "strip-numbers" },
      element("div", { class: "strip-head" }, label, this.origin),
      ...(this.isPressure ? [value, this.band] : [value]),
      this.instant,
    );
    this.node = element("div", { class: "strip", style: `--hue: var(--${this.about.color})` }, this.plot, numbers);
  }

  get isPressure() {
    return this.name.startsWith("p_");
  }

  /** Forgets another bed. */
  reset() {
    this.scale.reset();
    this.lookOfPainted = null;
  }

  /** Its place on the sheet is empty, and may be another one. */
  clear() {
    this.area = null;
    this.lookOfPainted = null;
  }

  /** Paints what is not on the sheet yet: what came after what was painted last or is not what it was any more, from
   * `changedFrom` on, or everything where it looks different. Returns whether there was anything. `options` are
   * `markers`, `withLabels`, `showSamples`, `showTruth`. */
  draw(history, viewport, changedFrom, options) {
    return this.#paint(history, viewport, changedFrom, options) !== null;
  }

  // What was painted is counted; null where there was nothing to paint.
  #paint(history, viewport, changedFrom, options) {
    this.area ??= this.sheet.areaOf(this.plot);
    this.#fit(history.estimate, viewport);
    const picture = this.#picture(viewport, options);
    const look = lookOf(picture, viewport);
    const isSame = this.lookOfPainted !== null && look.every((part, k) => part === this.lookOfPainted[k]);
    const from = isSame ? Math.min(changedFrom, this.paintedTo) : -Infinity;
    if (from >= viewport.right) return null;
    this.lookOfPainted = look;
    this.paintedTo = viewport.right;
    const ctx = this.sheet.contextOf(this.area);
    if (!isSame) paintAxis(ctx, picture);
    const account = { points: 0, bandPoints: 0, samples: 0 };
    for (const region of viewport.regions().filter(({ to }) => to > from)) {
      const painted = paintRegion(ctx, history, this.name, { ...region, from: Math.max(region.from, from) }, picture);
      for (const key of Object.keys(account)) account[key] += painted[key];
    }
    return account;
  }

  /** Paints everything anew, and says what that was: rows of the estimate, how many have a band, the newest band,
   * samples, the share of the truth within the band. For tests. */
  drawAnew(history, viewport, options) {
    this.lookOfPainted = null;
    const { left, right } = viewport;
    const account = { ...this.#paint(history, viewport, -Infinity, options), left, right };
    const { estimate } = history;
    const newest = estimate.at(right);
    for (const part of ["q05", "q95"]) account[part] = newest < 0 ? null : (estimate.column(`${this.name}.${part}`)?.[newest] ?? null);
    account.truthInside = options.showTruth ? shareInside(history, this.name, left, right) : null;
    return account;
  }

  /** A picture of its own of the same time, from edge to edge. */
  stretched(history, viewport, options) {
    const { width, height, ratio } = this.area;
    const canvas = element("canvas", { width: Math.round(width * ratio), height: Math.round(height * ratio) });
    const picture = { ...this.#picture(viewport, options), gap: 0 };
    const ctx = canvas.getContext("2d", { alpha: false });
    ctx.scale(ratio, ratio);
    paintAxis(ctx, picture);
    for (const region of viewport.stretch()) paintRegion(ctx, history, this.name, region, picture);
    return canvas;
  }

  #picture({ span, gap }, options) {
    const { width, height, ratio } = this.area;
    return { ...options, span, gap, width, height, ratio, scale: this.scale, palette: paletteOf(this.about.color) };
  }

  // Whether the scale is too wide is looked at now and then, whether it is too narrow whenever there is something new.
  #fit(estimate, { left, right, span, isPaused }) {
    if (!estimate.column(`${this.name}.mean`)) return;
    if (span !== this.span) this.scale.reset();
    this.span = span;
    const extentFrom = (time) => extent(estimate, this.name, estimate.lower(time), estimate.lower(right + 1e-6));
    const isDue = isPaused || Math.abs(right - this.fittedAt) > FIT_EVERY_S || !this.scale.isSet;
    if (!isDue && this.scale.holds(extentFrom(Math.max(left, this.paintedTo)))) return;
    this.fittedAt = right;
    this.scale.fit(extentFrom(left));
  }

  /** Writes the value at the right edge; a few times a second, or nobody could read it. */
  write(history, viewport, origin, isCurrent) {
    const { estimate } = history;
    const mean = estimate.column(`${this.name}.mean`);
    const row = mean ? estimate.at(viewport.right) : -1;
    const at = (part) => (row < 0 ? null : estimate.column(`${this.name}.${part}`)[row]);
    const [low, high] = [at("q05"), at("q95")];
    const digits = this.isPressure ? 0 : Math.min(decimals(at("mean"), (high - low) / 2), 1);
    const instant = `${number(at("mean"), digits)}  ${spread(low, high, digits)} ${this.about.unit}`;
    setText(this.origin, Object.hasOwn(ORIGINS, origin) ? ORIGINS[origin] : "");
    setAttribute(this.origin, "data-origin", origin ?? "");
    if (!isCurrent) {
      this.#writeNothing(row < 0 ? "" : `was ${instant}`);
    } else if (this.isPressure) {
      const reading = pressureReading(this.name, (key) => history.beatAt(key, viewport.right));
      setText(this.main, reading.main);
      setText(this.side, reading.side);
      setText(this.band, reading.band);
      setText(this.instant, `now ${instant}`);
      setAttribute(this.plot, "aria-label", `${this.about.text}: ${reading.main} ${reading.side} mmHg`);
    } else {
      setText(this.main, number(at("mean"), digits));
      setText(this.instant, row < 0 ? NONE : `${spread(low, high, digits)} ${this.about.unit}`);
      setAttribute(this.plot, "aria-label", `${this.about.text}: ${instant}`);
    }
  }

  // A number that is no longer true must not look like one.
  #writeNothing(was) {
    setText(this.main, NONE);
    setText(this.side, "");
    setText(this.band, "");
    setText(this.instant, was);
    setAttribute(this.plot, "aria-label", `${this.about.text}: no current value`);
  }
}

/** What a picture looks like but for the waveform: where any of it is different nothing painted before can stay. */
function lookOf({ width, height, ratio, scale, palette, showSamples, showTruth, markers }, { span, isPaused, right }) {
  const marks = markers.map(({ time, label }) => `${time} ${label}`).join("\n");
  return [width, height, ratio, scale.low, scale.high, palette, showSamples, showTruth, marks, span, isPaused ? right : null];
}
