//! The equations for eight members at once.

use std::f64::consts::PI;

use super::{Cvsim6, Parameter, PulmonaryResistance, SystoleRule};
use crate::model::lanes::{LaneModel, Lanes};

/// What does not change over a window.
#[derive(Debug, Clone, Copy, Default)]
pub struct Fixed {
    clock: Clock,
    left: Swing,
    right: Swing,
    /// `1/R` of the flows li, lo, a, ri, ro, pv.
    conductances: [Lanes; 6],
    /// `1/C` of the compartments a, v, pa, pv.
    elastances: [Lanes; 4],
    p_th: Lanes,
}

/// Of the flows, in their order.
const RESISTANCES: [Parameter; 6] =
    [Parameter::RLi, Parameter::RLo, Parameter::RA, Parameter::RRi, Parameter::RRo, Parameter::RPv];

/// Of the compartments that are no ventricles, in their order.
const CAPACITANCES: [Parameter; 4] = [Parameter::CA, Parameter::CV, Parameter::CPa, Parameter::CPv];

/// When a member's heart beats.
#[derive(Debug, Clone, Copy, Default)]
struct Clock {
    /// Beats since event time 0 at the start of the window.
    phase: Lanes,
    /// Beats per second, and its inverse.
    rate_hz: Lanes,
    cycle_s: Lanes,
    systole_s: Lanes,
    /// `d systole_s / d systole`
    unit_s: Lanes,
    /// `1/systole_s`
    per_systole: Lanes,
}

/// What the elastance of a ventricle is between: at rest, and half of what it rises by.
#[derive(Debug, Clone, Copy, Default)]
struct Swing {
    relaxed: Lanes,
    half: Lanes,
}

/// What the beat does to a ventricle at a moment, or the derivative of that.
#[derive(Debug, Clone, Copy, Default)]
struct Ventricle {
    /// `1/C`
    elastance: Lanes,
    /// `-(dC/dt)/C`
    stiffening: Lanes,
}

/// What depends on the time only.
#[derive(Debug, Clone, Copy, Default)]
pub struct Moment {
    left: Ventricle,
    right: Ventricle,
}

/// What a moment comes from.
#[derive(Debug, Clone, Copy, Default)]
pub struct Instant {
    activation: Activation,
    /// Since the beat began \[s\].
    time_s: Lanes,
    /// `1/C` of the ventricles, left and right, and the inverse of their product.
    elastances: [Lanes; 2],
    inverse: Lanes,
}

/// Conductances of the valves, 0 where they are closed.
#[derive(Debug, Clone, Copy, Default)]
pub struct Tangent {
    li: Lanes,
    lo: Lanes,
    ri: Lanes,
    ro: Lanes,
}

/// See [`crate::model::capacitance::Activation`].
#[derive(Debug, Clone, Copy, Default)]
struct Activation {
    value: Lanes,
    d_t: Lanes,
    d_tt: Lanes,
    d_ts: Lanes,
    d_t_ts: Lanes,
}

#[allow(clippy::inline_always)]
impl Cvsim6 {
    #[inline(always)]
    fn clock(&self, theta: &[Lanes]) -> Clock {
        let rate_hz = theta[Parameter::HeartRate as usize] / Lanes::splat(60.0);
        let cycle_s = Lanes::splat(1.0) / rate_hz;
        let unit_s = match self.systole {
            SystoleRule::Seconds => Lanes::splat(1.0),
            SystoleRule::Fraction => cycle_s,
            SystoleRule::Bazett => cycle_s.sqrt(),
        };
        let systole_s = theta[Parameter::Systole as usize] * unit_s;
        let per_systole = Lanes::splat(1.0) / systole_s;
        Clock { phase: theta[Parameter::BeatPhase as usize], rate_hz, cycle_s, systole_s, unit_s, per_systole }
    }
}

