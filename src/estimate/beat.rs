//! Beat by beat: what clinicians read off a pressure curve, for every member, so that each figure has its band.

use super::statistics::{Summary, summarise};
use super::time::EventTime;
use crate::model::{Extent, Model};

/// A beat that is over.
#[derive(Debug, Clone, PartialEq)]
pub struct BeatEstimate {
    /// Its onset.
    pub start: EventTime,
    /// The onset of the next.
    pub end: EventTime,
    /// One per clinical quantity of the model.
    pub values: Vec<Summary>,
}

/// Follows the members through a beat.
#[derive(Debug, Default)]
pub struct BeatFollower {
    /// Time and beats counted by the clock of the ensemble, when last heard of.
    last: Option<(EventTime, f64)>,
    /// Onset of the beat under way \[s\]; None before the first onset seen.
    onset_s: Option<f64>,
    /// What every quantity of every member did so far, `[n_quantities x n_members]`.
    smallest: Vec<f64>,
    largest: Vec<f64>,
    integral: Vec<f64>,
    first: Vec<f64>,
    /// How far the clock of each member was ahead of that of the ensemble at the start \[beats\].
    ahead: Vec<f64>,
}

impl Clone for BeatFollower {
    fn clone(&self) -> Self {
        let mut clone = Self::default();
        clone.clone_from(self);
        clone
    }

    /// Into the vectors that are there.
    fn clone_from(&mut self, other: &Self) {
        let Self { last, onset_s, smallest, largest, integral, first, ahead } = other;
        (self.last, self.onset_s) = (*last, *onset_s);
        self.smallest.clone_from(smallest);
        self.largest.clone_from(largest);
        self.integral.clone_from(integral);
        self.first.clone_from(first);
        self.ahead.clone_from(ahead);
    }
}

impl BeatFollower {
    /// Takes in all members at one time, `[n_quantities x n_members]`, states first; the clock of the ensemble says how
    /// many beats there were and how fast they follow each other \[1/s\]. `theta` gives the parameters of a member.
    /// Returns the beat that ended, if one did.
    pub fn follow<M: Model>(
        &mut self,
        model: &M,
        time: EventTime,
        (beats, rate_hz): (f64, f64),
        values: &[f64],
        theta: &dyn Fn(usize) -> Vec<f64>,
    ) -> Option<BeatEstimate> {
        let (before, beats_before) = self.last.replace((time, beats))?;
        let dt_s = time.as_s() - before.as_s();
        let mut over = None;
        if beats.floor() > beats_before.floor() {
            // The onset lies between two windows; flows through the outlets are zero there.
            let onset_s = time.as_s() - ((beats - beats.floor()) / rate_hz).min(dt_s);
            let phase = model.cycle().map(|cycle| cycle.phase);
            let ahead = |i: usize| phase.map_or(0.0, |phase| theta(i)[phase] - beats);
            let members = values.len() / (model.n_states() + model.derived().len());
            let ahead: Vec<f64> = (0..members).map(ahead).collect();
            over = self.onset_s.map(|start_s| self.read(model, (start_s, onset_s), (values, &ahead), theta));
            self.ahead = ahead;
            self.onset_s = Some(onset_s);
            for rows in [&mut self.smallest, &mut self.largest, &mut self.first] {
                rows.clear();
                rows.extend_from_slice(values);
            }
            self.integral.clear();
            self.integral.resize(values.len(), 0.0);
        }
        for (smallest, value) in self.smallest.iter_mut().zip(values) {
            *smallest = if *value < *smallest { *value } else { *smallest };
        }
        for (largest, value) in self.largest.iter_mut().zip(values) {
            *largest = if *value > *largest { *value } else { *largest };
        }
        for (integral, value) in self.integral.iter_mut().zip(values) {
            *integral += value * dt_s;
        }
        over
    }

    fn read<M: Model>(
        &self,
        model: &M,
        (start_s, end_s): (f64, f64),
        (values, ahead): (&[f64], &[f64]),
        theta: &dyn Fn(usize) -> Vec<f64>,
    ) -> BeatEstimate {
        let n_q = model.n_states() + model.derived().len();
        let members = self.first.len() / n_q;
        let duration_s = end_s - start_s;
        let mut read = vec![0.0; model.clinical().len() * members];
        let mut row = vec![0.0; model.clinical().len()];
        for i in 0..members {
            let whole = |q: usize| {
                let at = q * members + i;
                let (min, max, mean) = (self.smallest[at], self.largest[at], self.integral[at] / duration_s);
                Extent { min, max, mean, change: values[at] - self.first[at] }
            };
            let (states, derived): (Vec<_>, Vec<_>) =
                ((0..model.n_states()).map(whole).collect(), (model.n_states()..n_q).map(whole).collect());
            // The extents are those of the same stretch of time for all; a member thinks that it was a little more or less
            // than one beat.
            let own_s = duration_s / (1.0 + ahead[i] - self.ahead[i]).max(0.1);
            model.read_cycle(own_s, &theta(i), &states, &derived, &mut row);
            row.iter().enumerate().for_each(|(k, value)| read[k * members + i] = *value);
        }
        BeatEstimate {
            start: EventTime::from_s(start_s),
            end: EventTime::from_s(end_s),
            values: read.chunks_exact_mut(members).map(|v| summarise(v, 0.0, 0.0)).collect(),
        }
    }
}
