//! `[patient]`: parameters of the model, the start, and a script of changes.

use std::collections::BTreeMap;
use std::fmt;

use serde::de::value::MapAccessDeserializer;
use serde::de::{Deserializer, Error, MapAccess, Visitor};
use serde::{Deserialize, Serialize};

use super::error::{ConfigError, Problem};
use super::schema::{PerState, by_name};
use crate::model::cvsim6::{self, Cvsim6, Parameters, Pressures, SystoleRule};
use crate::model::truth::Change;
use crate::model::{Model, ParameterInfo};

/// Relative standard deviation of an initial pressure of which nothing is said.
const DEFAULT_INITIAL_SD: f64 = 0.04;

/// Declares [`Patient`] from the list of parameters that are plain numbers.
///
/// [`Patient::theta`] builds a [`Parameters`] field by field, so the list cannot fall behind the model.
macro_rules! patient {
    ($($(#[$doc:meta])* $parameter:ident),+ $(,)?) => {
        /// The patient: parameters of the model, start, script.
        #[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
        #[serde(deny_unknown_fields)]
        pub struct Patient {
            $($(#[$doc])* pub $parameter: f64,)+
            /// How long the ventricles contract.
            pub systole: Systole,
            /// Law of the pulmonary resistance.
            #[serde(deserialize_with = "by_name")]
            pub pulmonary_resistance: PulmonaryLaw,
            /// Pressures at the start \[mmHg\]; the eight balances of the model where left out.
            pub initial: PerState<Option<f64>>,
            /// Uncertainty of the pressures at the start.
            pub initial_sd: InitialSd,
            /// What changes on the way.
            pub script: Vec<ScriptEntry>,
            /// Parameters that wander by themselves: relative random walk, sd per square root of a second.
            pub variability: BTreeMap<String, f64>,
        }

        impl Default for Patient {
            fn default() -> Self {
                let defaults = Parameters::from_slice(&Cvsim6::default().default_parameters());
                Self {
                    $($parameter: defaults.$parameter,)+
                    systole: Systole::Seconds(defaults.systole),
                    pulmonary_resistance: PulmonaryLaw::Linear,
                    initial: PerState::default(),
                    initial_sd: InitialSd::Relative(DEFAULT_INITIAL_SD),
                    script: Vec::new(),
                    variability: BTreeMap::new(),
                }
            }
        }

        impl Patient {
            /// The full parameter vector of the model.
            #[must_use]
            pub fn theta(&self) -> Vec<f64> {
                // Nothing is missing from the patient itself.
                let lacking = Parameters::from_slice(&Cvsim6::default().default_parameters());
                Parameters { $($parameter: self.$parameter,)+ systole: self.systole.value(), ..lacking }.to_vec()
            }
        }
    };
}

patient! {
    /// Heart rate \[bpm\].
    heart_rate,
    /// Intrathoracic pressure \[mmHg\].
    p_th,
    /// Diastolic capacitance of the left ventricle \[mL/mmHg\].
    c_l_dia,
    /// Systolic capacitance of the left ventricle \[mL/mmHg\].
    c_l_sys,
    /// Capacitance of the systemic arteries \[mL/mmHg\].
    c_a,
    /// Capacitance of the systemic veins \[mL/mmHg\].
    c_v,
    /// Diastolic capacitance of the right ventricle \[mL/mmHg\].
    c_r_dia,
    /// Systolic capacitance of the right ventricle \[mL/mmHg\].
    c_r_sys,
    /// Capacitance of the pulmonary arteries \[mL/mmHg\].
    c_pa,
    /// Capacitance of the pulmonary veins \[mL/mmHg\].
    c_pv,
    /// Resistance of the left inlet (mitral) \[mmHg s/mL\].
    r_li,
    /// Resistance of the left outlet (aortic) \[mmHg s/mL\].
    r_lo,
    /// Systemic resistance \[mmHg s/mL\].
    r_a,
    /// Resistance of the right inlet (tricuspid) \[mmHg s/mL\].
    r_ri,
    /// Resistance of the right outlet (pulmonary valve) \[mmHg s/mL\].
    r_ro,
    /// Pulmonary resistance \[mmHg s/mL\].
    r_pv,
    /// Unstressed volume of the left ventricle \[mL\].
    v0_l,
    /// Unstressed volume of the systemic arteries \[mL\].
    v0_a,
    /// Unstressed volume of the systemic veins \[mL\].
    v0_v,
    /// Unstressed volume of the right ventricle \[mL\].
    v0_r,
    /// Unstressed volume of the pulmonary arteries \[mL\].
    v0_pa,
    /// Unstressed volume of the pulmonary veins \[mL\].
    v0_pv,
    /// Total blood volume \[mL\]; enters only the initial pressures.
    blood_volume,
    /// Beats since the last onset at the start.
    beat_phase,
}

/// How long the ventricles contract: exactly one of these keys.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Systole {
    /// A duration \[s\].
    Seconds(f64),
    /// A fraction of the cycle.
    Fraction(f64),
    /// Bazett's factor of the square root of the cycle \[s^0.5\].
    Bazett(f64),
}

impl Systole {
    /// The number, whose unit depends on the rule.
    #[must_use]
    pub fn value(self) -> f64 {
        match self {
            Self::Seconds(value) | Self::Fraction(value) | Self::Bazett(value) => value,
        }
    }

    /// The rule of the model and the key that chooses it.
    pub(super) fn rule(self) -> (SystoleRule, &'static str) {
        match self {
            Self::Seconds(_) => (SystoleRule::Seconds, "seconds"),
            Self::Fraction(_) => (SystoleRule::Fraction, "fraction"),
            Self::Bazett(_) => (SystoleRule::Bazett, "bazett"),
        }
    }
}

/// Law of the pulmonary resistance.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PulmonaryLaw {
    /// Constant.
    #[default]
    Linear,
    /// Rising with the flow.
    Nonlinear,
}

/// Uncertainty of the pressures at the start.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(untagged)]
pub enum InitialSd {
    /// Standard deviation as a fraction of each pressure.
    Relative(f64),
    /// Standard deviation of each pressure \[mmHg\]; 4 % of the pressure where left out.
    Mmhg(PerState<Option<f64>>),
}

impl<'de> Deserialize<'de> for InitialSd {
    /// By hand, because serde's untagged enums forget which key was wrong.
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct NumberOrTable;

        impl<'de> Visitor<'de> for NumberOrTable {
            type Value = InitialSd;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a number or a table of p_l .. p_pv")
            }

            fn visit_f64<E: Error>(self, value: f64) -> Result<InitialSd, E> {
                Ok(InitialSd::Relative(value))
            }

            #[expect(clippy::cast_precision_loss, reason = "numbers that large are out of range anyway")]
            fn visit_i64<E: Error>(self, value: i64) -> Result<InitialSd, E> {
                Ok(InitialSd::Relative(value as f64))
            }

            fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<InitialSd, A::Error> {
                PerState::deserialize(MapAccessDeserializer::new(map)).map(InitialSd::Mmhg)
            }
        }

        deserializer.deserialize_any(NumberOrTable)
    }
}

