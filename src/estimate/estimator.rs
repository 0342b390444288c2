//! The estimator of one bed: `handle(input, now) -> outputs`.
//!
//! The service, the file command, the tests and the simulator of bad networks drive this same state machine.

use std::collections::BTreeMap;

use super::adapt::fit::ChannelFit;
use super::beat::{BeatEstimate, BeatFollower};
use super::ensemble::{
    Ensemble, Observation, Parallel, ParameterSummary, Serial, Snapshot, WindowReport, with_companions,
};
use super::settings::{EstimatorSettings, SettingsError};
use super::statistics::Summary;
use super::time::{ArrivalTime, EventTime, NS_PER_S};
use super::window::{ClosedWindow, Ingested, Liveness, RawSample, Refusal, WindowCutter};
use crate::model::Model;

/// A cause of refusal is reported as an event at most this often per channel \[ns of arrival time\].
pub const REPORT_EVERY_NS: i64 = 10 * NS_PER_S;

/// Weight of the newest innovation in the running mean square.
const INNOVATION_WEIGHT: f64 = 0.005;

/// What an estimator can be told.
#[derive(Debug, Clone, PartialEq)]
pub enum Input {
    /// Samples of one channel, by its index in the settings.
    Samples {
        /// Index of the channel.
        channel: usize,
        /// In any order.
        samples: Vec<RawSample>,
    },
    /// Time has passed.
    Tick,
    /// No more samples will come: close what was delivered.
    End,
    /// Whether the whole ensemble is to be put out with every estimate.
    WantMembers(bool),
}

/// What an estimator says.
#[derive(Debug, Clone, PartialEq)]
pub enum Output {
    /// An estimate at a published time.
    Estimate(Estimate),
    /// A heart beat is over.
    Beat(BeatEstimate),
    /// A window was solved.
    Window(WindowDone),
    /// Something happened.
    Notice(Notice),
}

/// States, derived quantities and parameters at one time.
#[derive(Debug, Clone, PartialEq)]
pub struct Estimate {
    /// When.
    pub time: EventTime,
    /// Since the last sample that entered the estimate \[ns\].
    pub since_data_ns: i64,
    /// Members that took part.
    pub members: usize,
    /// States, then derived quantities.
    pub quantities: Vec<Summary>,
    /// Estimated parameters, and the time since a window last said something about each \[ns\].
    pub parameters: Vec<(ParameterSummary, i64)>,
    /// `[n_members x (n_states + n_estimated)]` at the end of the window, if wanted.
    pub ensemble: Option<Vec<f64>>,
}

/// A solved window.
#[derive(Debug, Clone, PartialEq)]
pub struct WindowDone {
    /// Its end.
    pub end: EventTime,
    /// When the input came that closed it.
    pub closed_at: ArrivalTime,
    /// Number of samples in it.
    pub samples: usize,
    /// How it went.
    pub report: WindowReport,
}

/// Something that people may want to know.
#[derive(Debug, Clone, PartialEq)]
pub struct Notice {
    /// Event time of the bed when it happened.
    pub time: EventTime,
    /// What.
    pub kind: NoticeKind,
    /// Index of the channel concerned.
    pub channel: Option<usize>,
}

/// What can happen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NoticeKind {
    /// The first window of this bed.
    Start,
    /// A channel went silent; windows no longer wait for it.
    Gap,
    /// A silent channel is back.
    Recovered,
    /// Samples were refused (reported once in a while; the counters have all).
    Rejected(Refusal, usize),
    /// Messages that could not be understood (reported once in a while; the counters have all).
    NotUnderstood(&'static str),
    /// Started anew after a silence too long to bridge or a jump of the sender's clock.
    Restart,
    /// Members that lost their numbers were replaced by draws from the others.
    MembersReplaced(usize),
    /// No member of a window could be solved; the ensemble stays where it was.
    WindowFailed,
}

