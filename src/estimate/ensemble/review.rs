//! A second look at the last windows, when what was believed of them turns out wrong.

use std::collections::VecDeque;

use super::{Ensemble, Observation, Parallel, WindowReport};
use crate::estimate::adapt::fit::ChannelFit;
use crate::estimate::adapt::pace::Pace;
use crate::estimate::beat::BeatFollower;
use crate::estimate::time::EventTime;
use crate::estimate::timing::TimingSource;
use crate::model::Model;
use crate::model::lanes::Lanes;

/// Spacing of the checkpoints \[s\], and how many are kept.
const CHECKPOINT_S: f64 = 0.1;

const CHECKPOINTS: usize = 8;

/// Nothing is looked at again after this time \[s\].
pub(super) const REMEMBERED_S: f64 = 0.9;

/// How far a second look goes back when a parameter has begun to move \[s\].
const LOOK_BACK_S: f64 = 0.4;

/// The ensemble as it was.
#[derive(Debug, Clone)]
pub(super) struct Checkpoint {
    /// States and parameters, batch by batch.
    members: Vec<(Vec<Lanes>, Vec<Lanes>)>,
    fits: Vec<ChannelFit>,
    paces: Vec<Pace>,
    wander_due_s: f64,
    elapsed_s: f64,
    window: u64,
    clock_waits: bool,
    beat: Option<(BeatFollower, EventTime)>,
}

/// The last moments, to be looked at again.
#[derive(Debug, Clone, Default)]
pub(super) struct Memory {
    /// Each with the windows since the one before it.
    checkpoints: VecDeque<(Checkpoint, Vec<Vec<Observation>>)>,
    since: Vec<Vec<Observation>>,
}

impl Memory {
    fn note(&mut self, observations: &[Observation]) {
        self.since.push(observations.to_vec());
    }

    #[allow(clippy::cast_precision_loss)]
    fn is_due(&self, h: f64) -> bool {
        self.checkpoints.is_empty() || self.since.len() as f64 * h >= CHECKPOINT_S - 1e-9
    }

    /// Nothing is remembered.
    pub(super) fn forget(&mut self) {
        self.checkpoints.clear();
        self.since.clear();
    }

    fn keep(&mut self, checkpoint: Checkpoint) {
        self.checkpoints.push_back((checkpoint, std::mem::take(&mut self.since)));
        if self.checkpoints.len() > CHECKPOINTS {
            self.checkpoints.pop_front();
        }
    }

    /// The last checkpoint before `from_s`, or the oldest, and all windows since, which are forgotten.
    fn rewind(&mut self, from_s: f64) -> Option<(Checkpoint, Vec<Vec<Observation>>)> {
        let before = self.checkpoints.iter().rposition(|(checkpoint, _)| checkpoint.elapsed_s <= from_s).unwrap_or(0);
        let (checkpoint, _) = self.checkpoints.get(before)?.clone();
        let mut windows: Vec<_> = self.checkpoints.drain(before + 1..).flat_map(|(_, windows)| windows).collect();
        windows.append(&mut self.since);
        Some((checkpoint, windows))
    }
}

impl<M: Model> Ensemble<M> {
    /// One window, and a second look at the last few if a parameter has begun to move in them.
    pub(super) fn coupled_step(
        &mut self,
        observations: &[Observation],
        h: f64,
        parallel: &dyn Parallel,
    ) -> WindowReport {
        let mut report = self.look(observations, h, parallel);
        if self.settings.adaptation.pace && self.listening {
            let learnt: Vec<bool> = (0..self.estimated.len()).map(|k| self.learns_pace(k)).collect();
            for (k, pace) in self.paces.iter_mut().enumerate() {
                if pace.advance(h) && learnt[k] {
                    report.moving.push(k);
                }
            }
            if !report.moving.is_empty() {
                self.look_again(self.elapsed_s - LOOK_BACK_S, false, parallel);
            }
        }
        report
    }

    /// One window, remembered.
    fn look(&mut self, observations: &[Observation], h: f64, parallel: &dyn Parallel) -> WindowReport {
        let report = self.first_look(observations, h, parallel);
        self.end_window(h);
        // Nothing else is ever looked at again.
        if self.settings.adaptation.pace || self.settings.live.timing != TimingSource::Clock {
            self.memory.note(observations);
            if self.memory.is_due(h) {
                self.memory.keep(self.checkpoint());
            }
        }
        report
    }

    /// Solves the windows since `from_s` (on the clock of `elapsed_s`) again, as far back as they are remembered.
    /// With `doubt`, what was learnt of the paces in them is forgotten and learnt anew.
    pub(super) fn look_again(&mut self, from_s: f64, doubt: bool, parallel: &dyn Parallel) {
        // A parameter that seems to move may turn out to be a beat that came early, so the first impression is kept.
        let before = (!doubt).then(|| self.memory.clone());
        let Some((checkpoint, windows)) = self.memory.rewind(from_s) else { return };
        let h = self.settings.window.length_s();
        self.restore(&checkpoint);
        self.take_back_edits(checkpoint.elapsed_s);
        if doubt {
            self.paces.clone_from(&checkpoint.paces);
        }
        self.second_look = Some(self.window);
        self.hears_again = doubt;
        for window in &windows {
            self.look(window, h, parallel);
            if doubt && self.settings.adaptation.pace && self.listening {
                self.paces.iter_mut().for_each(|pace| _ = pace.advance(h));
            }
            let last = self.window - 1;
            let mut smoother = std::mem::take(&mut self.smoother);
            smoother.in_window(last).for_each(|moment| self.fill(moment));
            self.smoother = smoother;
        }
        if let Some(before) = before {
            self.memory = before;
        }
        self.second_look = None;
        self.hears_again = false;
    }

    fn checkpoint(&self) -> Checkpoint {
        Checkpoint {
            members: self.batches.iter().map(|batch| (batch.x.clone(), batch.theta.clone())).collect(),
            fits: self.fits.clone(),
            paces: self.paces.clone(),
            wander_due_s: self.wander_due_s,
            elapsed_s: self.elapsed_s,
            window: self.window,
            clock_waits: self.clock_waits,
            beat: self.beats.as_ref().map(|beats| (beats.follower.clone(), beats.end)),
        }
    }

    fn restore(&mut self, checkpoint: &Checkpoint) {
        for (batch, (x, theta)) in self.batches.iter_mut().zip(&checkpoint.members) {
            batch.x.clone_from(x);
            batch.theta.clone_from(theta);
        }
        self.fits.clone_from(&checkpoint.fits);
        self.wander_due_s = checkpoint.wander_due_s;
        self.elapsed_s = checkpoint.elapsed_s;
        self.window = checkpoint.window;
        self.clock_waits = checkpoint.clock_waits;
        if let Some((beats, (follower, end))) = self.beats.as_mut().zip(checkpoint.beat.as_ref()) {
            beats.follower.clone_from(follower);
            beats.end = *end;
            beats.take_back(*end);
        }
    }
}
