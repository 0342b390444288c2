#![doc = include_str!("../cvsim6.md")]

mod lanes;

use nalgebra::{SMatrix, SVector};

use super::capacitance::{Activation, Capacitance, ValueAndRate};
use super::{Cycle, Extent, InductancePath, Model, ParameterInfo, Quantity, Transform};
use crate::named_vector;

/// Pascals-in-cgs per mmHg: the literature states CVSim-6 in Ba, the program computes in mmHg.
const BA_PER_MMHG: f64 = 1333.22;

/// Systolic fraction of the cycle in the eight balances of the initial pressures.
const BALANCE_SYSTOLIC_FRACTION: f64 = 0.33;

named_vector! {
    /// Pressures \[mmHg\].
    Pressures,
    /// Position of a pressure in the state vector.
    State {
        /// Left ventricle.
        p_l: L,
        /// Systemic arteries.
        p_a: A,
        /// Systemic veins.
        p_v: V,
        /// Right ventricle.
        p_r: R,
        /// Pulmonary arteries.
        p_pa: Pa,
        /// Pulmonary veins.
        p_pv: Pv,
    }
}

named_vector! {
    /// Flows \[mL/s\] and volumes \[mL\].
    FlowsAndVolumes,
    /// Position of a flow or volume in the vector of derived quantities.
    Derived {
        /// Flow into the left ventricle.
        q_li: QLi,
        /// Flow out of the left ventricle.
        q_lo: QLo,
        /// Systemic flow.
        q_a: QA,
        /// Flow into the right ventricle.
        q_ri: QRi,
        /// Flow out of the right ventricle.
        q_ro: QRo,
        /// Pulmonary flow.
        q_pv: QPv,
        /// Volume of the left ventricle.
        v_l: VL,
        /// Volume of the systemic arteries.
        v_a: VA,
        /// Volume of the systemic veins.
        v_v: VV,
        /// Volume of the right ventricle.
        v_r: VR,
        /// Volume of the pulmonary arteries.
        v_pa: VPa,
        /// Volume of the pulmonary veins.
        v_pv: VPv,
    }
}

named_vector! {
    /// Parameters; units in [`PARAMETERS`].
    Parameters,
    /// Position of a parameter in the parameter vector.
    Parameter {
        /// Heart rate \[bpm\].
        heart_rate: HeartRate,
        /// Systolic time; its unit depends on the [`SystoleRule`].
        systole: Systole,
        /// Intrathoracic pressure \[mmHg\].
        p_th: PTh,
        /// Diastolic capacitance of the left ventricle \[mL/mmHg\].
        c_l_dia: CLDia,
        /// Systolic capacitance of the left ventricle \[mL/mmHg\].
        c_l_sys: CLSys,
        /// Capacitance of the systemic arteries \[mL/mmHg\].
        c_a: CA,
        /// Capacitance of the systemic veins \[mL/mmHg\].
        c_v: CV,
        /// Diastolic capacitance of the right ventricle \[mL/mmHg\].
        c_r_dia: CRDia,
        /// Systolic capacitance of the right ventricle \[mL/mmHg\].
        c_r_sys: CRSys,
        /// Capacitance of the pulmonary arteries \[mL/mmHg\].
        c_pa: CPa,
        /// Capacitance of the pulmonary veins \[mL/mmHg\].
        c_pv: CPv,
        /// Resistance of the left inlet (mitral) \[mmHg s/mL\].
        r_li: RLi,
        /// Resistance of the left outlet (aortic) \[mmHg s/mL\].
        r_lo: RLo,
        /// Systemic resistance \[mmHg s/mL\].
        r_a: RA,
        /// Resistance of the right inlet (tricuspid) \[mmHg s/mL\].
        r_ri: RRi,
        /// Resistance of the right outlet (pulmonary valve) \[mmHg s/mL\].
        r_ro: RRo,
        /// Pulmonary resistance \[mmHg s/mL\].
        r_pv: RPv,
        /// Unstressed volume of the left ventricle \[mL\].
        v0_l: V0L,
        /// Unstressed volume of the systemic arteries \[mL\].
        v0_a: V0A,
        /// Unstressed volume of the systemic veins \[mL\].
        v0_v: V0V,
        /// Unstressed volume of the right ventricle \[mL\].
        v0_r: V0R,
        /// Unstressed volume of the pulmonary arteries \[mL\].
        v0_pa: V0Pa,
        /// Unstressed volume of the pulmonary veins \[mL\].
        v0_pv: V0Pv,
        /// Total blood volume \[mL\]; enters only the initial pressures.
        blood_volume: BloodVolume,
        /// Beats since event time 0 at the start of the window; a beat begins at every integer. The clock parameter.
        beat_phase: BeatPhase,
        /// What the flow into the left ventricle lacks \[mL/s\].
        delta_q_li: DeltaQLi,
        /// What the flow out of the left ventricle lacks \[mL/s\].
        delta_q_lo: DeltaQLo,
        /// What the systemic flow lacks \[mL/s\].
        delta_q_a: DeltaQA,
        /// What the flow into the right ventricle lacks \[mL/s\].
        delta_q_ri: DeltaQRi,
        /// What the flow out of the right ventricle lacks \[mL/s\].
        delta_q_ro: DeltaQRo,
        /// What the pulmonary flow lacks \[mL/s\].
        delta_q_pv: DeltaQPv,
        /// What `dP_l/dt` lacks \[mmHg/s\].
        delta_p_l: DeltaPL,
        /// What `dP_a/dt` lacks \[mmHg/s\].
        delta_p_a: DeltaPA,
        /// What `dP_v/dt` lacks \[mmHg/s\].
        delta_p_v: DeltaPV,
        /// What `dP_r/dt` lacks \[mmHg/s\].
        delta_p_r: DeltaPR,
        /// What `dP_pa/dt` lacks \[mmHg/s\].
        delta_p_pa: DeltaPPa,
        /// What `dP_pv/dt` lacks \[mmHg/s\].
        delta_p_pv: DeltaPPv,
    }
}

