// The event log, newest first, and the field for a note.

import { byId, element, recall, remember, setAttribute, setText } from "./dom.js";
import { eventLabel } from "./names.js";
import { clockText } from "./time.js";

const SHOWN_LIMIT = 200;

const GOOD = new Set(["start", "recovered", "artefact_over", "model_fits", "beat_found"]);

const kindOf = (event) => (event.kind === "note" ? "note" : GOOD.has(event.kind) ? "good" : "other");

export class EventLog {
  /** `onNote(text, author)` sends a note and says whether it went out. */
  constructor({ onNote }) {
    this.list = byId("event-log");
    this.text = byId("note-text");
    this.author = byId("note-author");
    this.said = byId("note-answer");
    this.button = byId("note-send");
    this.author.value = recall("author", "");
    this.shown = null;
    byId("note").addEventListener("submit", (event) => {
      event.preventDefault();
      this.#send(onNote);
    });
  }

  /** Shows the events; nothing is touched while there is no new one, so that text can be selected. */
  write(events) {
    const newest = events[events.length - 1];
    const key = newest ? `${events.length} ${newest.time_ns} ${newest.text}` : "";
    if (key === this.shown) return;
    this.shown = key;
    const sorted = [...events].sort((one, other) => (other.time ?? 0) - (one.time ?? 0)).slice(0, SHOWN_LIMIT);
    this.list.replaceChildren(...sorted.map(itemOf));
  }

  /** Says how the note that was sent ended; one that nobody took stays in its field. */
  answer({ ok, text }) {
    if (!this.button.disabled) return;
    this.button.disabled = false;
    setText(this.said, ok ? `✓ ${text}` : text);
    setAttribute(this.said, "data-ok", String(ok));
    if (ok) this.text.value = "";
  }

  #send(onNote) {
    const text = this.text.value.trim();
    if (!text || this.button.disabled) return;
    remember("author", this.author.value.trim());
    const isSent = onNote(text, this.author.value.trim());
    this.button.disabled = isSent;
    setText(this.said, isSent ? "" : "Not sent: the connection is lost.");
  }
}

function itemOf(event) {
  const what = event.kind === "note" ? "✎ note" : eventLabel(event);
  return element(
    "li",
    { "data-kind": kindOf(event) },
    element("time", { text: clockText(event.time) }),
    element("span", { class: "event-kind", text: what }),
    element("span", { class: "event-text", text: event.text }),
  );
}