#[allow(clippy::inline_always)]
impl Clock {
    /// Time since the beat began \[s\], at `t_s` after the start of the window.
    #[inline(always)]
    fn time_in_beat(&self, t_s: f64) -> Lanes {
        let phase = self.phase + Lanes::splat(t_s) * self.rate_hz;
        (phase - phase.floor()) * self.cycle_s
    }
}

#[allow(clippy::inline_always)]
impl Activation {
    #[inline(always)]
    fn at(clock: &Clock, tr: Lanes) -> Self {
        let ts = clock.systole_s;
        let (zero, one, turn) = (Lanes::splat(0.0), Lanes::splat(1.0), Lanes::splat(2.0 * PI));
        // 1 -+ cos(u) with u = k tr + const, k proportional to 1/Ts.
        let falling = tr - ts;
        let sign = falling.choose(one, zero - one);
        let k = falling.choose(turn, Lanes::splat(PI)) * clock.per_systole;
        let (sin, cos) = (k * tr - falling.choose(turn, zero)).sin_cos();
        let (minus_sin, minus_cos) = (zero - sign * sin, zero - sign * cos);
        let k_ts = zero - k * clock.per_systole;
        let u_ts = k_ts * tr;
        let active = (tr - Lanes::splat(1.5) * ts).choose(zero, tr.choose(one, zero));
        Self {
            value: active.choose(one - minus_cos, zero),
            d_t: active.choose(k * minus_sin, zero),
            d_tt: active.choose(k * k * minus_cos, zero),
            d_ts: active.choose(u_ts * minus_sin, zero),
            d_t_ts: active.choose(k_ts * minus_sin + k * u_ts * minus_cos, zero),
        }
    }
}

#[allow(clippy::inline_always)]
impl Instant {
    /// Derivatives of a moment, from those of the elastances and of their rates.
    #[inline(always)]
    fn by(&self, fixed: &Fixed, elastances: [Lanes; 2], rates: [Lanes; 2]) -> Moment {
        let [l, r] = self.elastances;
        // `1/l` and `1/r` without another division.
        let (over_l, over_r) = (self.inverse * r, self.inverse * l);
        let stiffening =
            [fixed.left.half * self.activation.d_t * over_l, fixed.right.half * self.activation.d_t * over_r];
        Moment {
            left: Ventricle {
                elastance: elastances[0],
                stiffening: (rates[0] - stiffening[0] * elastances[0]) * over_l,
            },
            right: Ventricle {
                elastance: elastances[1],
                stiffening: (rates[1] - stiffening[1] * elastances[1]) * over_r,
            },
        }
    }
}

// Functions, not closures: only they can be made to end up in the code that is compiled for an instruction set.

#[allow(clippy::inline_always)]
#[inline(always)]
fn inverse(theta: &[Lanes], p: Parameter) -> Lanes {
    Lanes::splat(1.0) / theta[p as usize]
}

#[allow(clippy::inline_always)]
#[inline(always)]
fn swing(theta: &[Lanes], diastolic: Parameter, systolic: Parameter) -> Swing {
    let relaxed = inverse(theta, diastolic);
    Swing { relaxed, half: (inverse(theta, systolic) - relaxed) * Lanes::splat(0.5) }
}

/// A flow changes by `-Q/R` with its resistance.
#[allow(clippy::inline_always)]
#[inline(always)]
fn by_resistance(drop: Lanes, open: Lanes, conductance: Lanes, (from, to): (Lanes, Lanes)) -> Lanes {
    drop * open * conductance * (from - to)
}

/// A ventricle between two compartments in `(I - phi df/dx)`, solved for.
#[derive(Debug, Clone, Copy, Default)]
struct Around {
    /// Inverse entries of the neighbours, and of the ventricle once they are eliminated.
    neighbours: [Lanes; 2],
    ventricle: Lanes,
    /// What a neighbour does to the ventricle, over its own entry, and what the ventricle does to it.
    of_neighbour: [Lanes; 2],
    to_neighbour: [Lanes; 2],
}

/// What is around both ventricles, without the systemic and the pulmonary flow between the two sides, which are slow.
#[derive(Debug, Clone, Copy, Default)]
pub struct Relaxation {
    left: Around,
    right: Around,
}

