//! Synthetic patients: the truth of a patient file, with sensors on it.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::config::{Config, ConfigError};
use crate::model::Model;
use crate::model::cvsim6::{Cvsim6, PARAMETERS, Pressures};
use crate::model::truth::{SimulationError, Simulator};

/// Time between two steps of a wandering parameter \[s\].
const WANDER_STEP_S: f64 = 0.25;

/// Which random numbers of a seed belong to the sensors, and which to the patient.
const SENSOR_STREAM: u64 = 1;
const WANDER_STREAM: u64 = 2;

/// Which random numbers of a seed decide where a patient starts.
const START_STREAM: u64 = 3;

/// Lets the patient of a configuration start somewhere in what is stated of the start, and so with a blood volume that
/// nobody knows.
///
/// # Errors
/// When the initial pressures have no solution.
pub fn draw_start(config: &mut Config, seed: u64) -> Result<(), ConfigError> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(START_STREAM);
    let mut drawn = config.patient.initial_pressures()?.into_iter().zip(config.patient.initial_sd()).map(|(p, sd)| {
        let e: f64 = StandardNormal.sample(&mut rng);
        p + sd * e
    });
    config.patient.initial.iter_mut().for_each(|pressure| *pressure = drawn.next());
    Ok(())
}

/// A patient in motion, wandering parameters and noisy sensors included. Deterministic in configuration and seed, and
/// in how often it is asked: sensors draw noise for every state at every call, so that one record does not depend on
/// which channels are looked at.
pub struct SyntheticPatient {
    simulator: Simulator<Cvsim6>,
    model: Cvsim6,
    noise_sd: Vec<f64>,
    sensors: ChaCha8Rng,
    /// Parameter, sd per square root of a second.
    wandering: Vec<(usize, f64)>,
    wander: ChaCha8Rng,
    next_step_s: f64,
    /// Parameters that change on the way, by script or by themselves.
    changing: Vec<usize>,
}

impl SyntheticPatient {
    /// The patient of a configuration at time 0.
    ///
    /// # Errors
    /// When the initial pressures have no solution.
    pub fn new(config: &Config, seed: u64) -> Result<Self, ConfigError> {
        let model = config.patient.model();
        let changes = config.patient.changes();
        let wandering: Vec<(usize, f64)> = config
            .patient
            .variability
            .iter()
            .filter_map(|(name, sd)| model.parameter_index(name).map(|p| (p, *sd)))
            .collect();
        let mut changing: Vec<usize> = changes.iter().flat_map(|c| c.assignments.iter().map(|(p, _)| *p)).collect();
        changing.extend(wandering.iter().map(|(p, _)| *p));
        changing.sort_unstable();
        changing.dedup();
        let stream = |stream: u64| {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            rng.set_stream(stream);
            rng
        };
        let initial = config.patient.initial_pressures()?;
        Ok(Self {
            simulator: Simulator::new(model, initial, config.patient.theta(), changes),
            model,
            noise_sd: Pressures::NAMES.iter().map(|n| config.channels.get(n).map_or(0.0, |c| c.noise_sd)).collect(),
            sensors: stream(SENSOR_STREAM),
            wandering,
            wander: stream(WANDER_STREAM),
            next_step_s: WANDER_STEP_S,
            changing,
        })
    }

    /// Parameters that change on the way, as indices.
    #[must_use]
    pub fn changing(&self) -> &[usize] {
        &self.changing
    }

    /// Moves on to `time_s` after the start.
    ///
    /// # Errors
    /// When the parameters have no bounded solution.
    pub fn advance_to(&mut self, time_s: f64) -> Result<(), SimulationError> {
        while !self.wandering.is_empty() && self.next_step_s <= time_s {
            self.simulator.advance_to(self.next_step_s)?;
            for &(p, sd) in &self.wandering {
                let e: f64 = StandardNormal.sample(&mut self.wander);
                let (low, high) = PARAMETERS[p].bounds;
                let value = self.simulator.parameters()[p] * (sd * WANDER_STEP_S.sqrt() * e).exp();
                self.simulator.assign(p, value.clamp(low, high));
            }
            self.next_step_s += WANDER_STEP_S;
        }
        self.simulator.advance_to(time_s)
    }

    /// True pressures, flows and volumes, in the order of the model.
    #[must_use]
    pub fn truth(&self) -> Vec<f64> {
        let mut row = self.simulator.state().to_vec();
        row.extend(self.simulator.derived());
        row
    }

    /// True parameters.
    #[must_use]
    pub fn parameters(&self) -> &[f64] {
        self.simulator.parameters()
    }

    /// What the sensors read now, one value per state \[mmHg\].
    pub fn observe(&mut self) -> Vec<f64> {
        let Self { simulator, noise_sd, sensors, .. } = self;
        let read = |(p, sd): (&f64, &f64)| {
            let e: f64 = StandardNormal.sample(sensors);
            p + sd * e
        };
        simulator.state().iter().zip(noise_sd.iter()).map(read).collect()
    }

    /// The model.
    #[must_use]
    pub fn model(&self) -> Cvsim6 {
        self.model
    }
}
