//! The beats of the members, right also where windows are solved again by another clock.

use super::review::REMEMBERED_S;
use super::{Ensemble, Snapshot};
use crate::estimate::beat::{BeatEstimate, BeatFollower};
use crate::estimate::time::{EventTime, ns_from_s};
use crate::estimate::timing::TimingSource;
use crate::model::Model;

/// Pressures are looked at this often \[ns\], or at the end of every window where that is less often.
const LOOK_NS: i64 = 4_000_000;

/// What is known of the beat under way.
#[derive(Debug, Clone)]
pub(super) struct Beats {
    /// Taken back with the members when windows are solved again.
    pub(super) follower: BeatFollower,
    /// End of the last window.
    pub(super) end: EventTime,
    /// Beats that are over and not told yet.
    over: Vec<BeatEstimate>,
    /// A beat that began before was told already.
    told_to: EventTime,
    scratch: Snapshot,
}

impl Beats {
    /// Forgets the beat under way.
    pub(super) fn begin_again(&mut self) {
        self.follower = BeatFollower::default();
    }

    /// Forgets what ended after `time`, which is looked at again.
    pub(super) fn take_back(&mut self, time: EventTime) {
        self.over.retain(|beat| beat.end <= time);
    }
}

impl<M: Model> Ensemble<M> {
    /// Reads what is clinical off every beat from now on; `start` is where the next window begins.
    pub fn follow_beats(&mut self, start: EventTime) {
        self.beats = Some(Beats {
            follower: BeatFollower::default(),
            end: start,
            over: Vec::new(),
            told_to: EventTime(i64::MIN),
            scratch: Snapshot::default(),
        });
    }

    /// Beats that are over and were not told yet. Where clocks may be set in what was solved already, a beat is told when
    /// that can no longer happen to it, or when this is the `last` time.
    pub fn take_beats(&mut self, last: bool) -> Vec<BeatEstimate> {
        let may_change = self.settings.live.timing != TimingSource::Clock && !last;
        let Some(beats) = &mut self.beats else { return Vec::new() };
        let settled = if may_change { beats.end.plus_ns(-ns_from_s(REMEMBERED_S)) } else { beats.end };
        let (now, later): (Vec<_>, Vec<_>) = beats.over.drain(..).partition(|beat| beat.end <= settled);
        beats.over = later;
        if let Some(beat) = now.last() {
            // Half a beat: what is found again in a second look begins a little earlier or later.
            beats.told_to = beat.start.plus_ns(beat.end.ns_since(beat.start) / 2);
        }
        now
    }

    /// Takes in the window that was just solved.
    pub(super) fn follow(&mut self) {
        let Some(mut beats) = self.beats.take() else { return };
        let before = beats.end;
        beats.end = before.plus_ns(self.settings.window.length_ns);
        if before.0.div_euclid(LOOK_NS) == beats.end.0.div_euclid(LOOK_NS) && self.listening {
            self.beats = Some(beats);
            return;
        }
        match self.cycles().zip(self.rate_hz()) {
            // Before the beat is found, clocks say nothing.
            Some(clock) if self.listening => {
                let values = self.snapshot(1.0, &mut beats.scratch);
                let over = beats.follower.follow(&self.model, beats.end, clock, values, &|i| self.theta_of(i));
                beats.over.extend(over.filter(|beat| beat.start >= beats.told_to));
            }
            _ => beats.follower = BeatFollower::default(),
        }
        self.beats = Some(beats);
    }
}
