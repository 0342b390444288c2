//! One window of X-TFC: what the members expect, how far off the samples are, what is learnt of that.

use super::{Ensemble, Observation, Parallel, WindowReport};
use crate::estimate::batch::{SharedPrior, expectations};
use crate::estimate::coupling::coupled;
use crate::estimate::smoother::Correction;
use crate::estimate::statistics::mean_and_sd;
use crate::model::Model;

/// Longest time between two steps of what wanders \[s\].
const WANDER_S: f64 = 0.02;

/// Samples of a window against what the members expect.
#[derive(Debug, Clone, Default)]
struct Judged {
    /// Mean of what the members expect \[mmHg\].
    expected: Vec<f64>,
    /// Noise that each is taken to have \[mmHg\].
    sd: Vec<f64>,
    /// Observed minus expected, in units of the stated noise.
    residuals: Vec<f64>,
    /// The sd that members and noise give it \[mmHg\].
    expected_sd: Vec<f64>,
    /// Observed minus expected in that unit.
    innovations: Vec<f64>,
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
        // Between samples a little at a time is enough.
        if !observations.is_empty() || self.wander_due_s >= WANDER_S {
            self.wander();
        }
        if observations.is_empty() {
            return self.forecast(parallel);
        }
        self.look_forward(observations, parallel);
        let expected = expectations(&self.batches, observations.len());
        let judged = self.judge(observations, &expected);
        if !self.listening {
            let report = self.go_on(parallel);
            return WindowReport { innovations: judged.innovations, expected: judged.expected, ..report };
        }
        let (rows, m) = (self.rows(), self.len());
        let noise = self.draw(observations.len(), &rows);
        coupled::covariance_root(&rows, m, &mut self.root);
        let inflation = self.settings.drift.inflation.powf(h);
        if inflation > 1.0 {
            self.root.iter_mut().for_each(|r| *r *= inflation.sqrt());
        }
        if self.held {
            self.fix_parameters();
        }
        if self.settings.live.smoothing_lag_ns > 0 {
            self.correct_the_past(observations, &expected, &judged.sd, &noise);
        }
        let root = std::mem::take(&mut self.root);
        let covariance = coupled::square(&root, rows.len() / m);
        let precision = coupled::precision(&coupled::covariance(&expected, &expected, m), &judged.sd);
        let prior = SharedPrior { root: &root, covariance: &covariance, precision: &precision };
        let before: Vec<_> = rows.chunks_exact(m).skip(self.model.n_states()).map(mean_and_sd).collect();
        let report = self.learn(observations, (&judged.sd, &noise), (Some(prior), &before), parallel);
        self.root = root;
        // Clocks stand at the end of the window by now.
        let clock = self.model.cycle().zip(self.cycles());
        for (j, o) in observations.iter().enumerate().filter(|_| !self.held) {
            let phase = clock.map(|(cycle, cycles)| {
                let rate = self.batches[0].theta[cycle.rate].0[0] / 60.0;
                (cycles - (1.0 - o.s) * h * rate).rem_euclid(1.0)
            });
            let (residual, innovation) = (judged.residuals[j], judged.innovations[j]);
            self.fits[o.channel].hear(self.elapsed_s + o.s * h, phase, residual, judged.expected_sd[j], innovation);
        }
        WindowReport { innovations: judged.innovations, expected: judged.expected, ..report }
    }

    /// One window of `independent`: every member for itself.
    pub(super) fn independent_step(&mut self, observations: &[Observation], parallel: &dyn Parallel) -> WindowReport {
        if observations.is_empty() {
            return self.forecast(parallel);
        }
        self.look_forward(observations, parallel);
        let expected = expectations(&self.batches, observations.len());
        let judged = self.judge(observations, &expected);
        let sd = self.stated_noise(observations);
        let noise = self.draw(observations.len(), &[]);
        let before = self.coordinates();
        let report = self.learn(observations, (&sd, &noise), (None, &before), parallel);
        WindowReport { innovations: judged.innovations, expected: judged.expected, ..report }
    }

    /// Takes the parameters out of what a window can move, but for the phase of the clock.
    fn fix_parameters(&mut self) {
        let (n, n_u) = (self.model.n_states(), self.unknowns.len(self.model.n_states()));
        let phase = self.model.cycle().map(|cycle| cycle.phase);
        for (k, _) in self.estimated.iter().enumerate().filter(|(_, p)| Some(**p) != phase) {
            self.root[(n + k) * n_u..(n + k + 1) * n_u].fill(0.0);
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
    fn judge(&self, observations: &[Observation], expected: &[f64]) -> Judged {
        let mut judged = Judged::default();
        for (o, expected) in observations.iter().zip(expected.chunks_exact(self.len())) {
            let (mean, spread) = mean_and_sd(expected);
            let stated = self.settings.channels[o.channel].noise_sd_mmhg;
            let noise = stated * self.fits[o.channel].noise_factor();
            let expected_sd = (spread * spread + noise * noise).sqrt();
            let innovation = (o.value - mean) / expected_sd;
            // A heavy tail (Huber): what is far off may be an artefact and pulls no more than what is just credible.
            let far = innovation.abs() / self.settings.adaptation.outlier_sd;
            judged.sd.push(if far > 1.0 { noise * far.sqrt() } else { noise });
            judged.residuals.push((o.value - mean) / stated);
            judged.expected.push(mean);
            judged.expected_sd.push(expected_sd);
            judged.innovations.push(innovation);
        }
        judged
    }
}
