//! What can be wrong with a file.

use std::fmt::Display;
use std::path::{Path, PathBuf};

/// A file that cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum FileError {
    /// Opening, reading or writing failed.
    #[error("{path}: {reason}")]
    File {
        /// Which file.
        path: PathBuf,
        /// What the system said.
        reason: String,
    },
    /// The content is not what it should be.
    #[error("{path}{}: found {found}, expected {expected}", line.map_or_else(String::new, |l| format!(":{l}")))]
    Content {
        /// Which file.
        path: PathBuf,
        /// Line, counted from 1.
        line: Option<u64>,
        /// What is there.
        found: String,
        /// What should be.
        expected: String,
    },
}

impl FileError {
    pub(in crate::edge) fn file(path: &Path, error: &dyn Display) -> Self {
        Self::File { path: path.to_owned(), reason: error.to_string() }
    }

    pub(in crate::edge) fn content(path: &Path, line: Option<u64>, found: impl Into<String>, expected: &str) -> Self {
        Self::Content { path: path.to_owned(), line, found: found.into(), expected: expected.to_owned() }
    }
}
