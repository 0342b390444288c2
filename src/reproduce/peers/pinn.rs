//! An ensemble of physics-informed networks.
//!
//! The loss of a member is the mean square of the residual of the equation at the collocation points, plus that of the
//! data misfit, plus the square of the misfit at the start; Adam minimises it over the weights and `k` together, at
//! constant rates. Members differ in the weights they start from, and at will in their copy of the data.
//!
//! The loss has further minima in `k`, for the example around two and a half times the truth. At the published rate for
//! all, some members end there when `k` starts at one and a half times the truth: it moves before the network has seen
//! the data. Such a member shows by its loss, several times that of the others; it stays in the outcome. A lower
//! [`PinnSettings::k_learning_rate`] or a closer guess avoids it.

use candle_core::{Tensor, Var};
use candle_nn::{AdamW, Optimizer, ParamsAdamW};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::network::{Misfits, Points, Weights, initial, normal, scalar};
use super::{Outcome, PeerError, Task};

/// Settings of the ensemble; the defaults are those of the paper where it states them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PinnSettings {
    /// Networks in the ensemble.
    pub members: usize,
    /// Units of the hidden layer.
    pub hidden: usize,
    /// Steps of Adam.
    pub iterations: usize,
    /// Of Adam, for weights and biases.
    pub learning_rate: f64,
    /// Of Adam, for `k`.
    pub k_learning_rate: f64,
    /// Points at which the equation has to hold, evenly over the horizon.
    pub collocation_points: usize,
    /// Whether each member has noise of its own added to the data; otherwise members differ in their start only.
    pub noisy_copies: bool,
}

impl Default for PinnSettings {
    fn default() -> Self {
        Self {
            members: 10,
            hidden: 50,
            iterations: 30_000,
            learning_rate: 1e-3,
            k_learning_rate: 1e-3,
            collocation_points: 100,
            noisy_copies: false,
        }
    }
}

impl PinnSettings {
    /// All steps of all members: what [`Task::progress`] adds up to.
    #[must_use]
    pub const fn work(&self) -> u64 {
        self.members as u64 * self.iterations as u64
    }

    fn check(&self) -> Result<(), PeerError> {
        if self.members == 0 || self.hidden == 0 || self.collocation_points < 2 {
            return Err(PeerError::Input("members, units and two collocation points are needed"));
        }
        Ok(())
    }
}

/// How the training of a member ended.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fit {
    /// Loss before the last step.
    pub loss: f64,
    /// Root mean square of the residual of the equation.
    pub residual_rms: f64,
    /// Root mean square of the data misfit.
    pub data_rms: f64,
    /// `k` at half of the steps; far from the last one, the member has not converged.
    pub k_half_way: f64,
}

/// Trains all members, on the threads of rayon.
///
/// # Errors
/// When task or settings make no sense, or a tensor operation fails.
pub fn pinn(task: &Task<'_>, settings: &PinnSettings) -> Result<Outcome<Vec<Fit>>, PeerError> {
    task.check()?;
    settings.check()?;
    let members: Vec<Member> = (0..settings.members as u64)
        .into_par_iter()
        .map(|index| train(task, settings, index))
        .collect::<Result<_, _>>()?;
    let mut outcome = Outcome { k: Vec::new(), x: Vec::new(), diagnostics: Vec::new() };
    for member in members {
        outcome.k.push(member.k);
        outcome.x.push(member.x);
        outcome.diagnostics.push(member.fit);
    }
    Ok(outcome)
}

/// A trained network.
struct Member {
    k: f64,
    x: Vec<f64>,
    fit: Fit,
}

/// One member; its randomness is a stream of its own, so the order of members does not matter.
fn train(task: &Task<'_>, settings: &PinnSettings, index: u64) -> Result<Member, PeerError> {
    let mut rng = ChaCha8Rng::seed_from_u64(task.seed);
    rng.set_stream(index);
    let weights = Weights::new(&initial(task, settings.hidden, &mut rng))?;
    let data = copy(task, settings, &mut rng);
    let points = Points::new(task, &data, settings.collocation_points, settings.hidden)?;
    let fit = descend(task, settings, &weights, &points)?;
    Ok(Member { k: weights.k()?, x: weights.predict(task, task.predict_at)?, fit })
}