/// The states: six pressures.
pub const STATES: &[Quantity] = &[mmhg("p_l"), mmhg("p_a"), mmhg("p_v"), mmhg("p_r"), mmhg("p_pa"), mmhg("p_pv")];

/// What states and parameters give: six flows, six volumes.
pub const DERIVED: &[Quantity] = &[
    flow("q_li"),
    flow("q_lo"),
    flow("q_a"),
    flow("q_ri"),
    flow("q_ro"),
    flow("q_pv"),
    volume("v_l"),
    volume("v_a"),
    volume("v_v"),
    volume("v_r"),
    volume("v_pa"),
    volume("v_pv"),
];

/// Of the left ventricle and the two circulations, then of each pressure.
const CLINICAL: &[Quantity] = &[
    Quantity { name: "heart_rate", unit: "bpm" },
    Quantity { name: "stroke_volume", unit: "mL" },
    Quantity { name: "cardiac_output", unit: "L/min" },
    Quantity { name: "ejection_fraction", unit: "" },
    Quantity { name: "svr", unit: "mmHg s/mL" },
    Quantity { name: "pvr", unit: "mmHg s/mL" },
    mmhg("p_l_systolic"),
    mmhg("p_l_diastolic"),
    mmhg("p_l_mean"),
    mmhg("p_a_systolic"),
    mmhg("p_a_diastolic"),
    mmhg("p_a_mean"),
    mmhg("p_v_systolic"),
    mmhg("p_v_diastolic"),
    mmhg("p_v_mean"),
    mmhg("p_r_systolic"),
    mmhg("p_r_diastolic"),
    mmhg("p_r_mean"),
    mmhg("p_pa_systolic"),
    mmhg("p_pa_diastolic"),
    mmhg("p_pa_mean"),
    mmhg("p_pv_systolic"),
    mmhg("p_pv_diastolic"),
    mmhg("p_pv_mean"),
];

/// The parameter table: defaults of the paper, converted from Ba to mmHg.
pub const PARAMETERS: &[ParameterInfo] = &[
    ParameterInfo {
        name: "heart_rate",
        unit: "bpm",
        default: 72.0,
        bounds: (20.0, 300.0),
        transform: Transform::Log,
        estimable: true,
    },
    ParameterInfo {
        name: "systole",
        unit: "s, fraction or s^0.5",
        default: 0.33,
        bounds: (0.02, 0.66),
        transform: Transform::Log,
        estimable: true,
    },
    ParameterInfo {
        name: "p_th",
        unit: "mmHg",
        default: -4.0,
        bounds: (-40.0, 40.0),
        transform: Transform::Linear { scale: 4.0 },
        estimable: true,
    },
    capacitance("c_l_dia", 7.50e-3),
    capacitance("c_l_sys", 3.00e-4),
    capacitance("c_a", 1.20e-3),
    capacitance("c_v", 7.50e-2),
    capacitance("c_r_dia", 1.50e-2),
    capacitance("c_r_sys", 9.00e-4),
    capacitance("c_pa", 3.23e-3),
    capacitance("c_pv", 6.30e-3),
    resistance("r_li", 13.33),
    resistance("r_lo", 8.00),
    resistance("r_a", 1333.22),
    resistance("r_ri", 66.66),
    resistance("r_ro", 4.00),
    resistance("r_pv", 106.66),
    fixed_volume("v0_l", 15.0),
    fixed_volume("v0_a", 715.0),
    fixed_volume("v0_v", 2500.0),
    fixed_volume("v0_r", 15.0),
    fixed_volume("v0_pa", 90.0),
    fixed_volume("v0_pv", 490.0),
    fixed_volume("blood_volume", 5000.0),
    ParameterInfo {
        name: "beat_phase",
        unit: "beats",
        default: 0.0,
        bounds: (-1e9, 1e9),
        transform: Transform::Linear { scale: 1.0 },
        estimable: true,
    },
    missing_flow("delta_q_li"),
    missing_flow("delta_q_lo"),
    missing_flow("delta_q_a"),
    missing_flow("delta_q_ri"),
    missing_flow("delta_q_ro"),
    missing_flow("delta_q_pv"),
    missing_rate("delta_p_l"),
    missing_rate("delta_p_a"),
    missing_rate("delta_p_v"),
    missing_rate("delta_p_r"),
    missing_rate("delta_p_pa"),
    missing_rate("delta_p_pv"),
];