impl NoticeKind {
    /// Name in topics.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Start => "start",
            Self::Gap => "gap",
            Self::Recovered => "recovered",
            Self::Rejected(..) | Self::NotUnderstood(_) => "rejected",
            Self::Restart => "restart",
            Self::MembersReplaced(_) => "members_lost",
            Self::WindowFailed => "window_failed",
        }
    }

    /// For people.
    #[must_use]
    pub fn text(self) -> String {
        match self {
            Self::Start => "first window".to_owned(),
            Self::Gap => "no samples within the allowed lateness; its windows are forecasts".to_owned(),
            Self::Recovered => "samples again".to_owned(),
            Self::Rejected(cause, n) => format!("{n} samples refused: {}", cause.name()),
            Self::NotUnderstood(cause) => format!("a message was not understood: {cause}"),
            Self::Restart => "started anew: silence too long to bridge, or the sender's clock jumped".to_owned(),
            Self::MembersReplaced(n) => format!("{n} members lost their numbers and were replaced by others"),
            Self::WindowFailed => "no member could be solved".to_owned(),
        }
    }
}

/// A channel, as a status tells it.
#[derive(Debug, Clone, PartialEq)]
pub struct ChannelHealth {
    /// State it observes.
    pub state: usize,
    /// Whether it delivers.
    pub liveness: Liveness,
    /// Its latest sample.
    pub last_sample: Option<EventTime>,
    /// Samples that entered the estimate.
    pub samples_used: u64,
    /// Root mean square of its normalised innovations, lately; NaN before any.
    pub innovation_rms: f64,
}

#[derive(Debug, Clone, Default)]
struct ChannelTally {
    samples_used: u64,
    innovation_square: Option<f64>,
    /// Last report of each cause.
    reported: BTreeMap<Refusal, ArrivalTime>,
}

/// The estimator of one bed.
#[derive(Debug, Clone)]
pub struct Estimator<M> {
    model: M,
    settings: EstimatorSettings,
    cutter: WindowCutter,
    estimated: Vec<usize>,
    /// None until the first window.
    ensemble: Option<Ensemble<M>>,
    tallies: Vec<ChannelTally>,
    refused: BTreeMap<Refusal, u64>,
    restarts: u64,
    last_observation: Option<EventTime>,
    /// End of the last window that said something about each estimated parameter.
    informed: Vec<EventTime>,
    want_members: bool,
    beat: BeatFollower,
    scratch: Snapshot,
}

impl<M: Model> Estimator<M> {
    /// An estimator that waits for its first sample.
    ///
    /// # Errors
    /// When the settings do not fit the model.
    pub fn new(model: M, settings: EstimatorSettings) -> Result<Self, SettingsError> {
        // Drawn once here, so that unusable settings are refused before anything starts.
        Ensemble::new(
            model.clone(),
            EstimatorSettings { members: 2.min(settings.members), ..settings.clone() },
            0.0,
            &Serial,
        )?;
        Ok(Self {
            cutter: WindowCutter::new(settings.window, &settings.channels),
            tallies: vec![ChannelTally::default(); settings.channels.len()],
            estimated: with_companions(&model, &settings.estimate),
            model,
            settings,
            ensemble: None,
            refused: BTreeMap::new(),
            restarts: 0,
            last_observation: None,
            informed: Vec::new(),
            want_members: false,
            beat: BeatFollower::default(),
            scratch: Snapshot::default(),
        })
    }

    /// The model.
    pub fn model(&self) -> &M {
        &self.model
    }

    /// How a channel fits; None before the first window.
    pub fn fit(&self, channel: usize) -> Option<&ChannelFit> {
        self.ensemble.as_ref().map(|ensemble| ensemble.fit(channel))
    }

    /// See [`Ensemble::pace`]; None before the first window.
    pub fn pace(&self, k: usize) -> Option<f64> {
        self.ensemble.as_ref().map(|ensemble| ensemble.pace(k))
    }

    /// What it was told.
    pub fn settings(&self) -> &EstimatorSettings {
        &self.settings
    }

    /// What is estimated, as indices into the model's parameters; the beat phase comes along with the heart rate.
    pub fn estimated(&self) -> &[usize] {
        &self.estimated
    }