#[allow(clippy::inline_always)]
impl Around {
    /// From a ventricle, its valves, and the elastances before and behind it.
    #[inline(always)]
    fn set(&mut self, ventricle: &Ventricle, phi: Lanes, valves: [Lanes; 2], elastances: [Lanes; 2]) {
        let (one, elastance) = (Lanes::splat(1.0), phi * ventricle.elastance);
        let of = [elastance * valves[0], elastance * valves[1]];
        let to = [phi * elastances[0] * valves[0], phi * elastances[1] * valves[1]];
        let own = one + of[0] + of[1] - phi * ventricle.stiffening;
        let (a, b) = (one + to[0], one + to[1]);
        // With the determinant, one division for all three.
        let whole = own * (a * b) - of[0] * to[0] * b - of[1] * to[1] * a;
        let inverse = one / (whole * (a * b));
        let (over_a, over_b) = (inverse * whole * b, inverse * whole * a);
        self.neighbours = [over_a, over_b];
        self.ventricle = inverse * (a * b) * (a * b);
        self.of_neighbour = [of[0] * over_a, of[1] * over_b];
        self.to_neighbour = [to[0] * over_a, to[1] * over_b];
    }

    #[inline(always)]
    fn solve(&self, own: Lanes, neighbours: [Lanes; 2], transposed: bool) -> (Lanes, [Lanes; 2]) {
        let (of, to) =
            if transposed { (self.to_neighbour, self.of_neighbour) } else { (self.of_neighbour, self.to_neighbour) };
        let middle = (own + of[0] * neighbours[0] + of[1] * neighbours[1]) * self.ventricle;
        let first = neighbours[0] * self.neighbours[0] + to[0] * middle;
        (middle, [first, neighbours[1] * self.neighbours[1] + to[1] * middle])
    }
}

#[allow(clippy::inline_always)]
impl LaneModel for Cvsim6 {
    type State = [Lanes; 6];
    type Fixed = Fixed;
    type Moment = Moment;
    type Instant = Instant;
    type Tangent = Tangent;
    type Relaxation = Relaxation;

    #[inline(always)]
    fn fixed(&self, theta: &[Lanes]) -> Option<Fixed> {
        let missing = &theta[Parameter::DeltaQLi as usize..=Parameter::DeltaPPv as usize];
        let mut lacking = Lanes::splat(0.0);
        for missing in missing {
            lacking = missing.abs().larger(lacking);
        }
        if !lacking.all_within(0.0) || self.pulmonary_resistance != PulmonaryResistance::Linear {
            return None;
        }
        let [r_li, r_lo, r_a, r_ri, r_ro, r_pv] = RESISTANCES;
        let [c_a, c_v, c_pa, c_pv] = CAPACITANCES;
        Some(Fixed {
            clock: self.clock(theta),
            left: swing(theta, Parameter::CLDia, Parameter::CLSys),
            right: swing(theta, Parameter::CRDia, Parameter::CRSys),
            conductances: [
                inverse(theta, r_li),
                inverse(theta, r_lo),
                inverse(theta, r_a),
                inverse(theta, r_ri),
                inverse(theta, r_ro),
                inverse(theta, r_pv),
            ],
            elastances: [inverse(theta, c_a), inverse(theta, c_v), inverse(theta, c_pa), inverse(theta, c_pv)],
            p_th: theta[Parameter::PTh as usize],
        })
    }

    #[inline(always)]
    fn change(&self, fixed: &mut Fixed, theta: &[Lanes], parameter: usize) {
        use Parameter as P;
        let is = |p: P| parameter == p as usize;
        if is(P::HeartRate) || is(P::Systole) || is(P::BeatPhase) {
            fixed.clock = self.clock(theta);
        } else if is(P::CLDia) || is(P::CLSys) {
            fixed.left = swing(theta, P::CLDia, P::CLSys);
        } else if is(P::CRDia) || is(P::CRSys) {
            fixed.right = swing(theta, P::CRDia, P::CRSys);
        } else if is(P::PTh) {
            fixed.p_th = theta[parameter];
        } else if let Some(k) = RESISTANCES.iter().position(|p| is(*p)) {
            fixed.conductances[k] = Lanes::splat(1.0) / theta[parameter];
        } else if let Some(k) = CAPACITANCES.iter().position(|p| is(*p)) {
            fixed.elastances[k] = Lanes::splat(1.0) / theta[parameter];
        }
    }

