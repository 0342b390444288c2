//! CVSim-6 in the paper's six scenarios: the runs that several studies look at.

use super::experiment::{Experiment, Sample, Trace};
use super::{Context, StudyError, timed};
use crate::edge::config::{Config, Coupling, InitialSd, PerState};
use crate::edge::synthetic::SyntheticPatient;
use crate::model::Model;
use crate::model::cvsim6::Cvsim6;

/// Spacing of what is kept \[s\]; a multiple of the spacing of all records.
const REPORT_EVERY_S: f64 = 0.006;

/// What is observed and what is unknown.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Scenario {
    Sc1,
    Sc2,
    Sc3,
    Sc4,
    Sc5,
    Sc6,
}

impl Scenario {
    pub(super) const ALL: [Self; 6] = [Self::Sc1, Self::Sc2, Self::Sc3, Self::Sc4, Self::Sc5, Self::Sc6];

    pub(super) fn key(self) -> &'static str {
        match self {
            Self::Sc1 => "sc1",
            Self::Sc2 => "sc2",
            Self::Sc3 => "sc3",
            Self::Sc4 => "sc4",
            Self::Sc5 => "sc5",
            Self::Sc6 => "sc6",
        }
    }

    pub(super) fn observed(self) -> &'static [&'static str] {
        match self {
            Self::Sc1 => &["p_l", "p_a", "p_v", "p_r", "p_pa", "p_pv"],
            Self::Sc2 => &["p_l", "p_a", "p_v", "p_r", "p_pa"],
            Self::Sc3 => &["p_a", "p_v", "p_r", "p_pa"],
            Self::Sc4 => &["p_a", "p_v", "p_pa"],
            Self::Sc5 | Self::Sc6 => &["p_a", "p_pa"],
        }
    }

    pub(super) fn unknown(self) -> &'static [&'static str] {
        if self == Self::Sc6 { &["r_pv", "c_a"] } else { &["r_pv"] }
    }
}

/// A scenario and how members hang together.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Case {
    pub scenario: Scenario,
    pub coupled: bool,
}

/// What is kept of a run.
pub(super) struct CaseRun {
    pub trace: Trace,
    pub config: Config,
    /// True quantities at the times of the trace.
    pub truth: Vec<Vec<f64>>,
    /// The record, for pictures.
    pub samples: Vec<Sample>,
    pub wall_s: f64,
    /// The last two beats \[s\].
    pub last_beats_s: (f64, f64),
    /// Times at which all members were kept: near the start, in the last diastole, in the last systole.
    pub moments_s: [f64; 3],
}

/// The paper's settings, with the record and the spreads that it leaves open: 12 s at 500 Hz, initial pressures
/// perturbed like the data.
#[must_use]
pub fn paper_config() -> Config {
    let mut config = Config::default();
    let noise = |name: &str| config.channels.get(name).map(|c| c.noise_sd);
    config.patient.initial_sd = InitialSd::Mmhg(PerState {
        p_l: noise("p_l"),
        p_a: noise("p_a"),
        p_v: noise("p_v"),
        p_r: noise("p_r"),
        p_pa: noise("p_pa"),
        p_pv: noise("p_pv"),
    });
    config.estimator.coupling = Coupling::Independent;
    config.estimator.estimate = vec!["r_pv".to_owned()];
    config.window.length_s = 0.001;
    guess(&mut config, 1.5);
    config
}

/// Lets every unknown start at `factor` times the truth.
pub(super) fn guess(config: &mut Config, factor: f64) {
    let theta = config.patient.theta();
    let model = config.patient.model();
    config.estimator.initial_guess = config
        .estimator
        .estimate
        .iter()
        .filter_map(|name| model.parameter_index(name).map(|p| (name.clone(), factor * theta[p])))
        .collect();
}

/// A record of a patient: what the channels of `observed` read, and the truth at the times of the reports.
pub(super) struct Record {
    pub samples: Vec<Sample>,
    pub times_s: Vec<f64>,
    pub truth: Vec<Vec<f64>>,
}

