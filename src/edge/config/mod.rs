//! Configuration: built-in defaults < TOML file < environment < `--set key=value`.
//!
//! [`Config::load`] refuses unknown keys, wrong types and values out of range before anything starts, and says of
//! every setting where it comes from. The schema is in `schema.rs` and `patient.rs`; `config/default.toml` is the
//! same for users, and a test keeps the two equal.
//!
//! Invariants: every default is written once, in `Default`; a [`Config`] that was loaded passes
//! [`Config::check`]; nothing here knows what a setting does.
//! Deliberately absent: logging, conversion to the types of the core other than the model's own.
//!
//! # How to add a setting
//!
//! A documented field and its default in `schema.rs`, its range in `check.rs`, a line with the reason in
//! `config/default.toml`. The tests name whatever was forgotten.

mod check;
mod effective;
mod error;
mod explain;
mod keys;
mod layers;
mod lines;
mod patient;
mod schema;

use std::path::Path;

pub use effective::{Origins, Setting, render};
pub use error::{ConfigError, Problem};
pub use keys::known_keys;
pub use patient::{InitialSd, Patient, PulmonaryLaw, ScriptEntry, Systole};
pub use schema::{
    Activation, AlarmPriority, AlarmSettings, ChannelSettings, Config, Coupling, DiscrepancyForm, DiscrepancySettings,
    Distribution, EstimatorSettings, Nodes, PerState, PriorSettings, PublishSettings, SecondOpinion, ServiceSettings,
    Timing, WindowSettings, ZenohMode, ZenohSettings,
};

impl Config {
    /// Reads all layers; `sets` are the `key=value` of `--set`, the last one wins.
    ///
    /// # Errors
    /// When a source cannot be read, or a setting is unknown, of the wrong type or out of range.
    pub fn load(file: Option<&Path>, sets: &[String]) -> Result<(Self, Origins), ConfigError> {
        Self::load_layers(None, file, environment(), sets)
    }

    /// As [`Config::load`], with a preset (its name and text) between the defaults and the file.
    ///
    /// # Errors
    /// As [`Config::load`].
    pub fn load_over(
        preset: (&str, &str),
        file: Option<&Path>,
        sets: &[String],
    ) -> Result<(Self, Origins), ConfigError> {
        Self::load_layers(Some(preset), file, environment(), sets)
    }

    /// The text of a file alone over the defaults, under what it is called.
    ///
    /// # Errors
    /// As [`Config::load`].
    pub fn load_text(name: &str, text: &str) -> Result<Self, ConfigError> {
        Ok(Self::load_layers(Some((name, text)), None, [], &[])?.0)
    }

    /// As [`Config::load`], with the environment as an argument.
    ///
    /// # Errors
    /// As [`Config::load`].
    pub fn load_from(
        file: Option<&Path>,
        environment: impl IntoIterator<Item = (String, String)>,
        sets: &[String],
    ) -> Result<(Self, Origins), ConfigError> {
        Self::load_layers(None, file, environment, sets)
    }

    fn load_layers(
        preset: Option<(&str, &str)>,
        file: Option<&Path>,
        environment: impl IntoIterator<Item = (String, String)>,
        sets: &[String],
    ) -> Result<(Self, Origins), ConfigError> {
        let stack = layers::Stack::read(preset, file, environment, sets)?;
        let config = stack.extract()?;
        let problems: Vec<Problem> = check::faults(&config).into_iter().map(|fault| fault.located(&stack)).collect();
        if !problems.is_empty() {
            return Err(ConfigError::Settings(problems));
        }
        let origins = Origins::new(&config, |key| stack.origin(key));
        Ok((config, origins))
    }

    /// Checks all ranges, for a configuration that was put together by hand.
    ///
    /// # Errors
    /// Names every setting that is out of range.
    pub fn check(&self) -> Result<(), ConfigError> {
        let problems: Vec<Problem> = check::faults(self).into_iter().map(check::Fault::unlocated).collect();
        if problems.is_empty() { Ok(()) } else { Err(ConfigError::Settings(problems)) }
    }
}

/// What is not Unicode cannot be one of our names; in a value it shows up as a replacement character.
fn environment() -> impl Iterator<Item = (String, String)> {
    let text = |os: std::ffi::OsString| os.to_string_lossy().into_owned();
    std::env::vars_os().map(move |(name, value)| (text(name), text(value)))
}
