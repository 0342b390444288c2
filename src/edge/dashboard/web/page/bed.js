// A bed: keeps its history and lets the panels show it. Strips go on with every frame, numbers twice a second, charts
// about once.

import { AlarmList } from "./alarmlist.js";
import { badge, highestPriority, unseenFirst } from "./alarms.js";
import { Charts } from "./charts.js";
import { byId, element, setAttribute, setHidden, setText } from "./dom.js";
import { EventLog } from "./eventlog.js";
import { fileName, save, stripsCsv, stripsPng } from "./export.js";
import { writeHealth } from "./health.js";
import { History } from "./history.js";
import { isCurrent, livenessText, outageText, qualityText } from "./liveness.js";
import { addLoops } from "./loops.js";
import { markersOf } from "./markers.js";
import { duration } from "./numbers.js";
import { Numerics } from "./numerics.js";
import { isInSight, watch } from "./sight.js";
import { Sources } from "./sources.js";
import { Strips } from "./strips.js";
import { nsOf } from "./time.js";
import { Timeline } from "./timeline.js";
import { Trends } from "./trends.js";
import { Viewport } from "./viewport.js";

/** Points of a waveform need not be closer than this [ms]. */
const SPACING_MS = 8;
const WRITE_EVERY_MS = 500;
/** What is out of sight is written with one of so many writes: somebody may have it read out. */
const WRITES_PER_UNSEEN = 4;