    /// Samples refused so far, by cause.
    pub fn refused(&self) -> &BTreeMap<Refusal, u64> {
        &self.refused
    }

    /// Times it started anew.
    pub fn restarts(&self) -> u64 {
        self.restarts
    }

    /// Samples waiting for their window.
    pub fn pending(&self) -> usize {
        self.cutter.pending()
    }

    /// The channels, in the order of the settings.
    pub fn channels(&self) -> Vec<ChannelHealth> {
        let health = |(i, tally): (usize, &ChannelTally)| {
            let (liveness, last_sample) = self.cutter.liveness(i);
            ChannelHealth {
                state: self.settings.channels[i].state,
                liveness,
                last_sample,
                samples_used: tally.samples_used,
                innovation_rms: tally.innovation_square.map_or(f64::NAN, f64::sqrt),
            }
        };
        self.tallies.iter().enumerate().map(health).collect()
    }

    /// Takes one input at arrival time `now` and appends what follows from it.
    pub fn handle(&mut self, input: Input, now: ArrivalTime, parallel: &dyn Parallel, out: &mut Vec<Output>) {
        match input {
            Input::Samples { channel, samples } => {
                if channel < self.tallies.len() {
                    self.take(channel, &samples, now, out);
                }
            }
            Input::Tick => {}
            Input::End => self.cutter.end(),
            Input::WantMembers(want) => self.want_members = want,
        }
        loop {
            while let Some(window) = self.cutter.next(now) {
                self.solve(&window, parallel, out);
            }
            if !self.cutter.needs_restart() {
                break;
            }
            self.start_anew(out);
            self.cutter.restart(now);
        }
    }

    fn take(&mut self, channel: usize, samples: &[RawSample], now: ArrivalTime, out: &mut Vec<Output>) {
        let mut ingested = self.cutter.ingest(channel, samples, now);
        self.report(channel, &ingested, now, out);
        if ingested.clock_changed {
            self.start_anew(out);
            let dropped = self.cutter.clear(now) as u64;
            if dropped > 0 {
                *self.refused.entry(Refusal::ClockJump).or_default() += dropped;
            }
            ingested = self.cutter.ingest(channel, samples, now);
            self.report(channel, &ingested, now, out);
        }
    }

    /// Counts what was refused and says so, not too often.
    fn report(&mut self, channel: usize, ingested: &Ingested, now: ArrivalTime, out: &mut Vec<Output>) {
        let time = self.time();
        if ingested.recovered {
            out.push(notice(time, NoticeKind::Recovered, Some(channel)));
        }
        for (cause, &count) in Refusal::ALL.into_iter().zip(&ingested.refused).filter(|(_, n)| **n > 0) {
            *self.refused.entry(cause).or_default() += count as u64;
            let reported = &mut self.tallies[channel].reported;
            if reported.get(&cause).is_none_or(|at| now.ns_since(*at) >= REPORT_EVERY_NS) {
                reported.insert(cause, now);
                out.push(notice(time, NoticeKind::Rejected(cause, count), Some(channel)));
            }
        }
    }

    fn time(&self) -> EventTime {
        self.cutter.closed_to().unwrap_or(EventTime(0))
    }

    fn start_anew(&mut self, out: &mut Vec<Output>) {
        if self.ensemble.take().is_some() {
            self.restarts += 1;
            out.push(notice(self.time(), NoticeKind::Restart, None));
        }
        self.last_observation = None;
        self.beat = BeatFollower::default();
    }

