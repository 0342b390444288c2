//! The estimator of one bed: `handle(input, now) -> outputs`.
//!
//! The service, the file command, the tests and the simulator of bad networks drive this same state machine.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::adapt::fit::ChannelFit;
use super::alarm::{Alarms, Band, Happening, Reading, Watched};
use super::beat::BeatEstimate;
use super::ensemble::{Ensemble, Observation, Parallel, Serial, Snapshot, with_companions};
pub use super::messages::{
    AlarmsNow, ChannelHealth, Disagreement, Estimate, Input, Notice, NoticeKind, Output, WindowDone,
};
use super::settings::{EstimatorSettings, SettingsError};
use super::signal::quality::{Change, Quality, QualitySettings};
use super::statistics::Summary;
use super::time::{ArrivalTime, EventTime, NS_PER_S};
use super::timing::{BeatTracker, ClockReading, Heard, TimingSource};
use super::window::{ClosedWindow, Ingested, Liveness, RawSample, Refusal, WindowCutter};
use crate::model::Model;

/// A cause of refusal is reported as an event at most this often per channel \[ns of arrival time\].
pub const REPORT_EVERY_NS: i64 = 10 * NS_PER_S;

/// How long a model must not fit, or fit again, before it is said \[ns\].
const MISFIT_NS: i64 = NS_PER_S;

/// Time since data from which on an estimate is a forecast, which ends no alarm \[ns\].
const FORECAST_NS: i64 = NS_PER_S / 2;

/// Time without a shift after which a parameter is said to have begun to move \[ns\].
const CALM_NS: i64 = 5 * NS_PER_S;

/// Beats told ahead of the windows that are kept.
const MAX_TOLD: usize = 1024;

/// Weight of the newest innovation in the running mean square.
const INNOVATION_WEIGHT: f64 = 0.005;

#[derive(Debug, Clone)]
struct ChannelTally {
    samples_used: u64,
    innovation_square: Option<f64>,
    quality: Quality,
    /// Since when the model has not fitted, or has fitted again, other than what was said last.
    doubted_since: Option<EventTime>,
    misfit: bool,
    /// Last report of each cause.
    reported: BTreeMap<Refusal, ArrivalTime>,
}

impl ChannelTally {
    fn new() -> Self {
        Self {
            samples_used: 0,
            innovation_square: None,
            quality: Quality::new(QualitySettings::default()),
            doubted_since: None,
            misfit: false,
            reported: BTreeMap::new(),
        }
    }
}

/// The estimator of one bed.
#[derive(Debug, Clone)]
pub struct Estimator<M: Model> {
    model: M,
    settings: EstimatorSettings,
    cutter: WindowCutter,
    estimated: Vec<usize>,
    /// The members as they start, and those of a filter beside them.
    drawn: (Arc<Ensemble<M>>, Option<Arc<Ensemble<M>>>),
    /// None until the first window.
    ensemble: Option<Ensemble<M>>,
    /// A filter beside it.
    second: Option<Ensemble<M>>,
    tracker: BeatTracker,
    /// Beats told that lie ahead of the windows closed.
    told: Vec<EventTime>,
    tallies: Vec<ChannelTally>,
    refused: BTreeMap<Refusal, u64>,
    restarts: u64,
    last_observation: Option<EventTime>,
    /// Start of the first window since it last began.
    began: EventTime,
    /// End of the last window that said something about each estimated parameter.
    informed: Vec<EventTime>,
    /// When each estimated parameter last began to move, or the start.
    calm_since: Vec<EventTime>,
    want_members: bool,
    /// Members to go on with.
    members: usize,
    alarms: Alarms,
    scratch: Scratch,
}

/// Reused from window to window.
#[derive(Debug, Clone, Default)]
struct Scratch {
    /// Samples of undisturbed sensors.
    used: Vec<Observation>,
    heard: Vec<Heard>,
    /// Channels that can be trusted with the beat.
    usable: Vec<bool>,
    snapshot: Snapshot,
}

