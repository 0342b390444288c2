//! An ensemble over a stretch of time, and what is kept of it.

use crate::estimate::ensemble::{Ensemble, Observation, Parallel, Snapshot};
use crate::estimate::settings::{EstimatorSettings, SettingsError};
use crate::estimate::statistics::Summary;
use crate::estimate::time::s_from_ns;
use crate::model::Model;

/// A sample of a channel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Sample {
    pub time_s: f64,
    pub channel: usize,
    pub value: f64,
}

/// What is to be done, and what of it is to be kept.
pub(super) struct Experiment<'a, M> {
    pub model: M,
    pub settings: EstimatorSettings,
    /// From 0 to here, rounded to whole windows \[s\].
    pub until_s: f64,
    /// In order of time.
    pub samples: &'a [Sample],
    /// Times of the summaries, ascending \[s\].
    pub report_at_s: &'a [f64],
    /// Times at which all members are kept, ascending \[s\].
    pub members_at_s: &'a [f64],
    /// Parameters are averaged, member by member, over windows that end in this interval \[s\].
    pub average_s: (f64, f64),
}

/// What was kept.
#[derive(Debug, Clone, Default)]
pub(super) struct Trace {
    pub times_s: Vec<f64>,
    /// Per time, one per quantity (states, then derived).
    pub quantities: Vec<Vec<Summary>>,
    /// Per time, one per estimated parameter.
    pub parameters: Vec<Vec<Summary>>,
    /// Per time wanted, `[n_quantities x n_members]`.
    pub members: Vec<Vec<f64>>,
    /// Per estimated parameter, the average of each member.
    pub averages: Vec<Vec<f64>>,
    pub not_converged: usize,
}

impl Trace {
    /// One quantity over time.
    pub(super) fn quantity(&self, q: usize) -> impl Iterator<Item = (f64, &Summary)> + '_ {
        self.times_s.iter().copied().zip(self.quantities.iter().map(move |row| &row[q]))
    }

    /// One estimated parameter over time.
    pub(super) fn parameter(&self, k: usize) -> impl Iterator<Item = (f64, &Summary)> + '_ {
        self.times_s.iter().copied().zip(self.parameters.iter().map(move |row| &row[k]))
    }
}

impl<M: Model> Experiment<'_, M> {
    /// Runs it; windows are `(start, end]` but for the first, which holds its start.
    #[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    pub(super) fn run(self, parallel: &dyn Parallel) -> Result<Trace, SettingsError> {
        let h = s_from_ns(self.settings.window.length_ns);
        let windows = (self.until_s / h).round() as usize;
        let mut ensemble = Ensemble::new(self.model, self.settings, parallel)?;
        let estimated = ensemble.estimated().to_vec();
        let mut trace = Trace { averages: vec![vec![0.0; ensemble.len()]; estimated.len()], ..Trace::default() };
        let mut averaged = 0_usize;
        let mut scratch = Snapshot::default();
        let (mut samples, mut reports, mut wanted) = (self.samples, self.report_at_s, self.members_at_s);
        for window in 0..windows {
            let (start, end) = (window as f64 * h, (window + 1) as f64 * h);
            let s = |t: f64| ((t - start) / h).clamp(0.0, 1.0);
            let within = take(&mut samples, end, h, |sample| sample.time_s);
            let observations: Vec<Observation> = within
                .iter()
                .map(|sample| Observation { s: s(sample.time_s), channel: sample.channel, value: sample.value })
                .collect();
            let report = ensemble.step(&observations, parallel);
            trace.not_converged += report.not_converged;

            for &t in take(&mut reports, end, h, |t| *t) {
                trace.times_s.push(t);
                trace.quantities.push(ensemble.summarise_at(s(t), &mut scratch, parallel));
                trace.parameters.push(ensemble.summarise_parameters().iter().map(|p| p.summary).collect());
            }
            for &t in take(&mut wanted, end, h, |t| *t) {
                trace.members.push(ensemble.snapshot(s(t), &mut scratch).to_vec());
            }
            if end > self.average_s.0 && end <= self.average_s.1 + 1e-6 * h {
                averaged += 1;
                for (sums, &p) in trace.averages.iter_mut().zip(&estimated) {
                    sums.iter_mut().zip(ensemble.parameter_of_members(p)).for_each(|(sum, value)| *sum += value);
                }
            }
        }
        trace.averages.iter_mut().flatten().for_each(|sum| *sum /= averaged as f64);
        Ok(trace)
    }
}

/// Takes what belongs to the window that ends at `end_s` off the front; the last window takes its end with rounding.
fn take<'a, T>(rest: &mut &'a [T], end_s: f64, length_s: f64, time_s: impl Fn(&T) -> f64) -> &'a [T] {
    let (now, later) = rest.split_at(rest.partition_point(|item| time_s(item) <= end_s + 1e-6 * length_s));
    *rest = later;
    now
}