const fn mmhg(name: &'static str) -> Quantity {
    Quantity { name, unit: "mmHg" }
}

const fn flow(name: &'static str) -> Quantity {
    Quantity { name, unit: "mL/s" }
}

const fn volume(name: &'static str) -> Quantity {
    Quantity { name, unit: "mL" }
}

const fn capacitance(name: &'static str, ml_per_ba: f64) -> ParameterInfo {
    let default = ml_per_ba * BA_PER_MMHG;
    let bounds = (default * 1e-2, default * 1e2);
    ParameterInfo { name, unit: "mL/mmHg", default, bounds, transform: Transform::Log, estimable: true }
}

const fn resistance(name: &'static str, ba_s_per_ml: f64) -> ParameterInfo {
    let default = ba_s_per_ml / BA_PER_MMHG;
    let bounds = (default * 1e-2, default * 1e2);
    ParameterInfo { name, unit: "mmHg s/mL", default, bounds, transform: Transform::Log, estimable: true }
}

const fn missing_flow(name: &'static str) -> ParameterInfo {
    ParameterInfo::missing(name, "mL/s", 10.0, 1e4)
}

const fn missing_rate(name: &'static str) -> ParameterInfo {
    ParameterInfo::missing(name, "mmHg/s", 1.0, 1e5)
}

const fn fixed_volume(name: &'static str, default: f64) -> ParameterInfo {
    ParameterInfo { name, unit: "mL", default, bounds: (0.0, 20_000.0), transform: Transform::Log, estimable: false }
}

/// What the parameter `systole` means.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum SystoleRule {
    /// `Ts = systole` \[s\].
    #[default]
    Seconds,
    /// `Ts = systole * T`.
    Fraction,
    /// `Ts = systole * sqrt(T)`, systole in s^0.5 (Bazett; 0.3 in CVSim).
    Bazett,
}

/// Law of the pulmonary resistance.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum PulmonaryResistance {
    /// `Q_pv = (P_pa - P_pv) / r_pv`.
    #[default]
    Linear,
    /// `r_pv` rises with the flow, see the module documentation.
    Nonlinear,
}

/// CVSim-6. The choices of law are fields; all numbers are parameters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Cvsim6 {
    /// Meaning of the parameter `systole`.
    pub systole: SystoleRule,
    /// Law of the pulmonary resistance.
    pub pulmonary_resistance: PulmonaryResistance,
}

/// Where in the beat a moment is, with derivatives by what determines it.
#[derive(Debug, Clone, Copy)]
struct BeatTime {
    /// Time since the beat began \[s\].
    time_s: f64,
    /// Cycle length \[s\].
    cycle_s: f64,
    /// `d time_s / d heart_rate`.
    by_heart_rate: f64,
    /// Systolic time \[s\].
    systole_s: f64,
    /// `d systole_s / d systole`.
    systole_by_parameter: f64,
    /// `d systole_s / d heart_rate`.
    systole_by_heart_rate: f64,
}

/// A flow and its derivatives by the pressures upstream and downstream and by its resistance.
#[derive(Debug, Clone, Copy)]
struct Flow {
    value: f64,
    conductance: f64,
    by_resistance: f64,
}

impl Flow {
    fn through(upstream: f64, downstream: f64, resistance: f64) -> Self {
        let conductance = 1.0 / resistance;
        let value = (upstream - downstream) * conductance;
        Self { value, conductance, by_resistance: -value * conductance }
    }

    /// A valve: closed unless the upstream pressure is higher.
    fn through_valve(upstream: f64, downstream: f64, resistance: f64) -> Self {
        if upstream > downstream {
            Self::through(upstream, downstream, resistance)
        } else {
            Self { value: 0.0, conductance: 0.0, by_resistance: 0.0 }
        }
    }