    #[inline(always)]
    fn instant(fixed: &Fixed, t_s: f64) -> Instant {
        let time_s = fixed.clock.time_in_beat(t_s);
        let activation = Activation::at(&fixed.clock, time_s);
        let (left, right) = (&fixed.left, &fixed.right);
        let (l, r) = (left.relaxed + left.half * activation.value, right.relaxed + right.half * activation.value);
        Instant { activation, time_s, elastances: [l, r], inverse: Lanes::splat(1.0) / (l * r) }
    }

    #[inline(always)]
    fn moment(fixed: &Fixed, instant: &Instant) -> Moment {
        let [l, r] = instant.elastances;
        let share = instant.activation.d_t * instant.inverse;
        Moment {
            left: Ventricle { elastance: l, stiffening: fixed.left.half * share * r },
            right: Ventricle { elastance: r, stiffening: fixed.right.half * share * l },
        }
    }

    fn is_timed(parameter: usize) -> bool {
        use Parameter as P;
        let timed = [P::HeartRate, P::Systole, P::BeatPhase, P::CLDia, P::CLSys, P::CRDia, P::CRSys];
        timed.into_iter().any(|p| p as usize == parameter)
    }

    #[inline(always)]
    fn moment_by(&self, fixed: &Fixed, (t_s, instant): (f64, &Instant), theta: &[Lanes], parameter: usize) -> Moment {
        use Parameter as P;
        let is = |p: P| parameter == p as usize;
        let (clock, Instant { activation, time_s, .. }) = (&fixed.clock, instant);
        let (zero, half) = (Lanes::splat(0.0), Lanes::splat(0.5));

        if is(P::HeartRate) || is(P::Systole) || is(P::BeatPhase) {
            let (time, systole) = if is(P::BeatPhase) {
                (clock.cycle_s, zero)
            } else if is(P::Systole) {
                (zero, clock.unit_s)
            } else {
                let per_rate = Lanes::splat(1.0) / theta[P::HeartRate as usize];
                let systole = match self.systole {
                    SystoleRule::Seconds => zero,
                    SystoleRule::Fraction => zero - clock.systole_s * per_rate,
                    SystoleRule::Bazett => zero - half * clock.systole_s * per_rate,
                };
                ((Lanes::splat(t_s) - *time_s) * per_rate, systole)
            };
            let value = activation.d_t * time + activation.d_ts * systole;
            let slope = activation.d_tt * time + activation.d_t_ts * systole;
            let (left, right) = (fixed.left.half, fixed.right.half);
            return instant.by(fixed, [left * value, right * value], [left * slope, right * slope]);
        }
        let c = theta[parameter];
        let (value, slope) = (half * activation.value / (c * c), half * activation.d_t / (c * c));
        let (value, slope) = if is(P::CLDia) || is(P::CRDia) {
            (value - Lanes::splat(1.0) / (c * c), slope)
        } else {
            (zero - value, zero - slope)
        };
        if is(P::CLDia) || is(P::CLSys) {
            instant.by(fixed, [value, zero], [slope, zero])
        } else {
            instant.by(fixed, [zero, value], [zero, slope])
        }
    }

    fn knows(&self, parameter: usize) -> bool {
        parameter < Parameter::DeltaQLi as usize
    }

