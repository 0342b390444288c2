//! The clocks of the members, where a beat did not come when it was due.

use super::{Batch, Ensemble, Parallel};
use crate::estimate::batch::{read, write};
use crate::estimate::timing::{ClockEdit, WAITING_PHASE};
use crate::model::Model;
use crate::model::lanes::WIDTH;

/// Longest time over which a clock that could not be corrected in time is set forth \[s\].
const MAX_CLOCK_S: f64 = 2.0;

/// Spread of heart rate (relative) and phase (beats) after an onset has set them.
const RATE_SD: f64 = 0.03;

const PHASE_SD: f64 = 0.01;

/// Something to be done with the clocks, on the clock of `elapsed_s`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Edit {
    /// When it takes effect: when it happened, or as soon as it was known.
    due_s: f64,
    /// When it happened.
    at_s: f64,
    what: ClockEdit,
}

impl<M: Model> Ensemble<M> {
    /// Sets the clocks of the members; `now_s` is the event time at the end of the last window.
    pub fn edit_clocks(&mut self, edits: &[ClockEdit], now_s: f64, parallel: &dyn Parallel) {
        let ago = |edit: &ClockEdit| match *edit {
            ClockEdit::Beat { at_s, .. } => now_s - at_s,
            ClockEdit::Wait { from_s } => now_s - from_s,
            ClockEdit::GoOn => 0.0,
        };
        let since_start = |edit: &ClockEdit| {
            let at_s = self.elapsed_s - ago(edit);
            Edit { due_s: at_s, at_s, what: *edit }
        };
        self.edits = edits.iter().map(since_start).collect();
        if let Some(earliest) = self.edits.first() {
            // Before the clock went wrong, parameters had no reason to move: their paces start again from there, too.
            self.look_again(earliest.at_s, true, parallel);
        }
        // What lies in the present, or could not be remembered.
        self.apply_edits(f64::INFINITY, self.elapsed_s);
        if !self.listening {
            self.spread_anew();
        }
    }

    /// Gives the states the spread that they started with: they have run by a wrong clock.
    fn spread_anew(&mut self) {
        let (n, m) = (self.model.n_states(), self.len());
        let draws = self.draw(n);
        for (s, draws) in draws.chunks_exact(m).enumerate() {
            let sd = self.settings.initial_state_sd[s];
            for (batch, draws) in self.batches.iter_mut().zip(draws.chunks(WIDTH)) {
                batch.x[s].0.iter_mut().zip(draws).for_each(|(x, e)| *x += sd * e);
                batch.fill_up();
            }
        }
    }

    /// Applies what falls before `until_s`; clocks stand at `start_s`.
    pub(super) fn apply_edits(&mut self, until_s: f64, start_s: f64) {
        while self.edits.first().is_some_and(|edit| edit.due_s < until_s) {
            let Edit { due_s, at_s, what } = self.edits.remove(0);
            self.applied.retain(|edit| edit.due_s >= start_s - MAX_CLOCK_S);
            self.applied.push(Edit { due_s: due_s.max(start_s), at_s, what });
            match what {
                ClockEdit::Beat { rate, another, .. } => {
                    self.begin_beat(at_s.max(start_s - MAX_CLOCK_S) - start_s, rate, another);
                }
                ClockEdit::Wait { .. } => {
                    self.clock_waits = true;
                    self.shift_clocks(|beats| beats.round() - 1.0 + WAITING_PHASE);
                }
                ClockEdit::GoOn => self.clock_waits = false,
            }
        }
    }

    /// What was applied from `from_s` on is to be applied again.
    pub(super) fn take_back_edits(&mut self, from_s: f64) {
        let (mut again, before): (Vec<Edit>, Vec<Edit>) = self.applied.drain(..).partition(|edit| edit.due_s >= from_s);
        self.applied = before;
        again.append(&mut self.edits);
        // Stable: of two at the same time, the one that was known first comes first.
        again.sort_by(|a, b| a.due_s.total_cmp(&b.due_s));
        self.edits = again;
    }

    /// A beat begins `ahead_s` from where the clocks stand; `another` than the one that they counted last.
    fn begin_beat(&mut self, ahead_s: f64, rate: Option<f64>, another: bool) {
        let Some(cycle) = self.model.cycle() else { return };
        self.clock_waits = false;
        let m = self.len();
        let known = !self.estimated.contains(&cycle.rate);
        let draws = self.draw(2);
        if let Some(rate) = rate {
            let (low, high) = self.settings.beliefs[cycle.rate].bounds;
            let sd = if known { 0.0 } else { RATE_SD };
            for batch in &mut self.batches {
                let draws = &draws[batch.first()..][..batch.len()];
                for (value, e) in batch.theta[cycle.rate].0.iter_mut().zip(draws) {
                    *value = (rate * (sd * e).exp()).clamp(low, high);
                }
            }
        }
        let per_s = self.rate_hz().unwrap_or(0.0);
        let beats = self.cycles().unwrap_or(0.0);
        let there = beats + ahead_s * per_s;
        let target = if another { there.ceil() } else { there.round() } - ahead_s * per_s;
        self.set_clocks(|i, phase| {
            // A new rhythm leaves nothing of what the members thought of the old one.
            let own = if rate.is_some() { 0.0 } else { phase - beats };
            target + own + if known { 0.0 } else { PHASE_SD * draws[m + i] }
        });
    }

    /// Moves all clocks alike, their mean to where `to` says.
    fn shift_clocks(&mut self, to: impl Fn(f64) -> f64) {
        let Some(beats) = self.cycles() else { return };
        let shift = to(beats) - beats;
        self.set_clocks(|_, phase| phase + shift);
    }

    /// Sets the clock of every member to what `to` says of its index and phase.
    fn set_clocks(&mut self, to: impl Fn(usize, f64) -> f64) {
        let Some(cycle) = self.model.cycle() else { return };
        let (mut x, mut theta) = (Vec::new(), Vec::new());
        for batch in &mut self.batches {
            for lane in 0..batch.len() {
                read(&batch.x, lane, &mut x);
                read(&batch.theta, lane, &mut theta);
                let phase = to(batch.first() + lane, theta[cycle.phase]);
                self.model.set_clock(phase, &mut x, &mut theta);
                write(&mut batch.x, lane, &x);
                write(&mut batch.theta, lane, &theta);
            }
            batch.fill_up();
        }
    }

    /// Mean rate of the cycles \[1/s\].
    pub fn rate_hz(&self) -> Option<f64> {
        Some(self.mean_of(self.model.cycle()?.rate) / 60.0)
    }

    /// Cycles counted at the end of the last window, by the mean clock of the members; None in models without cycles.
    pub fn cycles(&self) -> Option<f64> {
        Some(self.mean_of(self.model.cycle()?.phase))
    }

    #[allow(clippy::cast_precision_loss)]
    fn mean_of(&self, parameter: usize) -> f64 {
        let of = |batch: &Batch| batch.theta[parameter].0[..batch.len()].iter().sum::<f64>();
        self.batches.iter().map(of).sum::<f64>() / self.len() as f64
    }
}
