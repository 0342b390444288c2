//! What serde found, in the words of the person who wrote it.

use figment::error::{Actual, Kind};

use super::keys::{self, KeyPath};
use super::layers;

/// The message for an error at `path`, in a layer called `origin`.
pub(super) fn explain(path: &KeyPath, origin: &str, kind: Kind) -> String {
    match kind {
        Kind::UnknownField(_, known) => unknown_key(path, origin, known),
        // To serde the keys of a one-of table are variants, like the words of any choice.
        Kind::UnknownVariant(_, known) if layers::is_in_one_of(path) => unknown_key(path, origin, known),
        Kind::UnknownVariant(found, known) => keys::unknown_name(&found, known),
        Kind::InvalidType(found, expected) | Kind::InvalidValue(found, expected) => {
            format!("found {}, expected {}", found_text(&found), expected_text(&expected))
        }
        Kind::InvalidLength(found, expected) => format!("found a list of {found}, expected {expected}"),
        Kind::MissingField(name) => format!("found no `{name}`, expected one"),
        other => other.to_string(),
    }
}

fn unknown_key(path: &KeyPath, origin: &str, known: &[&str]) -> String {
    let in_environment = origin.starts_with("environment ");
    match keys::meant(path, known) {
        Some(meant) if in_environment => format!("unknown key, did you mean {}?", meant.variable()),
        Some(meant) => format!("unknown key, did you mean `{meant}`?"),
        None => format!("unknown key, expected one of {}", known.join(", ")),
    }
}

fn found_text(found: &Actual) -> String {
    match found {
        Actual::Bool(truth) => truth.to_string(),
        Actual::Signed(number) => number.to_string(),
        Actual::Unsigned(number) => number.to_string(),
        Actual::Float(number) => format!("{number:?}"),
        Actual::Str(text) => format!("{text:?}"),
        Actual::Seq => "a list".to_owned(),
        Actual::Map => "a table".to_owned(),
        other => other.to_string(),
    }
}

fn expected_text(expected: &str) -> &str {
    match expected {
        "f64" => "a number",
        "u64" | "usize" => "a whole number, 0 or more",
        "a boolean" => "true or false",
        "a string" => "text in quotes",
        "a sequence" => "a list",
        "a map" => "a table",
        other if other.starts_with("struct ") => "a table",
        other => other,
    }
}
