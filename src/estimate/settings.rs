//! Everything an estimator is told at the start. Plain values in mmHg, mL, s and nanoseconds; where they come from
//! (files, environment, command line) and whether they make sense together is the business of the edge.

use super::alarm::AlarmSettings;
use super::time::s_from_ns;
use super::timing::TimingSource;
use crate::model::lanes::InstructionSet;
use crate::model::{Model, ParameterInfo, Transform};
use crate::xtfc::features::FeatureSpec;
use crate::xtfc::problem::Stopping;

/// How members and windows hang together.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum CouplingKind {
    /// The window's initial pressures and the parameters are free, with the ensemble's covariance as prior.
    #[default]
    Coupled,
    /// The paper's: members know nothing of each other; continuity between windows is hard.
    Independent,
    /// Ensemble Kalman filter with a Runge-Kutta forecast: a rival of the field.
    Enkf,
    /// Unscented Kalman filter with a Runge-Kutta forecast: the rival a user would reach for first.
    Ukf,
}

impl CouplingKind {
    /// Whether members are draws from one posterior: starting guesses are spread, parameters wander, data are weighed
    /// by their noise.
    #[must_use]
    pub fn is_bayesian(self) -> bool {
        self != Self::Independent
    }

    /// Whether windows are solved by X-TFC.
    #[must_use]
    pub fn is_xtfc(self) -> bool {
        matches!(self, Self::Coupled | Self::Independent)
    }
}

/// One sensor.
#[derive(Debug, Clone, PartialEq)]
pub struct ChannelSettings {
    /// The state it observes.
    pub state: usize,
    /// Standard deviation of its noise \[mmHg\].
    pub noise_sd_mmhg: f64,
    /// Samples outside of this range \[mmHg\] are refused.
    pub plausible_mmhg: (f64, f64),
}

/// Windows in event time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WindowSettings {
    /// Length \[ns\].
    pub length_ns: i64,
    /// How long a window waits for channels that have not delivered past its end \[ns of arrival time\].
    pub allowed_lateness_ns: i64,
    /// Longest stretch without any sample that is bridged by forecasts \[ns\].
    pub forecast_limit_ns: i64,
}

impl WindowSettings {
    /// Length \[s\].
    #[must_use]
    pub fn length_s(&self) -> f64 {
        s_from_ns(self.length_ns)
    }
}

/// Weights of the rows; see [`problem`](crate::xtfc::problem).
#[derive(Debug, Clone, PartialEq)]
pub struct RowWeights {
    /// Physics rows \[s/mmHg\], per equation: `lambda_1`, and what is believed of discrepancies.
    pub physics: Vec<f64>,
    /// Data rows \[1/mmHg\] in `independent`, `lambda_2`; `coupled` uses the reciprocal of the noise.
    pub data: f64,
    /// `w_theta` of `independent`: pull of a parameter to its value in the previous window.
    pub parameter: f64,
}

/// What is believed of a parameter, in its coordinate (relative, for positive ones).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Belief {
    /// Spread of the starting guess.
    pub sd: f64,
    /// Random walk, sd per square root of a second.
    pub drift: f64,
    /// Pull back to the starting guess \[1/s\].
    pub reversion: f64,
    /// Smallest and largest value that an estimate takes.
    pub bounds: (f64, f64),
}

impl Belief {
    /// Within the bounds of the model.
    #[must_use]
    pub fn within(info: &ParameterInfo, sd: f64, drift: f64) -> Self {
        Self { sd, drift, reversion: 0.0, bounds: info.bounds }
    }

    /// The value at a coordinate, within the bounds.
    #[must_use]
    pub fn value(&self, transform: Transform, coordinate: f64) -> f64 {
        transform.inverse(coordinate).clamp(self.bounds.0, self.bounds.1)
    }

    /// The same belief of every parameter of a model.
    pub fn of_all<M: Model>(model: &M, sd: f64, drift: f64) -> Vec<Self> {
        model.parameters().iter().map(|info| Self::within(info, sd, drift)).collect()
    }
}

/// What the coupled ensemble assumes to change by itself.
#[derive(Debug, Clone, PartialEq)]
pub struct Drift {
    /// Process noise of every state, in its own unit, sd per square root of a second; `[n_states]`.
    pub states: Vec<f64>,
    /// Multiplicative inflation of the prior covariance, per second; 1 is none.
    pub inflation: f64,
}

