//! A truth, what its sensors read, and an estimator that is fed with it.

use std::collections::BTreeMap;

use super::scenario::Scenario;
use super::score::{Point, Score, Series};
use crate::edge::config::{Config, ConfigError};
use crate::edge::synthetic::SyntheticPatient;
use crate::estimate::beat::BeatEstimate;
use crate::estimate::ensemble::Parallel;
use crate::estimate::estimator::{Estimate, Estimator, Input, Output};
use crate::estimate::settings::SettingsError;
use crate::estimate::time::{ArrivalTime, EventTime, NS_PER_S, ns_from_s};
use crate::estimate::window::RawSample;
use crate::model::Model;
use crate::model::cvsim6::{Cvsim6, Derived, FlowsAndVolumes, Pressures};
use crate::model::discrepancy::Circulation;
use crate::model::truth::SimulationError;

/// Samples per second of every sensor, as monitors deliver.
pub const RATE_HZ: f64 = 125.0;

/// Spacing at which the true flow into the aorta is summed \[ns\].
const FINE_NS: i64 = 1_000_000;

/// The figure of a beat that is scored.
const CARDIAC_OUTPUT: &str = "cardiac_output";
/// L/min in a mL/s.
const L_PER_MIN: f64 = 0.06;

/// A patient for a while: what the sensors read, and what is true at the times of the estimates.
#[derive(Debug, Clone, Default)]
pub struct Record {
    /// Time and reading of all six sensors.
    pub samples: Vec<(EventTime, Vec<f64>)>,
    /// By time: quantities, then parameters, in the order of the model.
    truth: BTreeMap<EventTime, (Vec<f64>, Vec<f64>)>,
    /// Volume that has left the left ventricle by every multiple of the fine spacing \[mL\].
    ejected_ml: Vec<f64>,
}

impl Record {
    /// Draws one; the truth is kept every `publish_period_ns`.
    ///
    /// # Errors
    /// When the patient has no bounded solution.
    #[allow(clippy::cast_precision_loss)]
    pub fn new(truth: &Config, seconds: f64, publish_period_ns: i64, seed: u64) -> Result<Self, RecordError> {
        let mut patient = SyntheticPatient::new(truth, seed)?;
        let end = ns_from_s(seconds);
        let sample_ns = ns_from_s(1.0 / RATE_HZ);
        let mut record = Self::default();
        let (mut ejected_ml, mut flow_before) = (0.0, 0.0);
        let mut now = 0_i64;
        while now <= end {
            patient.advance_to(EventTime(now).as_s())?;
            let quantities = patient.truth();
            if now % FINE_NS == 0 {
                let flow = quantities[Pressures::LEN + Derived::QLo as usize];
                ejected_ml += if now == 0 { 0.0 } else { 0.5 * (flow + flow_before) * EventTime(FINE_NS).as_s() };
                flow_before = flow;
                record.ejected_ml.push(ejected_ml);
            }
            if now % publish_period_ns == 0 {
                record.truth.insert(EventTime(now), (quantities, patient.parameters().to_vec()));
            }
            if now % sample_ns == 0 {
                record.samples.push((EventTime(now), patient.observe()));
            }
            // On to the next multiple of any of the three.
            let next = |period: i64| (now / period + 1) * period;
            now = next(FINE_NS).min(next(publish_period_ns)).min(next(sample_ns));
        }
        Ok(record)
    }

    /// True output of the heart over a stretch of time \[L/min\]; None beyond the record.
    fn cardiac_output(&self, start: EventTime, end: EventTime) -> Option<f64> {
        let ml = self.ejected_by(end)? - self.ejected_by(start)?;
        Some(L_PER_MIN * ml / (end.as_s() - start.as_s()))
    }

    #[allow(clippy::cast_precision_loss)]
    fn ejected_by(&self, time: EventTime) -> Option<f64> {
        let before = usize::try_from(time.0.div_euclid(FINE_NS)).ok()?;
        let share = time.0.rem_euclid(FINE_NS) as f64 / FINE_NS as f64;
        let at = *self.ejected_ml.get(before)?;
        let after = self.ejected_ml.get(before + 1).copied().unwrap_or(at);
        Some(at + share * (after - at))
    }
}

/// A record could not be drawn.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// The start.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// On the way.
    #[error(transparent)]
    Simulation(#[from] SimulationError),
}

