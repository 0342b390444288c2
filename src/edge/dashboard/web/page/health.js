// How the estimator is doing: members, lag, work, what was refused, and every channel.

import { byId, element, setText } from "./dom.js";
import { describe } from "./names.js";
import { count, NONE, number } from "./numbers.js";

const CHANNELS_LIMIT = 12;
const COUNTERS_LIMIT = 20;
/** Innovations so many times as large as expected say that model or noise do not fit. */
const MISFIT = 1.5;

const ms = (value) => (value == null ? NONE : `${number(value, value < 10 ? 2 : 0)} ms`);

const lagText = (status) => ["p50", "p99", "max"].map((part) => number(status[`lag_${part}_ms`], 1)).join(" · ");

/** Shows a status of the protocol; nothing but dashes without one. */
export function writeHealth(status) {
  setText(byId("health-members"), status ? `${count(status.members_alive)} of ${count(status.members)}` : NONE);
  byId("health-members").dataset.bad = String(Boolean(status) && status.members_alive < status.members);
  setText(byId("health-lag"), status ? lagText(status) : NONE);
  setText(byId("health-solve"), ms(status?.solve_ms));
  setText(byId("health-queue"), count(status?.queue_depth));
  setText(byId("health-windows"), count(status?.windows));
  setText(byId("health-not-converged"), count(status?.not_converged));
  writeCounters(status?.counters ?? {});
  writeChannels(status?.channels ?? []);
}

function writeCounters(counters) {
  const entries = Object.entries(counters).slice(0, COUNTERS_LIMIT);
  setText(byId("health-counters"), entries.length ? entries.map(([cause, n]) => `${cause} ${count(n)}`).join(", ") : "none");
}

function writeChannels(channels) {
  const rows = channels.slice(0, CHANNELS_LIMIT).map((channel) => {
    const fits = !channel.misfit && !(channel.innovation_rms > MISFIT);
    const remark = channel.artefact ? `✕ ${channel.artefact}` : fits ? "✓ fits" : "△ model does not fit";
    const cells = [describe(channel.name).label, channel.state, number(channel.noise_sd, 2), number(channel.innovation_rms, 2), remark];
    const isBad = Boolean(channel.artefact) || !fits || channel.state !== "live";
    return element("tr", { "data-bad": String(isBad) }, ...cells.map((text) => element("td", { text })));
  });
  byId("health-channels").replaceChildren(...rows);
}
