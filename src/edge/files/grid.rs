//! Rows at a constant rate: those of a record that has one, or the nearest samples of one that has not.

use super::csv::Row;
use crate::estimate::time::{EventTime, NS_PER_S, ns_from_s};

/// How far a row may be from its place where nothing is resampled \[ns\]: what rounding to microseconds costs.
const TOLERANCE_NS: i64 = 1000;

/// Decimals of a rate that are tried.
const MAX_DECIMALS: i32 = 9;

/// Most places of a grid: 12 days at 125 Hz.
pub const MAX_PLACES: u64 = 1 << 27;

/// Times at a constant rate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Grid {
    /// Its first time.
    pub start: EventTime,
    /// Places per second.
    pub rate_hz: f64,
}

/// Why rows do not fit a grid.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum GridError {
    /// A row between two places.
    #[error("a row at {at_s} s where {expected_s} s is due at {rate_hz} Hz")]
    Irregular {
        /// Where it is.
        at_s: f64,
        /// Where it should be.
        expected_s: f64,
        /// At this rate.
        rate_hz: f64,
    },
    /// Too many places.
    #[error("more than {MAX_PLACES} places at {0} Hz")]
    TooLong(f64),
}

impl Grid {
    /// The grid of evenly spaced rows, at the rate with the fewest decimals; None for less than two rows.
    #[must_use]
    #[allow(clippy::cast_precision_loss)]
    pub fn through(first: EventTime, last: EventTime, rows: u64) -> Option<Self> {
        let span_ns = last.ns_since(first);
        if rows < 2 || span_ns <= 0 {
            return None;
        }
        let steps = (rows - 1) as f64;
        let exact = steps * NS_PER_S as f64 / span_ns as f64;
        let decimals = (0..=MAX_DECIMALS).map(|decimals| {
            let unit = 10_f64.powi(decimals);
            (exact * unit).round() / unit
        });
        let fits = |rate: &f64| *rate > 0.0 && (ns_from_s(steps / rate) - span_ns).abs() <= TOLERANCE_NS / 2;
        Some(Self { start: first, rate_hz: decimals.into_iter().find(fits).unwrap_or(exact) })
    }

    /// When a place is.
    #[must_use]
    #[allow(clippy::cast_precision_loss)]
    pub fn time(&self, place: u64) -> EventTime {
        self.start.plus_ns(ns_from_s(place as f64 / self.rate_hz))
    }

    /// The place nearest to a time that is not before the start, and how far it is from it \[ns\].
    #[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    fn place(&self, time: EventTime) -> Result<(u64, i64), GridError> {
        let since = time.ns_since(self.start);
        let place = (since as f64 / NS_PER_S as f64 * self.rate_hz).round();
        if place >= MAX_PLACES as f64 {
            return Err(GridError::TooLong(self.rate_hz));
        }
        let place = place.max(0.0) as u64;
        Ok((place, time.ns_since(self.time(place)).abs()))
    }
}

/// Puts rows on a grid.
pub struct OnGrid {
    grid: Grid,
    /// Whether every place must have a row, and every row be at its place.
    strict: bool,
    /// The place that is being filled.
    place: u64,
    /// Nearest value so far per column, and its distance \[ns\].
    nearest: Vec<Option<(f64, i64)>>,
}

impl OnGrid {
    /// For rows of so many columns. Unless `strict`, a place takes the nearest sample within half a period, and is
    /// empty without one.
    #[must_use]
    pub fn new(grid: Grid, columns: usize, strict: bool) -> Self {
        Self { grid, strict, place: 0, nearest: vec![None; columns] }
    }

    /// Takes the next row; `emit` gets all places before it, filled or empty.
    ///
    /// # Errors
    /// When it does not fit, or `emit` fails.
    pub fn take<E: From<GridError>>(&mut self, row: &Row, emit: &mut dyn FnMut(Row) -> Result<(), E>) -> Result<(), E> {
        let (place, distance) = self.grid.place(row.time)?;
        if self.strict && (distance > TOLERANCE_NS || place > self.place + 1) {
            let expected = if distance > TOLERANCE_NS { place } else { self.place + 1 };
            let (at_s, expected_s) = (row.time.as_s(), self.grid.time(expected).as_s());
            return Err(GridError::Irregular { at_s, expected_s, rate_hz: self.grid.rate_hz }.into());
        }
        while self.place < place {
            emit(self.filled())?;
            self.place += 1;
        }
        for (nearest, value) in self.nearest.iter_mut().zip(&row.values) {
            if let Some(value) = value.filter(|_| nearest.is_none_or(|(_, before)| distance < before)) {
                *nearest = Some((value, distance));
            }
        }
        Ok(())
    }