/// Something that an estimator said, how often and when first.
#[derive(Debug, Clone, PartialEq)]
pub struct Event {
    /// Its kind, as in topics.
    pub kind: &'static str,
    /// The state whose sensor it is about.
    pub channel: Option<&'static str>,
    /// How often.
    pub count: usize,
    /// When first \[s\].
    pub first_s: f64,
}

/// Which estimates of an estimator.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Stream {
    /// As they come.
    Live,
    /// Looked back at.
    Smoothed,
}

/// What an estimator said of one record, beside the truth.
#[derive(Debug, Clone, Default)]
pub struct Outcome {
    /// Per stream that said anything: states, derived quantities and parameters of which there is a truth.
    pub streams: BTreeMap<Stream, Vec<Series>>,
    /// Per beat, at its end.
    pub cardiac_output: Vec<Point>,
    /// By kind and channel, in order of their first time.
    pub events: Vec<Event>,
}

/// An estimator at work on a record.
struct Twin<'a> {
    estimator: Estimator<Circulation>,
    scenario: Scenario,
    record: &'a Record,
    outcome: Outcome,
}

/// Feeds an estimator with a record, sample by sample as they arrive; `second` is told of every second that is over.
///
/// # Errors
/// When no estimator can be made of what is believed.
pub fn watch(
    belief: &Config,
    scenario: Scenario,
    record: &Record,
    parallel: &dyn Parallel,
    second: &dyn Fn(),
) -> Result<Outcome, WatchError> {
    let estimator = Estimator::new(belief.circulation()?, belief.estimator_settings()?)?;
    let mut twin = Twin { estimator, scenario, record, outcome: Outcome::default() };
    let mut outputs = Vec::new();
    twin.estimator.handle(Input::WantMembers(true), ArrivalTime(0), parallel, &mut outputs);
    let states: Vec<usize> = twin.estimator.settings().channels.iter().map(|channel| channel.state).collect();
    let mut now = ArrivalTime(0);
    for (time, values) in &record.samples {
        if time.0 / NS_PER_S > now.0 / NS_PER_S {
            second();
        }
        // It arrives when it was taken.
        now = ArrivalTime(time.0);
        for (channel, &state) in states.iter().enumerate() {
            let samples = vec![RawSample { time: *time, value: values[state] }];
            twin.estimator.handle(Input::Samples { channel, samples }, now, parallel, &mut outputs);
        }
        outputs.drain(..).for_each(|output| twin.hear(&output));
    }
    twin.estimator.handle(Input::End, now, parallel, &mut outputs);
    outputs.drain(..).for_each(|output| twin.hear(&output));
    Ok(twin.outcome)
}

/// An estimator could not be made.
#[derive(Debug, thiserror::Error)]
pub enum WatchError {
    /// Of what the configuration says.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// Of the settings that follow from it.
    #[error(transparent)]
    Settings(#[from] SettingsError),
}

impl Twin<'_> {
    /// The only place that knows what an estimator can say.
    fn hear(&mut self, output: &Output) {
        match output {
            Output::Estimate(estimate) => self.estimate(Stream::Live, estimate),
            Output::Smoothed(estimate) => self.estimate(Stream::Smoothed, estimate),
            Output::Beat(beat) => self.beat(beat),
            Output::Notice(notice) => {
                let settings = self.estimator.settings();
                let channel = notice.channel.map(|channel| Pressures::NAMES[settings.channels[channel].state]);
                self.notice(notice.kind.name(), channel, notice.time.as_s());
            }
            // How windows went is not scored, nor what is made of the estimates.
            Output::Window(_) | Output::Alarms(_) => {}
        }
    }

    fn estimate(&mut self, stream: Stream, estimate: &Estimate) {
        let Self { estimator, scenario, record, outcome } = self;
        let Some((quantities, parameters)) = record.truth.get(&estimate.time) else { return };
        let model = estimator.model();
        let mut members = Members::new(estimator, estimate);
        let series = outcome.streams.entry(stream).or_insert_with(|| {
            let quantities = model.states().iter().chain(model.derived()).map(|q| (q.name, q.unit));
            let parameters =
                estimator.estimated().iter().map(|&p| (model.parameters()[p].name, model.parameters()[p].unit));
            quantities.chain(parameters).map(|(name, unit)| Series { name, unit, points: Vec::new() }).collect()
        });
        let time_s = estimate.time.as_s();
        // What a model may lack comes after its states and is nothing that the patient has.
        let (n, lacking) = (Pressures::LEN, model.n_discrepancies());
        let known = (0..n).chain(n + lacking..n + lacking + FlowsAndVolumes::LEN);
        for (q, truth) in known.zip(quantities) {
            let point = Point::new(time_s, *truth, &estimate.quantities[q], members.of(q));
            series[q].points.push(point);
        }
        for (k, (parameter, _)) in estimate.parameters.iter().enumerate() {
            let p = parameter.parameter;
            if scenario.has_truth(model.parameters()[p].name) {
                let q = estimate.quantities.len() + k;
                let point = Point::new(time_s, parameters[p], &parameter.summary, members.of(q));
                series[q].points.push(point);
            }
        }
    }

