//! `hemostream validate`: twin experiments. A synthetic patient whose truth is known is watched through noisy sensors by
//! the estimator as everybody runs it, sample by sample, and by the filters a user would reach for first, on the very
//! same samples; what they say is scored against the truth.
//!
//! Invariants: nothing that is told to the estimator changes the truth or the samples; a result is a function of patient,
//! scenario, seed and settings, not of the number of threads or of what else is run beside it.
//! Deliberately absent: a verdict on whether the numbers are good enough, and wall time. Layers: this one and
//! `reproduce` stand on all others and know nothing of each other.

use std::path::PathBuf;

use crate::edge::config::ConfigError;
use crate::estimate::settings::SettingsError;
use crate::model::truth::SimulationError;

pub mod experiment;
pub mod patients;
pub mod pictures;
pub mod scenario;
pub mod score;
pub mod table;
pub mod twin;

/// The settings of an estimator that is validated, where the user says nothing else: name and text.
pub const PRESET: (&str, &str) = ("config/validate.toml", include_str!("../../config/validate.toml"));

/// An experiment could not be done.
#[derive(Debug, thiserror::Error)]
pub enum ValidateError {
    /// A patient that is neither built in nor a file.
    #[error("found patient `{found}`, expected a TOML file or one of {}", known.join(", "))]
    UnknownPatient {
        /// What was asked for.
        found: String,
        /// What there is.
        known: Vec<&'static str>,
    },
    /// The same patient twice.
    #[error("found patient `{0}` twice, expected every name once")]
    PatientTwice(String),
    /// Settings of a patient or of an estimator.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// Settings that no estimator can be made of.
    #[error(transparent)]
    Settings(#[from] SettingsError),
    /// The truth.
    #[error("patient {patient}: {source}")]
    Simulation {
        /// Whose.
        patient: String,
        /// Why.
        source: SimulationError,
    },
    /// A file of results.
    #[error("{}: {reason}", path.display())]
    File {
        /// Which.
        path: PathBuf,
        /// Why.
        reason: String,
    },
}
