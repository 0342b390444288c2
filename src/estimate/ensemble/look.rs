//! One window of X-TFC: what the members expect, how far off the samples are, what is learnt of that.

use super::{Ensemble, Observation, Parallel, Walk, WindowReport};
use crate::estimate::batch::{SharedPrior, read_expectations};
use crate::estimate::cloud::Cloud;
use crate::estimate::coupling::coupled;
use crate::estimate::smoother::Correction;
use crate::model::Model;

/// Members wander in steps of this length \[s\], or window by window if these are longer: for a step all of them have to be
/// taken apart, and nothing wanders far in so short a time.
const WANDER_S: f64 = 0.02;

/// Reused from window to window.
#[derive(Debug, Clone, Default)]
pub(super) struct Scratch {
    pub walks: Vec<Walk>,
    /// Members, `[n_u x n_members]`, and what they are together.
    pub rows: Vec<f64>,
    pub cloud: Cloud,
    /// What they wander by, `[n_walks x n_members]`.
    pub draws: Vec<f64>,
    /// Of the samples, `[n_observations x n_members]`.
    noise: Vec<f64>,
    /// What members expect of them, `[n_observations x n_members]`, and what that is together.
    expected: Vec<f64>,
    expectations: Cloud,
    judged: Judged,
    /// Shared prior, `[n_u x n_u]`.
    root: Vec<f64>,
    covariance: Vec<f64>,
    /// Of the samples, `[n_observations x n_observations]`.
    precision: Vec<f64>,
    factor: Vec<f64>,
    /// Mean and sd of the estimated coordinates.
    before: Vec<(f64, f64)>,
}

/// Samples of a window against what the members expect.
#[derive(Debug, Clone, Default)]
struct Judged {
    /// Noise that each is taken to have \[mmHg\].
    sd: Vec<f64>,
    /// Observed minus expected, in units of the stated noise.
    residuals: Vec<f64>,
    /// The sd that members and noise give it \[mmHg\].
    expected_sd: Vec<f64>,
}

impl<M: Model> Ensemble<M> {
    /// Whether the pace of an estimated parameter is learnt. Where a pull to a centre is believed in, pace and pull are a
    /// statement about how far it gets, to be left as it is. The phase of the clock moves by itself, which is no pace of
    /// its own, and its rate is heard of once in a beat only: what is larger than their drift is left to those who listen
    /// for beats.
    pub(super) fn learns_pace(&self, k: usize) -> bool {
        let p = self.estimated[k];
        let is_clock = self.model.cycle().is_some_and(|cycle| cycle.phase == p || cycle.rate == p);
        !is_clock && self.settings.beliefs[p].reversion <= 0.0
    }

    pub(super) fn first_look(&mut self, observations: &[Observation], h: f64, parallel: &dyn Parallel) -> WindowReport {
        self.apply_edits(self.elapsed_s + h, self.elapsed_s);
        self.wander_due_s += h;
        if self.wander_due_s >= WANDER_S - 1e-9 {
            self.wander();
        }
        if observations.is_empty() {
            return self.forecast(parallel);
        }
        self.look_forward(observations, parallel);
        let mut scratch = std::mem::take(&mut self.scratch);
        self.judge(observations, &mut scratch);
        let report = if self.listening {
            let report = self.take_in(observations, h, &mut scratch, parallel);
            self.tell_the_fits(observations, h, &scratch.judged);
            report
        } else {
            self.go_on(parallel)
        };
        self.scratch = scratch;
        report
    }

    /// The update of the members by the samples of a window.
    fn take_in(
        &mut self,
        observations: &[Observation],
        h: f64,
        scratch: &mut Scratch,
        parallel: &dyn Parallel,
    ) -> WindowReport {
        let Scratch { rows, cloud, noise, expected, expectations, judged, root, .. } = scratch;
        self.read_rows(rows);
        cloud.set(rows, self.len(), self.settings.instructions);
        self.normals.draw(observations.len(), self.len(), Some(cloud), noise);
        root.clear();
        root.extend_from_slice(cloud.root());
        let inflation = self.settings.drift.inflation.powf(h);
        if inflation > 1.0 {
            root.iter_mut().for_each(|r| *r *= inflation.sqrt());
        }
        if self.held {
            self.fix_parameters(root);
        }
        if self.settings.live.smoothing_lag_ns > 0 {
            self.correct_the_past(observations, expected, &judged.sd, noise);
        }
        coupled::square(root, cloud.len(), &mut scratch.covariance);
        coupled::precision(expectations.root(), &judged.sd, &mut scratch.factor, &mut scratch.precision);
        scratch.before.clear();
        scratch.before.extend((self.model.n_states()..cloud.len()).map(|row| (cloud.mean()[row], cloud.sd(row))));
        let prior = SharedPrior { root, covariance: &scratch.covariance, precision: &scratch.precision };
        self.learn(observations, (&judged.sd, noise), (Some(prior), &scratch.before), parallel)
    }

