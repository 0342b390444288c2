//! The classical Runge-Kutta scheme: what filters of the field forecast with, and a cheap look ahead.

use super::Model;

/// Longest step \[s\]; the fastest time constant of the circulation is about 2 ms.
pub const MAX_STEP_S: f64 = 0.001;

/// Scratch.
#[derive(Debug, Clone, Default)]
pub struct Rk4 {
    slope: Vec<f64>,
    sum: Vec<f64>,
    trial: Vec<f64>,
}

impl Rk4 {
    /// Moves `x` from `from_s` to `until_s` in equal steps of at most `max_step_s`; times since the clocks in `theta`
    /// were set.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
    pub fn advance<M: Model>(
        &mut self,
        model: &M,
        (from_s, until_s): (f64, f64),
        max_step_s: f64,
        theta: &[f64],
        x: &mut [f64],
    ) {
        let span = until_s - from_s;
        if span <= 0.0 {
            return;
        }
        let steps = (span / max_step_s - 1e-6).ceil().max(1.0);
        let h = span / steps;
        for step in 0..steps as usize {
            self.step(model, from_s + step as f64 * h, h, theta, x);
        }
    }

    fn step<M: Model>(&mut self, model: &M, t: f64, h: f64, theta: &[f64], x: &mut [f64]) {
        let n = x.len();
        for scratch in [&mut self.slope, &mut self.sum, &mut self.trial] {
            scratch.resize(n, 0.0);
        }
        self.trial.copy_from_slice(x);
        self.sum.fill(0.0);
        for (ahead, weight) in [(0.0, 1.0), (0.5, 2.0), (0.5, 2.0), (1.0, 1.0)] {
            if ahead > 0.0 {
                self.trial.iter_mut().zip(x.iter().zip(&self.slope)).for_each(|(t, (x, k))| *t = x + ahead * h * k);
            }
            model.rhs(t + ahead * h, &self.trial, theta, &mut self.slope);
            self.sum.iter_mut().zip(&self.slope).for_each(|(s, k)| *s += weight * k);
        }
        x.iter_mut().zip(&self.sum).for_each(|(x, s)| *x += h / 6.0 * s);
    }
}
