//! Event time and arrival time. Integer nanoseconds: windows are cut exactly, for months.

/// Nanoseconds per second.
pub const NS_PER_S: i64 = 1_000_000_000;

/// When something happened to the patient \[ns\]; the zero is the sender's.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct EventTime(pub i64);

/// When the estimator heard of it \[ns\]; the zero is the start of the process (or event time 0 for files).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ArrivalTime(pub i64);

impl EventTime {
    /// From seconds, to the nearest nanosecond.
    #[must_use]
    pub fn from_s(seconds: f64) -> Self {
        Self(ns_from_s(seconds))
    }

    /// In seconds.
    #[must_use]
    pub fn as_s(self) -> f64 {
        s_from_ns(self.0)
    }

    /// This much later; saturates.
    #[must_use]
    pub fn plus_ns(self, ns: i64) -> Self {
        Self(self.0.saturating_add(ns))
    }

    /// Nanoseconds since `earlier`; saturates.
    #[must_use]
    pub fn ns_since(self, earlier: Self) -> i64 {
        self.0.saturating_sub(earlier.0)
    }
}

impl ArrivalTime {
    /// Nanoseconds since `earlier`; saturates.
    #[must_use]
    pub fn ns_since(self, earlier: Self) -> i64 {
        self.0.saturating_sub(earlier.0)
    }
}

/// Seconds to the nearest nanosecond; saturates, NaN becomes 0.
#[must_use]
#[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss)]
pub fn ns_from_s(seconds: f64) -> i64 {
    // Whole seconds apart, so that unix times keep their nanoseconds as well as an f64 can.
    let whole = seconds.trunc();
    let rest = ((seconds - whole) * NS_PER_S as f64).round();
    (whole as i64).saturating_mul(NS_PER_S).saturating_add(rest as i64)
}

/// Nanoseconds to seconds.
#[must_use]
#[allow(clippy::cast_precision_loss)]
pub fn s_from_ns(ns: i64) -> f64 {
    ns as f64 / NS_PER_S as f64
}
