//! The only reader of the machine's clock.

use std::time::{Instant, SystemTime, UNIX_EPOCH};

use crate::estimate::time::{ArrivalTime, EventTime};

/// Monotonic time since this clock was made.
#[derive(Debug, Clone, Copy)]
pub struct Clock {
    start: Instant,
}

impl Clock {
    /// Starts at zero now.
    #[must_use]
    #[allow(clippy::disallowed_methods)]
    pub fn start() -> Self {
        Self { start: Instant::now() }
    }

    /// Time since the start.
    #[must_use]
    pub fn now(&self) -> ArrivalTime {
        ArrivalTime(i64::try_from(self.start.elapsed().as_nanos()).unwrap_or(i64::MAX))
    }
}

/// Unix time, for senders that stamp what they sample now.
#[must_use]
#[allow(clippy::disallowed_methods)]
pub fn unix_time() -> EventTime {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    EventTime(i64::try_from(since.as_nanos()).unwrap_or(i64::MAX))
}
