//! When the heart beats: onsets from outside, or found in the pressures, against the clock of the ensemble.
//!
//! The same detector runs on what a channel reads and on what the members expect of it. The expected onset gives the
//! delay from the beginning of a beat to the upstroke in this channel; the observed one, less the delay, is when the
//! beat began. Small errors of the clock are left to the ensemble, which estimates heart rate and phase. Large ones are
//! none that a Gaussian could mend (a premature beat, a pause, a rhythm that changes): then the clock is set, at the
//! time at which it went wrong, and the windows since are solved again.

use super::signal::onset::{OnsetDetector, OnsetSettings, RateTracker, Recent};

/// Error of the clock that the ensemble is not left alone with \[beats\].
const SURPRISE: f64 = 0.05;

/// Less is no error of the clock \[beats\].
const TINY: f64 = 0.005;

/// An interval so many times longer than the last is that of more than one beat.
const MISSED: f64 = 1.8;

/// Share of the beat by which an onset may be late before it is missed, and what a detector needs to report it \[s\].
const LATE: f64 = 0.15;
const LATENCY_S: f64 = 0.13;

/// Intervals that differ by less than this share are a new rhythm.
const SAME_RHYTHM: f64 = 0.15;

/// Phase at which a clock without a beat waits for one: the ventricles are relaxed.
pub const WAITING_PHASE: f64 = 0.97;

/// Longest delay of an upstroke after the beginning of the beat \[s\].
const MAX_DELAY_S: f64 = 0.35;

/// Where the beat comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum TimingSource {
    /// The clock of the model, as it was set.
    #[default]
    Clock,
    /// Onsets told from outside.
    Told,
    /// Onsets found in the pressures.
    Found,
}

/// What is to be done with the clocks of the members; times are event times \[s\].
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ClockEdit {
    /// A beat began.
    Beat {
        /// When.
        at_s: f64,
        /// Heart rate from here on \[1/min\], if it changed.
        rate: Option<f64>,
        /// Whether the beat that the clock counted last was a real one, so that this is another, however early.
        another: bool,
    },
    /// No beat came where one was due: the clock waits from here on.
    Wait {
        /// When the clock reached [`WAITING_PHASE`].
        from_s: f64,
    },
    /// The clock goes on by itself: nothing can be told any more.
    GoOn,
}

/// The clock of the ensemble at the end of a window.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClockReading {
    /// End of the window \[s\].
    pub time_s: f64,
    /// Mean beats counted.
    pub beats: f64,
    /// Mean rate \[1/s\].
    pub rate_hz: f64,
}

impl ClockReading {
    fn beats_at(&self, time_s: f64) -> f64 {
        self.beats + (time_s - self.time_s) * self.rate_hz
    }
}

/// A sample beside what the members expected.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Heard {
    /// Index of the channel.
    pub channel: usize,
    /// \[s\]
    pub time_s: f64,
    /// \[mmHg\]
    pub observed: f64,
    /// \[mmHg\]
    pub expected: f64,
}

#[derive(Debug, Clone)]
struct Ear {
    observed: OnsetDetector,
    expected: OnsetDetector,
    /// From the beginning of a beat to its upstroke here \[s\], in the last beats. Members that follow the data rise with a
    /// beat that they did not expect, which is no delay: the median leaves such a beat out.
    delays_s: Recent,
}

/// Follows the beat.
#[derive(Debug, Clone)]
pub struct BeatTracker {
    source: TimingSource,
    /// One per channel.
    ears: Vec<Ear>,
    /// Channels in the order in which they are trusted with the beat.
    preferred: Vec<usize>,
    /// The one listened to.
    active: Option<usize>,
    rate: RateTracker,
    acquired: bool,
    waiting: bool,
    /// Beginning of the last beat observed \[s\], and the interval before it.
    last_beat_s: Option<f64>,
    last_interval_s: Option<f64>,
    surprises: u32,
}

/// What the tracker found.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Found {
    /// What is to be done, in order of time.
    pub edits: Vec<ClockEdit>,
    /// The beat was found for the first time, or again.
    pub acquired: bool,
    /// A beat did not come when it was due.
    pub missed: bool,
    /// A beat came at an unexpected time.
    pub surprised: bool,
}

impl BeatTracker {
    /// For a number of channels, `preferred` in the order in which they are trusted with the beat.
    #[must_use]
    pub fn new(source: TimingSource, channels: usize, preferred: Vec<usize>) -> Self {
        let ear = || Ear {
            observed: OnsetDetector::new(OnsetSettings::default()),
            expected: OnsetDetector::new(OnsetSettings::default()),
            delays_s: Recent::default(),
        };
        Self {
            source,
            ears: (0..channels).map(|_| ear()).collect(),
            preferred,
            active: None,
            rate: RateTracker::new(),
            acquired: source == TimingSource::Clock,
            waiting: false,
            last_beat_s: None,
            last_interval_s: None,
            surprises: 0,
        }
    }

    /// Whether estimates can be learnt from: not before the beat is known.
    #[must_use]
    pub fn is_acquired(&self) -> bool {
        self.acquired
    }

    /// Whether the rhythm is in doubt: a beat did not come, or came unexpectedly and none has come as expected since (one
    /// that is told is not unexpected).
    #[must_use]
    pub fn is_in_doubt(&self) -> bool {
        self.waiting || (self.source == TimingSource::Found && self.surprises > 0)
    }

