// The numbers at the top of a bed: what the beat at the right edge of the picture amounts to.

import { byId, element, setAttribute, setText } from "./dom.js";
import { pressureReading, singleReading } from "./readings.js";

const READINGS = [
  (at) => singleReading("heart_rate", at),
  (at) => pressureReading("p_a", at),
  (at) => pressureReading("p_pa", at),
  (at) => singleReading("cardiac_output", at),
  (at) => singleReading("stroke_volume", at),
  (at) => singleReading("ejection_fraction", at),
  (at) => singleReading("svr", at),
  (at) => singleReading("pvr", at),
];

export class Numerics {
  constructor() {
    this.cells = READINGS.map(() => {
      const [label, main, side, unit, band] = ["label", "main", "side", "unit", "band"].map((part) =>
        element("span", { class: `cell-${part}` }),
      );
      const node = element("div", { class: "cell" }, label, unit, element("span", { class: "cell-value" }, main, side), band);
      byId("numerics").append(node);
      return { node, label, main, side, unit, band };
    });
  }

  /** Shows the readings; `at` gives a clinical quantity by its key. */
  write(at) {
    READINGS.forEach((read, k) => {
      const cell = this.cells[k];
      const reading = read(at);
      for (const part of ["label", "main", "side", "unit", "band"]) setText(cell[part], reading[part]);
      setAttribute(cell.node, "style", `--hue: var(--${reading.color})`);
      setAttribute(cell.node, "title", [reading.text, reading.note].filter(Boolean).join(": "));
    });
  }
}
