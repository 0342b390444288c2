// Readings of a beat as a bedside writes them: a number or `sys/dia (mean)`, and the band under it.

import { BEAT_NAMES, describe } from "./names.js";
import { halfWidth, NONE, number, range, spread } from "./numbers.js";

/** Systolic, diastolic and mean value with their bands of one pressure; `at` gives a clinical quantity by its key. */
export function pressureReading(name, at) {
  const [systolic, diastolic, mean] = ["systolic", "diastolic", "mean"].map((part) => at(`${name}_${part}`));
  const isKnown = Boolean(systolic || diastolic || mean);
  return {
    label: describe(name).label,
    text: describe(name).text,
    color: describe(name).color,
    unit: "mmHg",
    ...arranged(name, isKnown, [systolic, diastolic, mean]),
    note: "",
  };
}

// Of a vein the mean is what is read, of an artery or a ventricle systole and diastole.
function arranged(name, isKnown, bands) {
  if (!isKnown) return { main: NONE, side: "", band: NONE };
  const [systolic, diastolic, mean] = bands.map((of) => number(of?.mean, 0));
  // All three in the same way, or they would be hard to compare.
  const asHalf = bands.some((of) => of && of.q95 - of.q05 < 1);
  const [ofSystolic, ofDiastolic, ofMean] = bands.map((of) =>
    asHalf ? halfWidth(of?.q05, of?.q95) : range(of?.q05, of?.q95, 0),
  );
  if (name === "p_v" || name === "p_pv") {
    return { main: mean, side: `(${systolic}/${diastolic})`, band: `${ofMean} (${ofSystolic} / ${ofDiastolic})` };
  }
  return { main: `${systolic}/${diastolic}`, side: `(${mean})`, band: `${ofSystolic} / ${ofDiastolic} (${ofMean})` };
}

/** A clinical quantity that is one number. */
export function singleReading(name, at) {
  const { label, text, digits, color } = BEAT_NAMES[name];
  const band = at(name);
  return {
    label,
    text,
    color,
    unit: band?.unit ?? "",
    main: number(band?.mean, digits),
    side: "",
    // Where the band is narrower than the last digit shown it needs another one to be seen as a band.
    band: band ? spread(band.q05, band.q95, band.q95 - band.q05 < 10 ** -digits ? digits + 1 : digits) : NONE,
    note: band && (name === "svr" || name === "pvr") ? woodUnits(band.mean) : "",
  };
}

// 1 mmHg s/mL is 1000/60 mmHg min/L, and one of these 80 dyn s/cm^5.
function woodUnits(resistance) {
  if (!Number.isFinite(resistance)) return "";
  const wood = (resistance * 1000) / 60;
  return `${wood.toFixed(1)} WU, ${(80 * wood).toFixed(0)} dyn s/cm⁵`;
}