/// The data of a member.
fn copy(task: &Task<'_>, settings: &PinnSettings, rng: &mut ChaCha8Rng) -> Vec<(f64, f64)> {
    let sd = if settings.noisy_copies { task.noise_sd } else { 0.0 };
    task.data.iter().map(|&(t, x)| (t, x + sd * normal(rng))).collect()
}

/// All steps of Adam; weights keep what they learn.
pub(super) fn descend(
    task: &Task<'_>,
    settings: &PinnSettings,
    weights: &Weights,
    points: &Points,
) -> Result<Fit, PeerError> {
    let [network @ .., k] = weights.vars();
    let mut adams = [adam(&network, settings.learning_rate)?, adam(&[k], settings.k_learning_rate)?];
    let mut k_half_way = weights.k()?;
    for iteration in 0..settings.iterations {
        let gradients = loss(&points.misfits(weights)?)?.backward()?;
        adams.iter_mut().try_for_each(|adam| adam.step(&gradients))?;
        (task.progress)(1);
        if iteration == settings.iterations / 2 {
            k_half_way = weights.k()?;
        }
    }
    let misfits = points.misfits(weights)?;
    Ok(Fit {
        loss: scalar(&loss(&misfits)?)?,
        residual_rms: scalar(&mean_square(&misfits.residual)?)?.sqrt(),
        data_rms: scalar(&mean_square(&misfits.data)?)?.sqrt(),
        k_half_way,
    })
}

/// Without the decay of weights, AdamW is Adam.
fn adam(vars: &[&Var], rate: f64) -> candle_core::Result<AdamW> {
    let parameters = ParamsAdamW { lr: rate, weight_decay: 0.0, ..ParamsAdamW::default() };
    AdamW::new(vars.iter().map(|&var| var.clone()).collect(), parameters)
}

fn loss(misfits: &Misfits) -> candle_core::Result<Tensor> {
    (mean_square(&misfits.residual)? + mean_square(&misfits.data)?)? + mean_square(&misfits.start)?
}

fn mean_square(misfit: &Tensor) -> candle_core::Result<Tensor> {
    misfit.sqr()?.mean_all()
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU64, Ordering};

    use super::*;
    use crate::reproduce::peers::tests::{exact_data, task};

    #[test]
    fn k_is_found() {
        let data = exact_data();
        let settings = PinnSettings {
            members: 2,
            iterations: 4_000,
            k_learning_rate: 3e-4,
            collocation_points: 40,
            ..PinnSettings::default()
        };
        let outcome = pinn(&task(&data, &[2.5, 10.0]), &settings).unwrap();
        for (k, x) in outcome.k.iter().zip(&outcome.x) {
            assert!((k - 1.0).abs() < 0.02, "{k}");
            assert!((x[0] - 10.0 - 2.5_f64.sin()).abs() < 0.05 && (x[1] - 10.0 - 10.0_f64.sin()).abs() < 0.2, "{x:?}");
        }
    }

    #[test]
    fn a_seed_gives_the_same_ensemble_and_progress_adds_up() {
        let data = exact_data();
        let done = AtomicU64::new(0);
        let progress = |units| {
            done.fetch_add(units, Ordering::Relaxed);
        };
        let settings = PinnSettings { members: 3, iterations: 20, noisy_copies: true, ..PinnSettings::default() };
        let task = task(&data, &[5.0]);
        let outcome = pinn(&Task { progress: &progress, ..task }, &settings).unwrap();
        assert_eq!(done.load(Ordering::Relaxed), settings.work());
        assert_eq!(outcome, pinn(&task, &settings).unwrap());
        assert_ne!(outcome, pinn(&Task { seed: 8, ..task }, &settings).unwrap());
    }
}
