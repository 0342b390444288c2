//! A Bayesian physics-informed network (Yang, Meng and Karniadakis 2021).
//!
//! Prior: standard normal weights and biases, `k` normal around the guess. Likelihood: independent normal residuals of
//! the equation at the collocation points, data with their known noise, and the start. Sampled by Hamiltonian Monte
//! Carlo with trajectories of one length (`2^doublings - 1` leapfrog steps, the sample drawn from the whole trajectory
//! by its weight); step size (dual averaging) and diagonal mass are adapted during burn-in and then kept.
//!
//! Several chains, because one cannot tell whether it has seen all of a posterior. Each starts from a briefly trained
//! member of [`pinn`](super::pinn()): from a random network `k` sometimes ends in a far minimum that no chain leaves.
//!
//! The posterior is narrow across and wide along, and a thousand samples are worth ten to twenty independent ones;
//! [`Mixing`] says how many. The standard deviations of the residual and of the start are choices: narrower ones mix
//! more slowly still. More [`BayesianSettings::doublings`] help, at twice the time each.

use std::collections::HashMap;
use std::fmt::Display;

use candle_core::Tensor;
use nuts_rs::{Chain, CpuLogpFunc, CpuMath, CpuMathError, DiagNutsSettings, HasDims, LogpError, Settings};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::mixing::{effective_samples, r_hat};
use super::network::{Points, Weights, initial, numbers, scalar};
use super::pinn::{PinnSettings, descend};
use super::{Outcome, PeerError, Task};

/// Settings of the sampler; the defaults are those of the paper where it states them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BayesianSettings {
    /// Chains, each with its own burn-in and samples.
    pub chains: usize,
    /// Units of the hidden layer.
    pub hidden: usize,
    /// Steps of Adam that a chain starts after.
    pub warm_up: usize,
    /// Draws of each chain that are thrown away, while it adapts.
    pub burn_in: usize,
    /// Draws of each chain that are kept.
    pub samples: usize,
    /// A trajectory takes `2^doublings - 1` leapfrog steps.
    pub doublings: u64,
    /// Acceptance that the step size aims at during burn-in.
    pub target_acceptance: f64,
    /// Points at which the equation has to hold, evenly over the horizon.
    pub collocation_points: usize,
    /// Standard deviation of the residual of the equation at a collocation point.
    pub residual_sd: f64,
    /// Standard deviation of the misfit at the known start.
    pub start_sd: f64,
    /// Standard deviation of the prior of `k`.
    pub k_sd: f64,
}

impl Default for BayesianSettings {
    fn default() -> Self {
        Self {
            chains: 2,
            hidden: 50,
            warm_up: 3_000,
            burn_in: 2_000,
            samples: 1_000,
            doublings: 6,
            target_acceptance: 0.95,
            collocation_points: 30,
            residual_sd: 0.1,
            start_sd: 0.05,
            k_sd: 0.5,
        }
    }
}

impl BayesianSettings {
    /// All draws of all chains: what [`Task::progress`] adds up to.
    #[must_use]
    pub const fn work(&self) -> u64 {
        self.chains as u64 * (self.burn_in as u64 + self.samples as u64)
    }

    fn check(&self) -> Result<(), PeerError> {
        if self.chains == 0 || self.samples == 0 || self.hidden == 0 || self.collocation_points < 2 {
            return Err(PeerError::Input("chains, samples, units and two collocation points are needed"));
        }
        if [self.residual_sd, self.start_sd, self.k_sd].iter().any(|sd| !(sd.is_finite() && *sd > 0.0)) {
            return Err(PeerError::Input("standard deviations have to be positive"));
        }
        Ok(())
    }
}

/// How well the chains mixed, after burn-in.
#[derive(Debug, Clone, PartialEq)]
pub struct Mixing {
    /// Mean acceptance along the trajectories of each chain.
    pub acceptance: Vec<f64>,
    /// Adapted step size of each chain, in units of its adapted mass.
    pub step_size: Vec<f64>,
    /// Trajectories cut short because the integration went astray, over all chains.
    pub divergences: usize,
    /// Split R-hat of `k`; 1 if the chains and their halves agree.
    pub r_hat: f64,
    /// Independent draws of `k` that the samples of all chains are worth.
    pub effective_samples: f64,
}

