//! From the configuration to what the core wants to know.

use super::config::{self, Config, ConfigError, DiscrepancyForm, DiscrepancySettings};
use crate::estimate::settings::{ChannelSettings, CouplingKind, Drift, EstimatorSettings, RowWeights, WindowSettings};
use crate::estimate::time::ns_from_s;
use crate::model::Model;
use crate::model::cvsim6::Pressures;
use crate::model::discrepancy::{Circulation, Discrepancy, Discrepant, Form};
use crate::xtfc::features::{Activation, FeatureSpec, Nodes, WeightDistribution};
use crate::xtfc::problem::Stopping;

/// Where nothing is said of a discrepancy: of flows \[mL/s\] and of balances \[mmHg/s\].
const MAGNITUDE: (f64, f64) = (300.0, 100.0);
/// The same per square root of a second.
const CHANGE: (f64, f64) = (100.0, 20.0);
/// The paper's `L = 10 R` \[s\].
const INERTANCE_S: f64 = 10.0;

/// A discrepancy with everything filled in.
#[derive(Debug, Clone, Copy)]
struct Belief {
    what: Discrepancy,
    /// Random walk between windows of `coupled`.
    drift: f64,
    change: f64,
    magnitude: f64,
    initial_sd: f64,
}

impl Belief {
    fn new(name: &str, settings: &DiscrepancySettings, parameter: usize) -> Self {
        let of = |(flow, balance): (f64, f64)| if name.starts_with('q') { flow } else { balance };
        let change = settings.change.unwrap_or(of(CHANGE));
        let (form, initial_sd) = match settings.form {
            DiscrepancyForm::Free => (Form::Free, 0.0),
            DiscrepancyForm::Tracked => (Form::Tracked, 0.3 * change),
            DiscrepancyForm::Inertial => (Form::Inertial { ratio_s: settings.inertance.unwrap_or(INERTANCE_S) }, 0.0),
        };
        Self {
            what: Discrepancy { parameter, form },
            drift: match settings.form {
                DiscrepancyForm::Free => 0.0,
                DiscrepancyForm::Tracked => change,
                // An inductance, unless something else is asked for.
                DiscrepancyForm::Inertial => settings.change.unwrap_or(0.0),
            },
            change,
            magnitude: settings.magnitude.unwrap_or(of(MAGNITUDE)),
            initial_sd: settings.initial_sd.unwrap_or(initial_sd),
        }
    }

    /// Weight of its equation at each of the nodes, so that all of them together count as the belief does.
    #[allow(clippy::cast_precision_loss)]
    fn weight(&self, config: &Config) -> f64 {
        let (h, nodes) = (config.window.length_s, config.window.collocation_points as f64);
        let independent = config.estimator.coupling == config::Coupling::Independent;
        match self.what.form {
            Form::Free => 1.0 / (self.magnitude * nodes.sqrt()),
            // The sum over the nodes of (w delta'/h)^2 is (change of delta / (pace sqrt(h)))^2.
            Form::Tracked if independent => (h / nodes).sqrt() / self.change,
            // `coupled` moves it between windows; in a window it does what its equation says.
            Form::Tracked | Form::Inertial { .. } => config.window.physics_weight,
        }
    }
}

impl Config {
    /// The model that the estimator believes in: that of the patient, and what it may lack.
    ///
    /// # Errors
    /// When a discrepancy cannot be had.
    pub fn circulation(&self) -> Result<Circulation, ConfigError> {
        let all: Vec<Discrepancy> = self.beliefs().iter().map(|belief| belief.what).collect();
        Discrepant::new(self.patient.model(), &all).map_err(|error| ConfigError::discrepancy(&error))
    }

    fn beliefs(&self) -> Vec<Belief> {
        let model = self.patient.model();
        let belief = |(name, settings): (&String, &DiscrepancySettings)| {
            model.parameter_index(&format!("delta_{name}")).map(|p| Belief::new(name, settings, p))
        };
        self.discrepancy.iter().filter_map(belief).collect()
    }

    /// What an estimator is told: a checked configuration gives settings that an estimator accepts, unless its random
    /// features span nothing (biases of hundreds).
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
        let (window, estimator) = (&self.window, &self.estimator);
        let (n, beliefs) = (model.n_states(), self.beliefs());
        // Discrepancies follow the pressures.
        let with = |pressures: Vec<f64>, of: &dyn Fn(&Belief) -> f64| -> Vec<f64> {
            pressures.into_iter().chain(beliefs.iter().map(of)).collect()
        };
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
            initial_state: with(self.patient.initial_pressures()?, &|_| 0.0),
            initial_state_sd: with(self.patient.initial_sd(), &|belief| belief.initial_sd),
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
                physics: with(vec![window.physics_weight; n], &|belief| belief.weight(self)),
                data: window.data_weight,
                parameter: window.parameter_weight,
            },
            drift: Drift {
                parameters: estimator.parameter_drift,
                states: with(vec![estimator.pressure_drift; n], &|belief| belief.drift),
                inflation: estimator.inflation,
            },
            stopping: Stopping { max_iterations: estimator.max_iterations, tolerance_mmhg: estimator.tolerance },
            channels: self.observed_channels(),
            aleatoric_sd_mmhg: with(self.channels.iter().map(|(_, c)| c.noise_sd).collect(), &|_| 0.0),
            publish_period_ns: ns_from_s(1.0 / self.publish.rate_hz),
        })
    }

    /// The observed states: one channel each, in this order.
    #[must_use]
    pub fn observed_states(&self) -> Vec<usize> {
        (0..Pressures::LEN).filter(|&i| self.observed.iter().any(|o| o == Pressures::NAMES[i])).collect()
    }

    fn observed_channels(&self) -> Vec<ChannelSettings> {
        let states = self.observed_states().into_iter();
        states
            .filter_map(|state| {
                self.channels.get(Pressures::NAMES[state]).map(|c| ChannelSettings {
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
