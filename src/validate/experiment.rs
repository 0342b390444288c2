//! All twins of an experiment: every patient in every scenario from every seed, watched by every method.

use super::ValidateError;
use super::patients::TwinPatient;
use super::scenario::{Rival, Scenario};
use super::score::Series;
use super::twin::{Event, Outcome, QuantityScore, Record, RecordError, Stream, WatchError, watch};
use crate::edge::config::{Config, Coupling};
use crate::estimate::ensemble::{Parallel, Serial};
use crate::estimate::time::ns_from_s;
use crate::model::cvsim6::Pressures;
use crate::runtime::workers::Workers;

/// Until here nothing is scored \[s\]; of a short run the first quarter.
const SCORED_FROM_S: f64 = 4.0;

/// What is shown of the record in a picture \[s\], at its end.
pub(super) const SHOWN_S: f64 = 2.0;

/// What is to be done.
pub struct Plan {
    /// Who is watched.
    pub patients: Vec<TwinPatient>,
    /// In what.
    pub scenarios: Vec<Scenario>,
    /// Times each, with another start, another noise and another wandering.
    pub seeds: u64,
    /// Length of each record \[s\].
    pub seconds: f64,
    /// The estimator that is validated.
    pub ensemble: Config,
    /// Who watches the same samples beside it.
    pub rivals: Vec<Rival>,
}

/// One patient in one scenario from one seed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Case {
    scenario: Scenario,
    /// Index of the patient.
    patient: usize,
    seed: u64,
}

/// What all methods made of one case; the trace of the first seed.
struct Told {
    rows: Vec<Row>,
    trace: Option<Trace>,
}

/// What one method made of one case.
#[derive(Debug, Clone)]
pub struct Row {
    /// In what.
    pub scenario: Scenario,
    /// Who was watched.
    pub patient: String,
    /// Which record of that patient.
    pub seed: u64,
    /// `coupled`, `coupled_smoothed`, `ukf` and so on.
    pub method: &'static str,
    /// Every quantity.
    pub scores: Vec<QuantityScore>,
    /// What it had to say.
    pub events: Vec<Event>,
}

/// What a picture needs of a case.
#[derive(Debug, Clone)]
pub(super) struct Trace {
    pub scenario: Scenario,
    pub patient: String,
    /// Per method, estimated parameters all the time and states at the end.
    pub told: Vec<(&'static str, Vec<Series>, Vec<Series>)>,
    /// Samples at the end: state, time \[s\], reading.
    pub samples: Vec<(usize, f64, f64)>,
}

/// What came out.
#[derive(Debug, Clone, Default)]
pub struct Results {
    /// In the order of the plan.
    pub rows: Vec<Row>,
    /// Of the first seed of every patient and scenario.
    pub(super) traces: Vec<Trace>,
    /// Length of each record, and from when on it is scored \[s\].
    pub seconds: f64,
    /// See [`Results::seconds`].
    pub from_s: f64,
}

impl Plan {
    /// Patient-seconds to be watched, all methods together.
    #[must_use]
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
    pub fn work_s(&self) -> u64 {
        let cases = self.patients.len() * self.scenarios.len() * (1 + self.rivals.len());
        cases as u64 * self.seeds * self.seconds as u64
    }

    /// Does it; `second` is told of every patient-second that one method is through with.
    ///
    /// # Errors
    /// When a belief is refused or a truth cannot be computed.
    pub fn run(&self, workers: &Workers, second: &(dyn Fn() + Sync)) -> Result<Results, ValidateError> {
        let mut cases = Vec::new();
        for &scenario in &self.scenarios {
            for patient in 0..self.patients.len() {
                cases.extend((0..self.seeds).map(|seed| Case { scenario, patient, seed }));
            }
        }
        // Many cases side by side keep the threads busier than the members of one; few leave some idle.
        let done: Vec<Result<Told, ValidateError>> = if cases.len() >= workers.threads() {
            workers.map(&cases, |case| self.case(*case, &Serial, second))
        } else {
            cases.iter().map(|case| self.case(*case, workers, second)).collect()
        };
        let mut results = Results { seconds: self.seconds, from_s: self.scored_from_s(), ..Results::default() };
        for one in done {
            let Told { rows, trace } = one?;
            results.rows.extend(rows);
            results.traces.extend(trace);
        }
        Ok(results)
    }

