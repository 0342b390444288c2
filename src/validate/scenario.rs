//! What happens to a patient, and what the estimator is told wrongly.

use crate::edge::config::{Config, ConfigError, Coupling, PulmonaryLaw, ScriptEntry, Systole};
use crate::edge::synthetic::draw_start;
use crate::model::Model;

/// How far off the parameters to be estimated are believed to be at the start (relative), one up and the next down.
const WRONG_GUESS: f64 = 0.3;
/// The same of the heart rate, which any monitor shows.
const WRONG_HEART_RATE: f64 = 0.05;

/// Parameters that wander in every patient whose file says nothing of it, relative sd per square root of a second.
const WANDER: [(&str, f64); 2] = [("r_pv", 0.01), ("c_a", 0.01)];

/// The parameter that changes at once, and its factor.
pub const STEP: (&str, f64) = ("r_pv", 1.5);

/// Process noise that suits the rivals best on these patients: `parameter_drift`, `pressure_drift`.
const RIVAL_DRIFT: (f64, f64) = (0.05, 0.001);

/// What is special about an experiment. In all of them the parameters to be estimated are 30 % wrong at the start, `r_pv`
/// and `c_a` wander, and the patient starts somewhere in the stated spread of the initial pressures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Scenario {
    /// The pulmonary resistance jumps to 1.5 times that of the start half way; everything else that is believed is true.
    Step,
    /// Nothing happens.
    Steady,
    /// The pulmonary resistance rises with the flow; the estimator believes it constant.
    NonlinearResistance,
    /// The pressure in the chest is believed to be 0, as under a ventilator.
    WrongPTh,
    /// The veins are believed to be 20 % too lax.
    WrongCV,
    /// Systole is believed to be 10 % too long.
    WrongSystole,
    /// Sensors are twice as noisy as stated.
    NoiseUnderstated,
    /// Sensors are half as noisy as stated.
    NoiseOverstated,
    /// Nothing but the arterial line.
    ArterialLineOnly,
}

impl Scenario {
    /// In the order of reports.
    pub const ALL: [Self; 9] = [
        Self::Step,
        Self::Steady,
        Self::NonlinearResistance,
        Self::WrongPTh,
        Self::WrongCV,
        Self::WrongSystole,
        Self::NoiseUnderstated,
        Self::NoiseOverstated,
        Self::ArterialLineOnly,
    ];

    /// Name on the command line and in files.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Step => "step",
            Self::Steady => "steady",
            Self::NonlinearResistance => "nonlinear_resistance",
            Self::WrongPTh => "wrong_p_th",
            Self::WrongCV => "wrong_c_v",
            Self::WrongSystole => "wrong_systole",
            Self::NoiseUnderstated => "noise_understated",
            Self::NoiseOverstated => "noise_overstated",
            Self::ArterialLineOnly => "arterial_line_only",
        }
    }

    /// In a sentence.
    #[must_use]
    pub fn about(self) -> &'static str {
        match self {
            Self::Step => "half way r_pv jumps to 1.5 times that of the start; what is believed of all else is true",
            Self::Steady => "nothing happens, and what is believed is true",
            Self::NonlinearResistance => "the true pulmonary resistance rises with the flow, the believed one does not",
            Self::WrongPTh => "the intrathoracic pressure is believed to be 0",
            Self::WrongCV => "the systemic venous capacitance is believed to be 20 % too large",
            Self::WrongSystole => "systole is believed to be 10 % too long",
            Self::NoiseUnderstated => "half of the sensors' noise is stated",
            Self::NoiseOverstated => "twice the sensors' noise is stated",
            Self::ArterialLineOnly => "only the arterial pressure is observed",
        }
    }

    /// When the change of the scenario comes \[s\].
    #[must_use]
    pub fn step_s(self, seconds: f64) -> Option<f64> {
        (self == Self::Step).then_some(0.5 * seconds)
    }

    /// Whether a parameter of the estimator is something that the patient has.
    #[must_use]
    pub fn has_truth(self, parameter: &str) -> bool {
        // There it is not one number.
        !(self == Self::NonlinearResistance && parameter == "r_pv")
    }

    /// The true patient.
    ///
    /// # Errors
    /// When the patient has no initial pressures, or changes beyond what is allowed.
    pub fn truth(self, patient: &Config, seconds: f64, seed: u64) -> Result<Config, ConfigError> {
        let mut truth = patient.clone();
        draw_start(&mut truth, seed)?;
        let patient = &mut truth.patient;
        if patient.variability.is_empty() {
            patient.variability = WANDER.map(|(name, sd)| (name.to_owned(), sd)).into();
        }
        if let Some(at_s) = self.step_s(seconds) {
            let scale = [(STEP.0.to_owned(), STEP.1)].into();
            patient.script.push(ScriptEntry { at_s, set: [].into(), scale });
        }
        if self == Self::NonlinearResistance {
            patient.pulmonary_resistance = PulmonaryLaw::Nonlinear;
        }
        truth.check()?;
        Ok(truth)
    }

    /// What the estimator of `settings` believes of a patient. Guesses that the settings name are theirs.
    ///
    /// # Errors
    /// When what it believes is out of range.
    pub fn belief(self, settings: &Config, patient: &Config, seed: u64) -> Result<Config, ConfigError> {
        let mut belief = Config { patient: patient.patient.clone(), ..settings.clone() };
        // A wrong belief about a parameter is not one about the pressures that people measured at the start.
        let mut start = patient.patient.initial_pressures()?.into_iter();
        belief.patient.initial.iter_mut().for_each(|pressure| *pressure = start.next());
        belief.patient.script.clear();
        belief.patient.variability.clear();
        belief.estimator.seed = settings.estimator.seed.wrapping_add(seed);

        let (model, theta) = (patient.patient.model(), patient.patient.theta());
        for (k, name) in (seed..).zip(&settings.estimator.estimate) {
            let size = if name == "heart_rate" { WRONG_HEART_RATE } else { WRONG_GUESS };
            let wrong = if k % 2 == 0 { 1.0 + size } else { 1.0 - size };
            if let Some(p) = model.parameter_index(name) {
                belief.estimator.initial_guess.entry(name.clone()).or_insert(wrong * theta[p]);
            }
        }
        match self {
            Self::Step | Self::Steady | Self::NonlinearResistance => {}
            Self::WrongPTh => belief.patient.p_th = 0.0,
            Self::WrongCV => belief.patient.c_v *= 1.2,
            Self::WrongSystole => {
                let systole = &mut belief.patient.systole;
                let (Systole::Seconds(value) | Systole::Fraction(value) | Systole::Bazett(value)) = systole;
                *value *= 1.1;
            }
            Self::NoiseUnderstated => belief.channels.iter_mut().for_each(|channel| channel.noise_sd *= 0.5),
            Self::NoiseOverstated => belief.channels.iter_mut().for_each(|channel| channel.noise_sd *= 2.0),
            Self::ArterialLineOnly => belief.observed = vec!["p_a".to_owned()],
        }
        belief.check()?;
        Ok(belief)
    }
}

