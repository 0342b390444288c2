// How alive a bed is and how good its estimates are, in words that cannot be taken for something else.

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
      return `${sign} FORECAST`;
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

/** What is missing from a bed that is not current, and for how long. */
export function outageText({ liveness, age_s: ageS }) {
  if (liveness === "no_estimate") return "NO ESTIMATE YET";
  if (liveness === "not_heard") return "NOTHING HEARD";
  return ageS == null ? "NO NEW DATA" : `NO NEW DATA for ${duration(Math.max(ageS, 0))}`;
}

const QUALITY_SIGNS = { good: "✓", degraded: "△", bad: "✕" };

/** A sign and what there is to say about the quality of a bed's estimates. */
export function qualityText({ quality, quality_text: text }) {
  const sign = Object.hasOwn(QUALITY_SIGNS, quality) ? QUALITY_SIGNS[quality] : "?";
  return `${sign} ${text || quality || "unknown"}`;
}
