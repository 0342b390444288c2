//! The filters that a user would reach for first, behind the interface of the ensemble: they forecast with a classical
//! Runge-Kutta scheme, know each sensor's noise and a constant process noise, and correct linearly at the end of a
//! window for all of its samples at once.

use super::batch::{Batch, read, read_expectations};
use super::cloud::Cloud;
use super::coupling::coupled::{covariance, gain, semidefinite_cholesky, square, with_noise};
use super::ensemble::{Ensemble, Observation, Parallel, Serial, WindowReport};
use super::random::Normals;
use super::statistics::mean_and_sd;
use crate::model::Model;
use crate::model::lanes::{Lanes, WIDTH};

/// Unscented Kalman filter over (state, parameter coordinates): mean, covariance, and a standard normal cloud that
/// stands for the posterior wherever members are asked for.
#[derive(Debug, Clone)]
pub(super) struct Unscented {
    mean: Vec<f64>,
    /// `[n x n]`
    covariance: Vec<f64>,
    /// `[n x n_members]`
    cloud: Vec<f64>,
    /// The sigma points, as members.
    points: Vec<Batch>,
}

impl Unscented {
    /// With the moments of the members.
    pub(super) fn new(members: &Cloud, normals: &mut Normals) -> Self {
        let (mut covariance, mut cloud) = (Vec::new(), Vec::new());
        square(members.root(), members.len(), &mut covariance);
        normals.draw(members.len(), members.members(), None, &mut cloud);
        Self { mean: members.mean().to_vec(), covariance, cloud, points: Vec::new() }
    }
}

impl<M: Model> Ensemble<M> {
    /// Forecast, then the stochastic update with perturbed observations.
    pub(super) fn enkf_step(&mut self, observations: &[Observation], h: f64, parallel: &dyn Parallel) -> WindowReport {
        self.wander_for(h);
        self.each(parallel, |tools, batch| batch.look_ahead(tools, observations, h));
        let report = WindowReport { solved: self.len(), ..Default::default() };
        if observations.is_empty() {
            return report;
        }
        let members = self.len();
        let (mut rows, mut sd, mut expected) = (Vec::new(), Vec::new(), Vec::new());
        self.read_rows(&mut rows);
        self.stated_noise(observations, &mut sd);
        read_expectations(&self.batches, sd.len(), &mut expected);
        let noise = self.draw(sd.len());
        let m = sd.len();
        let innovation = with_noise(covariance(&expected, &expected, members), &sd);
        for (j, o) in observations.iter().enumerate() {
            let mean = mean_and_sd(&expected[j * members..][..members]).0;
            self.findings.innovations.push((o.value - mean) / innovation[j * m + j].sqrt());
        }
        let before = self.coordinates();
        if let Some(gain) = gain(&covariance(&rows, &expected, members), &innovation, m) {
            let mut updated = rows;
            for (row, gain) in updated.chunks_exact_mut(members).zip(gain.chunks_exact(m)) {
                for (i, value) in row.iter_mut().enumerate() {
                    let off =
                        |j: usize| observations[j].value + sd[j] * noise[j * members + i] - expected[j * members + i];
                    *value += (0..m).map(|j| gain[j] * off(j)).sum::<f64>();
                }
            }
            self.place(&updated, h);
        }
        self.compare(&before);
        report
    }

    /// Sigma points, their forecast, and the update of the moments.
    pub(super) fn ukf_step(&mut self, observations: &[Observation], h: f64) -> WindowReport {
        let report = WindowReport { solved: self.len(), ..Default::default() };
        let Some(mut filter) = self.unscented.take() else { return report };
        let n = filter.mean.len();
        self.disturb(&mut filter, h);
        let before = self.coordinates();

        let points = self.sigma_points(&mut filter, observations, h);
        let m = observations.len();
        let (mut ends, mut expected) = (Vec::new(), Vec::new());
        self.read_rows_of(&filter.points, &mut ends);
        read_expectations(&filter.points, m, &mut expected);
        let moments = |a: &[f64], b: &[f64]| weighted_covariance(a, b, points);
        filter.mean = ends.chunks_exact(points).map(weighted_mean).collect();
        filter.covariance = moments(&ends, &ends);
        if m > 0 {
            let mut sd = Vec::new();
            self.stated_noise(observations, &mut sd);
            let innovation = with_noise(moments(&expected, &expected), &sd);
            let off: Vec<f64> =
                expected.chunks_exact(points).zip(observations).map(|(row, o)| o.value - weighted_mean(row)).collect();
            self.findings.innovations.extend((0..m).map(|j| off[j] / innovation[j * m + j].sqrt()));
            if let Some(gain) = gain(&moments(&ends, &expected), &innovation, m) {
                for i in 0..n {
                    let row = &gain[i * m..(i + 1) * m];
                    filter.mean[i] += row.iter().zip(&off).map(|(k, v)| k * v).sum::<f64>();
                    for j in 0..n {
                        let other = &gain[j * m..(j + 1) * m];
                        let seen: f64 = (0..m)
                            .map(|a| (0..m).map(|b| row[a] * innovation[a * m + b] * other[b]).sum::<f64>())
                            .sum();
                        filter.covariance[i * n + j] -= seen;
                    }
                }
            }
        }
        let mut clocks = Vec::new();
        read(&filter.points[0].theta, 0, &mut clocks);
        self.draw_cloud(&filter, &clocks, h);
        self.unscented = Some(filter);
        if m > 0 {
            self.compare(&before);
        }
        report
    }