/// A change of parameters at one time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScriptEntry {
    /// Time since the start \[s\].
    pub at_s: f64,
    /// New values.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub set: BTreeMap<String, f64>,
    /// Factors on the values before the change.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub scale: BTreeMap<String, f64>,
}

impl Patient {
    /// The model with the laws chosen here.
    #[must_use]
    pub fn model(&self) -> Cvsim6 {
        let pulmonary_resistance = match self.pulmonary_resistance {
            PulmonaryLaw::Linear => cvsim6::PulmonaryResistance::Linear,
            PulmonaryLaw::Nonlinear => cvsim6::PulmonaryResistance::Nonlinear,
        };
        Cvsim6 { systole: self.systole.rule().0, pulmonary_resistance }
    }

    /// Pressures at the start \[mmHg\], `[n_states]`.
    ///
    /// # Errors
    /// When a pressure is left out and the balances of the model have no solution.
    pub fn initial_pressures(&self) -> Result<Vec<f64>, ConfigError> {
        if let Some(given) = self.initial.iter().map(|(_, given)| *given).collect() {
            return Ok(given);
        }
        let balances = Cvsim6::initial_pressures(&self.theta()).ok_or_else(|| {
            let message = "found parameters whose eight balances have no solution, \
                           expected others or all six of `patient.initial`";
            ConfigError::Settings(vec![Problem::new("patient", message)])
        })?;
        Ok(self.initial.iter().zip(balances).map(|((_, given), balance)| given.unwrap_or(balance)).collect())
    }

    /// Standard deviation of the pressures at the start \[mmHg\], `[n_states]`.
    ///
    /// Relative ones refer to [`Patient::initial_pressures`]; without those they are NaN, which
    /// [`Config::check`](super::Config::check) does not let happen.
    #[must_use]
    pub fn initial_sd(&self) -> Vec<f64> {
        let pressures = self.initial_pressures().unwrap_or_else(|_| vec![f64::NAN; Pressures::LEN]);
        match &self.initial_sd {
            InitialSd::Relative(fraction) => pressures.iter().map(|p| fraction * p.abs()).collect(),
            InitialSd::Mmhg(given) => {
                let relative = pressures.iter().map(|p| DEFAULT_INITIAL_SD * p.abs());
                given.iter().zip(relative).map(|((_, given), relative)| given.unwrap_or(relative)).collect()
            }
        }
    }

    /// The script in order of time, factors resolved to values.
    #[must_use]
    pub fn changes(&self) -> Vec<Change> {
        self.resolved_script().into_iter().map(|(_, change)| change).collect()
    }

    /// The script in order of time and where each change was written. Unknown names are left out here and
    /// refused by [`Config::check`](super::Config::check).
    pub(super) fn resolved_script(&self) -> Vec<(usize, Change)> {
        let mut order: Vec<usize> = (0..self.script.len()).collect();
        order.sort_by(|&a, &b| self.script[a].at_s.total_cmp(&self.script[b].at_s));
        let mut theta = self.theta();
        let resolve = |entry: usize| {
            let ScriptEntry { at_s, set, scale } = &self.script[entry];
            let new = |(p, info): (usize, &ParameterInfo)| {
                let scaled = || scale.get(info.name).map(|factor| factor * theta[p]);
                set.get(info.name).copied().or_else(scaled).map(|value| (p, value))
            };
            let assignments: Vec<_> = cvsim6::PARAMETERS.iter().enumerate().filter_map(new).collect();
            for &(p, value) in &assignments {
                theta[p] = value;
            }
            (entry, Change { at_s: *at_s, assignments })
        };
        order.into_iter().map(resolve).collect()
    }
}
