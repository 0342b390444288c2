// The controls of time: span, pause, a slider over the past that is kept, back to live.

import { byId, element, setAttribute, setText } from "./dom.js";
import { duration } from "./numbers.js";
import { secondsPerLine } from "./paint.js";
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
  write(isCurrent) {
    const { viewport } = this;
    const behind = viewport.newest - viewport.right;
    SPANS_S.forEach((span, k) => setAttribute(this.spans[k], "aria-pressed", String(span === viewport.span)));
    setAttribute(this.pause, "aria-pressed", String(viewport.isPaused));
    setText(this.pause, viewport.isPaused ? "▶ Resume" : "❚❚ Pause");
    this.live.disabled = !viewport.isPaused;
    this.slider.min = String(Math.min(Math.floor(viewport.oldest + viewport.span - viewport.newest), -1));
    this.slider.value = String(-behind);
    setAttribute(this.slider, "aria-valuetext", viewport.isPaused ? `${duration(behind)} behind` : "live");
    setText(byId("grid-step"), `grid ${secondsPerLine(viewport.span)} s`);
    setText(byId("when"), clockText(viewport.right));
    const state = viewport.isPaused ? "paused" : isCurrent ? "live" : "outage";
    const words = { paused: `PAUSED, ${duration(behind)} behind`, live: "live", outage: "newest there is" };
    setText(byId("behind"), words[state]);
    setAttribute(byId("behind"), "data-state", state);
  }
}