/// Samples all chains, on the threads of rayon; the samples of a chain follow those of the one before.
///
/// # Errors
/// When task or settings make no sense, or a tensor operation or the sampler fails.
pub fn bayesian(task: &Task<'_>, settings: &BayesianSettings) -> Result<Outcome<Mixing>, PeerError> {
    task.check()?;
    settings.check()?;
    let chains: Vec<Run> = (0..settings.chains as u64)
        .into_par_iter()
        .map(|index| run(task, settings, index))
        .collect::<Result<_, _>>()?;
    let ks: Vec<&[f64]> = chains.iter().map(|chain| chain.k.as_slice()).collect();
    let diagnostics = Mixing {
        acceptance: chains.iter().map(|chain| chain.acceptance).collect(),
        step_size: chains.iter().map(|chain| chain.step_size).collect(),
        divergences: chains.iter().map(|chain| chain.divergences).sum(),
        r_hat: r_hat(&ks),
        effective_samples: effective_samples(&ks),
    };
    let k = ks.concat();
    Ok(Outcome { k, x: chains.into_iter().flat_map(|chain| chain.x).collect(), diagnostics })
}

/// What one chain gave.
#[derive(Default)]
struct Run {
    k: Vec<f64>,
    x: Vec<Vec<f64>>,
    acceptance: f64,
    step_size: f64,
    divergences: usize,
}

/// One chain; its randomness is a stream of its own.
fn run(task: &Task<'_>, settings: &BayesianSettings, index: u64) -> Result<Run, PeerError> {
    let mut rng = ChaCha8Rng::seed_from_u64(task.seed);
    rng.set_stream(index);
    let math = CpuMath::new(Posterior::new(task, settings)?);
    let mut chain = sampler(settings).new_chain(index, math, &mut rng).map_err(failed)?;
    chain.set_position(&warm(task, settings, &mut rng)?).map_err(failed)?;
    let mut run = Run::default();
    for draw in 0..settings.burn_in + settings.samples {
        let (position, _, statistics, progress) = chain.expanded_draw().map_err(failed)?;
        (task.progress)(1);
        if draw < settings.burn_in {
            continue;
        }
        let weights = Weights::new(&position)?;
        run.k.push(weights.k()?);
        run.x.push(weights.predict(task, task.predict_at)?);
        run.acceptance += statistics.adapt.step_size.mean_tree_accept / settings.samples as f64;
        run.step_size = progress.step_size;
        run.divergences += usize::from(progress.diverging);
    }
    Ok(run)
}

/// Where a chain starts. `k` learns slowly, lest it moves before the network has seen the data.
fn warm(task: &Task<'_>, settings: &BayesianSettings, rng: &mut ChaCha8Rng) -> Result<Vec<f64>, PeerError> {
    let weights = Weights::new(&initial(task, settings.hidden, rng))?;
    let training = PinnSettings { iterations: settings.warm_up, k_learning_rate: 3e-4, ..PinnSettings::default() };
    let points = Points::new(task, task.data, settings.collocation_points, settings.hidden)?;
    descend(&Task { progress: &|_| {}, ..*task }, &training, &weights, &points)?;
    weights.values()
}

/// Without the check for turning back, the sampler's trajectories all have the same length.
fn sampler(settings: &BayesianSettings) -> DiagNutsSettings {
    let mut sampler = DiagNutsSettings {
        num_tune: settings.burn_in as u64,
        num_draws: settings.samples as u64,
        maxdepth: settings.doublings,
        check_turning: false,
        ..DiagNutsSettings::default()
    };
    sampler.adapt_options.step_size_settings.target_accept = settings.target_acceptance;
    sampler
}

fn failed(error: impl Display) -> PeerError {
    PeerError::Sampler(format!("{error:#}"))
}

/// The unnormalised posterior.
#[derive(Debug)]
struct Posterior {
    points: Points,
    noise_sd: f64,
    k_guess: f64,
    settings: BayesianSettings,
}

