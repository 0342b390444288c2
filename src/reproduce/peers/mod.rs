//! Two peers to compare X-TFC with, on the harmonic example of De Florio, Zou, Schiavazzi and Karniadakis (2024).
//!
//! `dx/dt = cos(k t) / k` with a known start and an unknown `k`; noisy data on the first part of an interval, a
//! prediction to its end. Both peers fit the same network, one hidden layer of tanh units:
//!
//! * [`pinn()`]: an ensemble of physics-informed networks, trained by Adam.
//! * [`bayesian()`]: a Bayesian physics-informed network, sampled by Hamiltonian Monte Carlo.
//!
//! Automatic differentiation and Adam are those of `candle`, the sampler is that of `nuts-rs`. The settings default to
//! those of the paper where it states them. Guaranteed: the same task, settings and seed give the same outcome, on any
//! number of threads of one machine. Deliberately absent: clocks (the caller measures) and any other equation.

pub mod bayesian;
mod mixing;
mod network;
pub mod pinn;

pub use bayesian::{BayesianSettings, Mixing, bayesian};
pub use pinn::{Fit, PinnSettings, pinn};

/// What both peers are given.
#[derive(Clone, Copy)]
pub struct Task<'a> {
    /// Time and noisy value.
    pub data: &'a [(f64, f64)],
    /// Standard deviation of the noise of the data.
    pub noise_sd: f64,
    /// Known value at time 0.
    pub x0: f64,
    /// The equation holds, and is asked for, from 0 to here.
    pub horizon: f64,
    /// Where the search for `k` starts.
    pub k_guess: f64,
    /// Times at which `x` is asked for.
    pub predict_at: &'a [f64],
    /// Same seed, same outcome.
    pub seed: u64,
    /// Told the work done since its last call, in the units of `work()` of the settings; from several threads.
    pub progress: &'a (dyn Fn(u64) + Sync),
}

impl Task<'_> {
    /// Refuses what cannot be computed.
    fn check(&self) -> Result<(), PeerError> {
        let positive = |value: f64| value.is_finite() && value > 0.0;
        if self.data.is_empty() {
            return Err(PeerError::Input("there are no data"));
        }
        if !(positive(self.noise_sd) && positive(self.horizon) && positive(self.k_guess) && self.x0.is_finite()) {
            return Err(PeerError::Input("noise, horizon and guess have to be positive, the start finite"));
        }
        Ok(())
    }
}

/// What a peer found.
#[derive(Debug, Clone, PartialEq)]
pub struct Outcome<D> {
    /// `k` of each member or sample.
    pub k: Vec<f64>,
    /// `x` at [`Task::predict_at`] of each member or sample.
    pub x: Vec<Vec<f64>>,
    /// How it went: a [`Fit`] for each member, or the [`Mixing`] of the chains.
    pub diagnostics: D,
}

/// Why a peer has no outcome.
#[derive(Debug, thiserror::Error)]
pub enum PeerError {
    /// The task or the settings cannot be computed.
    #[error("{0}")]
    Input(&'static str),
    /// A tensor operation failed.
    #[error("tensor operation: {0}")]
    Tensor(#[from] candle_core::Error),
    /// The sampler failed.
    #[error("sampler: {0}")]
    Sampler(String),
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// The exact solution for `k = 1`, without noise.
    pub(crate) fn exact_data() -> Vec<(f64, f64)> {
        (0..20).map(|i| 0.25 * f64::from(i)).map(|t| (t, 10.0 + t.sin())).collect()
    }

    pub(crate) fn task<'a>(data: &'a [(f64, f64)], predict_at: &'a [f64]) -> Task<'a> {
        Task { data, noise_sd: 0.1, x0: 10.0, horizon: 10.0, k_guess: 1.5, predict_at, seed: 7, progress: &|_| {} }
    }

    #[test]
    fn nonsense_is_refused() {
        let data = exact_data();
        assert!(matches!(task(&[], &[]).check(), Err(PeerError::Input(_))));
        assert!(matches!(Task { noise_sd: 0.0, ..task(&data, &[]) }.check(), Err(PeerError::Input(_))));
        assert!(task(&data, &[]).check().is_ok());
    }
}
