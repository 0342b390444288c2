//! What is wrong with a configuration, in words for the person who wrote it.

use std::fmt;

use crate::model::discrepancy::DiscrepancyError;

/// A configuration that is refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ConfigError {
    /// The file could not be read.
    #[error("{file}: cannot be read: {reason}")]
    Unreadable {
        /// The file.
        file: String,
        /// Why.
        reason: String,
    },
    /// The file is not TOML.
    #[error("{file}:{line}:{column}: not valid TOML: {reason}")]
    Syntax {
        /// The file.
        file: String,
        /// Line, from 1.
        line: usize,
        /// Column, from 1.
        column: usize,
        /// Why.
        reason: String,
    },
    /// A `--set` that is not `key=value`.
    #[error("--set: found `{argument}`, expected `key=value` such as `window.length_s=0.002`")]
    Argument {
        /// What came after `--set`.
        argument: String,
    },
    /// Settings that are unknown, of the wrong type or out of range.
    #[error("{}", lines(.0))]
    Settings(Vec<Problem>),
}

impl ConfigError {
    /// Discrepancies that the model does not have.
    pub(in crate::edge) fn discrepancy(error: &DiscrepancyError) -> Self {
        Self::Settings(vec![Problem::new("discrepancy", error.to_string())])
    }
}

/// One setting that is refused.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Problem {
    /// Dotted key.
    pub key: String,
    /// Where it was set: `FILE:LINE`, `environment NAME`, `--set`, or `default`.
    pub origin: Option<String>,
    /// What was found and what was expected.
    pub message: String,
}

impl Problem {
    /// A problem of unknown origin.
    pub(super) fn new(key: impl Into<String>, message: impl Into<String>) -> Self {
        Self { key: key.into(), origin: None, message: message.into() }
    }
}

impl fmt::Display for Problem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(origin) = &self.origin {
            write!(f, "{origin}: ")?;
        }
        write!(f, "`{}`: {}", self.key, self.message)
    }
}

fn lines(problems: &[Problem]) -> String {
    problems.iter().map(Problem::to_string).collect::<Vec<_>>().join("\n")
}
