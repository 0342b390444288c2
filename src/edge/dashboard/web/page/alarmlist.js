// The alarms of a bed: raised ones first, each with a button to say that it was seen; quiet ones with their limits.

import { byUrgency, isRaised, signOf } from "./alarms.js";
import { byId, element, setAttribute, setHidden, setText } from "./dom.js";
import { labelOf } from "./names.js";
import { decimals, number, range } from "./numbers.js";
import { clockText, secondsOf } from "./time.js";

/** More than a bed has. */
const SHOWN_LIMIT = 64;
const NOTHING_WAITS = "No alarm to acknowledge.";

export class AlarmList {
  /** `onAcknowledge(names)` is called with the names of alarms and says whether that went out. */
  constructor({ onAcknowledge }) {
    this.list = byId("alarm-list");
    this.all = byId("acknowledge-all");
    this.onAcknowledge = onAcknowledge;
    this.shown = null;
    // All that are listed: what is raised meanwhile nobody has seen.
    this.unseen = [];
    this.all.addEventListener("click", () => this.#acknowledge(this.unseen));
  }

  /** Says how an acknowledgement ended: the list itself shows one that the daemon has taken. */
  answer({ ok, text }) {
    setText(byId("alarm-answer"), ok ? "" : text);
  }

  /** Puts the keyboard on the button of the most urgent alarm that nobody has seen, or says that there is none. */
  focus() {
    const button = this.list.querySelector("button");
    if (button) button.focus();
    else setText(byId("alarm-answer"), NOTHING_WAITS);
  }

  #acknowledge(names) {
    setText(byId("alarm-answer"), this.onAcknowledge(names) ? "" : "Not sent: the connection is lost.");
  }

  /** Shows the alarms, and beside those that are raised what is now, from `bandNow(quantity)`. A list that did not change
   * is left alone, so that no button moves away under the pointer. */
  write(alarms, bandNow) {
    this.bandNow = bandNow;
    this.#writeNow();
    const raised = byUrgency(alarms);
    const others = alarms.filter((alarm) => !isRaised(alarm));
    const key = JSON.stringify(alarms);
    if (key === this.shown) return;
    this.shown = key;
    const focused = this.list.contains(document.activeElement) ? document.activeElement.dataset.alarm : null;
    this.list.replaceChildren(...[...raised, ...others].slice(0, SHOWN_LIMIT).map((alarm) => this.#item(alarm)));
    if (focused !== null) [...this.list.querySelectorAll("button")].find((b) => b.dataset.alarm === focused)?.focus();
    if (byId("alarm-answer").textContent === NOTHING_WAITS) setText(byId("alarm-answer"), "");
    this.unseen = raised.filter((alarm) => !alarm.acknowledged).map((alarm) => alarm.name);
    setHidden(this.all, this.unseen.length === 0);
    setHidden(byId("no-alarms"), alarms.length > 0);
    this.#writeNow();
    this.#announce(raised);
  }

  #writeNow() {
    for (const node of this.list.querySelectorAll(".alarm-now")) {
      const band = this.bandNow(node.dataset.quantity);
      const digits = band ? decimals(band.mean, (band.q95 - band.q05) / 2) : 0;
      setText(node, band ? `now ${number(band.mean, digits)}` : "");
    }
  }

  #announce(raised) {
    const text = raised.filter((a) => !a.acknowledged).map((a) => `${a.priority} alarm: ${a.name}`).join(", ");
    setText(byId("alarm-voice"), text);
  }

  #item(alarm) {
    const item = element("li", { "data-priority": alarm.priority, "data-state": alarm.state });
    setAttribute(item, "data-acknowledged", String(Boolean(alarm.acknowledged)));
    const state = alarm.acknowledged ? "active, seen" : alarm.state === "latched" ? "was on" : alarm.state;
    const what = element("b", { text: alarm.name });
    const sign = isRaised(alarm) ? signOf(alarm.priority) : "○";
    item.append(
      element("span", { class: "alarm-sign", text: sign, title: `${alarm.priority} priority` }),
      element("span", { class: "alarm-what" }, what, " ", element("span", { class: "alarm-state", text: state })),
      element("span", { class: "alarm-text", text: detail(alarm), title: alarm.quantity }),
    );
    if (isRaised(alarm)) item.append(element("span", { class: "alarm-now", "data-quantity": alarm.quantity }));
    if (isRaised(alarm) && !alarm.acknowledged) item.append(this.#button(alarm.name));
    return item;
  }

  #button(name) {
    const attributes = { type: "button", "data-alarm": name, "aria-label": `Acknowledge ${name}`, text: "Acknowledge" };
    const button = element("button", attributes);
    button.addEventListener("click", () => this.#acknowledge([name]));
    return button;
  }
}

function detail(alarm) {
  const digits = decimals(alarm.mean, (alarm.q95 - alarm.q05) / 2);
  const limit = `${labelOf(alarm.quantity)} ${alarm.side === "below" ? "<" : ">"} ${alarm.limit} ${alarm.unit}`;
  // The band is of the moment when the alarm became what it is; what it is by now stands beside.
  const band = alarm.mean == null ? "" : `: ${number(alarm.mean, digits)} (${range(alarm.q05, alarm.q95, digits)})`;
  const since = alarm.state === "latched" ? "off since" : "since";
  const when = isRaised(alarm) ? `, ${since} ${clockText(secondsOf(alarm.since_ns))}` : "";
  return `${limit}${when}${band}`;
}
