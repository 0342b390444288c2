//! The clock that arrivals are told by.

use std::sync::atomic::{AtomicI64, Ordering};

use crate::estimate::time::{NS_PER_S, s_from_ns};
use crate::runtime::clock::{Clock, unix_time};

/// What the system clock may be off before it is said to have been set \[ns\].
const MAX_OFF_NS: i64 = NS_PER_S;

/// Wall clock that never goes back: counted on from the start, and set forward when the system clock was, as it is
/// after booting and after sleep.
pub(super) struct ArrivalClock {
    /// Unix time when `clock` was started, as it is known now \[ns\]. It only grows.
    start_ns: AtomicI64,
    clock: Clock,
    /// How far the system clock was behind when that was last said \[ns\].
    said_behind_ns: AtomicI64,
}

impl ArrivalClock {
    pub(super) fn start() -> Self {
        Self { start_ns: AtomicI64::new(unix_time().0), clock: Clock::start(), said_behind_ns: AtomicI64::new(0) }
    }

    pub(super) fn now_ns(&self) -> i64 {
        self.start_ns.load(Ordering::Relaxed).saturating_add(self.clock.now().0)
    }

    /// Looks whether the system clock has been set. For one thread; the others see what comes of it.
    pub(super) fn compare(&self) {
        let before_ns = self.now_ns();
        let system_ns = unix_time().0;
        self.follow(before_ns, system_ns, self.now_ns());
    }

    /// Follows the system clock, which was read between these two times: however long that took, it is not taken for a
    /// clock that was set.
    fn follow(&self, before_ns: i64, system_ns: i64, after_ns: i64) {
        let ahead_ns = system_ns.saturating_sub(after_ns);
        if ahead_ns > MAX_OFF_NS {
            self.start_ns.fetch_add(ahead_ns, Ordering::Relaxed);
            tracing::warn!(ahead_s = s_from_ns(ahead_ns), "the system clock is ahead: arrivals step forward");
        }
        self.say_behind(before_ns.saturating_sub(system_ns).max(0));
    }

    /// Says that the system clock is behind, once each time that it is set.
    fn say_behind(&self, behind_ns: i64) {
        let said_ns = self.said_behind_ns.load(Ordering::Relaxed);
        if behind_ns.abs_diff(said_ns) <= MAX_OFF_NS.unsigned_abs() {
            return;
        }
        let is_behind = behind_ns > MAX_OFF_NS;
        self.said_behind_ns.store(if is_behind { behind_ns } else { 0 }, Ordering::Relaxed);
        if is_behind {
            tracing::warn!(behind_s = s_from_ns(behind_ns), "the system clock is behind: arrivals do not go back");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: i64 = NS_PER_S;

    /// When the clock was started and how far the system clock was behind, after it has been read as so far ahead.
    fn after(clock: &ArrivalClock, ahead_ns: i64) -> (i64, i64) {
        let start_ns = clock.start_ns.load(Ordering::Relaxed);
        clock.follow(start_ns, start_ns + ahead_ns, start_ns);
        (clock.start_ns.load(Ordering::Relaxed) - start_ns, clock.said_behind_ns.load(Ordering::Relaxed))
    }

    #[test]
    fn arrivals_step_forward_with_the_system_clock_and_never_back() {
        let clock = ArrivalClock::start();
        assert_eq!([S, -S, 0].map(|ahead| after(&clock, ahead)), [(0, 0); 3], "two clocks are never quite the same");
        assert_eq!(after(&clock, S + 1), (S + 1, 0));
        assert_eq!(after(&clock, 50 * 365 * 86_400 * S), (50 * 365 * 86_400 * S, 0), "after booting without a battery");
        // Said once each time that it is set back.
        assert_eq!([-5 * S, -5 * S - 3, -7 * S, 0].map(|a| after(&clock, a).0), [0; 4]);
        assert_eq!([-5 * S, -5 * S - 3, -7 * S, 0].map(|a| after(&clock, a).1), [5 * S, 5 * S, 7 * S, 0]);
    }

    #[test]
    fn who_was_held_up_while_reading_the_clocks_sees_no_step() {
        let clock = ArrivalClock::start();
        let start_ns = clock.start_ns.load(Ordering::Relaxed);
        clock.follow(start_ns, start_ns + 3 * S, start_ns + 3 * S);
        clock.follow(start_ns, start_ns, start_ns + 3 * S);
        assert_eq!(clock.start_ns.load(Ordering::Relaxed), start_ns);
        assert_eq!(clock.said_behind_ns.load(Ordering::Relaxed), 0);
        let before_ns = clock.now_ns();
        clock.compare();
        assert!(clock.now_ns() >= before_ns);
    }
}
