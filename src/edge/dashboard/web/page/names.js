// What quantities are called at the bedside, where they belong, which colour they have.

const COMPARTMENTS = {
  l: { text: "left ventricle", pressure: "LVP" },
  a: { text: "systemic arteries", pressure: "ABP" },
  v: { text: "systemic veins", pressure: "CVP" },
  r: { text: "right ventricle", pressure: "RVP" },
  pa: { text: "pulmonary arteries", pressure: "PAP" },
  pv: { text: "pulmonary veins", pressure: "PVP" },
};

const FLOWS = {
  li: { text: "inflow of the left ventricle", label: "Mitral flow", hue: "pv" },
  lo: { text: "outflow of the left ventricle", label: "Aortic flow", hue: "l" },
  a: { text: "flow from systemic arteries to veins", label: "Systemic flow", hue: "a" },
  ri: { text: "inflow of the right ventricle", label: "Tricuspid flow", hue: "v" },
  ro: { text: "outflow of the right ventricle", label: "Pulmonic flow", hue: "r" },
  pv: { text: "flow from pulmonary arteries to veins", label: "Pulmonary flow", hue: "pa" },
};

/** Pressures in the order in which a bedside monitor shows them. */
export const PRESSURES = ["p_a", "p_pa", "p_v", "p_l", "p_r", "p_pv"];
export const FLOW_NAMES = ["q_lo", "q_a", "q_ri", "q_ro", "q_pv", "q_li"];
export const VOLUMES = ["v_l", "v_r", "v_a", "v_v", "v_pa", "v_pv"];

/** Label, description, unit and name of the colour of a quantity; of one that is not known, its own name. */
export function describe(name) {
  const [kind, place] = [name.slice(0, 2), name.slice(2)];
  const compartment = Object.hasOwn(COMPARTMENTS, place) ? COMPARTMENTS[place] : null;
  if (kind === "p_" && compartment) {
    return { label: compartment.pressure, text: `pressure, ${compartment.text}`, unit: "mmHg", color: `hue-${place}` };
  }
  if (kind === "v_" && compartment) {
    const label = `Volume ${place.toUpperCase()}`;
    return { label, text: `volume, ${compartment.text}`, unit: "mL", color: `hue-${place}` };
  }
  if (kind === "q_" && Object.hasOwn(FLOWS, place)) {
    const { label, text, hue } = FLOWS[place];
    return { label, text, unit: "mL/s", color: `hue-${hue}` };
  }
  return { label: name, text: name, unit: "", color: "ink" };
}

/** Clinical quantities of a beat: label, digits after the point, colour. */
export const BEAT_NAMES = {
  heart_rate: { label: "HR", text: "heart rate", digits: 0, color: "hue-hr" },
  cardiac_output: { label: "CO", text: "cardiac output", digits: 2, color: "hue-l" },
  stroke_volume: { label: "SV", text: "stroke volume", digits: 0, color: "hue-l" },
  ejection_fraction: { label: "EF", text: "ejection fraction, left ventricle", digits: 2, color: "hue-l" },
  svr: { label: "SVR", text: "systemic vascular resistance", digits: 2, color: "hue-a" },
  pvr: { label: "PVR", text: "pulmonary vascular resistance", digits: 3, color: "hue-pa" },
};

const OF_PARAMETERS = {
  heart_rate: ["HR", "heart rate"],
  systole: ["Systole", "duration of systole"],
  p_th: ["Thorax", "intrathoracic pressure"],
  blood_volume: ["Blood", "total blood volume"],
  c_l_dia: ["C LV dia", "compliance, left ventricle, diastole"],
  c_l_sys: ["C LV sys", "compliance, left ventricle, systole"],
  c_r_dia: ["C RV dia", "compliance, right ventricle, diastole"],
  c_r_sys: ["C RV sys", "compliance, right ventricle, systole"],
  c_a: ["C systemic", "compliance, systemic arteries"],
  c_v: ["C venous", "compliance, systemic veins"],
  c_pa: ["C pulmonary", "compliance, pulmonary arteries"],
  c_pv: ["C pulm. venous", "compliance, pulmonary veins"],
  r_li: ["R mitral", "resistance, inflow of the left ventricle"],
  r_lo: ["R aortic", "resistance, outflow of the left ventricle"],
  r_a: ["R systemic", "resistance, systemic arteries to veins"],
  r_ri: ["R tricuspid", "resistance, inflow of the right ventricle"],
  r_ro: ["R pulmonic", "resistance, outflow of the right ventricle"],
  r_pv: ["R pulmonary", "resistance, pulmonary arteries to veins"],
};

/** Label, description and colour of a parameter; of one that is not known, its own name. */
export function describeParameter(name) {
  const [label, text] = Object.hasOwn(OF_PARAMETERS, name) ? OF_PARAMETERS[name] : [name, name];
  return { label, text: text === name ? name : `${text} (${name})`, color: "hue-parameter" };
}

/** Label, description and colour of what a beat is told by: a figure of its own, or a part of a pressure. */
export function describeBeat(name) {
  if (Object.hasOwn(BEAT_NAMES, name)) return BEAT_NAMES[name];
  const [, quantity, part] = /^(.*)_(systolic|diastolic|mean)$/.exec(name) ?? [null, name, ""];
  const about = describe(quantity);
  return { label: `${about.label} ${part}`.trim(), text: `${part} ${about.text}`.trim(), color: about.color };
}

/** What an alarm watches, in a word or two: a figure of a beat, a parameter, or a quantity at any moment. */
export function labelOf(name) {
  return Object.hasOwn(OF_PARAMETERS, name) && name !== "heart_rate" ? describeParameter(name).label : describeBeat(name).label;
}

const EVENTS = {
  gap: "no samples",
  recovered: "samples again",
  rejected: "samples refused",
  members_lost: "members replaced",
  window_failed: "window failed",
  overload: "overload",
  overload_over: "overload over",
  artefact: "artefact",
  artefact_over: "artefact over",
  model_misfit: "model does not fit",
  model_fits: "model fits again",
  parameter_shift: "parameter moves",
  alarm_over: "alarm over",
  alarm_acknowledged: "alarm seen",
};

/** What happened and where, for people: `no samples, PAP`. */
export function eventLabel({ kind, channel }) {
  const what = Object.hasOwn(EVENTS, kind) ? EVENTS[kind] : kind.replaceAll("_", " ");
  return channel ? `${what}, ${describe(channel).label}` : what;
}
