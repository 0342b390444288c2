//! The beats of the members, right also where windows are solved again by another clock.

use super::{Ensemble, Snapshot};
use crate::estimate::beat::{BeatEstimate, BeatFollower};
use crate::estimate::time::EventTime;
use crate::model::Model;

/// What is known of the beat under way.
#[derive(Debug, Clone)]
pub(super) struct Beats {
    /// Taken back with the members when windows are solved again.
    pub(super) follower: BeatFollower,
    /// End of the last window.
    pub(super) end: EventTime,
    /// A beat that began before was told already.
    told_to: EventTime,
    over: Vec<BeatEstimate>,
    scratch: Snapshot,
}

impl<M: Model> Ensemble<M> {
    /// Reads what is clinical off every beat from now on; `start` is where the next window begins.
    pub fn follow_beats(&mut self, start: EventTime) {
        self.beats = Some(Beats {
            follower: BeatFollower::default(),
            end: start,
            told_to: EventTime(i64::MIN),
            over: Vec::new(),
            scratch: Snapshot::default(),
        });
    }

    /// Beats that are over and were not told yet.
    pub fn take_beats(&mut self) -> Vec<BeatEstimate> {
        self.beats.as_mut().map(|beats| std::mem::take(&mut beats.over)).unwrap_or_default()
    }

    /// Takes in the window that was just solved.
    pub(super) fn follow(&mut self) {
        let Some(mut beats) = self.beats.take() else { return };
        beats.end = beats.end.plus_ns(self.settings.window.length_ns);
        match self.cycles().zip(self.rate_hz()) {
            // Before the beat is found, clocks say nothing.
            Some(clock) if self.listening => {
                let values = self.snapshot(1.0, &mut beats.scratch);
                let over = beats.follower.follow(&self.model, beats.end, clock, values, &|i| self.theta_of(i));
                if let Some(beat) = over.filter(|beat| beat.start >= beats.told_to) {
                    // Half a beat: what is told again after a second look begins a little earlier or later.
                    beats.told_to = beat.start.plus_ns(beat.end.ns_since(beat.start) / 2);
                    beats.over.push(beat);
                }
            }
            _ => beats.follower = BeatFollower::default(),
        }
        self.beats = Some(beats);
    }
}