impl<M: Model> Estimator<M> {
    /// An estimator that waits for its first sample. Its clones are further beds, and share what was drawn for it.
    ///
    /// # Errors
    /// When the settings do not fit the model.
    pub fn new(model: M, settings: EstimatorSettings) -> Result<Self, SettingsError> {
        let drawn = Arc::new(Ensemble::new(model.clone(), settings.clone(), &Serial)?);
        let second = settings.live.second_opinion.map(|coupling| {
            let settings = EstimatorSettings { coupling, ..settings.clone() };
            Ensemble::new(model.clone(), settings, &Serial).map(Arc::new)
        });
        let members = settings.members;
        Ok(Self {
            cutter: WindowCutter::new(settings.window, &settings.channels),
            tallies: settings.channels.iter().map(|_| ChannelTally::new()).collect(),
            tracker: tracker(&settings),
            alarms: Alarms::new(&settings.live.alarms),
            drawn: (drawn, second.transpose()?),
            second: None,
            told: Vec::new(),
            estimated: with_companions(&model, &settings.estimate),
            model,
            settings,
            ensemble: None,
            refused: BTreeMap::new(),
            restarts: 0,
            last_observation: None,
            began: EventTime(0),
            informed: Vec::new(),
            calm_since: Vec::new(),
            want_members: false,
            members,
            scratch: Scratch::default(),
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
                noise_sd_mmhg: self.settings.channels[i].noise_sd_mmhg
                    * self.fit(i).map_or(1.0, ChannelFit::noise_factor),
                whiteness: self.fit(i).map_or(1.0, ChannelFit::whiteness),
                recurrence: self.fit(i).map_or(1.0, ChannelFit::recurrence),
                artefact: tally.quality.state(),
                misfit: tally.misfit,
            }
        };
        self.tallies.iter().enumerate().map(health).collect()
    }

