//! The equations for eight members at once.

use super::{Cvsim6, Parameter, PulmonaryResistance};
use crate::model::capacitance::Activation;
use crate::model::lanes::{LaneModel, Lanes, WIDTH};

/// What does not change over a window.
#[derive(Debug, Clone, Copy, Default)]
pub struct Fixed {
    /// `1/R` of the flows li, lo, a, ri, ro, pv.
    conductances: [Lanes; 6],
    /// `1/C` of the compartments a, v, pa, pv.
    elastances: [Lanes; 4],
    p_th: Lanes,
}

/// What the beat does to a ventricle at a moment.
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

impl Cvsim6 {
    /// Activation and its rate, lane by lane; members mostly share their clock.
    fn activations(&self, t_s: f64, theta: &[Lanes]) -> (Lanes, Lanes) {
        let at = |lane: usize| {
            let of = |p: Parameter| theta[p as usize].0[lane];
            let clock = [of(Parameter::HeartRate), of(Parameter::BeatPhase), of(Parameter::Systole)];
            (clock, clock.map(f64::to_bits))
        };
        let activation = |[heart_rate, beat_phase, systole]: [f64; 3]| {
            let beat = self.time_in_beat(t_s, heart_rate, beat_phase, systole);
            Activation::at(beat.time_s, beat.systole_s)
        };
        let (first, bits) = at(0);
        let shared = activation(first);
        let (mut values, mut rates) = (Lanes::splat(shared.value), Lanes::splat(shared.d_t));
        for lane in 1..WIDTH {
            let (clock, own) = at(lane);
            if own != bits {
                let activation = activation(clock);
                (values.0[lane], rates.0[lane]) = (activation.value, activation.d_t);
            }
        }
        (values, rates)
    }
}

impl LaneModel for Cvsim6 {
    type State = [Lanes; 6];
    type Fixed = Fixed;
    type Moment = Moment;

    fn fixed(&self, theta: &[Lanes]) -> Option<Fixed> {
        let missing = &theta[Parameter::DeltaQLi as usize..=Parameter::DeltaPPv as usize];
        let lacks_something = missing.iter().any(|lanes| *lanes != Lanes::splat(0.0));
        if lacks_something || self.pulmonary_resistance != PulmonaryResistance::Linear {
            return None;
        }
        use Parameter::{CA, CPa, CPv, CV, RA, RLi, RLo, RPv, RRi, RRo};
        let inverse = |p: Parameter| Lanes::splat(1.0) / theta[p as usize];
        Some(Fixed {
            conductances: [RLi, RLo, RA, RRi, RRo, RPv].map(inverse),
            elastances: [CA, CV, CPa, CPv].map(inverse),
            p_th: theta[Parameter::PTh as usize],
        })
    }

    fn moment(&self, t_s: f64, theta: &[Lanes]) -> Moment {
        let (activation, rate) = self.activations(t_s, theta);
        let ventricle = |diastolic: Parameter, systolic: Parameter| {
            let relaxed = Lanes::splat(1.0) / theta[diastolic as usize];
            let half_swing = (Lanes::splat(1.0) / theta[systolic as usize] - relaxed) * Lanes::splat(0.5);
            let elastance = relaxed + half_swing * activation;
            Ventricle { elastance, stiffening: half_swing * rate / elastance }
        };
        Moment {
            left: ventricle(Parameter::CLDia, Parameter::CLSys),
            right: ventricle(Parameter::CRDia, Parameter::CRSys),
        }
    }

    #[inline(always)]
    fn rhs(fixed: &Fixed, moment: &Moment, x: &[Lanes; 6]) -> [Lanes; 6] {
        let [l, a, v, r, pa, pv] = *x;
        let [g_li, g_lo, g_a, g_ri, g_ro, g_pv] = fixed.conductances;
        let [e_a, e_v, e_pa, e_pv] = fixed.elastances;
        let li = (pv - l).positive_part() * g_li;
        let lo = (l - a).positive_part() * g_lo;
        let systemic = (a - v) * g_a;
        let ri = (v - r).positive_part() * g_ri;
        let ro = (r - pa).positive_part() * g_ro;
        let pulmonary = (pa - pv) * g_pv;
        [
            (li - lo) * moment.left.elastance + (l - fixed.p_th) * moment.left.stiffening,
            (lo - systemic) * e_a,
            (systemic - ri) * e_v,
            (ri - ro) * moment.right.elastance + (r - fixed.p_th) * moment.right.stiffening,
            (ro - pulmonary) * e_pa,
            (pulmonary - li) * e_pv,
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::Model;

    /// The same slopes as the equations for one member, whatever the phase, the parameters and the pressures.
    #[test]
    fn lanes_are_eight_members() {
        let model = Cvsim6::default();
        let default = model.default_parameters();
        for step in 0..200_u32 {
            let wobble = |k: usize| 1.0 + 0.3 * (0.7 * f64::from(step) + 1.3 * k as f64).sin();
            // In the second half every member has its own clock.
            let own = |lane: usize| if step < 100 { 0.0 } else { 0.05 * lane as f64 };
            let thetas: Vec<Vec<f64>> = (0..WIDTH)
                .map(|lane| {
                    let mut theta = default.clone();
                    theta.iter_mut().enumerate().for_each(|(p, v)| *v *= wobble(p + 40 * lane));
                    let (rate, phase) = (Parameter::HeartRate as usize, Parameter::BeatPhase as usize);
                    (theta[rate], theta[phase]) = (72.0 + own(lane), 0.013 * f64::from(step) + own(lane));
                    theta[Parameter::Systole as usize] = 0.33;
                    theta
                })
                .collect();
            let xs: Vec<Vec<f64>> =
                (0..WIDTH).map(|lane| (0..6).map(|s| 50.0 * wobble(7 * s + lane) - 30.0).collect()).collect();
            let theta: Vec<Lanes> =
                (0..default.len()).map(|p| Lanes(std::array::from_fn(|lane| thetas[lane][p]))).collect();
            let x: [Lanes; 6] = std::array::from_fn(|s| Lanes(std::array::from_fn(|lane| xs[lane][s])));
            let t = 0.0007;
            let lanes =
                <Cvsim6 as LaneModel>::rhs(&model.fixed(&theta).unwrap(), &LaneModel::moment(&model, t, &theta), &x);
            for lane in 0..WIDTH {
                let mut dx = vec![0.0; 6];
                Model::rhs(&model, t, &xs[lane], &thetas[lane], &mut dx);
                for (s, dx) in dx.iter().enumerate() {
                    let found = lanes[s].0[lane];
                    assert!((found - dx).abs() <= 1e-12 * dx.abs().max(100.0), "{step} {lane} {s}: {found} {dx}");
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
