// One bed of the ward: a link with the numbers that say how the patient is.

import { badge, byUrgency, highestPriority, unseenFirst } from "./alarms.js";
import { element, setAttribute, setText } from "./dom.js";
import { isCurrent, livenessText, outageText, qualityText } from "./liveness.js";
import { NONE } from "./numbers.js";
import { pressureReading, singleReading } from "./readings.js";

const CELLS = [
  { of: (at) => singleReading("heart_rate", at), size: "large" },
  { of: (at) => singleReading("cardiac_output", at), size: "large" },
  { of: (at) => pressureReading("p_a", at), size: "wide" },
  { of: (at) => pressureReading("p_pa", at), size: "wide" },
  { of: (at) => singleReading("svr", at), size: "small" },
  { of: (at) => singleReading("pvr", at), size: "small" },
];

const ALARMS_SHOWN = 1;

export class Tile {
  constructor(name) {
    this.name = name;
    this.liveness = element("span", { class: "liveness" });
    this.alarms = element("div", { class: "tile-alarms" });
    this.stale = element("div", { class: "tile-stale" });
    this.quality = element("span", { class: "quality" });
    this.health = element("span", { class: "tile-health", title: "members alive if not all; 99 % of the windows lag less" });
    this.cells = CELLS.map(({ size }) => new Cell(size));
    const label = element("strong", { class: "tile-name", text: name, title: name });
    this.link = element(
      "a",
      { class: "tile", href: `#bed/${encodeURIComponent(name)}`, "data-testid": `tile-${name}`, tabindex: "-1" },
      element("div", { class: "tile-head" }, label, this.quality, this.health, this.liveness),
      this.alarms,
      element("div", { class: "tile-cells" }, ...this.cells.map((cell) => cell.node)),
      this.stale,
    );
    this.node = element("li", {}, this.link);
    this.alarmKey = null;
  }

  /** Shows what a ward frame says about the bed. */
  update(bed) {
    this.bed = bed;
    const current = isCurrent(bed.liveness);
    setAttribute(this.link, "data-liveness", bed.liveness);
    setAttribute(this.link, "data-alarm", highestPriority(bed.alarms));
    setAttribute(this.link, "data-quality", bed.quality);
    setText(this.liveness, livenessText(bed.liveness, bed.age_s));
    setText(this.stale, current ? "" : outageText(bed));
    this.#updateAlarms(bed.alarms ?? []);
    const at = (key) => bed.values?.[key] ?? null;
    CELLS.forEach(({ of }, k) => this.cells[k].update(of(at), current));
    setText(this.quality, qualityText(bed));
    setAttribute(this.quality, "title", qualityText(bed));
    setText(this.health, healthText(bed));
    setAttribute(this.link, "aria-label", `${bed.bed}, ${livenessText(bed.liveness, bed.age_s)}, ${alarmWords(bed.alarms)}`);
  }

  #updateAlarms(alarms) {
    const raised = unseenFirst(alarms);
    const key = JSON.stringify(raised);
    if (key === this.alarmKey) return;
    this.alarmKey = key;
    const unseen = raised.some((alarm) => !alarm.acknowledged);
    setAttribute(this.link, "data-unseen", String(unseen));
    const more = raised.length - ALARMS_SHOWN;
    this.alarms.replaceChildren(...raised.slice(0, ALARMS_SHOWN).map(badge));
    if (more > 0) this.alarms.append(element("span", { class: "alarm-more", text: `+${more}`, title: alarmWords(raised.slice(ALARMS_SHOWN)) }));
  }
}

/** A reading in a fixed place of a tile. */
class Cell {
  constructor(size) {
    this.label = element("span", { class: "cell-label" });
    this.main = element("span", { class: "cell-main" });
    this.side = element("span", { class: "cell-side" });
    this.unit = element("span", { class: "cell-unit" });
    this.band = element("span", { class: "cell-band" });
    const value = element("span", { class: "cell-value" }, this.main, this.side, this.unit);
    this.node = element("div", { class: `cell cell-${size}` }, this.label, value, this.band);
  }

  // A number that is no longer true must not look like one: it moves to where the band was, and says that it was.
  update(reading, current) {
    setText(this.label, reading.label);
    setAttribute(this.node, "title", [reading.text, reading.note].filter(Boolean).join(": "));
    setAttribute(this.node, "style", `--hue: var(--${reading.color})`);
    setText(this.unit, reading.unit);
    const was = reading.main === NONE ? "" : `was ${reading.main} ${reading.side}`;
    setText(this.main, current ? reading.main : NONE);
    setText(this.side, current ? reading.side : "");
    setText(this.band, current ? reading.band : was);
  }
}

function healthText(bed) {
  const lag = bed.lag_ms == null ? "" : `lag ${bed.lag_ms.toFixed(bed.lag_ms < 10 ? 1 : 0)} ms`;
  const members = bed.members != null && bed.members_alive < bed.members ? `${bed.members_alive}/${bed.members}` : "";
  return [members, lag].filter(Boolean).join(" · ");
}

function alarmWords(alarms) {
  const raised = byUrgency(alarms);
  return raised.length ? raised.map((a) => `${a.priority} alarm ${a.name}`).join(", ") : "no alarm";
}
