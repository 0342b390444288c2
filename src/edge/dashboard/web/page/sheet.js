// The sheet that all strips are painted on, behind their numbers. It is one canvas: what a browser does for each canvas
// that has changed costs more than the little that is new on it. For the same reason it need not wait for the rest of the
// page to be drawn (`desynchronized`).

import { element } from "./dom.js";
import { color, onTheme } from "./theme.js";

/** A strip is never taken for smaller than this [px]. */
const LEAST = { width: 60, height: 30 };

export class Sheet {
  /** Lies behind what is in `list`; `onClear()` is called when there is nothing on it any more. */
  constructor(list, onClear) {
    this.list = list;
    this.onClear = onClear;
    this.canvas = element("canvas", { class: "sheet", "aria-hidden": "true" });
    this.ctx = this.canvas.getContext("2d", { alpha: false, desynchronized: true });
    list.prepend(this.canvas);
    new ResizeObserver(() => this.clear()).observe(list);
    onTheme(() => this.clear());
  }

  /** Clears everything: strips have come, gone, or moved. */
  clear() {
    this.ratio = window.devicePixelRatio || 1;
    this.canvas.width = Math.round(this.list.clientWidth * this.ratio);
    this.canvas.height = Math.round(this.list.clientHeight * this.ratio);
    this.ctx.setTransform(1, 0, 0, 1, 0, 0);
    this.ctx.fillStyle = color("panel");
    this.ctx.fillRect(0, 0, this.canvas.width, this.canvas.height);
    this.onClear();
  }

  /** Where `node` is on the sheet, on whole pixels of the screen. */
  areaOf(node) {
    const [outer, inner] = [this.list.getBoundingClientRect(), node.getBoundingClientRect()];
    const whole = (length) => Math.round(length * this.ratio) / this.ratio;
    return {
      x: whole(inner.left - outer.left),
      y: whole(inner.top - outer.top),
      width: Math.max(whole(inner.width), LEAST.width),
      height: Math.max(whole(inner.height), LEAST.height),
      ratio: this.ratio,
    };
  }

  /** Its context, with the corner of an area as origin. */
  contextOf({ x, y, ratio }) {
    this.ctx.setTransform(ratio, 0, 0, ratio, Math.round(x * ratio), Math.round(y * ratio));
    return this.ctx;
  }
}
