//! What the members say together.

use super::rows::coordinates;
use super::{Ensemble, Parallel, Serial};
use crate::estimate::batch::{Look, Tools, read};
use crate::estimate::smoother::Remembered;
use crate::estimate::statistics::{Explainers, Summary, mean_and_sd, summarise};
use crate::estimate::time::EventTime;
use crate::model::Model;
use crate::model::lanes::Lanes;

/// A parameter is identifiable when data have brought its sd to less than a third of that it started with.
const IDENTIFIABLE: f64 = 0.9;

/// An estimated parameter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ParameterSummary {
    /// Index into the model's parameters.
    pub parameter: usize,
    /// Its distribution.
    pub summary: Summary,
    /// Share of the starting variance (of its coordinate) that data have removed: 0 nothing, 1 all.
    pub identifiability: f64,
}

impl ParameterSummary {
    /// Whether the data say so much about it that its value is theirs rather than that of the settings.
    #[must_use]
    pub fn is_identifiable(&self) -> bool {
        self.identifiability >= IDENTIFIABLE
    }
}

/// Scratch of [`Ensemble::summarise_at`].
#[derive(Debug, Clone, Default)]
pub struct Snapshot {
    values: Vec<f64>,
    x: Vec<Lanes>,
    derived: Vec<Lanes>,
}