    /// Takes the beats told from outside up to the end of a window.
    pub fn told(&mut self, onsets_s: &[f64], clock: ClockReading) -> Found {
        let mut found = Found::default();
        for &at_s in onsets_s {
            self.beat(at_s, clock, true, &mut found);
        }
        let phase = clock.beats - clock.beats.floor();
        let is_due = self.source == TimingSource::Told && self.acquired && onsets_s.is_empty();
        if is_due && !self.waiting && phase >= WAITING_PHASE {
            self.waiting = true;
            found.edits.push(ClockEdit::Wait { from_s: clock.time_s });
        }
        found
    }

    /// Takes the samples of a window, in order of time; `usable` says which channels can be trusted.
    pub fn listen(&mut self, heard: &[Heard], clock: ClockReading, usable: &[bool]) -> Found {
        let mut found = Found::default();
        if self.source != TimingSource::Found {
            return found;
        }
        let active = self.preferred.iter().copied().find(|c| usable.get(*c).copied().unwrap_or(false));
        if active != self.active {
            self.active = active;
            self.last_beat_s = None;
            self.last_interval_s = None;
        }
        for sample in heard {
            let ear = &mut self.ears[sample.channel];
            if let Some(onset) = ear.expected.take(sample.time_s, sample.expected) {
                let beats = clock.beats_at(onset.time_s);
                let delay_s = (beats - beats.floor()) / clock.rate_hz;
                if delay_s < MAX_DELAY_S && !self.waiting {
                    ear.delays_s.push(delay_s);
                }
            }
            let onset = ear.observed.take(sample.time_s, sample.observed);
            if let (Some(onset), Some(delay_s), true) =
                (onset, ear.delays_s.median(), self.active == Some(sample.channel))
            {
                self.rate.take(&onset);
                self.beat(onset.time_s - delay_s, clock, false, &mut found);
            }
        }
        self.look_for_missing(clock, &mut found);
        found
    }

    fn beat(&mut self, at_s: f64, clock: ClockReading, certain: bool, found: &mut Found) {
        let last_beat_s = self.last_beat_s.replace(at_s);
        let interval_s = last_beat_s.map(|last| at_s - last);
        if !self.acquired {
            let interval_s = if certain { interval_s } else { self.rate.interval_s() };
            if let Some(interval_s) = interval_s.filter(|interval_s| *interval_s > 0.0) {
                self.acquired = true;
                found.acquired = true;
                found.edits.push(ClockEdit::Beat { at_s, rate: Some(60.0 / interval_s), another: false });
            }
            self.last_interval_s = interval_s;
            return;
        }
        let beats = clock.beats_at(at_s);
        let error = beats - beats.round();
        if certain || self.waiting || error.abs() > SURPRISE {
            let counted_last = |last_s: f64| (clock.beats_at(last_s) - beats.floor()).abs() < 0.25;
            let another = error > 0.0 && !self.waiting && last_beat_s.is_some_and(counted_last);
            if error > TINY && !another && !self.waiting {
                // The clock went on to a beat that had not come yet: it should have waited.
                let from_s = at_s - (error + 1.0 - WAITING_PHASE) / clock.rate_hz;
                found.edits.push(ClockEdit::Wait { from_s });
            }
            let same = |(a, b): (f64, f64)| (a / b - 1.0).abs() < SAME_RHYTHM;
            let rhythm = interval_s.zip(self.last_interval_s).filter(|pair| same(*pair));
            let changed = if certain {
                // After one that was not told, the interval is that of two.
                let usual = |interval_s: &f64| self.last_interval_s.is_none_or(|last| *interval_s < MISSED * last);
                interval_s.filter(|interval_s| *interval_s > 0.0).filter(usual).map(|interval_s| 60.0 / interval_s)
            } else {
                rhythm.filter(|_| self.surprises > 0).map(|(now, before)| 120.0 / (now + before))
            };
            found.edits.push(ClockEdit::Beat { at_s, rate: changed, another });
            found.surprised |= !certain;
            self.surprises += 1;
            self.waiting = false;
        } else {
            self.surprises = 0;
        }
        self.last_interval_s = interval_s;
    }

    /// Waits where a beat was due that did not come, and goes on where nothing can be heard any more.
    fn look_for_missing(&mut self, clock: ClockReading, found: &mut Found) {
        let Some(channel) = self.active else {
            if std::mem::take(&mut self.waiting) {
                found.edits.push(ClockEdit::GoOn);
            }
            return;
        };
        let (Some(delay_s), Some(last_beat_s)) = (self.ears[channel].delays_s.median(), self.last_beat_s) else {
            return;
        };
        if !self.acquired || self.waiting || !found.edits.is_empty() {
            return;
        }
        let began_s = clock.time_s - (clock.beats - clock.beats.floor()) / clock.rate_hz;
        let due_s = began_s + delay_s + LATE / clock.rate_hz + LATENCY_S;
        if clock.time_s >= due_s && last_beat_s < began_s - 0.5 / clock.rate_hz {
            self.waiting = true;
            found.missed = true;
            found.edits.push(ClockEdit::Wait { from_s: began_s - (1.0 - WAITING_PHASE) / clock.rate_hz });
        }
    }
}