    /// With what the flow lacks.
    fn plus(self, missing: f64) -> Self {
        Self { value: self.value + missing, ..self }
    }

    /// Through the nonlinear pulmonary resistance `R(Q) = scale * table(Q)`.
    fn through_table(upstream: f64, downstream: f64, r_pv: f64) -> Self {
        let scale = r_pv / PARAMETERS[Parameter::RPv as usize].default;
        // Knots of (flow [mL/s], resistance [mmHg s/mL]).
        let knots = [(0.12, 13.0), (5.8, 104.9), (19.8, 327.8)]
            .map(|(l_per_min, ba)| (l_per_min * 1000.0 / 60.0, ba / BA_PER_MMHG));
        let drop = (upstream - downstream) / scale;
        let ((q_first, r_first), (q_last, r_last)) = (knots[0], knots[2]);
        // With y = drop/scale, `Q table(Q) = y`: dQ/dy = 1/(table + Q table').
        let (q, dq_dy) = if drop <= q_first * r_first {
            (drop / r_first, 1.0 / r_first)
        } else if drop >= q_last * r_last {
            (drop / r_last, 1.0 / r_last)
        } else {
            let segment = usize::from(drop > knots[1].0 * knots[1].1);
            let ((q0, r0), (q1, r1)) = (knots[segment], knots[segment + 1]);
            let slope = (r1 - r0) / (q1 - q0);
            let b = r0 - slope * q0;
            let root = (b * b + 4.0 * slope * drop).sqrt();
            ((root - b) / (2.0 * slope), 1.0 / root)
        };
        Self { value: q, conductance: dq_dy / scale, by_resistance: -dq_dy * drop / r_pv }
    }
}

/// All six flows.
struct Flows {
    li: Flow,
    lo: Flow,
    a: Flow,
    ri: Flow,
    ro: Flow,
    pv: Flow,
}

/// Everything `f` needs at one moment.
struct Moment {
    p: Pressures,
    theta: Parameters,
    beat: BeatTime,
    c_l: Capacitance,
    c_r: Capacitance,
    q: Flows,
}

impl Moment {
    /// `f`: the balances, and what they lack.
    fn rhs(&self) -> Pressures {
        let (balance, theta) = (self.balances(), &self.theta);
        Pressures {
            p_l: balance.p_l + theta.delta_p_l,
            p_a: balance.p_a + theta.delta_p_a,
            p_v: balance.p_v + theta.delta_p_v,
            p_r: balance.p_r + theta.delta_p_r,
            p_pa: balance.p_pa + theta.delta_p_pa,
            p_pv: balance.p_pv + theta.delta_p_pv,
        }
    }

    /// The balances of the compartments, row by row.
    fn balances(&self) -> Pressures {
        let Self { p, theta, c_l, c_r, q, .. } = self;
        let (c_l, c_r) = (c_l.value_and_rate(), c_r.value_and_rate());
        Pressures {
            p_l: (q.li.value - q.lo.value - (p.p_l - theta.p_th) * c_l.rate) / c_l.value,
            p_a: (q.lo.value - q.a.value) / theta.c_a,
            p_v: (q.a.value - q.ri.value) / theta.c_v,
            p_r: (q.ri.value - q.ro.value - (p.p_r - theta.p_th) * c_r.rate) / c_r.value,
            p_pa: (q.ro.value - q.pv.value) / theta.c_pa,
            p_pv: (q.pv.value - q.li.value) / theta.c_pv,
        }
    }
}

impl Cvsim6 {
    fn beat_time(&self, t_s: f64, theta: &Parameters) -> BeatTime {
        self.time_in_beat(t_s, theta.heart_rate, theta.beat_phase, theta.systole)
    }

    fn time_in_beat(&self, t_s: f64, heart_rate: f64, beat_phase: f64, systole: f64) -> BeatTime {
        let cycle_s = 60.0 / heart_rate;
        let phase = beat_phase + t_s / cycle_s;
        let time_s = (phase - phase.floor()) * cycle_s;
        let (unit_s, by_heart_rate) = match self.systole {
            SystoleRule::Seconds => (1.0, 0.0),
            SystoleRule::Fraction => (cycle_s, -systole * cycle_s / heart_rate),
            SystoleRule::Bazett => (cycle_s.sqrt(), -0.5 * systole * cycle_s.sqrt() / heart_rate),
        };
        BeatTime {
            time_s,
            cycle_s,
            by_heart_rate: (t_s - time_s) / heart_rate,
            systole_s: systole * unit_s,
            systole_by_parameter: unit_s,
            systole_by_heart_rate: by_heart_rate,
        }
    }

