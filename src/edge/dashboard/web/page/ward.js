// The ward: a tile per bed, found by name, ordered by name or by urgency, walked through with the arrow keys.

import { byUrgency, rankOf } from "./alarms.js";
import { byId, recall, remember, setAttribute, setText } from "./dom.js";
import { isCurrent } from "./liveness.js";
import { Tile } from "./tile.js";

const BEDS_LIMIT = 2000;
const collator = new Intl.Collator(undefined, { numeric: true });

export class Ward {
  constructor() {
    this.list = byId("tiles");
    this.filter = byId("filter");
    this.order = byId("order");
    this.tiles = new Map();
    this.head = null;
    this.order.value = recall("order", "name") === "alarms" ? "alarms" : "name";
    this.order.addEventListener("change", () => {
      remember("order", this.order.value);
      this.#arrange();
    });
    this.filter.addEventListener("input", () => this.#arrange());
    this.filter.addEventListener("keydown", (event) => this.#filterKey(event));
    this.list.addEventListener("keydown", (event) => this.#walk(event));
    this.list.addEventListener("focusin", (event) => this.#rove(event.target.closest(".tile")));
  }

  /** Keeps the newest frame; `draw` shows it. */
  take(head) {
    this.head = head;
  }

  /** Shows the newest frame. */
  draw() {
    if (!this.head) return;
    const beds = (this.head.beds ?? []).slice(0, BEDS_LIMIT);
    const names = new Set(beds.map((bed) => bed.bed));
    for (const [name, tile] of this.tiles) {
      if (names.has(name)) continue;
      tile.node.remove();
      this.tiles.delete(name);
    }
    for (const bed of beds) {
      if (!this.tiles.has(bed.bed)) this.tiles.set(bed.bed, new Tile(bed.bed));
      this.tiles.get(bed.bed).update(bed);
    }
    this.#arrange();
    this.#summarise(beds);
  }

  /** Puts the keyboard on a bed, or on the first one. */
  focus(name) {
    const tile = this.tiles.get(name) ?? this.#visible()[0];
    tile?.link.focus();
  }

  /** What the frame says, as CSV: a row per bed and quantity. */
  csv() {
    const rows = ["bed,liveness,age_s,quality,quantity,unit,mean,q05,q95"];
    for (const bed of this.head?.beds ?? []) {
      for (const [key, band] of Object.entries(bed.values ?? {})) {
        const cells = [bed.bed, bed.liveness, bed.age_s, bed.quality, key, band.unit, band.mean, band.q05, band.q95];
        rows.push(cells.map(csvCell).join(","));
      }
    }
    return `${rows.join("\n")}\n`;
  }

  #visible() {
    return [...this.list.children].map((node) => this.#tileOf(node)).filter((tile) => tile && !tile.node.hidden);
  }

  #tileOf(node) {
    return this.tiles.get(node.dataset.bed);
  }

  #arrange() {
    const wanted = this.filter.value.trim().toLowerCase();
    const tiles = [...this.tiles.values()].sort((one, other) => this.#compare(one, other));
    const focused = document.activeElement;
    // Moving a node takes the focus from it, so nodes stay where the order did not change.
    tiles.forEach((tile, k) => {
      tile.node.dataset.bed = tile.name;
      tile.node.hidden = !tile.name.toLowerCase().includes(wanted);
      if (this.list.children[k] !== tile.node) this.list.insertBefore(tile.node, this.list.children[k] ?? null);
    });
    if (focused instanceof HTMLElement && this.list.contains(focused) && document.activeElement !== focused) focused.focus();
    const visible = this.#visible();
    if (!visible.some((tile) => tile.link.tabIndex === 0)) this.#rove(visible[0]?.link);
    byId("ward-empty").hidden = visible.length > 0;
    setText(byId("ward-empty"), this.tiles.size ? "No bed of that name." : "No bed has been heard yet.");
  }

  #compare(one, other) {
    const urgency = (tile) => {
      const first = byUrgency(tile.bed.alarms)[0];
      const lost = isCurrent(tile.bed.liveness) ? 0 : 1;
      return first ? 4 * rankOf(first.priority) + (first.acknowledged ? 0 : 2) + lost : lost;
    };
    const byAlarm = this.order.value === "alarms" ? urgency(other) - urgency(one) : 0;
    return byAlarm || collator.compare(one.name, other.name);
  }

  #summarise(beds) {
    const alarms = (priority) => beds.flatMap((bed) => byUrgency(bed.alarms)).filter((a) => a.priority === priority).length;
    const stale = beds.filter((bed) => !isCurrent(bed.liveness)).length;
    const counts = [["high", alarms("high")], ["medium", alarms("medium")], ["low", alarms("low")], ["stale", stale]];
    setText(byId("count-beds"), `${beds.length} ${beds.length === 1 ? "bed" : "beds"}`);
    for (const [key, value] of counts) {
      const node = byId(`count-${key}`);
      setText(node.querySelector("b"), String(value));
      setAttribute(node, "data-any", String(value > 0));
    }
    document.title = counts[0][1] > 0 ? `▲ ${counts[0][1]} high · hemostream` : "hemostream";
    const { dropped = 0, unreadable = 0, refused = 0 } = this.head.lost ?? {};
    const lost = [[dropped, "dropped"], [unreadable, "unreadable"], [refused, "refused"]].filter(([n]) => n > 0);
    setText(byId("ward-lost"), lost.length ? `messages lost: ${lost.map(([n, word]) => `${n} ${word}`).join(", ")}` : "");
  }

  // One tile is in the tab order, the one last focused: with hundreds of beds Tab must still lead out of the list.
  #rove(link) {
    if (!link) return;
    for (const tile of this.tiles.values()) if (tile.link !== link) tile.link.tabIndex = -1;
    link.tabIndex = 0;
  }

  #filterKey(event) {
    if (event.key === "Escape") {
      this.filter.value = "";
      this.#arrange();
    }
    if (event.key === "Escape" || event.key === "Enter" || event.key === "ArrowDown") {
      event.preventDefault();
      event.stopPropagation();
      this.focus(null);
    }
  }

  #walk(event) {
    const links = this.#visible().map((tile) => tile.link);
    const at = links.indexOf(document.activeElement);
    if (at < 0 || event.ctrlKey || event.metaKey || event.altKey) return;
    const top = links[0].getBoundingClientRect().top;
    const columns = Math.max(links.filter((link) => Math.abs(link.getBoundingClientRect().top - top) < 2).length, 1);
    const steps = { ArrowRight: 1, ArrowLeft: -1, ArrowDown: columns, ArrowUp: -columns };
    const targets = { Home: 0, End: links.length - 1 };
    const target = event.key in steps ? at + steps[event.key] : targets[event.key];
    if (target === undefined) return;
    event.preventDefault();
    event.stopPropagation();
    links[Math.min(Math.max(target, 0), links.length - 1)].focus();
  }
}

function csvCell(value) {
  const text = value == null ? "" : String(value);
  return /[",\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
}
