//! From the configuration to what the core wants to know.

use super::config::{self, Config, ConfigError};
use crate::estimate::settings::{ChannelSettings, CouplingKind, Drift, EstimatorSettings, RowWeights, WindowSettings};
use crate::estimate::time::ns_from_s;
use crate::model::Model;
use crate::model::cvsim6::{Cvsim6, Pressures};
use crate::xtfc::features::{Activation, FeatureSpec, Nodes, WeightDistribution};
use crate::xtfc::problem::Stopping;

impl Config {
    /// What an estimator is told: a checked configuration gives settings that an estimator accepts.
    ///
    /// # Errors
    /// When the initial pressures have no solution.
    pub fn estimator_settings(&self) -> Result<EstimatorSettings, ConfigError> {
        let model = self.patient.model();
        let mut theta = self.patient.theta();
        for (name, guess) in &self.estimator.initial_guess {
            if let Some(p) = model.parameter_index(name) {
                theta[p] = *guess;
            }
        }
        let n = model.n_states();
        let (window, estimator) = (&self.window, &self.estimator);
        Ok(EstimatorSettings {
            coupling: match estimator.coupling {
                config::Coupling::Coupled => CouplingKind::Coupled,
                config::Coupling::Independent => CouplingKind::Independent,
            },
            estimate: estimator.estimate.iter().filter_map(|name| model.parameter_index(name)).collect(),
            members: estimator.members,
            seed: estimator.seed,
            theta,
            initial_guess_sd: estimator.initial_guess_sd,
            initial_state: self.patient.initial_pressures()?,
            initial_state_sd: self.patient.initial_sd(),
            features: FeatureSpec {
                activation: activation(window.activation),
                count: window.neurons,
                weights: distribution(window.weights),
                biases: distribution(window.biases),
                domain: (window.domain[0], window.domain[1]),
                nodes: window.collocation_points,
                placement: nodes(window.nodes),
            },
            window: WindowSettings {
                length_ns: ns_from_s(window.length_s),
                allowed_lateness_ns: ns_from_s(window.allowed_lateness_s),
                forecast_limit_ns: ns_from_s(window.forecast_limit_s),
            },
            weights: RowWeights {
                physics: vec![window.physics_weight; n],
                data: window.data_weight,
                parameter: window.parameter_weight,
            },
            drift: Drift {
                parameters: estimator.parameter_drift,
                pressures_mmhg: estimator.pressure_drift,
                inflation: estimator.inflation,
            },
            stopping: Stopping { max_iterations: estimator.max_iterations, tolerance_mmhg: estimator.tolerance },
            channels: self.observed_channels(model),
            aleatoric_sd_mmhg: Pressures::NAMES
                .iter()
                .map(|name| self.channels.get(name).map_or(0.0, |c| c.noise_sd))
                .collect(),
            publish_period_ns: ns_from_s(1.0 / self.publish.rate_hz),
        })
    }

    /// The observed channels, in the order of the states.
    fn observed_channels(&self, model: Cvsim6) -> Vec<ChannelSettings> {
        let observed = |name: &str| self.observed.iter().any(|o| o == name);
        let states = model.states().iter().enumerate().filter(|(_, q)| observed(q.name));
        states
            .filter_map(|(state, q)| {
                self.channels.get(q.name).map(|c| ChannelSettings {
                    state,
                    noise_sd_mmhg: c.noise_sd,
                    plausible_mmhg: (c.min_mmhg, c.max_mmhg),
                })
            })
            .collect()
    }

    /// The state that a channel label stands for: the name of the state itself, or a label of the table.
    #[must_use]
    pub fn state_of_label(&self, label: &str) -> Option<&str> {
        let known = Pressures::NAMES.iter().find(|name| **name == label).copied();
        known.or_else(|| self.labels.get(label).map(String::as_str))
    }
}

fn activation(a: config::Activation) -> Activation {
    match a {
        config::Activation::Tanh => Activation::Tanh,
        config::Activation::Logistic => Activation::Logistic,
        config::Activation::Sine => Activation::Sine,
        config::Activation::Arctan => Activation::Arctan,
        config::Activation::Softplus => Activation::Softplus,
        config::Activation::Swish => Activation::Swish,
    }
}

fn nodes(n: config::Nodes) -> Nodes {
    match n {
        config::Nodes::Uniform => Nodes::Uniform,
        config::Nodes::Chebyshev => Nodes::Chebyshev,
        config::Nodes::Legendre => Nodes::Legendre,
    }
}

fn distribution(d: config::Distribution) -> WeightDistribution {
    match d {
        config::Distribution::Uniform([low, high]) => WeightDistribution::Uniform { low, high },
        config::Distribution::Normal([mean, sd]) => WeightDistribution::Normal { mean, sd },
        config::Distribution::Exponential(mean) => WeightDistribution::Exponential { mean },
    }
}