    /// Process noise of a step, and the pull of the parameters to where they started.
    fn disturb(&self, filter: &mut Unscented, h: f64) {
        let (n, states) = (filter.mean.len(), self.model.n_states());
        for (s, sd) in self.settings.drift.states.iter().enumerate() {
            filter.covariance[s * n + s] += sd * sd * h;
        }
        for (k, &p) in self.estimated().iter().enumerate() {
            let (belief, i) = (&self.settings.beliefs[p], states + k);
            let keep = (-belief.reversion * h).exp();
            filter.mean[i] = self.centre[k] + keep * (filter.mean[i] - self.centre[k]);
            for j in 0..n {
                filter.covariance[i * n + j] *= keep;
                filter.covariance[j * n + i] *= keep;
            }
            filter.covariance[i * n + i] +=
                belief.drift * belief.drift * super::adapt::pace::diffusion(belief.reversion, h);
        }
    }

    /// The symmetric set of `2 n` points at `sqrt(n)` sd, moved on to the end of the window; returns their number.
    #[allow(clippy::cast_precision_loss)]
    fn sigma_points(&self, filter: &mut Unscented, observations: &[Observation], h: f64) -> usize {
        let (n, states) = (filter.mean.len(), self.model.n_states());
        let mut root = filter.covariance.clone();
        semidefinite_cholesky(&mut root, n);
        let reach = (n as f64).sqrt();
        let base = self.theta_of(0);
        let point = |i: usize| {
            let (column, sign) = (i % n, if i < n { reach } else { -reach });
            let at = |row: usize| filter.mean[row] + if column <= row { sign * root[row * n + column] } else { 0.0 };
            let mut theta = base.clone();
            for (k, &p) in self.estimated().iter().enumerate() {
                theta[p] = self.settings.beliefs[p].value(self.transforms[k], at(states + k));
            }
            ((0..states).map(at).collect::<Vec<f64>>(), theta)
        };
        let batch = |first: usize| {
            let (xs, thetas): (Vec<_>, Vec<_>) = (first..(first + WIDTH).min(2 * n)).map(point).unzip();
            Batch::new(first, Vec::new(), &xs, &thetas)
        };
        filter.points = (0..2 * n).step_by(WIDTH).map(batch).collect();
        let tools = self.tools();
        filter.points.iter_mut().for_each(|batch| batch.look_ahead(&tools, observations, h));
        2 * n
    }

    /// Members with the moments of the filter.
    fn draw_cloud(&mut self, filter: &Unscented, clocks: &[f64], h: f64) {
        let (n, members) = (filter.mean.len(), self.len());
        let mut root = filter.covariance.clone();
        semidefinite_cholesky(&mut root, n);
        let mut rows = Vec::with_capacity(n * members);
        for i in 0..n {
            for member in 0..members {
                let along: f64 = (0..=i).map(|k| root[i * n + k] * filter.cloud[k * members + member]).sum();
                rows.push(filter.mean[i] + along);
            }
        }
        for batch in &mut self.batches {
            batch.window.start.clone_from(&batch.x);
            batch.theta.iter_mut().zip(clocks).for_each(|(theta, clock)| *theta = Lanes::splat(*clock));
        }
        self.place(&rows, h);
    }

    /// Sets states and parameters at the end of the window from `rows` `[n_u x n_members]`.
    fn place(&mut self, rows: &[f64], h: f64) {
        self.place_from(0, rows);
        self.each(&Serial, |tools, batch| batch.start_from_end(tools, h));
    }

    /// The noise that each sample is said to have, into `out`.
    pub(super) fn stated_noise(&self, observations: &[Observation], out: &mut Vec<f64>) {
        out.clear();
        out.extend(observations.iter().map(|o| self.settings.channels[o.channel].noise_sd_mmhg));
    }
}

#[allow(clippy::cast_precision_loss)]
fn weighted_mean(row: &[f64]) -> f64 {
    row.iter().sum::<f64>() / row.len() as f64
}

#[allow(clippy::cast_precision_loss)]
fn weighted_covariance(a: &[f64], b: &[f64], points: usize) -> Vec<f64> {
    // All weights are equal, and the points are all there is: divided by their number.
    let share = (points as f64 - 1.0) / points as f64;
    covariance(a, b, points).into_iter().map(|c| share * c).collect()
}