/// A filter of the textbooks, to compare with.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Rival {
    /// Unscented Kalman filter.
    Ukf,
    /// Ensemble Kalman filter.
    Enkf,
}

impl Rival {
    /// In the order of reports.
    pub const ALL: [Self; 2] = [Self::Ukf, Self::Enkf];

    /// Name on the command line and in files.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Ukf => "ukf",
            Self::Enkf => "enkf",
        }
    }

    /// The same task with the settings that suit a rival: what the settings of the ensemble say of its own inner life is
    /// not for it.
    #[must_use]
    pub fn of(self, ensemble: &Config) -> Config {
        let mut config = Config { discrepancy: [].into(), ..ensemble.clone() };
        let estimator = &mut config.estimator;
        estimator.coupling = match self {
            Self::Ukf => Coupling::Ukf,
            Self::Enkf => Coupling::Enkf,
        };
        (estimator.parameter_drift, estimator.pressure_drift) = RIVAL_DRIFT;
        estimator.prior.clear();
        estimator.adaptive = false;
        estimator.inflation = 1.0;
        estimator.smoothing_lag_s = 0.0;
        config
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::float_cmp)]
mod tests {
    use super::*;
    use crate::validate::patients;

    #[test]
    fn every_scenario_is_possible_for_every_patient() {
        let settings = Config::load_text(super::super::PRESET.0, super::super::PRESET.1).unwrap();
        for patient in patients::built_in().unwrap() {
            for scenario in Scenario::ALL {
                let truth = scenario.truth(&patient.config, 24.0, 3).unwrap();
                let belief = scenario.belief(&settings, &patient.config, 3).unwrap();
                let balance = patient.config.patient.initial_pressures().unwrap();
                assert_eq!(belief.patient.initial_pressures().unwrap(), balance, "the start is measured");
                assert_ne!(truth.patient.initial_pressures().unwrap(), balance, "the truth starts near it");
                assert_eq!(truth.channels, patient.config.channels, "{}", scenario.name());
                for rival in Rival::ALL {
                    rival.of(&belief).check().unwrap();
                }
            }
        }
    }

    #[test]
    fn guesses_are_wrong_up_and_down_unless_they_are_given() {
        let patient = patients::find("healthy").unwrap().config;
        let mut settings = Config::default();
        let guess = |settings: &Config, seed| {
            Scenario::Steady.belief(settings, &patient, seed).unwrap().estimator.initial_guess
        };
        let (r_pv, c_a) = (patient.patient.r_pv, patient.patient.c_a);
        assert_eq!(guess(&settings, 0)["r_pv"], 1.3 * r_pv);
        assert_eq!(guess(&settings, 0)["c_a"], 0.7 * c_a);
        assert_eq!(guess(&settings, 1)["r_pv"], 0.7 * r_pv);
        settings.estimator.initial_guess = [("r_pv".to_owned(), 0.2)].into();
        assert_eq!(guess(&settings, 0)["r_pv"], 0.2);
        assert_eq!(guess(&settings, 0)["c_a"], 0.7 * c_a);
    }
}