/// What the coupled ensemble may find out for itself.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Adaptation {
    /// Whether the pace of parameters is learnt, around the one believed.
    pub pace: bool,
    /// Bounds of the sensors' noise found, in units of the one stated; (1, 1) leaves it.
    pub noise: (f64, f64),
    /// Largest process noise of a state whose sensor says that the model does not fit, in its unit per square root of a
    /// second; 0 leaves the one stated.
    pub excess: f64,
    /// Innovations beyond this many sd count as this many; infinite leaves all.
    pub outlier_sd: f64,
}

impl Adaptation {
    /// Everything as stated.
    pub const OFF: Self = Self { pace: false, noise: (1.0, 1.0), excess: 0.0, outlier_sd: f64::INFINITY };

    /// What suits signals from people.
    pub const ON: Self = Self { pace: true, noise: (0.4, 3.0), excess: 10.0, outlier_sd: 4.0 };
}

/// What an estimator does beside its windows.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct LiveSettings {
    /// Where the beat comes from.
    pub timing: TimingSource,
    /// Channels in which beats are looked for, the most trusted first.
    pub timing_channels: Vec<usize>,
    /// Whether channels are set aside while their sensor is disturbed.
    pub screen_artefacts: bool,
    /// How long estimates are corrected before they are put out a second time \[ns\]; 0 is never.
    pub smoothing_lag_ns: i64,
    /// A filter that runs beside, to compare with.
    pub second_opinion: Option<CouplingKind>,
    /// Limits that are watched.
    pub alarms: Vec<AlarmSettings>,
}

/// Everything else.
#[derive(Debug, Clone, PartialEq)]
pub struct EstimatorSettings {
    /// How members and windows hang together.
    pub coupling: CouplingKind,
    /// Parameters to estimate, as indices into the model's parameters.
    pub estimate: Vec<usize>,
    /// Number of members.
    pub members: usize,
    /// Seed of everything random.
    pub seed: u64,
    /// Parameters assumed or guessed at event time 0, `[n_parameters]`.
    pub theta: Vec<f64>,
    /// What is believed of each parameter, `[n_parameters]`; not used by `independent`.
    pub beliefs: Vec<Belief>,
    /// Initial states (pressures \[mmHg\], discrepancies), `[n_states]`.
    pub initial_state: Vec<f64>,
    /// Their spread, `[n_states]`.
    pub initial_state_sd: Vec<f64>,
    /// Features of the members.
    pub features: FeatureSpec,
    /// Windows.
    pub window: WindowSettings,
    /// Rows.
    pub weights: RowWeights,
    /// Drift.
    pub drift: Drift,
    /// What is left to the ensemble itself; `coupled` only.
    pub adaptation: Adaptation,
    /// When a member's iteration stops.
    pub stopping: Stopping,
    /// What kernels run on; the results are the same on each.
    pub instructions: InstructionSet,
    /// Sensors listened to.
    pub channels: Vec<ChannelSettings>,
    /// Sensor noise by state \[mmHg\], whether listened to or not; 0 where unknown. `[n_states]`.
    pub aleatoric_sd_mmhg: Vec<f64>,
    /// What it does beside its windows.
    pub live: LiveSettings,
    /// Spacing of the published estimates \[ns\].
    pub publish_period_ns: i64,
}

/// Settings that no estimator can be made of.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SettingsError {
    /// A vector of the wrong length.
    #[error("{what}: {found} values, the model has {expected}")]
    Length {
        /// Which.
        what: &'static str,
        /// Its length.
        found: usize,
        /// The model's.
        expected: usize,
    },
    /// Too few members for a spread.
    #[error("{0} members; at least 2 are needed for a spread")]
    Members(usize),
    /// Not positive.
    #[error("{0} must be positive")]
    NotPositive(&'static str),
    /// A state without a sensor.
    #[error("no sensor measures state number {0}")]
    State(usize),
    /// An index out of range, or a parameter the equations do not depend on.
    #[error("parameter number {0} cannot be estimated")]
    Parameter(usize),
    /// Features.
    #[error(transparent)]
    Features(#[from] crate::xtfc::features::FeatureError),
}
