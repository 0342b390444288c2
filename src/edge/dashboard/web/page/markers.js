// What happened, as marks on the timeline of strips and trends: notes, alarms, everything else that an event told.

import { isRaised, signOf } from "./alarms.js";
import { eventLabel } from "./names.js";
import { secondsOf } from "./time.js";

const LABEL_LENGTH = 28;

const short = (text) => (text.length > LABEL_LENGTH ? `${text.slice(0, LABEL_LENGTH - 1)}…` : text);

/** Marks of a history: time, kind (`note`, a priority, or `event`) and label. */
export function markersOf(history) {
  const events = history.events.filter((event) => event.time !== null).map((event) => {
    const isNote = event.kind === "note";
    const label = isNote ? `✎ ${event.text}` : eventLabel(event);
    return { time: event.time, kind: isNote ? "note" : "event", label: short(label) };
  });
  const alarms = (history.latest.alarms ?? []).filter(isRaised).map((alarm) => {
    const label = short(`${signOf(alarm.priority)} ${alarm.name}`);
    return { time: secondsOf(alarm.since_ns), kind: alarm.priority, label };
  });
  const known = alarms.filter((alarm) => alarm.time !== null);
  // An event that only tells of an alarm which is marked already would be a second mark in the same place.
  const isSaid = (event) => event.label.startsWith("alarm") && known.some((alarm) => Math.abs(alarm.time - event.time) < 1);
  return [...events.filter((event) => !isSaid(event)), ...known];
}

/** The marks between two times. */
export function between(markers, left, right) {
  return markers.filter((marker) => marker.time >= left && marker.time <= right);
}
