// The strips of a bed: which quantities are drawn, in which order, and the choice of them.

import { byId, element, recall, remember } from "./dom.js";
import { between } from "./markers.js";
import { closeByItself } from "./menu.js";
import { describe, FLOW_NAMES, PRESSURES, VOLUMES } from "./names.js";
import { Sheet } from "./sheet.js";
import { Strip } from "./strip.js";

const GROUPS = [["Pressures", PRESSURES], ["Flows", FLOW_NAMES], ["Volumes", VOLUMES]];
const ALL = GROUPS.flatMap(([, names]) => names);
/** Loops are drawn of these, whether or not a strip is. */
const OF_LOOPS = ["p_l", "v_l", "p_r", "v_r"];

export class Strips {
  /** `onChoice()` is called when other quantities are wanted, `onClear()` when there is nothing on the sheet any more. */
  constructor({ onChoice, onClear }) {
    this.list = byId("strips");
    this.strips = new Map();
    this.sheet = new Sheet(this.list, () => {
      for (const strip of this.strips.values()) strip.clear();
      onClear();
    });
    this.chosen = storedChoice();
    this.showSamples = byId("show-samples");
    this.showTruth = byId("show-truth");
    for (const box of [this.showSamples, this.showTruth]) box.addEventListener("change", onClear);
    this.#offer(onChoice);
    closeByItself(byId("strip-menu"));
    this.#arrange();
  }

  /** Quantities to ask the server for. */
  quantities() {
    return [...new Set([...this.chosen, ...OF_LOOPS])];
  }

  /** Brings every strip up to date; returns whether there was anything to paint. */
  draw(history, viewport, markers) {
    const changedFrom = history.takeChange();
    let isNew = false;
    for (const [strip, options] of this.#look(viewport, markers)) {
      isNew = strip.draw(history, viewport, changedFrom, options) || isNew;
    }
    return isNew;
  }

  /** Paints every strip anew and says what was painted, by quantity. For tests. */
  drawAnew(history, viewport, markers) {
    const painted = [...this.#look(viewport, markers)];
    return Object.fromEntries(painted.map(([strip, options]) => [strip.name, strip.drawAnew(history, viewport, options)]));
  }

  /** Pictures of all strips with their time from edge to edge. */
  *stretched(history, viewport, markers) {
    for (const [strip, options] of this.#look(viewport, markers)) yield [strip, strip.stretched(history, viewport, options)];
  }

  // Each strip and what is to be seen on it; the first one has the labels of the marks.
  *#look(viewport, markers) {
    const common = {
      markers: between(markers, viewport.left, viewport.right),
      showSamples: this.showSamples.checked,
      showTruth: this.showTruth.checked,
    };
    let withLabels = true;
    for (const strip of this.strips.values()) {
      yield [strip, { ...common, withLabels }];
      withLabels = false;
    }
  }

  /** Writes the numbers of every strip; of a bed that is not current there are none. */
  write(history, viewport, isCurrent) {
    const origins = new Map((history.latest.quantities ?? []).map((q) => [q.name, q.origin]));
    for (const strip of this.strips.values()) strip.write(history, viewport, origins.get(strip.name), isCurrent);
  }

  /** Forgets scales of another bed. */
  reset() {
    for (const strip of this.strips.values()) strip.reset();
  }

  [Symbol.iterator]() {
    return this.strips.values();
  }

  #offer(onChoice) {
    for (const [title, names] of GROUPS) {
      const boxes = names.map((name) => {
        const box = element("input", { type: "checkbox", value: name });
        box.checked = this.chosen.includes(name);
        box.addEventListener("change", () => {
          this.chosen = ALL.filter((other) => (other === name ? box.checked : this.chosen.includes(other)));
          remember("strips", this.chosen.join(" "));
          this.#arrange();
          onChoice();
        });
        return element("label", { title: describe(name).text }, box, ` ${describe(name).label} `, element("small", { text: name }));
      });
      byId("strip-choice").append(element("fieldset", {}, element("legend", { text: title }), ...boxes));
    }
  }

  #arrange() {
    for (const [name, strip] of this.strips) {
      if (this.chosen.includes(name)) continue;
      strip.node.remove();
      this.strips.delete(name);
    }
    const arranged = new Map();
    for (const name of this.chosen) {
      const strip = this.strips.get(name) ?? new Strip(name, this.sheet);
      arranged.set(name, strip);
      this.list.append(strip.node);
    }
    this.strips = arranged;
    this.sheet.clear();
  }
}

function storedChoice() {
  const stored = recall("strips", "").split(" ").filter((name) => ALL.includes(name));
  return stored.length ? ALL.filter((name) => stored.includes(name)) : [...PRESSURES];
}
