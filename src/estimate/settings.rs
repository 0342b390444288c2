//! Everything an estimator is told at the start. Plain values in mmHg, mL, s and nanoseconds; where they come from
//! (files, environment, command line) and whether they make sense together is the business of the edge.

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

/// What the coupled ensemble assumes to change by itself.
#[derive(Debug, Clone, PartialEq)]
pub struct Drift {
    /// Random walk of every estimated coordinate (relative, for positive parameters), sd per square root of a second.
    pub parameters: f64,
    /// Process noise of every state, in its own unit, sd per square root of a second; `[n_states]`.
    pub states: Vec<f64>,
    /// Multiplicative inflation of the prior covariance, per second; 1 is none.
    pub inflation: f64,
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
    /// Spread of the starting guesses of estimated parameters (relative, for positive ones); `coupled` only.
    pub initial_guess_sd: f64,
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
    /// When a member's iteration stops.
    pub stopping: Stopping,
    /// Sensors listened to.
    pub channels: Vec<ChannelSettings>,
    /// Sensor noise by state \[mmHg\], whether listened to or not; 0 where unknown. `[n_states]`.
    pub aleatoric_sd_mmhg: Vec<f64>,
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