    fn moment(&self, t_s: f64, x: &[f64], theta: &[f64]) -> Moment {
        let p = Pressures::from_slice(x);
        let theta = Parameters::from_slice(theta);
        let beat = self.beat_time(t_s, &theta);
        let activation = Activation::at(beat.time_s, beat.systole_s);
        let pulmonary = match self.pulmonary_resistance {
            PulmonaryResistance::Linear => Flow::through,
            PulmonaryResistance::Nonlinear => Flow::through_table,
        };
        Moment {
            p,
            theta,
            beat,
            c_l: Capacitance::new(activation, theta.c_l_dia, theta.c_l_sys),
            c_r: Capacitance::new(activation, theta.c_r_dia, theta.c_r_sys),
            q: Flows {
                li: Flow::through_valve(p.p_pv, p.p_l, theta.r_li).plus(theta.delta_q_li),
                lo: Flow::through_valve(p.p_l, p.p_a, theta.r_lo).plus(theta.delta_q_lo),
                a: Flow::through(p.p_a, p.p_v, theta.r_a).plus(theta.delta_q_a),
                ri: Flow::through_valve(p.p_v, p.p_r, theta.r_ri).plus(theta.delta_q_ri),
                ro: Flow::through_valve(p.p_r, p.p_pa, theta.r_ro).plus(theta.delta_q_ro),
                pv: pulmonary(p.p_pa, p.p_pv, theta.r_pv).plus(theta.delta_q_pv),
            },
        }
    }

    /// Initial pressures from the eight cycle-averaged balances; `None` if they have no solution.
    #[must_use]
    pub fn initial_pressures(theta: &[f64]) -> Option<Vec<f64>> {
        let theta = Parameters::from_slice(theta);
        let cycle = 60.0 / theta.heart_rate;
        let systole = BALANCE_SYSTOLIC_FRACTION * cycle;
        let diastole = cycle - systole;

        // Unknowns: P_l,dia, P_l,sys, P_a, P_v, P_r,dia, P_r,sys, P_pa, P_pv.
        let [l_dia, l_sys, a, v, r_dia, r_sys, pa, pv] = [0, 1, 2, 3, 4, 5, 6, 7];
        let mut m = SMatrix::<f64, 8, 8>::zeros();
        let mut b = SVector::<f64, 8>::zeros();
        // Every row: SV of the left ventricle minus something that equals it.
        let offset = (theta.c_l_dia - theta.c_l_sys) * theta.p_th;
        for row in 0..7 {
            m[(row, l_dia)] += theta.c_l_dia;
            m[(row, l_sys)] -= theta.c_l_sys;
            b[row] += offset;
        }
        m[(0, r_dia)] -= theta.c_r_dia;
        m[(0, r_sys)] += theta.c_r_sys;
        b[0] -= (theta.c_r_dia - theta.c_r_sys) * theta.p_th;
        let transfers = [
            (l_sys, a, systole / theta.r_lo),
            (a, v, cycle / theta.r_a),
            (v, r_dia, diastole / theta.r_ri),
            (r_sys, pa, systole / theta.r_ro),
            (pa, pv, cycle / theta.r_pv),
            (pv, l_dia, diastole / theta.r_li),
        ];
        for (row, (from, to, factor)) in (1..).zip(transfers) {
            m[(row, from)] -= factor;
            m[(row, to)] += factor;
        }
        // Total volume at the end of diastole.
        let unstressed = theta.v0_l + theta.v0_a + theta.v0_v + theta.v0_r + theta.v0_pa + theta.v0_pv;
        let stores = [
            (l_dia, theta.c_l_dia, theta.p_th),
            (a, theta.c_a, theta.p_th / 3.0),
            (v, theta.c_v, 0.0),
            (r_dia, theta.c_r_dia, theta.p_th),
            (pa, theta.c_pa, theta.p_th),
            (pv, theta.c_pv, theta.p_th),
        ];
        b[7] = theta.blood_volume - unstressed;
        for (column, c, reference) in stores {
            m[(7, column)] = c;
            b[7] += c * reference;
        }
        let s = m.lu().solve(&b)?;
        let p = Pressures { p_l: s[l_dia], p_a: s[a], p_v: s[v], p_r: s[r_dia], p_pa: s[pa], p_pv: s[pv] };
        let values = p.to_vec();
        values.iter().all(|v| v.is_finite()).then_some(values)
    }
}

impl Model for Cvsim6 {
    type Lanes = Self;

    fn lanes(&self) -> Option<Self> {
        Some(*self)
    }

    fn states(&self) -> &[Quantity] {
        STATES
    }

