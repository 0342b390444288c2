//! What can be set, with the built-in defaults. Ranges are in [`super::check`], prose for users is in
//! `config/default.toml`.
//!
//! No field has a serde default: what a file leaves out comes from the layer below, and the lowest layer is
//! `Config::default()`. So every default is written once.

use std::collections::BTreeMap;

use serde::de::{Deserializer, Error, IntoDeserializer};
use serde::{Deserialize, Serialize};

use super::patient::Patient;
use crate::model::cvsim6::Pressures;
use crate::model::lanes::InstructionSet;

/// The effective configuration. See [`Config::load`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Names of the states whose sensors are believed; other channels are received and ignored.
    pub observed: Vec<String>,
    /// Limits that are watched.
    pub alarms: Vec<AlarmSettings>,
    /// What the equations may lack, by flow (`q_pv`) or by state, for its balance (`p_a`).
    pub discrepancy: BTreeMap<String, DiscrepancySettings>,
    /// The patient: parameters of the model, start, script.
    pub patient: Patient,
    /// What is estimated and how.
    pub estimator: EstimatorSettings,
    /// The subdomain of X-TFC and its network.
    pub window: WindowSettings,
    /// The sensor of each state.
    pub channels: PerState<ChannelSettings>,
    /// Channel names of monitors, and the state each of them measures.
    pub labels: BTreeMap<String, String>,
    /// What is published, where and how often.
    pub publish: PublishSettings,
    /// Limits of the daemon.
    pub service: ServiceSettings,
    /// The network.
    pub zenoh: ZenohSettings,
}

/// One value per state.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PerState<T> {
    /// Left ventricle.
    pub p_l: T,
    /// Systemic arteries.
    pub p_a: T,
    /// Systemic veins.
    pub p_v: T,
    /// Right ventricle.
    pub p_r: T,
    /// Pulmonary arteries.
    pub p_pa: T,
    /// Pulmonary veins.
    pub p_pv: T,
}

impl<T> PerState<T> {
    /// Names and values in the order of the states.
    pub fn iter(&self) -> impl Iterator<Item = (&'static str, &T)> {
        let values = [&self.p_l, &self.p_a, &self.p_v, &self.p_r, &self.p_pa, &self.p_pv];
        Pressures::NAMES.iter().copied().zip(values)
    }

    /// Values in the order of the states.
    pub fn iter_mut(&mut self) -> impl Iterator<Item = &mut T> {
        [&mut self.p_l, &mut self.p_a, &mut self.p_v, &mut self.p_r, &mut self.p_pa, &mut self.p_pv].into_iter()
    }

    /// The value of the state called `name`.
    #[must_use]
    pub fn get(&self, name: &str) -> Option<&T> {
        self.iter().find(|(state, _)| *state == name).map(|(_, value)| value)
    }
}

/// `[estimator]`
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EstimatorSettings {
    /// How data enter the solve.
    #[serde(deserialize_with = "by_name")]
    pub coupling: Coupling,
    /// Names of the estimated parameters.
    pub estimate: Vec<String>,
    /// Centre of the starting spread, each in the unit of its parameter; the patient's value where left out.
    pub initial_guess: BTreeMap<String, f64>,
    /// Relative standard deviation of the starting spread of every estimated parameter.
    pub initial_guess_sd: f64,
    /// Monte Carlo members.
    pub members: usize,
    /// Seed of every random number.
    pub seed: u64,
    /// Relative random walk of the estimated parameters \[1/sqrt(s)\].
    pub parameter_drift: f64,
    /// Process noise of the pressures \[mmHg/sqrt(s)\].
    pub pressure_drift: f64,
    /// Factor by which the spread grows in one second.
    pub inflation: f64,
    /// What is believed of single parameters.
    pub prior: BTreeMap<String, PriorSettings>,
    /// Whether the pace of parameters, the noise of sensors and the fit of the model are learnt on the way.
    pub adaptive: bool,
    /// Bounds of the sensor noise that is learnt, in units of the one stated.
    #[serde(deserialize_with = "pair")]
    pub noise_range: [f64; 2],
    /// Innovations beyond so many standard deviations pull no more than this one does.
    pub outlier_sd: f64,
    /// Where the beat comes from.
    #[serde(deserialize_with = "by_name")]
    pub timing: Timing,
    /// How far estimates are looked back at \[s\]; 0 is not.
    pub smoothing_lag_s: f64,
    /// Whether disturbed sensors are set aside.
    pub screen_artefacts: bool,
    /// A filter that runs beside the ensemble.
    #[serde(deserialize_with = "by_name")]
    pub second_opinion: SecondOpinion,
    /// Gauss-Newton iterations of one window.
    pub max_iterations: usize,
    /// Error of the pressures left by the linearisation at which iterations stop \[mmHg\].
    pub tolerance: f64,
}

