//! A short past, in order of event time, with a limit on age, density and number.

use std::collections::VecDeque;

/// Rows that arrive this much too late are sorted in; what is older still means that the source began anew \[ns\].
const REORDERING_NS: i64 = 2_000_000_000;

/// How much of the past is kept.
#[derive(Debug, Clone, Copy)]
pub(super) struct Limits {
    /// Oldest row, before the newest \[ns\].
    pub(super) age_ns: i64,
    /// Rows closer than this to a kept one are left out \[ns\].
    pub(super) spacing_ns: i64,
    /// Most rows.
    pub(super) rows: usize,
}

/// Rows with their event times.
#[derive(Debug, Clone)]
pub(super) struct History<T> {
    rows: VecDeque<(i64, T)>,
    restarts: u64,
}

// Derived, it would ask for `T: Default`.
impl<T> Default for History<T> {
    fn default() -> Self {
        Self { rows: VecDeque::new(), restarts: 0 }
    }
}

impl<T> History<T> {
    /// Takes a row in, or leaves it out where the past is dense enough already.
    pub(super) fn push(&mut self, time_ns: i64, row: T, limits: Limits) {
        if let Some(newest_ns) = self.newest_ns() {
            if time_ns < newest_ns.saturating_sub(REORDERING_NS) {
                self.rows.clear();
                self.restarts += 1;
            }
            let at = self.rows.partition_point(|(t, _)| *t < time_ns);
            if self.is_dense_at(at, time_ns, limits.spacing_ns) {
                return;
            }
            self.rows.insert(at, (time_ns, row));
        } else {
            self.rows.push_back((time_ns, row));
        }
        self.trim(limits);
    }

    fn is_dense_at(&self, at: usize, time_ns: i64, spacing_ns: i64) -> bool {
        let close = |row: Option<&(i64, T)>| row.is_some_and(|(t, _)| t.abs_diff(time_ns) < spacing_ns.unsigned_abs());
        close(self.rows.get(at)) || at.checked_sub(1).is_some_and(|before| close(self.rows.get(before)))
    }

    fn trim(&mut self, limits: Limits) {
        let oldest_ns = self.newest_ns().unwrap_or(i64::MIN).saturating_sub(limits.age_ns);
        while self.rows.len() > limits.rows || self.rows.front().is_some_and(|(t, _)| *t < oldest_ns) {
            self.rows.pop_front();
        }
    }

    /// Event time of the newest row.
    pub(super) fn newest_ns(&self) -> Option<i64> {
        self.rows.back().map(|(t, _)| *t)
    }

    /// Event time of the oldest row.
    pub(super) fn oldest_ns(&self) -> Option<i64> {
        self.rows.front().map(|(t, _)| *t)
    }

    /// The newest row that is not after `time_ns`.
    pub(super) fn at(&self, time_ns: i64) -> Option<(i64, &T)> {
        let after = self.rows.partition_point(|(t, _)| *t <= time_ns);
        after.checked_sub(1).and_then(|last| self.rows.get(last)).map(|(t, row)| (*t, row))
    }

    /// The rows that are not after `time_ns`.
    pub(super) fn until(&self, time_ns: i64) -> Self
    where
        T: Clone,
    {
        let after = self.rows.partition_point(|(t, _)| *t <= time_ns);
        Self { rows: self.rows.range(..after).cloned().collect(), restarts: self.restarts }
    }

    /// How often the source began anew.
    pub(super) fn restarts(&self) -> u64 {
        self.restarts
    }

    /// The rows after `time_ns`.
    pub(super) fn after(&self, time_ns: i64) -> impl DoubleEndedIterator<Item = (i64, &T)> + Clone {
        let first = self.rows.partition_point(|(t, _)| *t <= time_ns);
        self.rows.range(first..).map(|(t, row)| (*t, row))
    }

    /// Number of rows.
    #[cfg(test)]
    pub(super) fn len(&self) -> usize {
        self.rows.len()
    }

    /// The rows from `from_ns` on, and one before so that a line can enter the picture.
    pub(super) fn since(&self, from_ns: i64) -> impl DoubleEndedIterator<Item = (i64, &T)> + Clone {
        let first = self.rows.partition_point(|(t, _)| *t < from_ns).saturating_sub(1);
        self.rows.range(first..).map(|(t, row)| (*t, row))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMITS: Limits = Limits { age_ns: 10_000_000_000, spacing_ns: 8_000_000, rows: 1000 };
    const MS: i64 = 1_000_000;

    fn times_ms(history: &History<u8>) -> Vec<i64> {
        history.since(i64::MIN).map(|(t, _)| t / MS).collect()
    }

    #[test]
    fn a_late_row_is_sorted_in_and_a_dense_one_left_out() {
        let mut history = History::default();
        for ms in [0, 100, 50, 52, 50, 104] {
            history.push(ms * MS, 0, LIMITS);
        }
        assert_eq!(times_ms(&history), [0, 50, 100]);
    }

    #[test]
    fn time_that_goes_back_begins_anew() {
        let mut history = History::default();
        for ms in [0, 9000, 100] {
            history.push(ms * MS, 0, LIMITS);
        }
        assert_eq!(times_ms(&history), [100]);
    }

    #[test]
    fn the_past_ends_where_it_is_asked_to() {
        let mut history = History::default();
        for (ms, row) in [(0, 1), (100, 2), (200, 3)] {
            history.push(ms * MS, row, LIMITS);
        }
        assert_eq!(times_ms(&history.until(199 * MS)), [0, 100]);
        assert_eq!(
            [-1, 100, 199, 900].map(|ms| history.at(ms * MS).map(|(_, row)| *row)),
            [None, Some(2), Some(2), Some(3)]
        );
        assert_eq!((history.oldest_ns(), history.until(-1).oldest_ns()), (Some(0), None));
    }

    #[test]
    fn age_and_number_are_limited() {
        let mut history = History::default();
        for i in 0..100_000 {
            history.push(i * MS, 0, LIMITS);
        }
        assert_eq!(history.len(), 1000);
        history.push(i64::MAX, 0, LIMITS);
        assert_eq!(history.len(), 1);
        history.push(i64::MIN, 0, LIMITS);
        assert_eq!(history.len(), 1);
    }
}
