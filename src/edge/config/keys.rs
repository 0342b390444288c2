//! Dotted keys: their spelling, which of them exist, and what a misspelt one may have meant.

use std::fmt;

use super::effective;
use super::schema::Config;

/// Keys that exist and have no value by default, besides those of `Config::default()`.
const WITHOUT_DEFAULT: &[&str] = &[
    "patient.systole.fraction",
    "patient.systole.bazett",
    "patient.initial.p_l",
    "patient.initial.p_a",
    "patient.initial.p_v",
    "patient.initial.p_r",
    "patient.initial.p_pa",
    "patient.initial.p_pv",
    "patient.initial_sd.p_l",
    "patient.initial_sd.p_a",
    "patient.initial_sd.p_v",
    "patient.initial_sd.p_r",
    "patient.initial_sd.p_pa",
    "patient.initial_sd.p_pv",
    "window.weights.normal",
    "window.weights.exponential",
    "window.biases.normal",
    "window.biases.exponential",
];

/// A key as the list of its segments: the position in an array is a segment, and a segment may contain dots.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Default)]
pub(super) struct KeyPath(pub(super) Vec<String>);

impl KeyPath {
    /// The key of an entry.
    pub(super) fn join(&self, segment: impl Into<String>) -> Self {
        Self(self.0.iter().cloned().chain([segment.into()]).collect())
    }

    /// Whether these are the first segments.
    pub(super) fn starts_with(&self, segments: &[&str]) -> bool {
        self.0.len() >= segments.len() && self.0.iter().zip(segments).all(|(a, b)| a == b)
    }

    /// The name of the environment variable that sets this key.
    pub(super) fn variable(&self) -> String {
        format!("{}{}", super::layers::PREFIX, self.0.join("__").to_uppercase())
    }
}

impl From<&str> for KeyPath {
    fn from(dotted: &str) -> Self {
        Self(dotted.split('.').map(str::to_owned).collect())
    }
}

impl From<String> for KeyPath {
    fn from(dotted: String) -> Self {
        dotted.as_str().into()
    }
}

impl fmt::Display for KeyPath {
    /// As TOML would spell it, in quotes where necessary.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (position, segment) in self.0.iter().enumerate() {
            let dot = if position > 0 { "." } else { "" };
            let bare = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
            if !segment.is_empty() && segment.chars().all(bare) {
                write!(f, "{dot}{segment}")?;
            } else {
                write!(f, "{dot}{}", toml::Value::String(segment.clone()))?;
            }
        }
        Ok(())
    }
}

/// Every key that can be set, dotted. Maps with free names are represented by their default entries.
#[must_use]
pub fn known_keys() -> Vec<String> {
    known_paths().iter().map(KeyPath::to_string).collect()
}

fn known_paths() -> Vec<KeyPath> {
    let with_default = effective::leaves(&Config::default()).into_iter().map(|(path, _)| path);
    with_default.chain(WITHOUT_DEFAULT.iter().map(|&key| key.into())).collect()
}

/// The key that an unknown one may have meant; `siblings` are the known names in its place.
pub(super) fn meant(unknown: &KeyPath, siblings: &[&str]) -> Option<KeyPath> {
    let (name, parents) = unknown.0.split_last()?;
    let known = known_paths();
    // The tables joined by the wrong character, or the right name in the wrong table.
    let joined = unknown.0.join("_");
    let respelt = || known.iter().find(|key| key.0.join("_") == joined);
    let elsewhere = || only(known.iter().filter(|key| key.0.last() == Some(name)));
    let sibling = || nearest(name, siblings).map(|near| KeyPath(parents.to_vec()).join(near));
    respelt().or_else(elsewhere).cloned().or_else(sibling)
}

/// What to say of a name that is not one of `known`.
pub(super) fn unknown_name(found: &str, known: &[&str]) -> String {
    let hint = nearest(found, known).map(|near| format!("; did you mean \"{near}\"?"));
    format!("found \"{found}\", expected one of {}{}", known.join(", "), hint.unwrap_or_default())
}

/// The one candidate with the fewest edits, if they are few, or else the one that `name` begins.
fn nearest<'a>(name: &str, candidates: &[&'a str]) -> Option<&'a str> {
    let candidates = || candidates.iter().copied();
    let limit = (name.chars().count() / 3).max(1);
    let fewest = candidates().map(|candidate| edits(name, candidate)).min().filter(|&edits| edits <= limit);
    let alike = |fewest| only(candidates().filter(|candidate| edits(name, candidate) == fewest));
    let longer = || only(candidates().filter(|candidate| !name.is_empty() && candidate.starts_with(name)));
    fewest.and_then(alike).or_else(longer)
}

fn only<T>(mut candidates: impl Iterator<Item = T>) -> Option<T> {
    candidates.next().filter(|_| candidates.next().is_none())
}

/// Levenshtein distance, upper and lower case alike.
fn edits(a: &str, b: &str) -> usize {
    let (a, b) = (a.to_lowercase(), b.to_lowercase());
    let mut row: Vec<usize> = (0..=b.chars().count()).collect();
    for (i, from) in a.chars().enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for (j, to) in b.chars().enumerate() {
            let replaced = diagonal + usize::from(from != to);
            diagonal = row[j + 1];
            row[j + 1] = replaced.min(row[j] + 1).min(diagonal + 1);
        }
    }
    row[b.chars().count()]
}
