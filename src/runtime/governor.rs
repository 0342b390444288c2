//! What is done when the machine cannot keep up: fewer members, in all beds alike, and all of them again when it can.
//!
//! Every [`PERIOD`] the longest wait of any bed and the share of the workers' time that was spent working are looked at.
//!
//! - Samples have waited longer than [`TOO_LONG`] at two looks in a row: one step down; two at once if it is four times
//!   that. Beds that have just begun need more than they will, so that until [`SETTLED`] after the last of them only the
//!   latter counts.
//! - Nobody has waited for long, and the step above would leave a reserve: after two such looks, one step up; to the top at
//!   once where even that would leave half of the time free.
//!
//! Too few members know too little of what they share: how few there may be is for the bed to say.
//!
//! Deliberately absent: clocks, beds, threads.

use std::time::Duration;

/// Time between two looks.
pub const PERIOD: Duration = Duration::from_millis(250);

/// A wait that says that the machine cannot keep up.
pub const TOO_LONG: Duration = Duration::from_millis(100);

/// Time after which a bed needs no more than it will, and what had piled up when it began is done.
pub const SETTLED: Duration = Duration::from_secs(5);

/// A wait that is none.
const SHORT: Duration = Duration::from_millis(40);

/// Shares of the members.
const STEPS: [f64; 6] = [1.0, 0.75, 0.5, 0.35, 0.25, 0.15];

/// Share of the time that may be spent after a step up.
const RESERVE: f64 = 0.85;

/// Looks in a row that have to be good.
const GOOD_LOOKS: u32 = 2;

/// Decides how many members the ensembles have.
#[derive(Debug, Clone, Default)]
pub struct Governor {
    step: usize,
    good: u32,
    bad: u32,
}

impl Governor {
    /// Share of the members that take part.
    #[must_use]
    pub fn share(&self) -> f64 {
        STEPS[self.step]
    }

    /// Takes in a look: the longest wait now, the share of the workers' time spent since the last look, and whether beds
    /// have just begun. Returns the new share if it changes.
    pub fn look(&mut self, longest_wait: Duration, busy: f64, beginning: bool) -> Option<f64> {
        let before = self.step;
        self.bad = if longest_wait > TOO_LONG && !beginning { self.bad + 1 } else { 0 };
        if longest_wait > TOO_LONG {
            self.good = 0;
            let steps = if longest_wait > TOO_LONG * 4 { 2 } else { usize::from(self.bad > 1) };
            self.step = (self.step + steps).min(STEPS.len() - 1);
        } else if let Some(above) = self.step.checked_sub(1) {
            // As if all work grew with the members: some does not, so that this is on the safe side.
            let expected = |step: usize| busy * STEPS[step] / STEPS[before];
            let good = longest_wait < SHORT && expected(above) < RESERVE;
            self.good = if good { self.good + 1 } else { 0 };
            if self.good >= GOOD_LOOKS {
                self.good = 0;
                self.step = if expected(0) < 0.5 { 0 } else { above };
            }
        }
        (self.step != before).then(|| self.share())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WAITING: Duration = Duration::from_millis(150);
    const NONE: Duration = Duration::from_millis(1);

    #[test]
    fn members_go_step_by_step_and_come_back_when_there_is_room() {
        let mut governor = Governor::default();
        assert_eq!(governor.look(NONE, 0.99, false), None, "busy, but nobody waits");
        assert_eq!(governor.look(WAITING, 1.0, true), None);
        assert_eq!(governor.look(WAITING, 1.0, true), None, "beds begin");
        assert_eq!(governor.look(WAITING, 1.0, false), None, "once is an accident");
        assert_eq!(governor.look(NONE, 1.0, false), None);
        assert_eq!(governor.look(WAITING, 1.0, false), None);
        assert_eq!(governor.look(WAITING, 1.0, false), Some(0.75));
        assert_eq!(governor.look(WAITING * 4, 1.0, false), Some(0.35), "twice as fast where it is bad");
        assert_eq!(governor.look(NONE, 0.7, false), None);
        assert_eq!(governor.look(NONE, 0.7, false), None, "0.5 would need all of the time");
        assert_eq!(governor.look(NONE, 0.55, false), None);
        assert_eq!(governor.look(NONE, 0.55, false), Some(0.5));
        assert_eq!(governor.look(NONE, 0.1, false), None);
        assert_eq!(governor.look(NONE, 0.1, false), Some(1.0), "the load has gone away");
    }

    #[test]
    fn there_is_a_least() {
        let mut governor = Governor::default();
        (0..20).for_each(|_| _ = governor.look(WAITING, 1.0, false));
        assert!((governor.share() - 0.15).abs() < 1e-12);
    }

    /// From the least, in a machine that is idle, within the five seconds that are promised.
    #[test]
    fn full_quality_is_back_soon() {
        let mut governor = Governor::default();
        (0..20).for_each(|_| _ = governor.look(WAITING, 1.0, false));
        let looks = (1..).find(|_| {
            governor.look(NONE, 0.6 * governor.share(), false);
            governor.share() >= 1.0
        });
        assert!(looks.unwrap() * PERIOD < Duration::from_secs(5), "{looks:?}");
    }
}
