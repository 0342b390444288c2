//! A display that was stopped, and the past that can be gone through then.

use std::time::Duration;

use super::super::bed::Bed;

/// A bed as it was when the display was stopped.
pub(super) struct Frozen {
    pub(super) name: String,
    bed: Bed,
    pub(super) at: Duration,
    /// An earlier time that was gone back to \[ns\], and the bed as it was then.
    past: Option<(i64, Box<Bed>)>,
}

impl Frozen {
    pub(super) fn new(name: &str, bed: &Bed, at: Duration) -> Self {
        Self { name: name.to_owned(), bed: bed.clone(), at, past: None }
    }

    /// What is to be shown.
    pub(super) fn shown(&self) -> &Bed {
        self.past.as_ref().map_or(&self.bed, |(_, past)| past)
    }

    /// How far before the stop it is gone back \[ns\].
    pub(super) fn back_ns(&self) -> i64 {
        let end_ns = self.bed.newest_ns(self.at).unwrap_or(0);
        self.past.as_ref().map_or(0, |(time_ns, _)| end_ns.saturating_sub(*time_ns))
    }

    /// Goes by so much, back where it is negative, and no further than that `least_ns` of the past are still seen; says
    /// whether there was anywhere to go.
    pub(super) fn scrub(&mut self, by_ns: i64, least_ns: i64) -> bool {
        let (Some(end_ns), Some(oldest_ns)) = (self.bed.newest_ns(self.at), self.bed.history.oldest_ns()) else {
            return false;
        };
        let from_ns = self.past.as_ref().map_or(end_ns, |(time_ns, _)| *time_ns);
        let first_ns = oldest_ns.saturating_add(least_ns).min(end_ns);
        let to_ns = from_ns.saturating_add(by_ns).clamp(first_ns, end_ns);
        self.past = (to_ns < end_ns).then(|| (to_ns, Box::new(self.bed.as_of(to_ns))));
        to_ns != from_ns
    }
}