impl<M: Model> Ensemble<M> {
    /// States and derived quantities of all members at position `s` of the last window, `[n_quantities x n_members]`,
    /// states first.
    pub fn snapshot<'a>(&self, s: f64, scratch: &'a mut Snapshot) -> &'a mut [f64] {
        let (n, m) = (self.model.n_states(), self.len());
        let n_q = n + self.model.derived().len();
        let t = s * self.settings.window.length_s();
        scratch.values.resize(n_q * m, 0.0);
        let tools = self.tools();
        for batch in &self.batches {
            batch.states_at(&self.model, s, &mut scratch.x);
            scratch.derived.resize(n_q - n, Lanes::default());
            batch.derive_at(&tools, t, &scratch.x, &mut scratch.derived);
            let rows = scratch.values.chunks_exact_mut(m);
            for (row, lanes) in rows.zip(scratch.x.iter().chain(&scratch.derived)) {
                row[batch.first()..][..batch.len()].copy_from_slice(&lanes.0[..batch.len()]);
            }
        }
        &mut scratch.values
    }

    pub(in crate::estimate) fn tools(&self) -> Tools<'_, M> {
        let Self { model, shared, settings, unknowns, estimated, varying, .. } = self;
        Tools { model, shared: shared.as_ref(), settings, unknowns, estimated, varying, look: Look::default() }
    }

    /// One summary per quantity of [`Ensemble::snapshot`].
    pub fn summarise_at(&self, s: f64, scratch: &mut Snapshot, parallel: &dyn Parallel) -> Vec<Summary> {
        self.summarise(self.snapshot(s, scratch), self.cycles(), parallel)
    }

    /// One summary per row of `values` `[n_quantities x n_members]`, states first, where the clock says `cycles`.
    fn summarise(&self, values: &mut [f64], cycles: Option<f64>, parallel: &dyn Parallel) -> Vec<Summary> {
        let (n, m) = (self.model.n_states(), self.len());
        let explainers = Explainers::new(&values[(n - self.model.n_discrepancies()) * m..n * m], m);
        let noise = |q: usize| self.settings.aleatoric_sd_mmhg.get(q).copied().unwrap_or(0.0);
        let phase = cycles.map(|cycles| cycles.rem_euclid(1.0));
        let systematic = |q: usize| {
            let own = self.settings.channels.iter().position(|c| c.state == q);
            own.map_or(0.0, |channel| self.fits[channel].systematic_sd(phase))
        };
        // The rows from `first` on.
        let fill = |first: usize, rows: &mut [f64], out: &mut [Summary]| {
            for ((q, row), out) in (first..).zip(rows.chunks_exact_mut(m)).zip(out) {
                let share = explainers.share_of(row);
                *out = summarise(row, noise(q), share).widened(systematic(q));
            }
        };
        let count = values.len() / m;
        let mut out = vec![Summary::default(); count];
        let half = count / 2;
        let (rows, other_rows) = values.split_at_mut(half * m);
        let (summaries, other_summaries) = out.split_at_mut(half);
        parallel.both(&mut || fill(0, rows, summaries), &mut || fill(half, other_rows, other_summaries));
        out
    }

    /// A parameter of every member at the end of the last window.
    pub fn parameter_of_members(&self, parameter: usize) -> impl Iterator<Item = f64> + '_ {
        self.batches.iter().flat_map(move |batch| batch.theta[parameter].0.into_iter().take(batch.len()))
    }

    /// The estimated parameters at the end of the last window.
    pub fn summarise_parameters(&self) -> Vec<ParameterSummary> {
        let summary = |(k, &p): (usize, &usize)| {
            let mut values: Vec<f64> = self.parameter_of_members(p).collect();
            self.parameter_summary(k, &mut values, self.coordinate(k).1)
        };
        self.estimated.iter().enumerate().map(summary).collect()
    }

    fn parameter_summary(&self, k: usize, values: &mut [f64], coordinate_sd: f64) -> ParameterSummary {
        let share = coordinate_sd / self.initial_sd[k];
        ParameterSummary {
            parameter: self.estimated[k],
            summary: summarise(values, 0.0, 0.0),
            identifiability: if share.is_finite() { (1.0 - share * share).clamp(0.0, 1.0) } else { 0.0 },
        }
    }

    /// States and estimated parameters of every member at the end of the last window,
    /// `[n_members x (n_states + n_estimated)]`.
    pub fn members_at_end(&self) -> Vec<f64> {
        let mut out = Vec::with_capacity(self.len() * (self.model.n_states() + self.estimated.len()));
        for batch in &self.batches {
            for lane in 0..batch.len() {
                out.extend(batch.x.iter().map(|x| x.0[lane]));
                out.extend(self.estimated.iter().map(|&p| batch.theta[p].0[lane]));
            }
        }
        out
    }

    /// Keeps the members at position `s` of the last window, to be corrected by what comes.
    pub fn remember(&mut self, time: EventTime, s: f64) {
        let mut moment = Remembered { time, window: self.window - 1, s, rows: Vec::new(), theta: Vec::new() };
        self.fill(&mut moment);
        self.smoother.remember(moment);
    }

    /// The members at a moment of the last window.
    pub(super) fn fill(&self, moment: &mut Remembered) {
        // States and parameters of every batch.
        let mut at: Vec<[Vec<Lanes>; 2]> = Vec::with_capacity(self.batches.len());
        for batch in &self.batches {
            let mut x = Vec::new();
            batch.states_at(&self.model, moment.s, &mut x);
            let ahead_s = moment.s * self.settings.window.length_s();
            at.push([x, batch.parameters_at(&self.tools(), ahead_s)]);
        }
        moment.rows.clear();
        let mut row = |of: &dyn Fn(&[Vec<Lanes>; 2]) -> Lanes| {
            for (batch, at) in self.batches.iter().zip(&at) {
                moment.rows.extend_from_slice(&of(at).0[..batch.len()]);
            }
        };
        (0..self.model.n_states()).for_each(|s| row(&|[x, _]| x[s]));
        for (&p, transform) in self.estimated.iter().zip(&self.transforms) {
            row(&|[_, theta]| coordinates(theta[p], *transform));
        }
        if let Some([_, theta]) = at.first() {
            read(theta, 0, &mut moment.theta);
        }
    }

    /// The oldest remembered moment that is not after `until`: its time, a summary per quantity and per parameter.
    pub fn smoothed(&mut self, until: EventTime) -> Option<(EventTime, Vec<Summary>, Vec<ParameterSummary>)> {
        let moment = self.smoother.release(until)?;
        let (n, m) = (self.model.n_states(), self.len());
        let n_d = self.model.derived().len();
        let mut values = vec![0.0; (n + n_d) * m];
        let mut parameters = vec![0.0; self.estimated.len() * m];
        let (mut x, mut derived, mut theta) = (vec![0.0; n], vec![0.0; n_d], moment.theta.clone());
        for i in 0..m {
            x.iter_mut().enumerate().for_each(|(s, x)| *x = moment.rows[s * m + i]);
            for (k, &p) in self.estimated.iter().enumerate() {
                theta[p] = self.settings.beliefs[p].value(self.transforms[k], moment.rows[(n + k) * m + i]);
                parameters[k * m + i] = theta[p];
            }
            self.model.derive(0.0, &x, &theta, &mut derived);
            x.iter().chain(&derived).enumerate().for_each(|(q, value)| values[q * m + i] = *value);
        }
        let summaries = parameters.chunks_exact_mut(m).enumerate().map(|(k, row)| {
            let coordinates: Vec<f64> = row.iter().map(|v| self.transforms[k].forward(*v)).collect();
            self.parameter_summary(k, row, mean_and_sd(&coordinates).1)
        });
        let summaries = summaries.collect();
        let cycles = self.model.cycle().map(|cycle| {
            let own = self.estimated.iter().position(|&p| p == cycle.phase);
            own.map_or(moment.theta[cycle.phase], |k| mean_and_sd(&parameters[k * m..(k + 1) * m]).0)
        });
        Some((moment.time, self.summarise(&mut values, cycles, &Serial), summaries))
    }
}