    /// How the alarms stand; None where there are none, and before the first window.
    pub fn alarms(&self) -> Option<AlarmsNow> {
        self.ensemble.as_ref()?;
        let alarms = self.alarms.reports();
        (!alarms.is_empty()).then(|| AlarmsNow { time: self.time(), alarms })
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
            Input::Members(members) => {
                self.members = members.min(self.settings.members);
                self.resize(out);
            }
            Input::Beats(onsets) => {
                self.told.extend(onsets);
                self.told.sort_unstable();
                // The first are needed first.
                self.told.truncate(MAX_TOLD);
            }
            Input::Acknowledge { alarm, author } => self.acknowledge(alarm.as_deref(), &author, out),
        }
        let ended = self.cutter.has_ended();
        loop {
            while let Some(window) = self.cutter.next(now) {
                self.solve(&window, parallel, out);
                self.cutter.recycle(window);
            }
            if !self.cutter.needs_restart() {
                break;
            }
            self.start_anew(out);
            self.cutter.restart(now);
        }
        if ended {
            self.put_out_the_rest(out);
        }
    }

    /// Goes on with as many members as the machine can keep up with.
    fn resize(&mut self, out: &mut Vec<Output>) {
        let wanted = self.members;
        if self.ensemble.as_ref().is_none_or(|ensemble| !ensemble.would_resize(wanted)) {
            return;
        }
        self.put_out_the_rest(out);
        let time = self.time();
        let Some(ensemble) = &mut self.ensemble else { return };
        ensemble.set_members(wanted);
        let now = ensemble.len();
        let kind = if now < self.settings.members { NoticeKind::Overload(now) } else { NoticeKind::OverloadOver };
        out.push(notice(time, kind, None));
    }

    /// Members that take part.
    pub fn members(&self) -> usize {
        self.ensemble.as_ref().map_or(self.members, Ensemble::len)
    }

    /// What was kept back because more might become known of it.
    fn put_out_the_rest(&mut self, out: &mut Vec<Output>) {
        self.put_out_smoothed(EventTime(i64::MAX), out);
        self.put_out_beats(true, out);
    }

    fn put_out_beats(&mut self, last: bool, out: &mut Vec<Output>) {
        let (time, data) = (self.time(), self.data_behind(self.time()));
        let Some(ensemble) = &mut self.ensemble else { return };
        for beat in ensemble.take_beats(last) {
            self.alarms.look(time, |watched| read_beat(&beat, watched, data));
            out.push(Output::Beat(beat));
        }
        self.put_out_alarms(time, out);
    }

    /// What stands behind an estimate at a time.
    fn data_behind(&self, time: EventTime) -> Data {
        match self.last_observation {
            // What the settings say of a patient raises no alarm.
            Some(last) if self.tracker.is_acquired() => {
                if time.ns_since(last) <= FORECAST_NS {
                    Data::Behind
                } else {
                    Data::Missing
                }
            }
            _ => Data::NotYet,
        }
    }

    /// Says what has changed of the alarms, if anything has.
    fn put_out_alarms(&mut self, time: EventTime, out: &mut Vec<Output>) {
        if !self.alarms.take_changed() {
            return;
        }
        let alarms = self.alarms.reports();
        for (i, what) in self.alarms.take_happened() {
            let (alarm, band) = (&self.settings.live.alarms[i], alarms[i].band);
            let (kind, text) = match what {
                Happening::Raised => (NoticeKind::Alarm(i), alarm.raised_text(&self.model, band)),
                Happening::Over(latched) => (NoticeKind::AlarmOver(i), alarm.over_text(&self.model, band, latched)),
            };
            out.push(Output::Notice(Notice { time, kind, channel: None, text: Some(text) }));
        }
        out.push(Output::Alarms(AlarmsNow { time, alarms }));
    }

    fn acknowledge(&mut self, alarm: Option<&str>, author: &str, out: &mut Vec<Output>) {
        let time = self.time();
        let by = if author.is_empty() { String::new() } else { format!(" by {author}") };
        self.alarms.acknowledge(alarm, time, |alarm| {
            let text = Some(format!("{} acknowledged{by}", alarm.name));
            out.push(Output::Notice(Notice { time, kind: NoticeKind::AlarmAcknowledged, channel: None, text }));
        });
        self.put_out_alarms(time, out);
    }

    fn take(&mut self, channel: usize, samples: &[RawSample], now: ArrivalTime, out: &mut Vec<Output>) {
        let mut ingested = self.cutter.ingest(channel, samples, now);
        self.report(channel, &ingested, now, out);
        if ingested.clock_changed {
            self.start_anew(out);
            self.told.clear();
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
        self.put_out_the_rest(out);
        if self.ensemble.take().is_some() {
            self.restarts += 1;
            out.push(notice(self.time(), NoticeKind::Restart, None));
        }
        self.last_observation = None;
        self.second = None;
        self.tracker = tracker(&self.settings);
        for tally in &mut self.tallies {
            tally.quality = Quality::new(QualitySettings::default());
            (tally.doubted_since, tally.misfit) = (None, false);
        }
    }

    fn solve(&mut self, window: &ClosedWindow, parallel: &dyn Parallel, out: &mut Vec<Output>) {
        let first = self.ensemble.is_none();
        if first {
            self.began = window.start;
            let start_s = window.start.as_s();
            let mut ensemble = self.drawn.0.starting_at(start_s);
            ensemble.follow_beats(window.start);
            self.informed = vec![window.start; ensemble.estimated().len()];
            self.calm_since.clone_from(&self.informed);
            self.second = self.drawn.1.as_ref().map(|second| second.starting_at(start_s));
            self.ensemble = Some(ensemble);
            out.push(notice(window.start, NoticeKind::Start, None));
            self.alarms.begin(window.start);
            self.put_out_alarms(window.start, out);
            self.resize(out);
        }
        out.extend(window.gone_silent.iter().map(|&c| notice(window.end, NoticeKind::Gap, Some(c))));
        let mut observations = std::mem::take(&mut self.scratch.used);
        self.screen(window, &mut observations, out);
        let Some(ensemble) = &mut self.ensemble else { return };

        ensemble.listen(self.tracker.is_acquired());
        let report = ensemble.step(&observations, parallel);
        if let Some(second) = &mut self.second {
            second.step(&observations, parallel);
        }
        if report.solved == 0 {
            out.push(notice(window.end, NoticeKind::WindowFailed, None));
        } else if report.replaced > 0 {
            out.push(notice(window.end, NoticeKind::MembersReplaced(report.replaced), None));
        }
        for &k in &ensemble.findings().moving {
            // What is still being found out has not begun to move; and once said is enough.
            if window.end.ns_since(self.calm_since[k]) >= CALM_NS {
                out.push(notice(window.end, NoticeKind::ParameterShift(self.estimated[k]), None));
            }
            self.calm_since[k] = window.end;
        }
        // Before the beat is found, samples are listened to but nothing is learnt of them.
        let learnt: &[Observation] = if self.tracker.is_acquired() { &observations } else { &[] };
        self.tally(window.end, learnt, out);
        self.keep_time(window, &observations, parallel, out);
        self.publish((window, first), learnt, parallel, out);
        self.put_out_beats(false, out);
        let samples = learnt.len();
        out.push(Output::Window(WindowDone { end: window.end, closed_at: window.closed_at, samples, report }));
        self.scratch.used = observations;
    }

    /// The samples of a window without those of disturbed sensors, into `used`.
    fn screen(&mut self, window: &ClosedWindow, used: &mut Vec<Observation>, out: &mut Vec<Output>) {
        used.clear();
        if !self.settings.live.screen_artefacts {
            used.extend_from_slice(&window.observations);
            return;
        }
        for observation in &window.observations {
            let time = observed_at(window, observation);
            let verdict = self.tallies[observation.channel].quality.take(time.as_s(), observation.value);
            let kind = verdict.changed.map(|change| match change {
                Change::SetAside(artefact) => NoticeKind::Artefact(artefact),
                Change::TakenBack => NoticeKind::ArtefactOver,
            });
            out.extend(kind.map(|kind| notice(time, kind, Some(observation.channel))));
            if verdict.use_sample {
                used.push(*observation);
            }
        }
    }

    /// Follows the beat, and sets the clocks of the members where it went its own way.
    fn keep_time(
        &mut self,
        window: &ClosedWindow,
        observations: &[Observation],
        parallel: &dyn Parallel,
        out: &mut Vec<Output>,
    ) {
        if self.settings.live.timing == TimingSource::Clock {
            return;
        }
        let Some(ensemble) = &mut self.ensemble else { return };
        let (Some(beats), Some(rate_hz)) = (ensemble.cycles(), ensemble.rate_hz()) else { return };
        let clock = ClockReading { time_s: window.end.as_s(), beats, rate_hz };
        let heard = observations.iter().zip(&ensemble.findings().expected).map(|(o, expected)| Heard {
            channel: o.channel,
            time_s: observed_at(window, o).as_s(),
            observed: o.value,
            expected: *expected,
        });
        self.scratch.heard.clear();
        self.scratch.heard.extend(heard);
        let found = if self.settings.live.timing == TimingSource::Told {
            let due = self.told.partition_point(|at| *at <= window.end);
            let onsets: Vec<f64> = self.told.drain(..due).map(EventTime::as_s).collect();
            self.tracker.told(&onsets, clock)
        } else {
            let usable =
                |i: usize| self.tallies[i].quality.state().is_none() && self.cutter.liveness(i).0 == Liveness::Live;
            self.scratch.usable.clear();
            self.scratch.usable.extend((0..self.tallies.len()).map(usable));
            self.tracker.listen(&self.scratch.heard, clock, &self.scratch.usable)
        };
        for (said, kind) in [
            (found.acquired, NoticeKind::BeatFound),
            (found.missed, NoticeKind::BeatMissed),
            (found.surprised, NoticeKind::BeatUnexpected),
        ] {
            if said {
                out.push(notice(window.end, kind, None));
            }
        }
        // What a rhythm in doubt makes of the pressures says nothing about resistances.
        ensemble.hold_parameters(self.tracker.is_in_doubt());
        if !found.edits.is_empty() {
            ensemble.edit_clocks(&found.edits, clock.time_s, parallel);
        }
    }

    fn tally(&mut self, end: EventTime, observations: &[Observation], out: &mut Vec<Output>) {
        for (channel, tally) in self.tallies.iter_mut().enumerate() {
            let Some(fit) = self.ensemble.as_ref().map(|ensemble| ensemble.fit(channel)) else { continue };
            let now = fit.is_misfit();
            if now == tally.misfit {
                tally.doubted_since = None;
            } else if end.ns_since(*tally.doubted_since.get_or_insert(end)) >= MISFIT_NS {
                tally.misfit = now;
                let kind = if now { NoticeKind::Misfit } else { NoticeKind::FitsAgain };
                out.push(notice(end, kind, Some(channel)));
            }
        }
        let Some(findings) = self.ensemble.as_ref().map(Ensemble::findings) else { return };
        for (observation, innovation) in observations.iter().zip(&findings.innovations) {
            let tally = &mut self.tallies[observation.channel];
            tally.samples_used += 1;
            let square = innovation * innovation;
            if square.is_finite() {
                let mean = tally.innovation_square.get_or_insert(square);
                *mean += INNOVATION_WEIGHT * (square - *mean);
            }
        }
        for (at, informed) in self.informed.iter_mut().zip(&findings.informed) {
            if *informed {
                *at = end;
            }
        }
    }

    /// Puts out what lies the smoothing lag back.
    fn put_out_smoothed(&mut self, until: EventTime, out: &mut Vec<Output>) {
        let Some(ensemble) = &mut self.ensemble else { return };
        while let Some((time, quantities, parameters)) = ensemble.smoothed(until) {
            out.push(Output::Smoothed(Estimate {
                time,
                since_data_ns: time.ns_since(self.last_observation.unwrap_or(self.began)).max(0),
                members: ensemble.len(),
                quantities,
                parameters: parameters
                    .into_iter()
                    .zip(&self.informed)
                    .map(|(p, at)| (p, time.ns_since(*at).max(0)))
                    .collect(),
                ensemble: None,
            }));
        }
    }

    /// How far the second filter is from the ensemble now; None without one.
    pub fn disagreement(&self) -> Option<Disagreement> {
        let (first, second) = (self.ensemble.as_ref()?, self.second.as_ref()?);
        let apart = |(a, b): (&Summary, &Summary)| (a.mean - b.mean) / a.epistemic_sd.hypot(b.epistemic_sd);
        let states = |of: &Ensemble<M>| of.summarise_at(1.0, &mut Snapshot::default(), &Serial);
        let parameters =
            |of: &Ensemble<M>| of.summarise_parameters().into_iter().map(|p| p.summary).collect::<Vec<_>>();
        Some(Disagreement {
            states: states(first).iter().zip(&states(second)).take(self.model.n_states()).map(apart).collect(),
            parameters: parameters(first).iter().zip(&parameters(second)).map(apart).collect(),
        })
    }

    /// Puts out an estimate for every published time in the window.
    fn publish(
        &mut self,
        (window, first): (&ClosedWindow, bool),
        observations: &[Observation],
        parallel: &dyn Parallel,
        out: &mut Vec<Output>,
    ) {
        let period = self.settings.publish_period_ns;
        let before = if first { window.start.0 - 1 } else { window.start.0 };
        let mut time = EventTime((before.div_euclid(period) + 1) * period);
        while time <= window.end {
            let estimate = self.estimate(window, observations, time, parallel);
            let data = self.data_behind(time);
            self.alarms.look(time, |watched| read_estimate(&estimate, watched, data));
            out.push(Output::Estimate(estimate));
            self.put_out_alarms(time, out);
            if self.settings.live.smoothing_lag_ns > 0
                && let Some(ensemble) = &mut self.ensemble
            {
                ensemble.remember(time, position(window, time));
            }
            time = time.plus_ns(period);
        }
        if let Some(last) = observations.last() {
            self.last_observation = Some(observed_at(window, last));
        }
        if self.settings.live.smoothing_lag_ns > 0 {
            self.put_out_smoothed(window.end.plus_ns(-self.settings.live.smoothing_lag_ns), out);
        }
    }

    fn estimate(
        &mut self,
        window: &ClosedWindow,
        observations: &[Observation],
        time: EventTime,
        parallel: &dyn Parallel,
    ) -> Estimate {
        let s = position(window, time);
        let within = observations.iter().map(|o| observed_at(window, o)).filter(|t| *t <= time).max();
        // Before anything is learnt, there have been no data since the beginning.
        let last_data = within.or(self.last_observation).unwrap_or(self.began);
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
            since_data_ns: time.ns_since(last_data).max(0),
            members: ensemble.len(),
            quantities: ensemble.summarise_at(s, &mut self.scratch.snapshot, parallel),
            parameters: parameters.map(|(p, at)| (p, time.ns_since(*at).max(0))).collect(),
            ensemble: self.want_members.then(|| ensemble.members_at_end()),
        }
    }
}