    /// Hands out the last place.
    ///
    /// # Errors
    /// When `emit` fails.
    pub fn finish<E>(mut self, emit: &mut dyn FnMut(Row) -> Result<(), E>) -> Result<(), E> {
        emit(self.filled())
    }

    fn filled(&mut self) -> Row {
        let values = self.nearest.iter_mut().map(|nearest| nearest.take().map(|(value, _)| value)).collect();
        Row { time: self.grid.time(self.place), values }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(ns: i64, value: f64) -> Row {
        Row { time: EventTime(ns), values: vec![Some(value)] }
    }

    fn put(grid: Grid, strict: bool, rows: &[Row]) -> Result<Vec<(i64, Option<f64>)>, GridError> {
        let mut placed = Vec::new();
        let mut emit = |row: Row| -> Result<(), GridError> {
            placed.push((row.time.0, row.values[0]));
            Ok(())
        };
        let mut on = OnGrid::new(grid, 1, strict);
        for row in rows {
            on.take(row, &mut emit)?;
        }
        on.finish(&mut emit)?;
        Ok(placed)
    }

    #[test]
    fn rates_are_found_in_times_rounded_to_nanoseconds_and_to_microseconds() {
        for rate in [125.0, 360.0, 62.5, 250.0, 128.0, 1000.0 / 3.0, 499.907, 0.1, 30_000.0] {
            for unit in [1, 1000] {
                let truth = Grid { start: EventTime(7_000), rate_hz: rate };
                let time = |k: u64| EventTime(truth.time(k).0 / unit * unit);
                let found = Grid::through(time(0), time(10_000), 10_001).unwrap();
                let worst = (0..=10_000).map(|k| found.time(k).ns_since(time(k)).abs()).max().unwrap();
                assert!(worst <= 1000, "{rate} Hz: {} Hz, {worst} ns", found.rate_hz);
                if unit == 1 && rate.fract() == 0.0 {
                    assert_eq!(found.rate_hz.to_bits(), rate.to_bits());
                }
            }
        }
        assert_eq!(Grid::through(EventTime(0), EventTime(0), 1), None);
    }

    #[test]
    fn what_is_not_at_its_place_is_refused_without_resampling() {
        let grid = Grid { start: EventTime(0), rate_hz: 100.0 };
        let ms = 1_000_000;
        let even = [row(0, 0.0), row(10 * ms + 900, 1.0), row(20 * ms - 900, 2.0)];
        assert_eq!(put(grid, true, &even).unwrap(), [(0, Some(0.0)), (10 * ms, Some(1.0)), (20 * ms, Some(2.0))]);
        let jitter = put(grid, true, &[row(0, 0.0), row(10 * ms + 1001, 1.0)]).unwrap_err().to_string();
        assert_eq!(jitter, "a row at 0.010001001 s where 0.01 s is due at 100 Hz");
        let gap = put(grid, true, &[row(0, 0.0), row(20 * ms, 1.0)]).unwrap_err().to_string();
        assert_eq!(gap, "a row at 0.02 s where 0.01 s is due at 100 Hz");
    }

    #[test]
    fn a_place_takes_the_nearest_sample_within_half_a_period_or_none() {
        let grid = Grid { start: EventTime(0), rate_hz: 100.0 };
        let ms = 1_000_000;
        let rows = [row(0, 0.0), row(4 * ms, 0.4), row(8 * ms, 0.8), row(11 * ms, 1.1), row(34 * ms, 3.4)];
        let expected = [(0, Some(0.0)), (10 * ms, Some(1.1)), (20 * ms, None), (30 * ms, Some(3.4))];
        assert_eq!(put(grid, false, &rows).unwrap(), expected);
        let far = put(grid, false, &[row(0, 0.0), row(i64::MAX, 1.0)]).unwrap_err();
        assert_eq!(far, GridError::TooLong(100.0));
    }
}
