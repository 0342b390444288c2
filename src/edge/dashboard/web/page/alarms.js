// Priorities of alarms: their order, their signs. Colour is never alone: each has a sign and a word as well.

import { element } from "./dom.js";

const RANK = { high: 3, medium: 2, low: 1 };
const SIGNS = { high: "▲ !!!", medium: "◆ !!", low: "● !" };

/** 3 for high, 2 for medium, 1 for low, 0 for anything else. */
export const rankOf = (priority) => (Object.hasOwn(RANK, priority) ? RANK[priority] : 0);

/** Whether an alarm demands to be looked at: it is on, or was on and nobody has seen it. */
export const isRaised = (alarm) => alarm.state === "active" || alarm.state === "latched";

/** Shape and exclamation marks of a priority. */
export const signOf = (priority) => (Object.hasOwn(SIGNS, priority) ? SIGNS[priority] : "○");

/** The raised alarms, most urgent first: by priority, then those that nobody has seen. */
export function byUrgency(alarms) {
  const urgency = (alarm) => 2 * rankOf(alarm.priority) + (alarm.acknowledged ? 0 : 1);
  return (alarms ?? []).filter(isRaised).sort((one, other) => urgency(other) - urgency(one));
}

/** The raised alarms where not all are shown: those first that nobody has seen, so that none hides behind one that somebody
 * has. */
export function unseenFirst(alarms) {
  return byUrgency(alarms).sort((one, other) => Number(Boolean(one.acknowledged)) - Number(Boolean(other.acknowledged)));
}

/** Highest priority among raised alarms; empty without one. */
export function highestPriority(alarms) {
  return byUrgency(alarms)[0]?.priority ?? "";
}

/** A coloured badge with the sign and name of an alarm. */
export function badge(alarm) {
  const state = alarm.acknowledged ? "seen" : alarm.state;
  return element(
    "span",
    { class: "alarm-badge", "data-priority": alarm.priority, "data-state": state, title: alarm.text },
    element("span", { class: "alarm-sign", text: signOf(alarm.priority), "aria-hidden": "true" }),
    element("span", { class: "alarm-name", text: alarm.name }),
    element("span", { class: "alarm-word", text: alarm.state === "latched" ? "was on" : alarm.acknowledged ? "seen" : "" }),
  );
}