/// `[estimator.prior.NAME]`; what is left out is that of all parameters.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PriorSettings {
    /// Spread at the start (relative).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sd: Option<f64>,
    /// Random walk \[1/sqrt(s)\].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub drift: Option<f64>,
    /// Pull back to the initial guess \[1/s\].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reversion: Option<f64>,
    /// Smallest value, in the unit of the parameter.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub min: Option<f64>,
    /// Largest value.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max: Option<f64>,
}

/// Where the heart beat comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Timing {
    /// Heart rate and phase of the patient's table, or estimated from there.
    #[default]
    Config,
    /// Onsets received on the `beat` topic.
    Beats,
    /// Onsets found in the pressures, then heart rate and phase as parameters.
    Tracked,
}

/// A filter beside the ensemble, whose distance from it is published.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SecondOpinion {
    /// None.
    #[default]
    None,
    /// Unscented Kalman filter.
    Ukf,
    /// Ensemble Kalman filter.
    Enkf,
}

/// How data enter the solve.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Coupling {
    /// Members share what the data say through the covariance of the ensemble.
    #[default]
    Coupled,
    /// Every member fits its own perturbed data, as in the paper.
    Independent,
    /// Ensemble Kalman filter with a Runge-Kutta forecast, to compare with.
    Enkf,
    /// Unscented Kalman filter with a Runge-Kutta forecast, to compare with.
    Ukf,
}

/// `[discrepancy.NAME]`; flows are in mL/s, what a balance lacks in mmHg/s.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DiscrepancySettings {
    /// What is believed of it.
    #[serde(deserialize_with = "by_name")]
    pub form: DiscrepancyForm,
    /// How fast it is believed to change: random walk, sd per square root of a second.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub change: Option<f64>,
    /// How large a free one is believed to be at any time (sd).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub magnitude: Option<f64>,
    /// Inductance of an inertial one over the resistance beside it \[s\].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub inertance: Option<f64>,
    /// Spread at the start (sd).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub initial_sd: Option<f64>,
}

/// What is believed of a discrepancy.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DiscrepancyForm {
    /// Nothing, and it starts anew in every window.
    Free,
    /// It is the flow through an inductance beside the resistance.
    Inertial,
    /// It changes slowly.
    Tracked,
}

/// `[[alarms]]`; below or above, and what is left out is the default.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AlarmSettings {
    /// What people call it.
    pub name: String,
    /// Quantity, clinical quantity of a beat, or estimated parameter.
    pub quantity: String,
    /// It is raised below this, in the unit of the quantity.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub below: Option<f64>,
    /// It is raised above this.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub above: Option<f64>,
    /// Probability of being beyond the limit from which on it counts.
    #[serde(default = "AlarmSettings::default_probability")]
    pub probability: f64,
    /// How long it must be before it is raised \[s\].
    #[serde(default = "AlarmSettings::default_for_s")]
    pub for_s: f64,
    /// How far back beyond the limit it must be to be over, in the unit of the quantity.
    #[serde(default)]
    pub clear_margin: f64,
    /// How long it must be back \[s\].
    #[serde(default = "AlarmSettings::default_clear_for_s")]
    pub clear_for_s: f64,
    /// How urgent it is.
    #[serde(default, deserialize_with = "by_name")]
    pub priority: AlarmPriority,
    /// Whether it stays until somebody acknowledges it.
    #[serde(default = "AlarmSettings::default_latched")]
    pub latched: bool,
}

// Entries of a list have no layer below them.
impl AlarmSettings {
    fn default_probability() -> f64 {
        0.95
    }

    fn default_for_s() -> f64 {
        10.0
    }

    fn default_clear_for_s() -> f64 {
        5.0
    }