fn tracker(settings: &EstimatorSettings) -> BeatTracker {
    BeatTracker::new(settings.live.timing, settings.channels.len(), settings.live.timing_channels.clone())
}

/// Where in a window a time lies, in `[0, 1]`.
#[allow(clippy::cast_precision_loss)]
fn position(window: &ClosedWindow, time: EventTime) -> f64 {
    time.ns_since(window.start) as f64 / window.end.ns_since(window.start) as f64
}

fn notice(time: EventTime, kind: NoticeKind, channel: Option<usize>) -> Output {
    Output::Notice(Notice { time, kind, channel, text: None })
}

/// Whether data stand behind an estimate.
#[derive(Debug, Clone, Copy)]
enum Data {
    /// There were none so far.
    NotYet,
    /// There were none lately: a forecast.
    Missing,
    Behind,
}

impl Data {
    fn reading(self, summary: Option<&Summary>) -> Reading {
        match (self, summary) {
            (Self::NotYet, _) | (_, None) => Reading::Unknown,
            (Self::Missing, Some(summary)) => Reading::Forecast(Band::from(summary)),
            (Self::Behind, Some(summary)) => Reading::Measured(Band::from(summary)),
        }
    }
}

/// What an estimate says of what an alarm watches.
fn read_estimate(estimate: &Estimate, watched: Watched, data: Data) -> Reading {
    match watched {
        Watched::Clinical(_) => Reading::Same,
        Watched::Quantity(q) => data.reading(estimate.quantities.get(q)),
        Watched::Parameter(parameter) => {
            let own = estimate.parameters.iter().map(|(p, _)| p).find(|p| p.parameter == parameter);
            data.reading(own.filter(|p| p.is_identifiable()).map(|p| &p.summary))
        }
    }
}

/// What a beat says of what an alarm watches.
fn read_beat(beat: &BeatEstimate, watched: Watched, data: Data) -> Reading {
    match watched {
        Watched::Clinical(q) => data.reading(beat.values.get(q)),
        Watched::Quantity(_) | Watched::Parameter(_) => Reading::Same,
    }
}

#[allow(clippy::cast_possible_truncation, clippy::cast_precision_loss)]
fn observed_at(window: &ClosedWindow, observation: &Observation) -> EventTime {
    let length = window.end.ns_since(window.start) as f64;
    window.start.plus_ns((observation.s * length).round() as i64)
}