    fn scored_from_s(&self) -> f64 {
        SCORED_FROM_S.min(0.25 * self.seconds)
    }

    fn case(&self, case: Case, parallel: &dyn Parallel, second: &(dyn Fn() + Sync)) -> Result<Told, ValidateError> {
        let Case { scenario, seed, .. } = case;
        let TwinPatient { name, config: patient } = &self.patients[case.patient];
        let own = seed_of(name, seed);
        let truth = scenario.truth(patient, self.seconds, own)?;
        let belief = scenario.belief(&self.ensemble, patient, seed)?;
        let period_ns = ns_from_s(1.0 / belief.publish.rate_hz);
        let record = Record::new(&truth, self.seconds, period_ns, own).map_err(|error| match error {
            RecordError::Config(error) => ValidateError::Config(error),
            RecordError::Simulation(source) => ValidateError::Simulation { patient: name.clone(), source },
        })?;

        let (from_s, step_s) = (self.scored_from_s(), scenario.step_s(self.seconds));
        let mut rows = Vec::new();
        let mut told = Vec::new();
        let rivals = self.rivals.iter().map(|rival| ([rival.name(); 2], rival.of(&belief)));
        for (names, belief) in std::iter::once((names(&belief), belief.clone())).chain(rivals) {
            let outcome = watch(&belief, scenario, &record, parallel, second).map_err(|error| match error {
                WatchError::Config(error) => ValidateError::Config(error),
                WatchError::Settings(error) => ValidateError::Settings(error),
            })?;
            for (&stream, method) in outcome.streams.keys().zip(names) {
                let events = if stream == Stream::Live { outcome.events.clone() } else { Vec::new() };
                let scores = outcome.scores(stream, from_s, step_s);
                rows.push(Row { scenario, patient: name.clone(), seed, method, scores, events });
                if seed == 0 {
                    let (parameters, states) = self.shown(&outcome, stream, &belief);
                    told.push((method, parameters, states));
                }
            }
        }
        let samples = record.samples.iter().filter(|(time, _)| time.as_s() >= self.seconds - SHOWN_S);
        let observed = belief.observed_states();
        let samples =
            samples.flat_map(|(time, values)| observed.iter().map(|&s| (s, time.as_s(), values[s]))).collect();
        let trace = (seed == 0).then(|| Trace { scenario, patient: name.clone(), told, samples });
        Ok(Told { rows, trace })
    }

    /// Parameters all the time, states at the end.
    fn shown(&self, outcome: &Outcome, stream: Stream, belief: &Config) -> (Vec<Series>, Vec<Series>) {
        let parameters = belief.estimator.estimate.iter().filter_map(|name| outcome.series(stream, name)).cloned();
        let late = |series: &Series| {
            let from = series.points.partition_point(|point| point.time_s < self.seconds - SHOWN_S);
            Series { points: series.points[from..].to_vec(), ..*series }
        };
        let states = Pressures::NAMES.iter().filter_map(|name| outcome.series(stream, name));
        (parameters.collect(), states.map(late).collect())
    }
}

/// Names of the streams of the ensemble.
fn names(belief: &Config) -> [&'static str; 2] {
    match belief.estimator.coupling {
        Coupling::Coupled => ["coupled", "coupled_smoothed"],
        Coupling::Independent => ["independent", "independent_smoothed"],
        Coupling::Enkf => ["enkf", "enkf_smoothed"],
        Coupling::Ukf => ["ukf", "ukf_smoothed"],
    }
}

/// Other patients get other noise from the same seed, whoever else takes part (FNV-1a).
fn seed_of(patient: &str, seed: u64) -> u64 {
    let bytes = patient.bytes().chain(seed.to_le_bytes());
    let hash =
        bytes.fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3));
    // A seed in a configuration is a positive integer of TOML.
    hash >> 1
}