    fn default_latched() -> bool {
        true
    }
}

/// How urgent an alarm is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[expect(missing_docs, reason = "the names are the documentation")]
pub enum AlarmPriority {
    Low,
    #[default]
    Medium,
    High,
}

/// `[window]`
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WindowSettings {
    /// Length of a subdomain \[s\].
    pub length_s: f64,
    /// How long a window waits for late samples, in event time \[s\].
    pub allowed_lateness_s: f64,
    /// Longest gap bridged by forecasts \[s\].
    pub forecast_limit_s: f64,
    /// Points per window at which the physics is enforced.
    pub collocation_points: usize,
    /// Where those points lie.
    #[serde(deserialize_with = "by_name")]
    pub nodes: Nodes,
    /// Random features per state.
    pub neurons: usize,
    /// Their nonlinearity.
    #[serde(deserialize_with = "by_name")]
    pub activation: Activation,
    /// Distribution of the input weights.
    pub weights: Distribution,
    /// Distribution of the biases.
    pub biases: Distribution,
    /// Interval to which a window is mapped before it enters the network.
    #[serde(deserialize_with = "pair")]
    pub domain: [f64; 2],
    /// Weight of the physics rows.
    pub physics_weight: f64,
    /// Weight of the data rows of [`Coupling::Independent`], which are in mmHg.
    pub data_weight: f64,
    /// Weight that holds the parameters of [`Coupling::Independent`] to their last value (`w_theta`).
    pub parameter_weight: f64,
}

/// Where collocation points lie.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Nodes {
    /// Equidistant, both ends included.
    #[default]
    Uniform,
    /// Chebyshev-Gauss-Lobatto.
    Chebyshev,
    /// Gauss-Legendre, all inside.
    Legendre,
}

/// Nonlinearity of the random features.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[expect(missing_docs, reason = "the names are the documentation")]
pub enum Activation {
    #[default]
    Tanh,
    Logistic,
    Sine,
    Arctan,
    Softplus,
    Swish,
}

/// A distribution of random weights: exactly one of these keys.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Distribution {
    /// Between two ends.
    #[serde(deserialize_with = "pair")]
    Uniform([f64; 2]),
    /// Mean and standard deviation.
    #[serde(deserialize_with = "pair")]
    Normal([f64; 2]),
    /// Mean.
    Exponential(f64),
}

/// `[channels.STATE]`
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ChannelSettings {
    /// Standard deviation of the sensor noise \[mmHg\].
    pub noise_sd: f64,
    /// Samples below are refused as implausible \[mmHg\].
    pub min_mmhg: f64,
    /// Samples above are refused as implausible \[mmHg\].
    pub max_mmhg: f64,
}

/// `[publish]`
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PublishSettings {
    /// First chunks of every topic.
    pub prefix: String,
    /// State estimates per second and bed \[Hz\].
    pub rate_hz: f64,
    /// Whether every topic has a JSON twin.
    pub json: bool,
    /// Status messages per second and bed \[Hz\].
    pub status_rate_hz: f64,
}

/// `[service]`
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ServiceSettings {
    /// Threads that solve windows; 0 for one per core.
    pub workers: usize,
    /// What kernels run on.
    #[serde(deserialize_with = "by_name")]
    pub instruction_set: Instructions,
    /// Beds served at the same time.
    pub max_beds: usize,
    /// Blocks of samples queued per bed.
    pub queue_blocks: usize,
}

/// Vector instructions that kernels use; the results are the same with all.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Instructions {
    /// The best that this processor has.
    #[default]
    Best,
    /// Those that every processor has.
    Portable,
    /// Four numbers at a time.
    Avx2,
    /// Eight numbers at a time.
    Avx512,
}

impl Instructions {
    /// Those meant on this processor.
    #[must_use]
    pub fn set(self) -> InstructionSet {
        match self {
            Self::Best => InstructionSet::best(),
            Self::Portable => InstructionSet::Portable,
            Self::Avx2 => InstructionSet::Avx2,
            Self::Avx512 => InstructionSet::Avx512,
        }
    }
}

/// `[zenoh]`
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ZenohSettings {
    /// Role in the network.
    #[serde(deserialize_with = "by_name")]
    pub mode: ZenohMode,
    /// Endpoints on which connections are accepted.
    pub listen: Vec<String>,
    /// Endpoints to which connections are made.
    pub connect: Vec<String>,
}