    fn parameters(&self) -> &[ParameterInfo] {
        PARAMETERS
    }

    fn derived(&self) -> &[Quantity] {
        DERIVED
    }

    fn rhs(&self, t_s: f64, x: &[f64], theta: &[f64], dx: &mut [f64]) {
        self.moment(t_s, x, theta).rhs().write_to(dx);
    }

    fn rhs_and_state_jacobian(&self, t_s: f64, x: &[f64], theta: &[f64], dx: &mut [f64], dfdx: &mut [f64]) {
        use State::{A, L, Pa, Pv, R, V};
        let moment = self.moment(t_s, x, theta);
        moment.rhs().write_to(dx);

        let Moment { theta, c_l, c_r, q, .. } = &moment;
        let (c_l, c_r) = (c_l.value_and_rate(), c_r.value_and_rate());
        let dfdx = &mut dfdx[..Pressures::LEN * Pressures::LEN];
        dfdx.fill(0.0);
        let capacity = |s: State| match s {
            L => c_l.value,
            A => theta.c_a,
            V => theta.c_v,
            R => c_r.value,
            Pa => theta.c_pa,
            Pv => theta.c_pv,
        };
        // A flow leaves one compartment and enters the next; both rows feel both pressures.
        let ring = [(&q.li, Pv, L), (&q.lo, L, A), (&q.a, A, V), (&q.ri, V, R), (&q.ro, R, Pa), (&q.pv, Pa, Pv)];
        for (flow, from, to) in ring {
            let (from_gain, to_gain) = (flow.conductance / capacity(from), flow.conductance / capacity(to));
            let at = |row: State, column: State| row as usize * Pressures::LEN + column as usize;
            dfdx[at(from, from)] -= from_gain;
            dfdx[at(from, to)] += from_gain;
            dfdx[at(to, from)] += to_gain;
            dfdx[at(to, to)] -= to_gain;
        }
        dfdx[L as usize * Pressures::LEN + L as usize] -= c_l.rate / c_l.value;
        dfdx[R as usize * Pressures::LEN + R as usize] -= c_r.rate / c_r.value;
    }

    fn parameter_jacobian(&self, t_s: f64, x: &[f64], theta: &[f64], which: &[usize], dfdtheta: &mut [f64]) {
        let moment = self.moment(t_s, x, theta);
        let f = moment.balances();
        let width = which.len();
        for (column, &p) in which.iter().enumerate() {
            let d = moment.rhs_by_parameter(&f, p);
            let rows = [d.p_l, d.p_a, d.p_v, d.p_r, d.p_pa, d.p_pv];
            for (row, value) in rows.into_iter().enumerate() {
                dfdtheta[row * width + column] = value;
            }
        }
    }

    fn derive(&self, t_s: f64, x: &[f64], theta: &[f64], out: &mut [f64]) {
        let Moment { p, theta, c_l, c_r, q, .. } = self.moment(t_s, x, theta);
        FlowsAndVolumes {
            q_li: q.li.value,
            q_lo: q.lo.value,
            q_a: q.a.value,
            q_ri: q.ri.value,
            q_ro: q.ro.value,
            q_pv: q.pv.value,
            v_l: theta.v0_l + (p.p_l - theta.p_th) * c_l.value_and_rate().value,
            v_a: theta.v0_a + (p.p_a - theta.p_th / 3.0) * theta.c_a,
            v_v: theta.v0_v + p.p_v * theta.c_v,
            v_r: theta.v0_r + (p.p_r - theta.p_th) * c_r.value_and_rate().value,
            v_pa: theta.v0_pa + (p.p_pa - theta.p_th) * theta.c_pa,
            v_pv: theta.v0_pv + (p.p_pv - theta.p_th) * theta.c_pv,
        }
        .write_to(out);
    }

    fn inductance_path(&self, parameter: usize) -> Option<InductancePath> {
        let path = |from: State, to: State, resistance: Parameter| {
            Some(InductancePath { from: from as usize, to: to as usize, resistance: resistance as usize })
        };
        // Through a closed valve nothing flows, whatever its inertia: only the open vessels have one.
        if parameter == Parameter::DeltaQA as usize {
            path(State::A, State::V, Parameter::RA)
        } else if parameter == Parameter::DeltaQPv as usize {
            path(State::Pa, State::Pv, Parameter::RPv)
        } else {
            None
        }
    }

    fn advance(&self, dt_s: f64, theta: &mut [f64]) {
        let rate = theta[Parameter::HeartRate as usize] / 60.0;
        // Not wrapped: the spread of the phase over an ensemble must not jump at the onset of a beat.
        theta[Parameter::BeatPhase as usize] += dt_s * rate;
    }

