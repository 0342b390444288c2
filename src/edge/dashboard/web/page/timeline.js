// The controls of time: span, pause, a slider over the past that is kept, back to live.

import { byId, element, setAttribute, setText } from "./dom.js";
import { duration } from "./numbers.js";
import { clockText } from "./time.js";
import { SPANS_S } from "./viewport.js";

export class Timeline {
  constructor(viewport) {
    this.viewport = viewport;
    this.slider = byId("scrub");
    this.pause = byId("pause");
    this.live = byId("live");
    this.slider.addEventListener("input", () => viewport.scrubTo(viewport.newest + Number(this.slider.value)));
    this.pause.addEventListener("click", () => viewport.toggle());
    this.live.addEventListener("click", () => viewport.live());
    this.spans = SPANS_S.map((span) => {
      const button = element("button", { type: "button", text: `${span} s`, "aria-label": `show ${span} seconds` });
      button.addEventListener("click", () => viewport.setSpan(span));
      byId("spans").append(button);
      return button;
    });
  }

  /** Shows where in time the picture is. */
  write() {
    const { viewport } = this;
    const behind = viewport.newest - viewport.right;
    SPANS_S.forEach((span, k) => setAttribute(this.spans[k], "aria-pressed", String(span === viewport.span)));
    setAttribute(this.pause, "aria-pressed", String(viewport.isPaused));
    setText(this.pause, viewport.isPaused ? "▶ Resume" : "❚❚ Pause");
    this.live.disabled = !viewport.isPaused;
    this.slider.min = String(Math.min(Math.floor(viewport.oldest + viewport.span - viewport.newest), -1));
    this.slider.value = String(-behind);
    setAttribute(this.slider, "aria-valuetext", viewport.isPaused ? `${duration(behind)} behind` : "live");
    setText(byId("when"), clockText(viewport.right));
    setText(byId("behind"), viewport.isPaused ? `PAUSED, ${duration(behind)} behind` : "live");
    setAttribute(byId("behind"), "data-paused", String(viewport.isPaused));
  }
}