/// Role in the zenoh network.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[expect(missing_docs, reason = "zenoh's own words")]
pub enum ZenohMode {
    #[default]
    Peer,
    Client,
    Router,
}

impl Default for Config {
    fn default() -> Self {
        let labels = [
            ("ABP", "p_a"),
            ("ART", "p_a"),
            ("AOBP", "p_a"),
            ("UAP", "p_a"),
            ("PAP", "p_pa"),
            ("CVP", "p_v"),
            ("LAP", "p_pv"),
            ("RVP", "p_r"),
            ("LVP", "p_l"),
        ];
        Self {
            observed: Pressures::NAMES.iter().map(|&name| name.to_owned()).collect(),
            alarms: Vec::new(),
            patient: Patient::default(),
            estimator: EstimatorSettings::default(),
            discrepancy: BTreeMap::new(),
            window: WindowSettings::default(),
            channels: default_channels(),
            labels: labels.map(|(label, state)| (label.to_owned(), state.to_owned())).into(),
            publish: PublishSettings {
                prefix: "hemostream".to_owned(),
                rate_hz: 50.0,
                json: true,
                status_rate_hz: 1.0,
            },
            service: ServiceSettings {
                workers: 0,
                instruction_set: Instructions::Best,
                max_beds: 256,
                queue_blocks: 1024,
            },
            zenoh: ZenohSettings {
                mode: ZenohMode::Peer,
                listen: vec!["tcp/127.0.0.1:7447".to_owned()],
                connect: Vec::new(),
            },
        }
    }
}

impl Default for EstimatorSettings {
    fn default() -> Self {
        Self {
            coupling: Coupling::Coupled,
            estimate: vec!["r_pv".to_owned(), "c_a".to_owned()],
            initial_guess: BTreeMap::new(),
            initial_guess_sd: 0.3,
            members: 100,
            seed: 1,
            parameter_drift: 0.02,
            pressure_drift: 0.0002,
            inflation: 1.0,
            prior: BTreeMap::new(),
            adaptive: true,
            noise_range: [0.4, 3.0],
            outlier_sd: 4.0,
            timing: Timing::Config,
            smoothing_lag_s: 0.0,
            screen_artefacts: true,
            second_opinion: SecondOpinion::None,
            max_iterations: 20,
            tolerance: 1e-4,
        }
    }
}

impl Default for WindowSettings {
    fn default() -> Self {
        Self {
            length_s: 0.002,
            allowed_lateness_s: 0.2,
            forecast_limit_s: 10.0,
            collocation_points: 5,
            nodes: Nodes::Legendre,
            neurons: 5,
            activation: Activation::Tanh,
            weights: Distribution::Uniform([-1.0, 1.0]),
            biases: Distribution::Uniform([-1.0, 1.0]),
            domain: [0.0, 1.0],
            physics_weight: 1.0,
            data_weight: 1.0,
            parameter_weight: 10.0,
        }
    }
}

/// Noise of 2 % of the maximum pressures in the paper.
fn default_channels() -> PerState<ChannelSettings> {
    let noise = |noise_sd| ChannelSettings { noise_sd, min_mmhg: -50.0, max_mmhg: 350.0 };
    PerState {
        p_l: noise(2.07),
        p_a: noise(2.06),
        p_v: noise(0.146),
        p_r: noise(0.408),
        p_pa: noise(0.40),
        p_pv: noise(0.242),
    }
}

/// Reads an enum from its name only: figment would also take a number as the position of a variant.
pub(super) fn by_name<'de, D: Deserializer<'de>, T: Deserialize<'de>>(deserializer: D) -> Result<T, D::Error> {
    let name = String::deserialize(deserializer)?;
    T::deserialize(name.into_deserializer())
}

/// Reads two numbers and no more: figment would ignore the rest of a longer list.
fn pair<'de, D: Deserializer<'de>>(deserializer: D) -> Result<[f64; 2], D::Error> {
    let numbers = Vec::deserialize(deserializer)?;
    numbers.try_into().map_err(|longer: Vec<f64>| D::Error::invalid_length(longer.len(), &"two numbers"))
}
