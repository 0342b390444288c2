//! From the configuration to what the core wants to know.

use super::config::{self, Config, ConfigError, DiscrepancyForm, DiscrepancySettings};
use crate::estimate::alarm::{AlarmSettings, Limit, Priority, Watched};
use crate::estimate::settings::{
    Adaptation, Belief, ChannelSettings, CouplingKind, Drift, EstimatorSettings, LiveSettings, RowWeights,
    WindowSettings,
};
use crate::estimate::time::ns_from_s;
use crate::estimate::timing::TimingSource;
use crate::model::cvsim6::{PARAMETERS, Pressures, State};
use crate::model::discrepancy::{Circulation, Discrepancy, Discrepant, Form};
use crate::model::{Model, ParameterInfo};
use crate::xtfc::features::{Activation, FeatureSpec, Nodes, WeightDistribution};
use crate::xtfc::problem::Stopping;

/// Where nothing is said of a discrepancy: of flows \[mL/s\] and of balances \[mmHg/s\].
const MAGNITUDE: (f64, f64) = (300.0, 100.0);
/// The same per square root of a second.
const CHANGE: (f64, f64) = (100.0, 20.0);
/// Spread at the start and drift of the heart rate (relative) and of the phase of the beat (beats).
const HEART_RATE: (f64, f64) = (0.05, 0.01);
const BEAT_PHASE: (f64, f64) = (0.03, 0.005);
/// The paper's `L = 10 R` \[s\].
const INERTANCE_S: f64 = 10.0;

/// A discrepancy with everything filled in.
#[derive(Debug, Clone, Copy)]
struct Lack {
    what: Discrepancy,
    /// Random walk between windows of `coupled`.
    drift: f64,
    change: f64,
    magnitude: f64,
    initial_sd: f64,
}