    /// After a window, what was off in it.
    fn tell_the_fits(&mut self, observations: &[Observation], h: f64, judged: &Judged) {
        if self.held {
            return;
        }
        // Clocks stand at the end of the window by now.
        let clock = self.model.cycle().zip(self.cycles());
        for (j, o) in observations.iter().enumerate() {
            let phase = clock.map(|(cycle, cycles)| {
                let rate = self.batches[0].theta[cycle.rate].0[0] / 60.0;
                (cycles - (1.0 - o.s) * h * rate).rem_euclid(1.0)
            });
            let (residual, innovation) = (judged.residuals[j], self.findings.innovations[j]);
            self.fits[o.channel].hear(self.elapsed_s + o.s * h, phase, residual, judged.expected_sd[j], innovation);
        }
    }

    /// One window of `independent`: every member for itself.
    pub(super) fn independent_step(&mut self, observations: &[Observation], parallel: &dyn Parallel) -> WindowReport {
        if observations.is_empty() {
            return self.forecast(parallel);
        }
        self.look_forward(observations, parallel);
        let mut scratch = std::mem::take(&mut self.scratch);
        self.judge(observations, &mut scratch);
        let Scratch { noise, judged, before, .. } = &mut scratch;
        self.stated_noise(observations, &mut judged.sd);
        self.normals.draw(observations.len(), self.len(), None, noise);
        before.clear();
        before.extend((0..self.estimated.len()).map(|k| self.coordinate(k)));
        let report = self.learn(observations, (&judged.sd, noise), (None, before), parallel);
        self.scratch = scratch;
        report
    }

    /// Takes the parameters out of what a window can move, but for the phase of the clock.
    fn fix_parameters(&self, root: &mut [f64]) {
        let (n, n_u) = (self.model.n_states(), self.unknowns.len(self.model.n_states()));
        let phase = self.model.cycle().map(|cycle| cycle.phase);
        for (k, _) in self.estimated.iter().enumerate().filter(|(_, p)| Some(**p) != phase) {
            root[(n + k) * n_u..(n + k + 1) * n_u].fill(0.0);
        }
    }

    fn correct_the_past(&mut self, observations: &[Observation], expected: &[f64], sd: &[f64], noise: &[f64]) {
        let m = self.len();
        let off: Vec<f64> = expected
            .iter()
            .zip(noise)
            .enumerate()
            .map(|(k, (expected, e))| observations[k / m].value + sd[k / m] * e - expected)
            .collect();
        if let Some(correction) = Correction::new(expected, &off, sd, m) {
            // What is looked at again has corrected the times before it already.
            self.smoother.correct(&correction, self.second_look.unwrap_or(0));
        }
    }

    /// What the members expect of the samples, and how far off each sample is.
    fn judge(&mut self, observations: &[Observation], scratch: &mut Scratch) {
        let Scratch { expected, expectations, judged, .. } = scratch;
        read_expectations(&self.batches, observations.len(), expected);
        expectations.set(expected, self.len(), self.settings.instructions);
        judged.sd.clear();
        judged.residuals.clear();
        judged.expected_sd.clear();
        for (j, o) in observations.iter().enumerate() {
            let (mean, spread) = (expectations.mean()[j], expectations.sd(j));
            let stated = self.settings.channels[o.channel].noise_sd_mmhg;
            let noise = stated * self.fits[o.channel].noise_factor();
            let expected_sd = (spread * spread + noise * noise).sqrt();
            let innovation = (o.value - mean) / expected_sd;
            // A heavy tail (Huber): what is far off may be an artefact and pulls no more than what is just credible.
            let far = innovation.abs() / self.settings.adaptation.outlier_sd;
            judged.sd.push(if far > 1.0 { noise * far.sqrt() } else { noise });
            judged.residuals.push((o.value - mean) / stated);
            judged.expected_sd.push(expected_sd);
            self.findings.expected.push(mean);
            self.findings.innovations.push(innovation);
        }
    }
}