    #[inline(always)]
    fn linearise(fixed: &Fixed, moment: &Moment, x: &[Lanes; 6]) -> ([Lanes; 6], Tangent) {
        let [l, a, v, r, pa, pv] = *x;
        let [g_li, g_lo, g_a, g_ri, g_ro, g_pv] = fixed.conductances;
        let [e_a, e_v, e_pa, e_pv] = fixed.elastances;
        let zero = Lanes::splat(0.0);
        let tangent = Tangent {
            li: (pv - l).choose(g_li, zero),
            lo: (l - a).choose(g_lo, zero),
            ri: (v - r).choose(g_ri, zero),
            ro: (r - pa).choose(g_ro, zero),
        };
        let (li, lo) = ((pv - l) * tangent.li, (l - a) * tangent.lo);
        let (ri, ro) = ((v - r) * tangent.ri, (r - pa) * tangent.ro);
        let (systemic, pulmonary) = ((a - v) * g_a, (pa - pv) * g_pv);
        let slopes = [
            (li - lo) * moment.left.elastance + (l - fixed.p_th) * moment.left.stiffening,
            (lo - systemic) * e_a,
            (systemic - ri) * e_v,
            (ri - ro) * moment.right.elastance + (r - fixed.p_th) * moment.right.stiffening,
            (ro - pulmonary) * e_pa,
            (pulmonary - li) * e_pv,
        ];
        (slopes, tangent)
    }

    #[inline(always)]
    fn pull(fixed: &Fixed, moment: &Moment, tangent: &Tangent, dual: &[Lanes; 6]) -> [Lanes; 6] {
        let [e_a, e_v, e_pa, e_pv] = fixed.elastances;
        let [l, a, v, r, pa, pv] = *dual;
        // What a compartment's dual is to a flow into it.
        let (l, r, a) = (l * moment.left.elastance, r * moment.right.elastance, a * e_a);
        let (v, pa, pv) = (v * e_v, pa * e_pa, pv * e_pv);
        let (li, lo) = ((l - pv) * tangent.li, (a - l) * tangent.lo);
        let (ri, ro) = ((r - v) * tangent.ri, (pa - r) * tangent.ro);
        let (systemic, pulmonary) = ((v - a) * fixed.conductances[2], (pv - pa) * fixed.conductances[5]);
        [
            lo - li + dual[0] * moment.left.stiffening,
            systemic - lo,
            ri - systemic,
            ro - ri + dual[3] * moment.right.stiffening,
            pulmonary - ro,
            li - pulmonary,
        ]
    }

    #[inline(always)]
    fn relaxation(fixed: &Fixed, moment: &Moment, tangent: &Tangent, phi: Lanes, out: &mut Relaxation) {
        let [e_a, e_v, e_pa, e_pv] = fixed.elastances;
        out.left.set(&moment.left, phi, [tangent.li, tangent.lo], [e_pv, e_a]);
        out.right.set(&moment.right, phi, [tangent.ri, tangent.ro], [e_v, e_pa]);
    }

    #[inline(always)]
    fn relax(relaxation: &Relaxation, residual: &[Lanes; 6], transposed: bool) -> [Lanes; 6] {
        let [l, a, v, r, pa, pv] = *residual;
        let (l, [pv, a]) = relaxation.left.solve(l, [pv, a], transposed);
        let (r, [v, pa]) = relaxation.right.solve(r, [v, pa], transposed);
        [l, a, v, r, pa, pv]
    }

    #[inline(always)]
    fn is_alike(one: &Tangent, other: &Tangent) -> bool {
        let left = (one.li - other.li).abs().larger((one.lo - other.lo).abs());
        let right = (one.ri - other.ri).abs().larger((one.ro - other.ro).abs());
        left.larger(right).all_within(0.0)
    }

