// A bed: keeps its history and lets the panels show it. Strips are drawn with every frame, numbers four times a second,
// charts about once.

import { AlarmList } from "./alarmlist.js";
import { badge, byUrgency } from "./alarms.js";
import { Charts } from "./charts.js";
import { byId, setAttribute, setText } from "./dom.js";
import { EventLog } from "./eventlog.js";
import { fileName, save, stripsCsv, stripsPng } from "./export.js";
import { writeHealth } from "./health.js";
import { History } from "./history.js";
import { isCurrent, livenessText, outageText, qualityText } from "./liveness.js";
import { addLoops } from "./loops.js";
import { markersOf } from "./markers.js";
import { Numerics } from "./numerics.js";
import { Sources } from "./sources.js";
import { Strips } from "./strips.js";
import { nsOf } from "./time.js";
import { Timeline } from "./timeline.js";
import { Trends } from "./trends.js";
import { Viewport } from "./viewport.js";

/** Points of a waveform need not be closer than this [ms]. */
const SPACING_MS = 8;
const WRITE_EVERY_MS = 250;

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
    this.viewport = new Viewport();
    this.timeline = new Timeline(this.viewport);
    this.strips = new Strips({ onChoice: () => this.#ask(), onResize: changed });
    this.history = new History(this.strips.quantities());
    this.numerics = new Numerics();
    this.sources = new Sources();
    this.charts = new Charts();
    this.trends = new Trends(this.charts, () => this.#scene());
    addLoops(this.charts, () => this.#scene());
    this.alarms = new AlarmList({ onAcknowledge: (alarm) => send({ acknowledge: alarm, bed: this.name }) });
    this.events = new EventLog({ onNote: (text, author) => this.#note(text, author) });
    this.viewport.onChange(() => this.#redraw());
  }

  /** Shows another bed from now on. */
  open(name) {
    this.name = name;
    this.head = null;
    this.newestNs = null;
    this.history = new History(this.strips.quantities());
    for (const panel of [this.strips, this.trends, this.sources]) panel.reset();
    this.viewport.follow(0, 0);
    this.viewport.live();
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
    this.viewport.follow(this.history.oldest ?? now, now);
    if (this.viewport.isPaused && this.viewport.edge > now) this.viewport.live();
  }

  /** Draws the strips, and from time to time writes the numbers. */
  draw(now) {
    this.markers = markersOf(this.history);
    this.strips.draw(this.history, this.viewport, this.markers);
    if (now - this.writtenAt < WRITE_EVERY_MS) return;
    this.writtenAt = now;
    this.#write();
  }

  /** What was painted of each quantity, for tests. */
  drawn() {
    return Object.fromEntries([...this.strips].filter((strip) => strip.account).map((strip) => [strip.name, { ...strip.account }]));
  }

  /** Hands out what is shown as a file. */
  async export(ending) {
    const name = fileName(this.name, this.viewport.right, ending);
    if (ending === "png") return save(await stripsPng(this.name, this.viewport, this.strips), name);
    const names = [...this.strips].map((strip) => strip.name);
    return save(new Blob([stripsCsv(this.history, this.viewport, names)], { type: "text/csv" }), name);
  }

  #scene() {
    return { history: this.history, viewport: this.viewport, markers: this.markers ?? [] };
  }

  #ask() {
    const quantities = this.strips.quantities();
    this.history.show(quantities);
    if (this.name) this.show({ show: "bed", bed: this.name, quantities, spacing_ms: SPACING_MS });
  }

  #redraw() {
    this.writtenAt = -Infinity;
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
    this.trends.write(history, viewport);
    this.sources.write(latest.quantities ?? []);
    this.events.write(history.events);
    this.alarms.write(latest.alarms ?? []);
    writeHealth(latest.status ?? null);
  }

  #writeHead() {
    const head = this.head;
    const liveness = head?.liveness ?? "";
    setAttribute(this.node, "data-liveness", liveness);
    setText(byId("bed-liveness"), head ? livenessText(liveness, head.age_s) : "waiting");
    setAttribute(byId("bed-liveness"), "data-liveness", liveness);
    setText(byId("bed-quality"), head ? qualityText(head) : "");
    setAttribute(byId("bed-quality"), "data-quality", head?.quality ?? "");
    byId("bed-unknown").hidden = head?.known !== false;
    const raised = byUrgency(this.history.latest.alarms);
    const key = JSON.stringify(raised.slice(0, 2));
    if (byId("bed-alarms").dataset.key !== key) {
      byId("bed-alarms").dataset.key = key;
      byId("bed-alarms").replaceChildren(...raised.slice(0, 2).map(badge));
    }
    const isHigh = raised[0]?.priority === "high";
    document.title = `${isHigh ? "▲ " : ""}${this.name} · hemostream`;
  }
}

// Without a history of beats the last one is known, but not what it was in the past.
const liveOnly = (viewport, band) => (viewport.isPaused ? null : (band ?? null));
