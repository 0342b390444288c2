//! A second look at the last windows, when what was believed of them turns out wrong.

use std::collections::VecDeque;

use super::{Ensemble, Observation, Parallel, WindowReport};
use crate::estimate::adapt::fit::ChannelFit;
use crate::estimate::adapt::pace::Pace;
use crate::estimate::beat::{BeatCounter, Curve};
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
#[derive(Debug, Clone, Default)]
pub(super) struct Checkpoint {
    /// Batch by batch, states and what varies of the parameters.
    members: Vec<Lanes>,
    fits: Vec<ChannelFit>,
    paces: Vec<Pace>,
    wander_due_s: f64,
    elapsed_s: f64,
    window: u64,
    clock_waits: bool,
    curves: Vec<Curve>,
    beat: Option<(BeatCounter, Vec<f64>, EventTime)>,
}

/// The samples of some windows.
#[derive(Debug, Clone, Default)]
struct Windows {
    observations: Vec<Observation>,
    /// Where each window ends.
    ends: Vec<usize>,
}

impl Windows {
    fn push(&mut self, observations: &[Observation]) {
        self.observations.extend_from_slice(observations);
        self.ends.push(self.observations.len());
    }

    fn clear(&mut self) {
        self.observations.clear();
        self.ends.clear();
    }

    fn iter(&self) -> impl Iterator<Item = &[Observation]> {
        let starts = std::iter::once(0).chain(self.ends.iter().copied());
        starts.zip(&self.ends).map(|(start, end)| &self.observations[start..*end])
    }
}

/// The last moments, to be looked at again.
#[derive(Debug, Clone, Default)]
pub(super) struct Memory {
    /// Each with the windows since the one before it.
    checkpoints: VecDeque<(Checkpoint, Windows)>,
    since: Windows,
}

impl Memory {
    #[allow(clippy::cast_precision_loss)]
    fn is_due(&self, h: f64) -> bool {
        self.checkpoints.is_empty() || self.since.ends.len() as f64 * h >= CHECKPOINT_S - 1e-9
    }

    /// Nothing is remembered.
    pub(super) fn forget(&mut self) {
        self.checkpoints.clear();
        self.since.clear();
    }

    /// A place for a new checkpoint: that of the oldest, if there are enough.
    fn place(&mut self) -> &mut Checkpoint {
        let oldest = if self.checkpoints.len() < CHECKPOINTS { None } else { self.checkpoints.pop_front() };
        let (checkpoint, mut windows) = oldest.unwrap_or_default();
        std::mem::swap(&mut windows, &mut self.since);
        self.since.clear();
        self.checkpoints.push_back((checkpoint, windows));
        let last = self.checkpoints.len() - 1;
        &mut self.checkpoints[last].0
    }

    /// The last checkpoint before `from_s`, or the oldest, and all windows since, which are forgotten.
    fn rewind(&mut self, from_s: f64) -> Option<(Checkpoint, Windows)> {
        let before = self.checkpoints.iter().rposition(|(checkpoint, _)| checkpoint.elapsed_s <= from_s).unwrap_or(0);
        let (checkpoint, _) = self.checkpoints.get(before)?.clone();
        let mut all = Windows::default();
        for (_, windows) in self.checkpoints.drain(before + 1..) {
            windows.iter().for_each(|window| all.push(window));
        }
        self.since.iter().for_each(|window| all.push(window));
        self.since.clear();
        Some((checkpoint, all))
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
        let report = self.look(observations, h, parallel);
        if self.settings.adaptation.pace && self.listening {
            for k in 0..self.paces.len() {
                if self.paces[k].advance(h) && self.learns_pace(k) {
                    self.findings.moving.push(k);
                }
            }
            if !self.findings.moving.is_empty() {
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
            self.memory.since.push(observations);
            if self.memory.is_due(h) {
                let mut memory = std::mem::take(&mut self.memory);
                self.keep(memory.place());
                self.memory = memory;
            }
        }
        report
    }

    /// Solves the windows since `from_s` (on the clock of `elapsed_s`) again, as far back as they are remembered.
    /// With `doubt`, what was learnt of the paces in them is forgotten and learnt anew.
    pub(super) fn look_again(&mut self, from_s: f64, doubt: bool, parallel: &dyn Parallel) {
        // A parameter that seems to move may turn out to be a beat that came early, so the first impression is kept.
        let before = (!doubt).then(|| {
            let copy = self.memory.clone();
            std::mem::replace(&mut self.memory, copy)
        });
        let Some((checkpoint, windows)) = self.memory.rewind(from_s) else { return };
        let h = self.settings.window.length_s();
        self.restore(&checkpoint);
        self.take_back_edits(checkpoint.elapsed_s);
        if doubt {
            self.paces.clone_from(&checkpoint.paces);
        }
        self.second_look = Some(self.window);
        self.hears_again = doubt;
        let findings = std::mem::take(&mut self.findings);
        for window in windows.iter() {
            self.findings.clear();
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
        self.findings = findings;
        self.second_look = None;
        self.hears_again = false;
    }

    /// Makes a checkpoint of how things are.
    fn keep(&mut self, checkpoint: &mut Checkpoint) {
        self.take_in_looks();
        checkpoint.members.clear();
        for batch in &self.batches {
            checkpoint.members.extend_from_slice(&batch.x);
            checkpoint.members.extend(self.varying.iter().map(|p| batch.theta[*p]));
        }
        checkpoint.fits.clone_from(&self.fits);
        checkpoint.paces.clone_from(&self.paces);
        checkpoint.wander_due_s = self.wander_due_s;
        checkpoint.elapsed_s = self.elapsed_s;
        checkpoint.window = self.window;
        checkpoint.clock_waits = self.clock_waits;
        checkpoint.curves.resize_with(self.batches.len(), Curve::default);
        for (kept, batch) in checkpoint.curves.iter_mut().zip(&self.batches) {
            kept.clone_from(&batch.curve);
        }
        match (&mut checkpoint.beat, &self.beats) {
            (Some((counter, ahead, end)), Some(beats)) => {
                counter.clone_from(&beats.counter);
                ahead.clone_from(&beats.ahead);
                *end = beats.end;
            }
            (beat, beats) => {
                *beat = beats.as_ref().map(|beats| (beats.counter.clone(), beats.ahead.clone(), beats.end));
            }
        }
    }

    fn restore(&mut self, checkpoint: &Checkpoint) {
        let size = self.model.n_states() + self.varying.len();
        for (batch, members) in self.batches.iter_mut().zip(checkpoint.members.chunks_exact(size)) {
            let (x, theta) = members.split_at(batch.x.len());
            batch.x.copy_from_slice(x);
            self.varying.iter().zip(theta).for_each(|(p, value)| batch.theta[*p] = *value);
        }
        self.fits.clone_from(&checkpoint.fits);
        self.wander_due_s = checkpoint.wander_due_s;
        self.elapsed_s = checkpoint.elapsed_s;
        self.window = checkpoint.window;
        self.clock_waits = checkpoint.clock_waits;
        for (batch, kept) in self.batches.iter_mut().zip(&checkpoint.curves) {
            batch.curve.clone_from(kept);
        }
        if let Some((beats, (counter, ahead, end))) = self.beats.as_mut().zip(checkpoint.beat.as_ref()) {
            beats.counter.clone_from(counter);
            beats.ahead.clone_from(ahead);
            beats.end = *end;
            beats.take_back(*end);
        }
    }
}