impl Lack {
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
        let all: Vec<Discrepancy> = self.lacks().iter().map(|lack| lack.what).collect();
        Discrepant::new(self.patient.model(), &all).map_err(|error| ConfigError::discrepancy(&error))
    }

    fn lacks(&self) -> Vec<Lack> {
        let model = self.patient.model();
        let lack = |(name, settings): (&String, &DiscrepancySettings)| {
            model.parameter_index(&format!("delta_{name}")).map(|p| Lack::new(name, settings, p))
        };
        self.discrepancy.iter().filter_map(lack).collect()
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
        let (n, lacks) = (model.n_states(), self.lacks());
        // Discrepancies follow the pressures.
        let with = |pressures: Vec<f64>, of: &dyn Fn(&Lack) -> f64| -> Vec<f64> {
            pressures.into_iter().chain(lacks.iter().map(of)).collect()
        };
        Ok(EstimatorSettings {
            coupling: match estimator.coupling {
                config::Coupling::Coupled => CouplingKind::Coupled,
                config::Coupling::Independent => CouplingKind::Independent,
                config::Coupling::Enkf => CouplingKind::Enkf,
                config::Coupling::Ukf => CouplingKind::Ukf,
            },
            estimate: estimator.estimate.iter().filter_map(|name| model.parameter_index(name)).collect(),
            members: estimator.members,
            seed: estimator.seed,
            theta,
            beliefs: self.parameter_beliefs(),
            initial_state: with(self.patient.initial_pressures()?, &|_| 0.0),
            initial_state_sd: with(self.patient.initial_sd(), &|lack| lack.initial_sd),
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
                physics: with(vec![window.physics_weight; n], &|lack| lack.weight(self)),
                data: window.data_weight,
                parameter: window.parameter_weight,
            },
            drift: Drift {
                states: with(vec![estimator.pressure_drift; n], &|lack| lack.drift),
                inflation: estimator.inflation,
            },
            adaptation: if estimator.adaptive {
                let [low, high] = estimator.noise_range;
                Adaptation { noise: (low, high), outlier_sd: estimator.outlier_sd, ..Adaptation::ON }
            } else {
                Adaptation::OFF
            },
            stopping: Stopping { max_iterations: estimator.max_iterations, tolerance_mmhg: estimator.tolerance },
            instructions: self.service.instruction_set.set(),
            channels: self.observed_channels(),
            aleatoric_sd_mmhg: with(self.channels.iter().map(|(_, c)| c.noise_sd).collect(), &|_| 0.0),
            live: LiveSettings {
                timing: match estimator.timing {
                    config::Timing::Config => TimingSource::Clock,
                    config::Timing::Beats => TimingSource::Told,
                    config::Timing::Tracked => TimingSource::Found,
                },
                timing_channels: self.timing_channels(),
                screen_artefacts: estimator.screen_artefacts,
                smoothing_lag_ns: ns_from_s(estimator.smoothing_lag_s),
                second_opinion: match estimator.second_opinion {
                    config::SecondOpinion::None => None,
                    config::SecondOpinion::Ukf => Some(CouplingKind::Ukf),
                    config::SecondOpinion::Enkf => Some(CouplingKind::Enkf),
                },
                alarms: self.watched_limits()?,
            },
            publish_period_ns: ns_from_s(1.0 / self.publish.rate_hz),
        })
    }

    /// Limits that are watched, in their order; what [`Config::check`] refuses is left out.
    fn watched_limits(&self) -> Result<Vec<AlarmSettings>, ConfigError> {
        let model = self.circulation()?;
        let alarm = |alarm: &config::AlarmSettings| {
            let limit = alarm.below.map(Limit::Below).or(alarm.above.map(Limit::Above))?;
            Some(AlarmSettings {
                name: alarm.name.clone(),
                watched: Watched::by_name(&model, &alarm.quantity)?,
                limit,
                probability: alarm.probability,
                for_ns: ns_from_s(alarm.for_s),
                clear_margin: alarm.clear_margin,
                clear_for_ns: ns_from_s(alarm.clear_for_s),
                priority: match alarm.priority {
                    config::AlarmPriority::Low => Priority::Low,
                    config::AlarmPriority::Medium => Priority::Medium,
                    config::AlarmPriority::High => Priority::High,
                },
                latched: alarm.latched,
            })
        };
        Ok(self.alarms.iter().filter_map(alarm).collect())
    }

    /// What is believed of each parameter: of all the same, but for the clock and for what the configuration names.
    fn parameter_beliefs(&self) -> Vec<Belief> {
        let estimator = &self.estimator;
        let belief = |info: &ParameterInfo| {
            let (sd, drift) = match info.name {
                "heart_rate" => (HEART_RATE.0.min(estimator.initial_guess_sd), HEART_RATE.1),
                "beat_phase" => BEAT_PHASE,
                _ => (estimator.initial_guess_sd, estimator.parameter_drift),
            };
            let own = estimator.prior.get(info.name).copied().unwrap_or_default();
            Belief {
                sd: own.sd.unwrap_or(sd),
                drift: own.drift.unwrap_or(drift),
                reversion: own.reversion.unwrap_or(0.0),
                bounds: (own.min.unwrap_or(info.bounds.0), own.max.unwrap_or(info.bounds.1)),
            }
        };
        PARAMETERS.iter().map(belief).collect()
    }

    /// The observed states: one channel each, in this order.
    #[must_use]
    pub fn observed_states(&self) -> Vec<usize> {
        (0..Pressures::LEN).filter(|&i| self.observed.iter().any(|o| o == Pressures::NAMES[i])).collect()
    }

    /// Observed channels in which beats show, the clearest first: arteries, ventricles.
    fn timing_channels(&self) -> Vec<usize> {
        let observed = self.observed_states();
        let clearest = [State::A, State::L, State::Pa, State::R].map(|state| state as usize);
        clearest.iter().filter_map(|state| observed.iter().position(|o| o == state)).collect()
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
