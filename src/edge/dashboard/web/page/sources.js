// Where the uncertainty of each quantity comes from: shares of its variance, and how much it is in all.

import { byId, element, setAttribute, setText } from "./dom.js";
import { describe } from "./names.js";
import { decimals, number } from "./numbers.js";

const SOURCES = ["epistemic", "aleatoric", "model"];
const ROWS_LIMIT = 40;

export class Sources {
  constructor() {
    this.body = byId("sources");
    this.rows = new Map();
  }

  /** Shows the quantities of the newest frame. */
  write(quantities) {
    for (const quantity of quantities.slice(0, ROWS_LIMIT)) {
      if (!this.rows.has(quantity.name)) this.rows.set(quantity.name, this.#row(quantity.name));
      update(this.rows.get(quantity.name), quantity);
    }
  }

  /** Forgets the rows of another bed. */
  reset() {
    this.rows.clear();
    this.body.replaceChildren();
  }

  #row(name) {
    const about = describe(name);
    const parts = SOURCES.map((source) => element("span", { class: `share share-${source}` }));
    const bar = element("div", { class: "bar", role: "img" }, ...parts);
    const sd = element("span", { class: "source-sd" });
    const label = element("span", { class: "source-name", text: about.label, title: `${about.text} (${name})` });
    this.body.append(element("div", { class: "source" }, label, bar, sd));
    return { parts, bar, sd };
  }
}

function update({ parts, bar, sd }, quantity) {
  const variances = SOURCES.map((source) => (quantity[`${source}_sd`] ?? 0) ** 2);
  const whole = variances.reduce((sum, variance) => sum + variance, 0);
  const shares = variances.map((variance) => (whole > 0 ? (100 * variance) / whole : 0));
  shares.forEach((share, k) => {
    setAttribute(parts[k], "style", `width: ${share.toFixed(1)}%`);
    // A label that does not fit would be read as a smaller number.
    setText(parts[k], share >= 14 ? `${share.toFixed(0)}` : "");
  });
  setAttribute(bar, "aria-label", SOURCES.map((source, k) => `${source} ${shares[k].toFixed(0)} %`).join(", "));
  setAttribute(bar, "title", SOURCES.map((source, k) => `${source} ${shares[k].toFixed(0)} %`).join(", "));
  setText(sd, `± ${number(quantity.sd, decimals(quantity.sd, quantity.sd))} ${quantity.unit}`);
}