    fn solve(&mut self, window: &ClosedWindow, parallel: &dyn Parallel, out: &mut Vec<Output>) {
        let first = self.ensemble.is_none();
        if first {
            let drawn = Ensemble::new(self.model.clone(), self.settings.clone(), window.start.as_s(), parallel);
            // Checked when the estimator was made; a failure here leaves the bed without estimates, visibly.
            let Ok(ensemble) = drawn else {
                out.push(notice(window.start, NoticeKind::WindowFailed, None));
                return;
            };
            self.informed = vec![window.start; ensemble.estimated().len()];
            self.ensemble = Some(ensemble);
            out.push(notice(window.start, NoticeKind::Start, None));
        }
        out.extend(window.gone_silent.iter().map(|&c| notice(window.end, NoticeKind::Gap, Some(c))));
        let Some(ensemble) = &mut self.ensemble else { return };

        let report = ensemble.step(&window.observations, parallel);
        if report.solved == 0 {
            out.push(notice(window.end, NoticeKind::WindowFailed, None));
        } else if report.replaced > 0 {
            out.push(notice(window.end, NoticeKind::MembersReplaced(report.replaced), None));
        }
        self.tally(window, &report);
        self.publish(window, first, out);
        self.follow_beat(window.end, out);
        let samples = window.observations.len();
        out.push(Output::Window(WindowDone { end: window.end, closed_at: window.closed_at, samples, report }));
    }

    fn tally(&mut self, window: &ClosedWindow, report: &WindowReport) {
        for (observation, innovation) in window.observations.iter().zip(&report.innovations) {
            let tally = &mut self.tallies[observation.channel];
            tally.samples_used += 1;
            let square = innovation * innovation;
            if square.is_finite() {
                let mean = tally.innovation_square.get_or_insert(square);
                *mean += INNOVATION_WEIGHT * (square - *mean);
            }
        }
        for (at, informed) in self.informed.iter_mut().zip(&report.informed) {
            if *informed {
                *at = window.end;
            }
        }
    }

    fn follow_beat(&mut self, end: EventTime, out: &mut Vec<Output>) {
        let Some(ensemble) = &self.ensemble else { return };
        if let Some(beats) = ensemble.cycles() {
            let values = ensemble.snapshot(1.0, &mut self.scratch);
            let over = self.beat.follow(&self.model, end, beats, values, &|member| ensemble.theta_of(member));
            out.extend(over.map(Output::Beat));
        }
    }

    /// Puts out an estimate for every published time in the window.
    fn publish(&mut self, window: &ClosedWindow, first: bool, out: &mut Vec<Output>) {
        let period = self.settings.publish_period_ns;
        let before = if first { window.start.0 - 1 } else { window.start.0 };
        let mut time = EventTime((before.div_euclid(period) + 1) * period);
        while time <= window.end {
            out.push(Output::Estimate(self.estimate(window, time)));
            time = time.plus_ns(period);
        }
        if let Some(last) = window.observations.last() {
            self.last_observation = Some(observed_at(window, last));
        }
    }

    #[allow(clippy::cast_precision_loss)]
    fn estimate(&mut self, window: &ClosedWindow, time: EventTime) -> Estimate {
        let s = time.ns_since(window.start) as f64 / self.settings.window.length_ns as f64;
        let within = window.observations.iter().map(|o| observed_at(window, o)).filter(|t| *t <= time).max();
        let last_data = within.or(self.last_observation);
        let Some(ensemble) = &self.ensemble else {
            return Estimate {
                time,
                since_data_ns: 0,
                members: 0,
                quantities: Vec::new(),
                parameters: Vec::new(),
                ensemble: None,
            };
        };
        let parameters = ensemble.summarise_parameters().into_iter().zip(&self.informed);
        Estimate {
            time,
            since_data_ns: last_data.map_or(0, |last| time.ns_since(last).max(0)),
            members: ensemble.len(),
            quantities: ensemble.summarise_at(s, &mut self.scratch),
            parameters: parameters.map(|(p, at)| (p, time.ns_since(*at).max(0))).collect(),
            ensemble: self.want_members.then(|| ensemble.members_at_end()),
        }
    }
}

fn notice(time: EventTime, kind: NoticeKind, channel: Option<usize>) -> Output {
    Output::Notice(Notice { time, kind, channel })
}

#[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss)]
fn observed_at(window: &ClosedWindow, observation: &Observation) -> EventTime {
    let length = window.end.ns_since(window.start) as f64;
    window.start.plus_ns((observation.s * length).round() as i64)
}