    #[inline(always)]
    fn push(
        fixed: &Fixed,
        (moment, by): (&Moment, Option<&Moment>),
        x: &[Lanes; 6],
        dual: &[Lanes; 6],
        parameter: usize,
    ) -> Lanes {
        use Parameter as P;
        let is = |p: P| parameter == p as usize;
        let [l, a, v, r, pa, pv] = *x;
        let zero = Lanes::splat(0.0);
        if let Some(by) = by {
            let (_, tangent) = Self::linearise(fixed, moment, x);
            let (li, lo) = ((pv - l) * tangent.li, (l - a) * tangent.lo);
            let (ri, ro) = ((v - r) * tangent.ri, (r - pa) * tangent.ro);
            let left = (li - lo) * by.left.elastance + (l - fixed.p_th) * by.left.stiffening;
            let right = (ri - ro) * by.right.elastance + (r - fixed.p_th) * by.right.stiffening;
            return dual[0] * left + dual[3] * right;
        }
        // Each parameter by itself: it is called for one at a time, and what others need is not worked out.
        let [e_a, e_v, e_pa, e_pv] = fixed.elastances;
        let (e_l, e_r) = (moment.left.elastance, moment.right.elastance);
        let [g_li, g_lo, g_a, g_ri, g_ro, g_pv] = fixed.conductances;
        if is(P::RLi) {
            by_resistance(pv - l, (pv - l).choose(g_li, zero), g_li, (dual[5] * e_pv, dual[0] * e_l))
        } else if is(P::RLo) {
            by_resistance(l - a, (l - a).choose(g_lo, zero), g_lo, (dual[0] * e_l, dual[1] * e_a))
        } else if is(P::RA) {
            by_resistance(a - v, g_a, g_a, (dual[1] * e_a, dual[2] * e_v))
        } else if is(P::RRi) {
            by_resistance(v - r, (v - r).choose(g_ri, zero), g_ri, (dual[2] * e_v, dual[3] * e_r))
        } else if is(P::RRo) {
            by_resistance(r - pa, (r - pa).choose(g_ro, zero), g_ro, (dual[3] * e_r, dual[4] * e_pa))
        } else if is(P::RPv) {
            by_resistance(pa - pv, g_pv, g_pv, (dual[4] * e_pa, dual[5] * e_pv))
        } else if is(P::CA) {
            zero - dual[1] * Self::linearise(fixed, moment, x).0[1] * e_a
        } else if is(P::CV) {
            zero - dual[2] * Self::linearise(fixed, moment, x).0[2] * e_v
        } else if is(P::CPa) {
            zero - dual[4] * Self::linearise(fixed, moment, x).0[4] * e_pa
        } else if is(P::CPv) {
            zero - dual[5] * Self::linearise(fixed, moment, x).0[5] * e_pv
        } else if is(P::PTh) {
            zero - dual[0] * moment.left.stiffening - dual[3] * moment.right.stiffening
        } else {
            // Unstressed volumes and the total volume are not in the equations.
            zero
        }
    }

    #[inline(always)]
    fn derive((fixed, moment): (&Fixed, &Moment), x: &[Lanes; 6], theta: &[Lanes], out: &mut [Lanes]) {
        let (_, tangent) = <Self as LaneModel>::linearise(fixed, moment, x);
        let [l, a, v, r, pa, pv] = *x;
        let of = |p: Parameter| theta[p as usize];
        let p_th = fixed.p_th;
        use Parameter::{CA, CPa, CPv, CV, V0A, V0L, V0Pa, V0Pv, V0R, V0V};
        out.copy_from_slice(&[
            (pv - l) * tangent.li,
            (l - a) * tangent.lo,
            (a - v) * fixed.conductances[2],
            (v - r) * tangent.ri,
            (r - pa) * tangent.ro,
            (pa - pv) * fixed.conductances[5],
            of(V0L) + (l - p_th) / moment.left.elastance,
            of(V0A) + (a - p_th * Lanes::splat(1.0 / 3.0)) * of(CA),
            of(V0V) + v * of(CV),
            of(V0R) + (r - p_th) / moment.right.elastance,
            of(V0Pa) + (pa - p_th) * of(CPa),
            of(V0Pv) + (pv - p_th) * of(CPv),
        ]);
    }

