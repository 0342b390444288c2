// A strip: the canvas of one quantity, and beside it what it is, where it comes from, and its value.

import { element, setAttribute, setText } from "./dom.js";
import { describe } from "./names.js";
import { decimals, NONE, number, spread } from "./numbers.js";
import { paintStrip } from "./paint.js";
import { paletteOf } from "./palette.js";
import { pressureReading } from "./readings.js";
import { extent, Scale } from "./scale.js";

const ORIGINS = { observed: "● observed", silent: "◌ sensor silent", inferred: "◇ inferred" };

export class Strip {
  constructor(name) {
    this.name = name;
    this.about = describe(name);
    this.scale = new Scale();
    this.account = null;
    this.span = 0;
    this.canvas = element("canvas", { "data-testid": `strip-${name}`, role: "img" });
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
    const plot = element("div", { class: "strip-plot" }, this.canvas);
    this.node = element("div", { class: "strip", style: `--hue: var(--${this.about.color})` }, plot, numbers);
    this.plot = plot;
    this.resizing = new ResizeObserver(() => this.#resize());
    this.resizing.observe(plot);
  }

  get isPressure() {
    return this.name.startsWith("p_");
  }

  /** Takes the strip off the page. */
  remove() {
    this.resizing.disconnect();
    this.node.remove();
  }

  #resize() {
    const ratio = window.devicePixelRatio || 1;
    this.width = Math.max(this.plot.clientWidth, 60);
    this.height = Math.max(this.plot.clientHeight, 30);
    this.canvas.width = Math.round(this.width * ratio);
    this.canvas.height = Math.round(this.height * ratio);
    this.onResize?.();
  }

  /** Paints what the viewport shows. */
  draw(history, viewport, options) {
    if (!this.width) this.#resize();
    const { left, right, span } = viewport;
    if (span !== this.span) this.scale.reset();
    this.span = span;
    const { estimate } = history;
    if (estimate.column(`${this.name}.mean`)) {
      this.scale.fit(extent(estimate, this.name, estimate.lower(left), estimate.lower(right + 1e-6)));
    }
    const ctx = this.canvas.getContext("2d", { alpha: false });
    const ratio = this.canvas.width / this.width;
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    this.account = paintStrip(ctx, history, this.name, {
      ...options, left, right, width: this.width, height: this.height, scale: this.scale, palette: paletteOf(this.about.color),
    });
  }

  /** Writes the value at the right edge; a few times a second, or nobody could read it. */
  write(history, viewport, origin, isCurrent) {
    const { estimate } = history;
    const mean = estimate.column(`${this.name}.mean`);
    const row = mean ? estimate.at(viewport.right) : -1;
    const at = (part) => (row < 0 ? null : estimate.column(`${this.name}.${part}`)[row]);
    const [low, high] = [at("low"), at("high")];
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
      setAttribute(this.canvas, "aria-label", `${this.about.text}: ${reading.main} ${reading.side} mmHg`);
    } else {
      setText(this.main, number(at("mean"), digits));
      setText(this.instant, row < 0 ? NONE : `${spread(low, high, digits)} ${this.about.unit}`);
      setAttribute(this.canvas, "aria-label", `${this.about.text}: ${instant}`);
    }
  }

  // A number that is no longer true must not look like one.
  #writeNothing(was) {
    setText(this.main, NONE);
    setText(this.side, "");
    setText(this.band, "");
    setText(this.instant, was);
    setAttribute(this.canvas, "aria-label", `${this.about.text}: no current value`);
  }
}