    fn beat(&mut self, beat: &BeatEstimate) {
        let clinical = self.estimator.model().clinical();
        let at = clinical.iter().position(|quantity| quantity.name == CARDIAC_OUTPUT);
        if let (Some(at), Some(truth)) = (at, self.record.cardiac_output(beat.start, beat.end)) {
            self.outcome.cardiac_output.push(Point::new(beat.end.as_s(), truth, &beat.values[at], &mut []));
        }
    }

    fn notice(&mut self, kind: &'static str, channel: Option<&'static str>, time_s: f64) {
        let events = &mut self.outcome.events;
        match events.iter_mut().find(|event| event.kind == kind && event.channel == channel) {
            Some(event) => event.count += 1,
            None => events.push(Event { kind, channel, count: 1, first_s: time_s }),
        }
    }
}

/// Every quantity of every member behind an estimate, `[(n_quantities + n_estimated) x n_members]`.
struct Members {
    count: usize,
    values: Vec<f64>,
}

impl Members {
    /// From the states and estimated parameters that the estimator put out; nothing if it did not.
    fn new(estimator: &Estimator<Circulation>, estimate: &Estimate) -> Self {
        let (model, estimated) = (estimator.model(), estimator.estimated());
        let Some(ensemble) = &estimate.ensemble else { return Self { count: 0, values: Vec::new() } };
        let n = model.n_states();
        let count = ensemble.len() / (n + estimated.len());
        let mut values = vec![0.0; (n + model.derived().len() + estimated.len()) * count];
        let mut theta = estimator.settings().theta.clone();
        // The clock of those that do not estimate it.
        model.advance(estimate.time.as_s(), &mut theta);
        let mut derived = vec![0.0; model.derived().len()];
        for (i, row) in ensemble.chunks_exact(n + estimated.len()).enumerate() {
            let (x, parameters) = row.split_at(n);
            estimated.iter().zip(parameters).for_each(|(&p, value)| theta[p] = *value);
            model.derive(0.0, x, &theta, &mut derived);
            for (q, value) in x.iter().chain(&derived).chain(parameters).enumerate() {
                values[q * count + i] = *value;
            }
        }
        Self { count, values }
    }

    fn of(&mut self, q: usize) -> &mut [f64] {
        self.values.get_mut(q * self.count..(q + 1) * self.count).unwrap_or_default()
    }
}

/// The score of one quantity as one method of one twin told it.
#[derive(Debug, Clone, PartialEq)]
pub struct QuantityScore {
    /// Name of the quantity.
    pub quantity: &'static str,
    /// Its unit.
    pub unit: &'static str,
    /// How good.
    pub score: Score,
}

impl Outcome {
    /// Scores of a stream from `from_s` on, and of the beats with the live one.
    #[must_use]
    pub fn scores(&self, stream: Stream, from_s: f64, step_s: Option<f64>) -> Vec<QuantityScore> {
        let model = Cvsim6::default();
        let told = self.streams.get(&stream).into_iter().flatten().filter(|series| !series.points.is_empty());
        let score = |series: &Series| {
            let is_parameter = model.parameter_index(series.name).is_some();
            let score =
                if is_parameter { Score::of_parameter(series, from_s, step_s) } else { Score::new(series, from_s) };
            QuantityScore { quantity: series.name, unit: series.unit, score }
        };
        let mut scores: Vec<QuantityScore> = told.map(score).collect();
        if stream == Stream::Live && !self.cardiac_output.is_empty() {
            let beats = Series { name: CARDIAC_OUTPUT, unit: "L/min", points: self.cardiac_output.clone() };
            scores.push(score(&beats));
        }
        scores
    }

    /// A series of a stream by its name.
    #[must_use]
    pub fn series(&self, stream: Stream, name: &str) -> Option<&Series> {
        self.streams.get(&stream)?.iter().find(|series| series.name == name)
    }
}