    fn set_clock(&self, phase: f64, x: &mut [f64], theta: &mut [f64]) {
        let capacitances = |theta: &[f64]| {
            let moment = self.moment(0.0, &[0.0; Pressures::LEN], theta);
            (moment.c_l.value_and_rate().value, moment.c_r.value_and_rate().value)
        };
        let before = capacitances(theta);
        theta[Parameter::BeatPhase as usize] = phase;
        let after = capacitances(theta);
        let p_th = theta[Parameter::PTh as usize];
        // The blood in the ventricles stays where it is.
        for (state, before, after) in [(State::L, before.0, after.0), (State::R, before.1, after.1)] {
            let pressure = &mut x[state as usize];
            *pressure = p_th + (*pressure - p_th) * before / after;
        }
    }

    fn cycle(&self) -> Option<Cycle> {
        Some(Cycle { rate: Parameter::HeartRate as usize, phase: Parameter::BeatPhase as usize })
    }

    fn clinical(&self) -> &[Quantity] {
        CLINICAL
    }

    fn read_cycle(&self, duration_s: f64, theta: &[f64], states: &[Extent], derived: &[Extent], out: &mut [f64]) {
        let drop = |from: State, to: State| states[from as usize].mean - states[to as usize].mean;
        // What left the arteries and what they kept: in the model the same as what the ventricle put out, and right
        // also where data had to correct a model that does not fit.
        let kept = theta[Parameter::CA as usize] * states[State::A as usize].change / duration_s;
        let flow = derived[Derived::QA as usize].mean + kept;
        let volume = derived[Derived::VL as usize];
        out[0] = 60.0 / duration_s;
        out[1] = flow * duration_s;
        out[2] = flow * 60.0 / 1000.0;
        out[3] = (volume.max - volume.min) / volume.max;
        out[4] = drop(State::A, State::V) / flow;
        out[5] = drop(State::Pa, State::Pv) / flow;
        for (out, pressure) in out[6..].chunks_exact_mut(3).zip(states) {
            out.copy_from_slice(&[pressure.max, pressure.min, pressure.mean]);
        }
    }

    fn next_corner(&self, t_s: f64, until_s: f64, theta: &[f64]) -> Option<f64> {
        let beat = self.beat_time(t_s, &Parameters::from_slice(theta));
        // A corner closer than this is the one we stand on.
        let nearest = 1e-9;
        [beat.systole_s, 1.5 * beat.systole_s, beat.cycle_s]
            .into_iter()
            .filter(|&corner| corner <= beat.cycle_s)
            .map(|corner| t_s + corner - beat.time_s)
            .filter(|&t| t > t_s + nearest && t < until_s - nearest)
            .min_by(f64::total_cmp)
    }
}

impl Moment {
    /// The column of `df/dtheta` that belongs to one parameter; `f` are the balances.
    fn rhs_by_parameter(&self, f: &Pressures, parameter: usize) -> Pressures {
        use Parameter as P;
        let zero = Pressures { p_l: 0.0, p_a: 0.0, p_v: 0.0, p_r: 0.0, p_pa: 0.0, p_pv: 0.0 };
        let Self { theta, q, .. } = self;
        let (c_l, c_r) = (self.c_l.value_and_rate().value, self.c_r.value_and_rate().value);
        let is = |p: Parameter| parameter == p as usize;

        if is(P::HeartRate) {
            self.by_timing(f, self.beat.by_heart_rate, self.beat.systole_by_heart_rate)
        } else if is(P::Systole) {
            self.by_timing(f, 0.0, self.beat.systole_by_parameter)
        } else if is(P::BeatPhase) {
            self.by_timing(f, self.beat.cycle_s, 0.0)
        } else if is(P::PTh) {
            let (l, r) = (self.c_l.value_and_rate(), self.c_r.value_and_rate());
            Pressures { p_l: l.rate / l.value, p_r: r.rate / r.value, ..zero }
        } else if is(P::CLDia) {
            Pressures { p_l: self.left_by(f, self.c_l.by_diastolic()), ..zero }
        } else if is(P::CLSys) {
            Pressures { p_l: self.left_by(f, self.c_l.by_systolic()), ..zero }
        } else if is(P::CRDia) {
            Pressures { p_r: self.right_by(f, self.c_r.by_diastolic()), ..zero }
        } else if is(P::CRSys) {
            Pressures { p_r: self.right_by(f, self.c_r.by_systolic()), ..zero }
        } else if is(P::CA) {
            Pressures { p_a: -f.p_a / theta.c_a, ..zero }
        } else if is(P::CV) {
            Pressures { p_v: -f.p_v / theta.c_v, ..zero }
        } else if is(P::CPa) {
            Pressures { p_pa: -f.p_pa / theta.c_pa, ..zero }
        } else if is(P::CPv) {
            Pressures { p_pv: -f.p_pv / theta.c_pv, ..zero }
        } else if is(P::RLi) {
            Pressures { p_pv: -q.li.by_resistance / theta.c_pv, p_l: q.li.by_resistance / c_l, ..zero }
        } else if is(P::RLo) {
            Pressures { p_l: -q.lo.by_resistance / c_l, p_a: q.lo.by_resistance / theta.c_a, ..zero }
        } else if is(P::RA) {
            Pressures { p_a: -q.a.by_resistance / theta.c_a, p_v: q.a.by_resistance / theta.c_v, ..zero }
        } else if is(P::RRi) {
            Pressures { p_v: -q.ri.by_resistance / theta.c_v, p_r: q.ri.by_resistance / c_r, ..zero }
        } else if is(P::RRo) {
            Pressures { p_r: -q.ro.by_resistance / c_r, p_pa: q.ro.by_resistance / theta.c_pa, ..zero }
        } else if is(P::RPv) {
            Pressures { p_pa: -q.pv.by_resistance / theta.c_pa, p_pv: q.pv.by_resistance / theta.c_pv, ..zero }
        } else {
            self.rhs_by_missing(parameter)
        }
    }

