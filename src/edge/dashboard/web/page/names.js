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