/// Draws a record at `rate_hz`; `noise` scales the noise of the sensors.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
pub(super) fn record(config: &Config, until_s: f64, rate_hz: f64, noise: f64, seed: u64) -> Result<Record, StudyError> {
    let mut patient = SyntheticPatient::new(config, seed)?;
    let states = config.observed_states();
    let mut all = Record { samples: Vec::new(), times_s: Vec::new(), truth: Vec::new() };
    let every = (rate_hz * REPORT_EVERY_S).round().max(1.0) as usize;
    for i in 1..=(until_s * rate_hz).round() as usize {
        let time_s = i as f64 / rate_hz;
        patient.advance_to(time_s)?;
        let (truth, read) = (patient.truth(), patient.observe());
        for (channel, &state) in states.iter().enumerate() {
            let value = truth[state] + noise * (read[state] - truth[state]);
            all.samples.push(Sample { time_s, channel, value });
        }
        if i % every == 0 {
            all.times_s.push(time_s);
            all.truth.push(truth);
        }
    }
    Ok(all)
}

impl Case {
    pub(super) fn independent(scenario: Scenario) -> Self {
        Self { scenario, coupled: false }
    }

    pub(super) fn coupled(scenario: Scenario) -> Self {
        Self { scenario, coupled: true }
    }

    /// Key in the summary.
    pub(super) fn key(self) -> String {
        let suffix = if self.coupled { "_coupled" } else { "" };
        format!("{}{suffix}", self.scenario.key())
    }

    pub(super) fn name(self) -> String {
        format!("{}{}", self.scenario.key(), if self.coupled { ", coupled" } else { "" })
    }

    pub(super) fn config(self) -> Config {
        let mut config = paper_config();
        let owned = |names: &[&str]| names.iter().map(|&name| name.to_owned()).collect();
        config.observed = owned(self.scenario.observed());
        config.estimator.estimate = owned(self.scenario.unknown());
        guess(&mut config, 1.5);
        if self.coupled {
            config.estimator.coupling = Coupling::Coupled;
            config.estimator.pressure_drift = 0.002;
            config.estimator.parameter_drift = 0.005;
        }
        config
    }

    pub(super) fn run(self, context: &Context<'_>) -> Result<CaseRun, StudyError> {
        let mut config = self.config();
        config.estimator.members = context.size(100, 20);
        CaseRun::new(config, context.size(12.0, 3.0), context)
    }
}

impl CaseRun {
    /// Runs a configuration on the record of its patient.
    pub(super) fn new(config: Config, until_s: f64, context: &Context<'_>) -> Result<Self, StudyError> {
        let record = record(&config, until_s, 500.0, 1.0, 1)?;
        let cycle_s = 60.0 / config.patient.heart_rate;
        // Whole beats fit: 0.8333 s from event time 0 on.
        let last = (until_s / cycle_s + 1e-9).floor() * cycle_s;
        let last_beats_s = (last - 2.0 * cycle_s, last);
        let moments_s = [0.005, last - 0.1 * cycle_s, last - cycle_s + 0.15];
        let mut members_at_s = moments_s;
        members_at_s.sort_by(f64::total_cmp);
        let experiment = Experiment {
            model: config.circulation()?,
            settings: config.estimator_settings()?,
            until_s,
            samples: &record.samples,
            report_at_s: &record.times_s,
            members_at_s: &members_at_s,
            average_s: last_beats_s,
        };
        let (trace, wall_s) = timed(|| experiment.run(context.workers));
        let mut trace = trace?;
        // In the order asked for, not in that of time.
        let order = moments_s.map(|t| members_at_s.iter().position(|m| m.total_cmp(&t).is_eq()).unwrap_or(0));
        trace.members = order.iter().filter_map(|&i| trace.members.get(i).cloned()).collect();
        let Record { samples, truth, .. } = record;
        Ok(Self { trace, config, truth, samples, wall_s, last_beats_s, moments_s })
    }

    /// Positions in the trace of the last two beats.
    pub(super) fn last_beats(&self) -> impl Iterator<Item = usize> + '_ {
        self.within(self.last_beats_s.0, self.last_beats_s.1)
    }

    /// Positions in the trace of the times in `(from, to]` \[s\].
    pub(super) fn within(&self, from: f64, to: f64) -> impl Iterator<Item = usize> + '_ {
        self.trace.times_s.iter().enumerate().filter(move |(_, t)| **t > from && **t <= to + 1e-9).map(|(i, _)| i)
    }
}

/// Names and units of the 18 quantities, in order.
pub(super) fn quantities() -> Vec<crate::model::Quantity> {
    let model = Cvsim6::default();
    model.states().iter().chain(model.derived()).copied().collect()
}