impl Posterior {
    fn new(task: &Task<'_>, settings: &BayesianSettings) -> Result<Self, PeerError> {
        let points = Points::new(task, task.data, settings.collocation_points, settings.hidden)?;
        Ok(Self { points, noise_sd: task.noise_sd, k_guess: task.k_guess, settings: *settings })
    }

    /// Minus the logarithm of the density, but for a constant.
    fn energy(&self, weights: &Weights) -> Result<Tensor, PeerError> {
        let misfits = self.points.misfits(weights)?;
        let mut energy = (half_squares(&misfits.residual, self.settings.residual_sd)?
            + half_squares(&misfits.data, self.noise_sd)?)?;
        energy = (energy + half_squares(&misfits.start, self.settings.start_sd)?)?;
        let [network @ .., k] = weights.vars();
        for var in network {
            energy = (energy + half_squares(var, 1.0)?)?;
        }
        Ok((energy + half_squares(&k.affine(1.0, -self.k_guess)?, self.settings.k_sd)?)?)
    }

    /// Logarithm of the density, and its gradient.
    fn log_density(&self, position: &[f64], gradient: &mut [f64]) -> Result<f64, PeerError> {
        let weights = Weights::new(position)?;
        let energy = self.energy(&weights)?;
        let gradients = energy.backward()?;
        let mut at = 0;
        for var in weights.vars() {
            let slopes = gradients.get(var).map(numbers).transpose()?.unwrap_or_default();
            gradient[at..at + slopes.len()].iter_mut().zip(&slopes).for_each(|(out, slope)| *out = -slope);
            at += var.elem_count();
        }
        Ok(-scalar(&energy)?)
    }
}

/// Half the sum of squares, in units of `sd`.
fn half_squares(misfit: &Tensor, sd: f64) -> candle_core::Result<Tensor> {
    misfit.sqr()?.sum_all()? * (0.5 / (sd * sd))
}

/// A density that could not be computed; ends the chain.
#[derive(Debug, thiserror::Error)]
#[error(transparent)]
struct DensityError(#[from] PeerError);

impl LogpError for DensityError {
    fn is_recoverable(&self) -> bool {
        false
    }
}

impl HasDims for Posterior {
    fn dim_sizes(&self) -> HashMap<String, u64> {
        HashMap::from([("unconstrained_parameter".to_owned(), self.dim() as u64)])
    }
}

impl CpuLogpFunc for Posterior {
    type LogpError = DensityError;
    type FlowParameters = ();
    type ExpandedVector = Vec<f64>;

    fn dim(&self) -> usize {
        Weights::count(self.settings.hidden)
    }

    fn logp(&mut self, position: &[f64], gradient: &mut [f64]) -> Result<f64, DensityError> {
        Ok(self.log_density(position, gradient)?)
    }

    fn expand_vector<R: rand::Rng + ?Sized>(&mut self, _: &mut R, position: &[f64]) -> Result<Vec<f64>, CpuMathError> {
        Ok(position.to_vec())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reproduce::peers::tests::{exact_data, task};

    #[test]
    fn k_is_found() {
        let data = exact_data();
        let settings = BayesianSettings {
            hidden: 20,
            burn_in: 200,
            samples: 50,
            collocation_points: 30,
            ..BayesianSettings::default()
        };
        let outcome = bayesian(&task(&data, &[2.5]), &settings).unwrap();
        let mean = outcome.k.iter().sum::<f64>() / outcome.k.len() as f64;
        assert_eq!((outcome.k.len(), outcome.x.len()), (100, 100));
        assert!((mean - 1.0).abs() < 0.05, "{mean}, {:?}", outcome.diagnostics);
    }

    #[test]
    fn a_seed_gives_the_same_samples() {
        let data = exact_data();
        let settings = BayesianSettings { burn_in: 10, samples: 5, doublings: 3, ..BayesianSettings::default() };
        let task = task(&data, &[5.0]);
        let outcome = bayesian(&task, &settings).unwrap();
        assert_eq!(outcome.k, bayesian(&task, &settings).unwrap().k);
        assert_ne!(outcome.k, bayesian(&Task { seed: 8, ..task }, &settings).unwrap().k);
    }
}