    /// The same for what flows and balances lack.
    fn rhs_by_missing(&self, parameter: usize) -> Pressures {
        use Parameter as P;
        let zero = Pressures { p_l: 0.0, p_a: 0.0, p_v: 0.0, p_r: 0.0, p_pa: 0.0, p_pv: 0.0 };
        let theta = &self.theta;
        let (c_l, c_r) = (self.c_l.value_and_rate().value, self.c_r.value_and_rate().value);
        let is = |p: Parameter| parameter == p as usize;

        if is(P::DeltaQLi) {
            Pressures { p_pv: -1.0 / theta.c_pv, p_l: 1.0 / c_l, ..zero }
        } else if is(P::DeltaQLo) {
            Pressures { p_l: -1.0 / c_l, p_a: 1.0 / theta.c_a, ..zero }
        } else if is(P::DeltaQA) {
            Pressures { p_a: -1.0 / theta.c_a, p_v: 1.0 / theta.c_v, ..zero }
        } else if is(P::DeltaQRi) {
            Pressures { p_v: -1.0 / theta.c_v, p_r: 1.0 / c_r, ..zero }
        } else if is(P::DeltaQRo) {
            Pressures { p_r: -1.0 / c_r, p_pa: 1.0 / theta.c_pa, ..zero }
        } else if is(P::DeltaQPv) {
            Pressures { p_pa: -1.0 / theta.c_pa, p_pv: 1.0 / theta.c_pv, ..zero }
        } else if is(P::DeltaPL) {
            Pressures { p_l: 1.0, ..zero }
        } else if is(P::DeltaPA) {
            Pressures { p_a: 1.0, ..zero }
        } else if is(P::DeltaPV) {
            Pressures { p_v: 1.0, ..zero }
        } else if is(P::DeltaPR) {
            Pressures { p_r: 1.0, ..zero }
        } else if is(P::DeltaPPa) {
            Pressures { p_pa: 1.0, ..zero }
        } else if is(P::DeltaPPv) {
            Pressures { p_pv: 1.0, ..zero }
        } else {
            zero
        }
    }

    /// Change of `f` when the time in the beat and the systolic time change.
    fn by_timing(&self, f: &Pressures, beat_time: f64, systole: f64) -> Pressures {
        let combine = |c: &Capacitance| {
            let (t, s) = (c.by_time(), c.by_systolic_time());
            ValueAndRate { value: t.value * beat_time + s.value * systole, rate: t.rate * beat_time + s.rate * systole }
        };
        Pressures {
            p_l: self.left_by(f, combine(&self.c_l)),
            p_a: 0.0,
            p_v: 0.0,
            p_r: self.right_by(f, combine(&self.c_r)),
            p_pa: 0.0,
            p_pv: 0.0,
        }
    }

    /// Change of `dP_l/dt` when `C_l` and `dC_l/dt` change by `d`.
    fn left_by(&self, f: &Pressures, d: ValueAndRate) -> f64 {
        -((self.p.p_l - self.theta.p_th) * d.rate + f.p_l * d.value) / self.c_l.value_and_rate().value
    }

    /// Change of `dP_r/dt` when `C_r` and `dC_r/dt` change by `d`.
    fn right_by(&self, f: &Pressures, d: ValueAndRate) -> f64 {
        -((self.p.p_r - self.theta.p_th) * d.rate + f.p_r * d.value) / self.c_r.value_and_rate().value
    }
}