export class Bed {
  /** `show(wish)` and `send(order)` reach the server, `changed()` asks for a picture. */
  constructor({ show, send, changed }) {
    this.node = byId("bed-view");
    this.show = show;
    this.send = send;
    this.changed = changed;
    this.name = "";
    this.head = null;
    this.newestNs = null;
    this.writtenAt = -Infinity;
    this.markers = [];
    this.viewport = new Viewport();
    this.timeline = new Timeline(this.viewport);
    this.strips = new Strips({ onChoice: () => this.#ask(), onClear: changed });
    this.history = new History(this.strips.quantities());
    this.numerics = new Numerics();
    this.sources = new Sources();
    this.charts = new Charts();
    this.trends = new Trends(this.charts, () => this.#scene());
    addLoops(this.charts, () => this.#scene());
    this.alarms = new AlarmList({ onAcknowledge: (alarms) => send({ acknowledge: alarms, bed: this.name }) });
    this.events = new EventLog({ onNote: (text, author) => this.#note(text, author) });
    this.viewport.onChange(() => this.#redraw());
    this.writes = 0;
    for (const panel of this.#panels()) watch(panel.node);
  }

  /** Shows another bed from now on. */
  open(name) {
    this.name = name;
    this.head = null;
    this.newestNs = null;
    this.history = new History(this.strips.quantities());
    for (const panel of [this.strips, this.trends, this.sources]) panel.reset();
    this.viewport.reset();
    setAttribute(this.node, "data-bed", name);
    setAttribute(this.node, "data-liveness", "");
    setText(byId("bed-name"), name);
    this.#ask();
    this.charts.run(true);
    this.#redraw();
  }

  /** Shows nothing from now on, and forgets. */
  close() {
    this.name = "";
    this.charts.run(false);
    setAttribute(this.node, "data-bed", "");
    this.history = new History(this.strips.quantities());
  }

  /** Takes in a frame; one of another bed was still under way when this one was opened. */
  take(head, numbers) {
    if (head.bed !== this.name) return;
    this.history.take(head, numbers);
    if (head.reset) this.writtenAt = -Infinity;
    this.head = head;
    this.newestNs = head.now_ns ?? null;
    const now = this.history.now ?? 0;
    this.viewport.follow(this.history.oldest ?? now, now, performance.now());
    if (this.viewport.isPaused && this.viewport.edge > now) this.viewport.live();
  }

  /** Takes the answer to an order that was sent. */
  answer(message) {
    if (message.order === "note") this.events.answer(message);
    else this.alarms.answer(message);
  }

  /** The line is lost, and with it what was under way. */
  lose() {
    this.events.answer({ ok: false, text: "The connection is lost; whether the note was taken is not known." });
  }

  /** Draws the strips up to `now` [ms], and from time to time writes the numbers. Returns whether a waveform went on. */
  draw(now) {
    this.viewport.advance(now);
    const isDue = now - this.writtenAt >= WRITE_EVERY_MS;
    if (isDue) this.markers = markersOf(this.history);
    const isNew = this.strips.draw(this.history, this.viewport, this.markers);
    if (isDue) {
      this.writtenAt = now;
      this.#write();
    }
    return isNew;
  }

  /** Draws the strips anew and says what was painted of each quantity, for tests. */
  drawn() {
    return this.strips.drawAnew(this.history, this.viewport, this.markers);
  }

  /** Hands out what is shown as a file. */
  async export(ending) {
    const name = fileName(this.name, this.viewport.right, ending);
    if (ending === "png") {
      const pictures = [...this.strips.stretched(this.history, this.viewport, this.markers)];
      return save(await stripsPng(this.name, this.viewport, pictures), name);
    }
    const names = [...this.strips].map((strip) => strip.name);
    return save(new Blob([stripsCsv(this.history, this.viewport, names)], { type: "text/csv" }), name);
  }

  #scene() {
    return { history: this.history, viewport: this.viewport, markers: this.markers };
  }

  #ask() {
    const quantities = this.strips.quantities();
    this.history.show(quantities);
    if (this.name) this.show({ show: "bed", bed: this.name, quantities, spacing_ms: SPACING_MS });
  }

  #redraw() {
    this.writtenAt = -Infinity;
    this.writes = 0;
    this.changed();
  }

  // A note taken while paused is about the moment that is looked at.
  #note(text, author) {
    const order = { note: text, author, bed: this.name };
    return this.send(this.viewport.isPaused ? { ...order, time_ns: nsOf(this.viewport.right) } : order);
  }

  #write() {
    const { history, viewport } = this;
    const { latest } = history;
    this.#writeHead();
    // The past stays what it was, whatever the bed is now.
    const current = this.head === null || viewport.isPaused || isCurrent(this.head.liveness);
    this.timeline.write(current);
    setAttribute(this.node, "data-current", String(current));
    setText(byId("strips-stale"), current ? "" : outageText(this.head));
    this.numerics.write((key) => (current ? (history.beatAt(key, viewport.right) ?? liveOnly(viewport, latest.beat?.[key])) : null));
    this.strips.write(history, viewport, current);
    this.events.write(history.events);
    this.alarms.write(latest.alarms ?? [], (name) => bandNow(latest, name));
    const isForAll = this.writes % WRITES_PER_UNSEEN === 0;
    this.writes += 1;
    for (const panel of this.#panels()) if (isForAll || isInSight(panel.node)) panel.write();
  }

  // Panels of many numbers, most of which are below what a screen shows.
  #panels() {
    const { latest } = this.history;
    return [
      { node: byId("beat-trends"), write: () => this.trends.write("beats", this.history, this.viewport) },
      { node: byId("parameter-trends"), write: () => this.trends.write("parameters", this.history, this.viewport) },
      { node: byId("sources"), write: () => this.sources.write(latest.quantities ?? []) },
      { node: byId("health-panel"), write: () => writeHealth(latest.status ?? null) },
    ];
  }

  #writeHead() {
    const head = this.head;
    const liveness = head?.liveness ?? "";
    setAttribute(this.node, "data-liveness", liveness);
    setText(byId("bed-liveness"), head ? livenessText(liveness, head.age_s) : "waiting");
    setAttribute(byId("bed-liveness"), "data-liveness", liveness);
    setHidden(byId("bed-paused"), !this.viewport.isPaused);
    setText(byId("bed-paused"), `❚❚ PAUSED, waveforms and numbers of ${duration(this.viewport.newest - this.viewport.right)} ago`);
    setText(byId("bed-quality"), head ? qualityText(head) : "");
    setAttribute(byId("bed-quality"), "data-quality", head?.quality ?? "");
    setHidden(byId("bed-unknown"), head?.known !== false);
    const raised = unseenFirst(this.history.latest.alarms);
    const [shown, others] = [raised.slice(0, 2), raised.length - 2];
    const key = JSON.stringify([shown, others]);
    if (byId("bed-alarms").dataset.key !== key) {
      byId("bed-alarms").dataset.key = key;
      const more = others > 0 ? [element("span", { class: "quiet", text: `+${others} more` })] : [];
      byId("bed-alarms").replaceChildren(...shown.map(badge), ...more);
    }
    const isHigh = highestPriority(this.history.latest.alarms) === "high";
    document.title = `${isHigh ? "▲ " : ""}${this.name} · hemostream`;
  }
}

// Band of a quantity, of a beat, or of a parameter at present, by its name.
function bandNow({ beat, quantities, parameters }, name) {
  return beat?.[name] ?? [...(quantities ?? []), ...(parameters ?? [])].find((entry) => entry.name === name) ?? null;
}

// Without a history of beats the last one is known, but not what it was in the past.
const liveOnly = (viewport, band) => (viewport.isPaused ? null : (band ?? null));