    #[inline(always)]
    fn advance(&self, dt_s: f64, theta: &mut [Lanes]) {
        let beats = Lanes::splat(dt_s) * (theta[Parameter::HeartRate as usize] / Lanes::splat(60.0));
        let phase = &mut theta[Parameter::BeatPhase as usize];
        *phase = *phase + beats;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::Model;
    use crate::model::lanes::WIDTH;

    /// Parameters, pressures and duals of eight members, whatever the phase.
    struct Case {
        thetas: Vec<Vec<f64>>,
        xs: Vec<Vec<f64>>,
        duals: Vec<Vec<f64>>,
    }

    fn cases(model: Cvsim6) -> impl Iterator<Item = Case> {
        let default = model.default_parameters();
        (0..200_u32).map(move |step| {
            let wobble = |k: usize| 1.0 + 0.3 * (0.7 * f64::from(step) + 1.3 * k as f64).sin();
            // In the second half every member has its own clock.
            let own = |lane: usize| if step < 100 { 0.0 } else { 0.05 * lane as f64 };
            let theta = |lane: usize| {
                let mut theta = default.clone();
                theta.iter_mut().enumerate().for_each(|(p, v)| *v *= wobble(p + 40 * lane));
                let (rate, phase) = (Parameter::HeartRate as usize, Parameter::BeatPhase as usize);
                (theta[rate], theta[phase]) = (72.0 + own(lane), 0.013 * f64::from(step) + own(lane));
                theta[Parameter::Systole as usize] = 0.33;
                theta
            };
            let pressures = |lane: usize| (0..6).map(|s| 50.0 * wobble(7 * s + lane) - 30.0).collect();
            let dual = |lane: usize| (0..6).map(|s| wobble(11 * s + 3 * lane) - 1.0).collect();
            Case {
                thetas: (0..WIDTH).map(theta).collect(),
                xs: (0..WIDTH).map(pressures).collect(),
                duals: (0..WIDTH).map(dual).collect(),
            }
        })
    }

    fn lanes<const N: usize>(rows: &[Vec<f64>]) -> [Lanes; N] {
        std::array::from_fn(|k| Lanes(std::array::from_fn(|lane| rows[lane][k])))
    }

    fn close(found: f64, expected: f64, size: f64, what: &str) {
        assert!((found - expected).abs() <= 1e-11 * expected.abs().max(size), "{what}: {found} {expected}");
    }

    const T_S: f64 = 0.0007;

    /// The same slopes, derivatives and derived quantities as the equations for one member.
    #[test]
    fn lanes_are_eight_members() {
        for systole in [SystoleRule::Seconds, SystoleRule::Bazett] {
            let model = Cvsim6 { systole, ..Cvsim6::default() };
            for Case { thetas, xs, duals } in cases(model) {
                let (theta, x, dual) = (lanes::<37>(&thetas), lanes::<6>(&xs), lanes::<6>(&duals));
                let fixed = model.fixed(&theta).unwrap();
                let instant = Cvsim6::instant(&fixed, T_S);
                let moment = <Cvsim6 as LaneModel>::moment(&fixed, &instant);
                let (slopes, tangent) = <Cvsim6 as LaneModel>::linearise(&fixed, &moment, &x);
                let pulled = <Cvsim6 as LaneModel>::pull(&fixed, &moment, &tangent, &dual);
                let mut derived = [Lanes::default(); 12];
                <Cvsim6 as LaneModel>::derive((&fixed, &moment), &x, &theta, &mut derived);
                for lane in 0..WIDTH {
                    let (mut dx, mut dfdx, mut own) = (vec![0.0; 6], vec![0.0; 36], vec![0.0; 12]);
                    model.rhs_and_state_jacobian(T_S, &xs[lane], &thetas[lane], &mut dx, &mut dfdx);
                    Model::derive(&model, T_S, &xs[lane], &thetas[lane], &mut own);
                    for s in 0..6 {
                        close(slopes[s].0[lane], dx[s], 100.0, "slope");
                        let expected: f64 = (0..6).map(|i| duals[lane][i] * dfdx[i * 6 + s]).sum();
                        close(pulled[s].0[lane], expected, 100.0, "pull");
                    }
                    own.iter().zip(&derived).for_each(|(own, lanes)| close(lanes.0[lane], *own, 10.0, "derived"));
                }
            }
        }
    }

    #[test]
    fn lanes_know_what_every_parameter_does() {
        for systole in [SystoleRule::Seconds, SystoleRule::Fraction, SystoleRule::Bazett] {
            let model = Cvsim6 { systole, ..Cvsim6::default() };
            for Case { thetas, xs, duals } in cases(model) {
                let (theta, x, dual) = (lanes::<37>(&thetas), lanes::<6>(&xs), lanes::<6>(&duals));
                let fixed = model.fixed(&theta).unwrap();
                let instant = Cvsim6::instant(&fixed, T_S);
                let moment = <Cvsim6 as LaneModel>::moment(&fixed, &instant);
                for p in (0..37).filter(|&p| LaneModel::knows(&model, p)) {
                    let by = Cvsim6::is_timed(p).then(|| model.moment_by(&fixed, (T_S, &instant), &theta, p));
                    let found = <Cvsim6 as LaneModel>::push(&fixed, (&moment, by.as_ref()), &x, &dual, p);
                    for lane in 0..WIDTH {
                        let mut column = vec![0.0; 6];
                        model.parameter_jacobian(T_S, &xs[lane], &thetas[lane], &[p], &mut column);
                        let expected: f64 = column.iter().zip(&duals[lane]).map(|(a, b)| a * b).sum();
                        close(found.0[lane], expected, 1e3, model.parameters()[p].name);
                    }
                }
            }
        }
    }

    /// Exact where the flows between the two sides are zero.
    #[test]
    fn relaxation_inverts_what_is_around_a_ventricle() {
        let model = Cvsim6::default();
        for Case { mut thetas, xs, duals } in cases(model) {
            for theta in &mut thetas {
                (theta[Parameter::RA as usize], theta[Parameter::RPv as usize]) = (1e300, 1e300);
            }
            let (theta, x, residual) = (lanes::<37>(&thetas), lanes::<6>(&xs), lanes::<6>(&duals));
            let fixed = model.fixed(&theta).unwrap();
            let instant = Cvsim6::instant(&fixed, T_S);
            let moment = <Cvsim6 as LaneModel>::moment(&fixed, &instant);
            let (_, tangent) = <Cvsim6 as LaneModel>::linearise(&fixed, &moment, &x);
            let phi = 3e-4;
            for transposed in [false, true] {
                let mut relaxation = Relaxation::default();
                Cvsim6::relaxation(&fixed, &moment, &tangent, Lanes::splat(phi), &mut relaxation);
                let solved = Cvsim6::relax(&relaxation, &residual, transposed);
                for lane in 0..WIDTH {
                    let (mut dx, mut dfdx) = (vec![0.0; 6], vec![0.0; 36]);
                    model.rhs_and_state_jacobian(T_S, &xs[lane], &thetas[lane], &mut dx, &mut dfdx);
                    for i in 0..6 {
                        let entry = |j: usize| if transposed { dfdx[j * 6 + i] } else { dfdx[i * 6 + j] };
                        let product: f64 = (0..6).map(|j| entry(j) * solved[j].0[lane]).sum();
                        close(solved[i].0[lane] - phi * product, duals[lane][i], 1.0, "relaxed");
                    }
                }
            }
        }
    }

    #[test]
    fn other_laws_are_left_to_the_equations_for_one() {
        let theta: Vec<Lanes> = Cvsim6::default().default_parameters().into_iter().map(Lanes::splat).collect();
        let nonlinear = Cvsim6 { pulmonary_resistance: PulmonaryResistance::Nonlinear, ..Cvsim6::default() };
        assert!(nonlinear.fixed(&theta).is_none());
        let mut lacking = theta;
        lacking[Parameter::DeltaQPv as usize].0[5] = 1.0;
        assert!(Cvsim6::default().fixed(&lacking).is_none());
    }
}
