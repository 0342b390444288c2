// How alive a bed is, in words that cannot be taken for something else.

import { duration } from "./numbers.js";

const SIGNS = { live: "●", forecast: "◌", no_estimate: "□", stale: "✕", not_heard: "✕" };

/** Whether numbers of such a bed describe the present. */
export const isCurrent = (liveness) => liveness === "live" || liveness === "forecast";

/** A sign and a few words, with how long ago where that is the matter. */
export function livenessText(liveness, ageS) {
  const sign = Object.hasOwn(SIGNS, liveness) ? SIGNS[liveness] : "?";
  switch (liveness) {
    case "live":
      return `${sign} live`;
    case "forecast":
      return `${sign} FORECAST, no data`;
    case "no_estimate":
      return `${sign} no estimate`;
    case "stale":
      return `${sign} STALE ${ageS == null ? "" : duration(Math.max(ageS, 0))}`.trim();
    case "not_heard":
      return `${sign} not heard`;
    default:
      return `${sign} ${liveness ?? "unknown"}`;
  }
}
