// Event time. Nanoseconds since the epoch of a daemon do not fit a JavaScript number, so the page counts seconds from
// the first event time that it hears of.

const NS_PER_S = 1_000_000_000n;
const YEAR_2001_NS = 1_000_000_000n * NS_PER_S;

let baseNs = null;

/** Seconds after the page's origin of an event time given as a decimal string; null where there is none. */
export function secondsOf(text) {
  if (typeof text !== "string" || !/^-?\d{1,20}$/.test(text)) return null;
  const ns = BigInt(text);
  baseNs ??= ns;
  const difference = ns - baseNs;
  return Number(difference / NS_PER_S) + Number(difference % NS_PER_S) / 1e9;
}

/** The inverse, as the decimal string that the server reads. */
export function nsOf(seconds) {
  const whole = Math.floor(seconds);
  const ns = BigInt(whole) * NS_PER_S + BigInt(Math.round((seconds - whole) * 1e9));
  return ((baseNs ?? 0n) + ns).toString();
}

/** Event time for people: of day (UTC) if it counts from 1970, else seconds since whatever it counts from. */
export function clockText(seconds) {
  if (seconds == null) return "–";
  const ns = BigInt(nsOf(seconds));
  const tenths = ns / 100_000_000n;
  if (ns < YEAR_2001_NS) return `${(Number(tenths) / 10).toFixed(1)} s`;
  const second = Number((tenths / 10n) % 86_400n);
  const pad = (value) => String(value).padStart(2, "0");
  return `${pad(Math.floor(second / 3600))}:${pad(Math.floor(second / 60) % 60)}:${pad(second % 60)}.${tenths % 10n}`;
}
