//! One window of X-TFC: what the members expect, how far off the samples are, what is learnt of that.

use super::{Ensemble, Observation, Parallel, Walk, WindowReport};
use crate::estimate::batch::{Lesson, SharedPrior, read_expectations};
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
    /// The noise that samples were taken to have \[mmHg\].
    assumed: Vec<f64>,
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
        let mut scratch = std::mem::take(&mut self.scratch);
        let report = if self.listening {
            self.set_prior(observations, h, &mut scratch);
            let report = self.learn_at_once(observations, &mut scratch, parallel);
            let report = report.unwrap_or_else(|| self.learn_in_turn(observations, &mut scratch, parallel));
            if self.settings.live.smoothing_lag_ns > 0 {
                self.correct_the_past(observations, &scratch.expected, &scratch.judged.sd, &scratch.noise);
            }
            self.tell_the_fits(observations, h, &scratch.judged);
            report
        } else {
            self.look_forward(observations, parallel);
            self.judge(observations, &mut scratch);
            self.go_on(parallel)
        };
        self.scratch = scratch;
        report
    }

    /// What is believed before the samples of a window: the covariance of the members; and how the samples are perturbed.
    fn set_prior(&mut self, observations: &[Observation], h: f64, scratch: &mut Scratch) {
        let Scratch { rows, cloud, noise, root, .. } = scratch;
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
        coupled::square(root, cloud.len(), &mut scratch.covariance);
        scratch.before.clear();
        scratch.before.extend((self.model.n_states()..cloud.len()).map(|row| (cloud.mean()[row], cloud.sd(row))));
    }

    /// The update of the members by the samples of a window, as long as these are what they are expected to be. None, and
    /// nothing done, if one of them is too far off to pull as it would by the noise of its sensor.
    fn learn_at_once(
        &mut self,
        observations: &[Observation],
        scratch: &mut Scratch,
        parallel: &dyn Parallel,
    ) -> Option<WindowReport> {
        if self.is_surprised {
            return None;
        }
        let Scratch { noise, root, covariance, precision, factor, assumed, before, .. } = &mut *scratch;
        assumed.clear();
        assumed.extend(observations.iter().map(|o| self.noise_of(o.channel)));
        // Of the states at the start, which is good enough for a guess.
        let (n_u, states) = (before.len() + self.model.n_states(), &self.settings.channels);
        let state = |o: &Observation| states[o.channel].state;
        factor.clear();
        for o in observations {
            factor.extend(observations.iter().map(|other| covariance[state(o) * n_u + state(other)]));
        }
        coupled::precision(factor, assumed, precision);
        let lesson = Lesson {
            observations,
            sd: assumed,
            noise,
            members: self.len(),
            shared: Some(SharedPrior { root, covariance, precision }),
        };
        self.take_lesson_at_once(&lesson, parallel);
        self.judge(observations, scratch);
        if self.is_surprised {
            self.take_back();
            return None;
        }
        let report = self.account();
        self.compare(&scratch.before);
        Some(report)
    }

    /// The update of the members by the samples of a window, once it is known what is expected of these.
    fn learn_in_turn(
        &mut self,
        observations: &[Observation],
        scratch: &mut Scratch,
        parallel: &dyn Parallel,
    ) -> WindowReport {
        self.look_forward(observations, parallel);
        self.judge(observations, scratch);
        let Scratch { noise, expectations, judged, root, covariance, precision, factor, before, .. } = scratch;
        coupled::square(expectations.root(), observations.len(), factor);
        coupled::precision(factor, &judged.sd, precision);
        let prior = SharedPrior { root, covariance, precision };
        self.learn(observations, (&judged.sd, noise), (Some(prior), before), parallel)
    }

    fn take_lesson_at_once(&mut self, lesson: &Lesson<'_>, parallel: &dyn Parallel) {
        let h = self.clock_step_s();
        self.begin_window();
        self.each_and_draw_ahead(parallel, |tools, batch| {
            batch.forecast_and_fit(tools, lesson);
            batch.move_on(tools, h);
        });
    }

    /// Back to before the last lesson that was taken at once.
    fn take_back(&mut self) {
        for batch in &mut self.batches {
            batch.take_back(&self.varying);
        }
        // The look before it is in the curves by now, and would be taken in again.
        let is_due = self.next_look().is_due;
        if let Some(beats) = self.beats.as_mut().filter(|_| is_due) {
            beats.counter.due_s = None;
        }
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
        let mut scratch = std::mem::take(&mut self.scratch);
        let Scratch { noise, assumed, before, .. } = &mut scratch;
        self.stated_noise(observations, assumed);
        self.normals.draw(observations.len(), self.len(), None, noise);
        before.clear();
        before.extend((0..self.estimated.len()).map(|k| self.coordinate(k)));
        let lesson = Lesson { observations, sd: assumed, noise, members: self.len(), shared: None };
        self.take_lesson_at_once(&lesson, parallel);
        self.judge(observations, &mut scratch);
        let report = self.account();
        self.compare(&scratch.before);
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

    /// The noise of a channel, as it is known by now \[mmHg\].
    fn noise_of(&self, channel: usize) -> f64 {
        self.settings.channels[channel].noise_sd_mmhg * self.fits[channel].noise_factor()
    }

    /// What the members expect of the samples, and how far off each sample is.
    fn judge(&mut self, observations: &[Observation], scratch: &mut Scratch) {
        let Scratch { expected, expectations, judged, .. } = scratch;
        read_expectations(&self.batches, observations.len(), expected);
        expectations.set(expected, self.len(), self.settings.instructions);
        judged.sd.clear();
        judged.residuals.clear();
        judged.expected_sd.clear();
        self.findings.expected.clear();
        self.findings.innovations.clear();
        self.is_surprised = false;
        for (j, o) in observations.iter().enumerate() {
            let (mean, spread) = (expectations.mean()[j], expectations.sd(j));
            let stated = self.settings.channels[o.channel].noise_sd_mmhg;
            let noise = self.noise_of(o.channel);
            let expected_sd = (spread * spread + noise * noise).sqrt();
            let innovation = (o.value - mean) / expected_sd;
            // A heavy tail (Huber): what is far off may be an artefact and pulls no more than what is just credible.
            let far = innovation.abs() / self.settings.adaptation.outlier_sd;
            self.is_surprised |= far > 1.0;
            judged.sd.push(if far > 1.0 { noise * far.sqrt() } else { noise });
            judged.residuals.push((o.value - mean) / stated);
            judged.expected_sd.push(expected_sd);
            self.findings.expected.push(mean);
            self.findings.innovations.push(innovation);
        }
    }
}
