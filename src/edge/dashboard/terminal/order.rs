//! Which beds are listed, and in what order.

use std::cmp::Reverse;
use std::time::Duration;

use super::super::bed::Bed;
use super::super::ward::Ward;
use super::urgency;

/// What decides the order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Order {
    /// The name.
    Name,
    /// The most urgent alarm, then silence, then the name.
    Alarms,
}

impl Order {
    pub(super) fn next(self) -> Self {
        match self {
            Self::Name => Self::Alarms,
            Self::Alarms => Self::Name,
        }
    }

    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Name => "by name",
            Self::Alarms => "alarms first",
        }
    }
}

/// A stretch of a name; numbers come before letters and compare as numbers.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Chunk {
    Number(u128),
    Text(String),
}

/// By this `bed-2` comes before `bed-10`.
pub(super) fn natural(name: &str) -> Vec<Chunk> {
    let mut chunks = Vec::new();
    let mut rest = name;
    while let Some(first) = rest.chars().next() {
        let is_digit = first.is_ascii_digit();
        let end = rest.find(|c: char| c.is_ascii_digit() != is_digit).unwrap_or(rest.len());
        let (chunk, after) = rest.split_at(end);
        // More digits than a number holds are a text.
        let number = chunk.parse().ok().filter(|_| is_digit);
        chunks.push(number.map_or_else(|| Chunk::Text(chunk.to_owned()), Chunk::Number));
        rest = after;
    }
    chunks
}

/// The beds whose names hold `filter`, in order.
pub(super) fn listed<'a>(ward: &'a Ward, order: Order, filter: &str, now: Duration) -> Vec<(&'a str, &'a Bed)> {
    let wanted = filter.trim().to_lowercase();
    let beds = ward.beds.iter().filter(|(name, _)| name.to_lowercase().contains(&wanted));
    let mut beds: Vec<(&str, &Bed)> = beds.map(|(name, bed)| (name.as_str(), bed)).collect();
    beds.sort_by_cached_key(|(name, bed)| {
        let urgency = (urgency::of_bed(bed), !bed.liveness(now).is_live());
        (Reverse((order == Order::Alarms).then_some(urgency)), natural(name), *name)
    });
    beds
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_in_names_are_numbers() {
        let mut names = ["icu-10", "icu-2", "ICU", "icu-2b", "7", "icu-02", ""];
        names.sort_by_key(|name| natural(name));
        assert_eq!(names, ["", "7", "ICU", "icu-2", "icu-02", "icu-2b", "icu-10"]);
        let huge = "9".repeat(40);
        assert_eq!(natural(&huge), [Chunk::Text(huge)]);
    }
}
