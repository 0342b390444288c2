//! A bed as a dashboard knows it: what it says now, and its recent past.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use super::history::{History, Limits};
use super::ward::{Content, MAX_NAME};
use crate::edge::wire::{
    Alarm, Alarms, BEAT_STATISTICS, BeatEstimate, ChannelStatus, Event, Header, Note, PARAMETER_STATISTICS,
    ParameterEstimate, PressureBlock, STATE_STATISTICS, StateEstimate, Status, Truth,
};
use crate::model::Quantity;
use crate::model::cvsim6::{DERIVED, FlowsAndVolumes, PARAMETERS, Pressures, STATES};

/// Pressures, flows and volumes.
pub(super) const QUANTITIES: usize = Pressures::LEN + FlowsAndVolumes::LEN;
/// Nothing for this long, and a bed is stale.
pub(super) const STALE_AFTER: Duration = Duration::from_secs(2);
/// An estimate this long without data is called a forecast \[s\].
pub(super) const FORECAST_AFTER_S: f64 = 0.25;
/// A parameter that the data have said nothing about for so long is uninformed \[s\].
pub(super) const UNINFORMED_AFTER_S: f64 = 5.0;

/// A beat that ended longer ago is not the present one.
const PRESENT_BEAT_NS: i64 = 4 * NS_PER_S;

const NS_PER_S: i64 = 1_000_000_000;
/// Trends of parameters: ten minutes of seconds.
const TREND: Limits = Limits { age_ns: 600 * NS_PER_S, spacing_ns: NS_PER_S, rows: 601 };
/// Trends of what a beat is told by: ten minutes, of slow beats all of them.
const BEAT_TREND: Limits = Limits { spacing_ns: NS_PER_S / 4, rows: 1201, ..TREND };
/// Samples come more often than estimates are published.
const SAMPLES_PER_ROW: usize = 3;
const MAX_PARAMETERS: usize = 64;
const MAX_EVENTS: usize = 200;
const MAX_STATUS_ENTRIES: usize = 32;
const MAX_ALARMS: usize = 64;
const MAX_TEXT: usize = 200;

/// A mean and the 5 and 95 % quantiles; `f32` because a screen has few dots.
#[derive(Debug, Clone, Copy)]
pub(super) struct Band {
    pub(super) mean: f32,
    pub(super) low: f32,
    pub(super) high: f32,
}

/// All quantities at one time.
#[derive(Debug, Clone)]
pub(super) struct StateRow {
    /// NaN where not published.
    pub(super) bands: [Band; QUANTITIES],
    /// Seconds since data entered the estimate.
    pub(super) since_data_s: f64,
}

/// An estimated parameter, now and lately.
#[derive(Debug, Clone)]
pub(super) struct Parameter {
    pub(super) name: String,
    pub(super) unit: &'static str,
    pub(super) mean: f64,
    pub(super) low: f64,
    pub(super) high: f64,
    /// Seconds since the data last said something about it.
    pub(super) since_informed_s: f64,
    /// Whether data rather than settings say what it is.
    pub(super) is_identifiable: bool,
    pub(super) trend: History<TrendPoint>,
}

/// A parameter at one time.
#[derive(Debug, Clone, Copy)]
pub(super) struct TrendPoint {
    pub(super) band: Band,
    /// Whether the data said something about it then.
    pub(super) is_informed: bool,
    /// What it was; NaN where nobody tells.
    pub(super) truth: f32,
}

/// A clinical quantity of a heart beat.
#[derive(Debug, Clone)]
pub(super) struct BeatReading {
    pub(super) name: String,
    pub(super) unit: String,
    pub(super) band: Band,
}

/// Standard deviations of a quantity by their source.
#[derive(Debug, Clone, Copy)]
pub(super) struct Spread {
    pub(super) total: f64,
    pub(super) epistemic: f64,
    pub(super) aleatoric: f64,
    pub(super) model: f64,
}

/// How far the estimates of a bed can be trusted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Quality {
    /// The daemon has not said.
    Unknown,
    /// All sensors deliver, and the model fits them.
    Good,
    /// Something is amiss.
    Degraded,
    /// No sensor delivers anything of use.
    Bad,
}

/// A line of the event log.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct EventLine {
    pub(super) time_ns: i64,
    sequence: u64,
    pub(super) kind: String,
    pub(super) channel: String,
    pub(super) text: String,
}

/// Where a pressure comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Origin {
    /// A sensor delivers it.
    Observed,
    /// It has a sensor that delivers nothing of use at present.
    Silent,
    /// No sensor.
    Inferred,
}

/// Whether what is shown is the present.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Liveness {
    /// Estimates arrive; the last was made this long after its data \[s\].
    Live {
        /// As in [`StateRow::since_data_s`].
        since_data_s: f64,
    },
    /// Pressures arrive, estimates do not.
    NoEstimate,
    /// Nothing has arrived for this long.
    Stale(Duration),
    /// Only values from before this screen was opened.
    NotHeard,
}

impl Liveness {
    pub(super) fn is_live(self) -> bool {
        matches!(self, Self::Live { .. })
    }
}

/// One bed.
#[derive(Debug, Clone, Default)]
pub(super) struct Bed {
    /// The newest estimate in event time.
    pub(super) state: Option<(i64, StateRow)>,
    pub(super) history: History<StateRow>,
    /// Of the newest estimate.
    pub(super) spread: Vec<Spread>,
    /// Raw samples of the six pressures.
    pub(super) samples: [History<f32>; Pressures::LEN],
    /// What a synthetic patient really is; NaN where not published.
    pub(super) truth: History<[f32; QUANTITIES]>,
    pub(super) true_parameters: BTreeMap<&'static str, f64>,
    pub(super) parameters: Vec<Parameter>,
    /// Of the last beat that was over, and when it was \[ns\].
    pub(super) beat: (i64, Vec<BeatReading>),
    /// The same over the last minutes, by name.
    pub(super) beat_trends: BTreeMap<String, History<Band>>,
    pub(super) alarms: Vec<Alarm>,
    pub(super) status: Option<Status>,
    pub(super) events: VecDeque<EventLine>,
    /// Events ever taken in, so that a reader knows which are new to it.
    pub(super) events_taken: u64,
    estimate_arrival: Option<Duration>,
    sample_arrival: Option<Duration>,
    pub(super) status_arrival: Option<Duration>,
}

/// The quantities in their order here.
pub(super) fn quantity_infos() -> impl Iterator<Item = &'static Quantity> {
    STATES.iter().chain(DERIVED)
}

/// Their names.
pub(super) fn quantity_names() -> impl Iterator<Item = &'static str> {
    quantity_infos().map(|q| q.name)
}

/// Where a quantity stands in that order.
pub(super) fn quantity(name: &str) -> Option<usize> {
    quantity_names().position(|n| n == name)
}

/// The statistic `name` in one row of a table of `names`.
fn statistic(names: &[&str], row: &[f64], name: &str) -> f64 {
    names.iter().zip(row).find(|(n, _)| **n == name).map_or(f64::NAN, |(_, value)| *value)
}

/// Text of others: short, and without what could steer the terminal.
pub(super) fn tame(text: &str, longest: usize) -> String {
    text.chars().take(longest).map(|c| if c.is_control() { ' ' } else { c }).collect()
}

impl Band {
    fn from_row(names: &[&str], row: &[f64]) -> Self {
        let narrow = |name| statistic(names, row, name) as f32;
        Self { mean: narrow("mean"), low: narrow("q05"), high: narrow("q95") }
    }
}

impl Bed {
    pub(super) fn take(&mut self, content: Content, arrival: Option<Duration>, limits: Limits) {
        match content {
            Content::State(state) => {
                self.estimate_arrival = arrival.or(self.estimate_arrival);
                self.take_state(&state, limits);
            }
            Content::Samples(channel, block) => {
                self.sample_arrival = arrival.or(self.sample_arrival);
                self.take_samples(channel, &block, limits);
            }
            Content::Parameters(parameters) => self.take_parameters(&parameters),
            Content::Beat(beat) => self.take_beat(&beat),
            Content::Truth(truth) => self.take_truth(&truth, limits),
            Content::Status(status) => {
                self.status_arrival = arrival.or(self.status_arrival);
                self.status = Some(tame_status(status));
            }
            Content::Event(event) => self.take_event(&event),
            Content::Alarms(alarms) => self.take_alarms(alarms),
            Content::Note(note) => self.take_note(&note),
        }
    }

    fn take_state(&mut self, state: &StateEstimate, limits: Limits) {
        let columns: Vec<Option<usize>> = state.names.iter().map(|name| quantity(name)).collect();
        let rows = state.values.chunks(state.names.len() * STATE_STATISTICS.len());
        for ((&time_ns, &since_data_s), row) in state.times_ns.iter().zip(&state.since_data_s).zip(rows) {
            let mut bands = [Band { mean: f32::NAN, low: f32::NAN, high: f32::NAN }; QUANTITIES];
            for (column, statistics) in columns.iter().zip(row.chunks(STATE_STATISTICS.len())) {
                if let Some(q) = column {
                    bands[*q] = Band::from_row(&STATE_STATISTICS, statistics);
                }
            }
            let state_row = StateRow { bands, since_data_s };
            let generation = self.history.restarts();
            self.history.push(time_ns, state_row.clone(), limits);
            if self.history.restarts() != generation {
                self.forget_beats();
            }
            // The history thins out and forgets after a jump back: its end decides what is newest.
            if self.history.newest_ns().is_none_or(|newest| time_ns >= newest) {
                self.state = Some((time_ns, state_row));
                self.spread = spread(&columns, row);
            }
        }
    }

    /// Event time has begun anew: beats of another run are none of this one, and neither are trends.
    fn forget_beats(&mut self) {
        self.beat.1.clear();
        self.beat_trends.clear();
        self.parameters.iter_mut().for_each(|parameter| parameter.trend = History::default());
    }

    fn take_samples(&mut self, channel: usize, block: &PressureBlock, limits: Limits) {
        let limits = Limits { rows: limits.rows.saturating_mul(SAMPLES_PER_ROW), ..limits };
        for (i, value) in block.values.iter().enumerate() {
            let regular = || block.period_ns.saturating_mul(i64::try_from(i).unwrap_or(i64::MAX));
            let offset_ns = block.offsets_ns.get(i).copied().unwrap_or_else(regular);
            self.samples[channel].push(block.start_ns.saturating_add(offset_ns), *value as f32, limits);
        }
    }

    fn take_parameters(&mut self, estimate: &ParameterEstimate) {
        // What is not estimated any more is not known any more.
        self.parameters.retain(|p| estimate.names.iter().any(|name| tame(name, MAX_NAME) == p.name));
        let rows = estimate.values.chunks(PARAMETER_STATISTICS.len());
        for (name, row) in estimate.names.iter().zip(rows).take(MAX_PARAMETERS) {
            let name = tame(name, MAX_NAME);
            let known = self.parameters.iter().position(|p| p.name == name);
            if known.is_none() && self.parameters.len() >= MAX_PARAMETERS {
                continue;
            }
            let at = known.unwrap_or_else(|| {
                self.parameters.push(Parameter::new(name));
                self.parameters.len() - 1
            });
            let truth = self.true_parameters.get(self.parameters[at].name.as_str());
            let truth = truth.map_or(f32::NAN, |truth| *truth as f32);
            self.parameters[at].update(estimate.header.time_ns, row, truth);
        }
    }

    fn take_beat(&mut self, beat: &BeatEstimate) {
        let rows = beat.names.iter().zip(&beat.units).zip(beat.values.chunks(BEAT_STATISTICS.len()));
        let reading = |((name, unit), row): ((&String, &String), &[f64])| BeatReading {
            name: tame(name, MAX_NAME),
            unit: tame(unit, MAX_NAME),
            band: Band::from_row(&BEAT_STATISTICS, row),
        };
        self.beat = (beat.end_ns, rows.take(MAX_PARAMETERS).map(reading).collect());
        for BeatReading { name, band, .. } in &self.beat.1 {
            if let Some(trend) = self.beat_trends.get_mut(name) {
                trend.push(beat.end_ns, *band, BEAT_TREND);
            } else if self.beat_trends.len() < MAX_PARAMETERS {
                self.beat_trends.entry(name.clone()).or_default().push(beat.end_ns, *band, BEAT_TREND);
            }
        }
    }

    /// All clinical quantities of the last beat, on the same condition.
    pub(super) fn beat(&self) -> &[BeatReading] {
        if self.is_beating() { &self.beat.1 } else { &[] }
    }

    fn is_beating(&self) -> bool {
        // Who does not listen to estimates has the status to tell the time by.
        let now_ns = self.history.newest_ns().max(self.status.as_ref().map(|status| status.header.time_ns));
        now_ns.is_some_and(|now_ns| now_ns.saturating_sub(self.beat.0) <= PRESENT_BEAT_NS)
    }

    /// A clinical quantity of the last beat, unless that was long ago: what does not beat has no output.
    pub(super) fn of_beat(&self, name: &str) -> Option<&BeatReading> {
        self.beat().iter().find(|reading| reading.name == name)
    }

    /// Unit of a clinical quantity, as the last beat told it.
    pub(super) fn beat_unit(&self, name: &str) -> &str {
        self.beat.1.iter().find(|reading| reading.name == name).map_or("", |reading| &reading.unit)
    }

    /// Whether beats are told.
    pub(super) fn has_beats(&self) -> bool {
        !self.beat.1.is_empty()
    }

    fn take_truth(&mut self, truth: &Truth, limits: Limits) {
        let mut row = [f32::NAN; QUANTITIES];
        for (name, value) in truth.names.iter().zip(&truth.values) {
            if let Some(q) = quantity(name) {
                row[q] = *value as f32;
            } else if let Some(parameter) = PARAMETERS.iter().find(|p| p.name == name) {
                self.true_parameters.insert(parameter.name, *value);
            }
        }
        if row.iter().any(|v| v.is_finite()) {
            self.truth.push(truth.time_ns, row, limits);
        }
    }

    fn take_event(&mut self, event: &Event) {
        let [kind, channel] = [&event.kind, &event.channel].map(|s| tame(s, MAX_NAME));
        let Header { time_ns, sequence, .. } = event.header;
        self.log(EventLine { time_ns, sequence, kind, channel, text: tame(&event.text, MAX_TEXT) });
    }

    /// A note stands among the events.
    fn take_note(&mut self, note: &Note) {
        let text = match tame(&note.author, MAX_NAME) {
            author if author.trim().is_empty() => tame(&note.text, MAX_TEXT),
            author => format!("{} ({author})", tame(&note.text, MAX_TEXT)),
        };
        let (kind, channel) = ("note".to_owned(), String::new());
        self.log(EventLine { time_ns: note.time_ns, sequence: 0, kind, channel, text });
    }

    fn log(&mut self, line: EventLine) {
        // A last value may arrive a second time as news.
        if self.events.contains(&line) {
            return;
        }
        self.events.push_back(line);
        self.events_taken += 1;
        if self.events.len() > MAX_EVENTS {
            self.events.pop_front();
        }
    }

    fn take_alarms(&mut self, alarms: Alarms) {
        self.alarms = alarms.alarms;
        self.alarms.truncate(MAX_ALARMS);
        for Alarm { name, quantity, unit, priority, state, side, text, .. } in &mut self.alarms {
            for short in [name, quantity, unit, priority, state, side] {
                *short = tame(short, MAX_NAME);
            }
            *text = tame(text, MAX_TEXT);
        }
    }

    /// How far the estimates can be trusted, and why not further.
    pub(super) fn quality(&self) -> (Quality, String) {
        let Some(status) = &self.status else { return (Quality::Unknown, "no status".to_owned()) };
        let trouble = |c: &ChannelStatus| match c.state.as_str() {
            "live" if !c.artefact.is_empty() => Some(format!("{} set aside: {}", c.name, c.artefact)),
            "live" => None,
            state => Some(format!("{} {}", c.name, if state == "never" { "never heard" } else { state })),
        };
        let unusable: Vec<String> = status.channels.iter().filter_map(trouble).collect();
        let misfit = status.channels.iter().filter(|c| c.misfit).map(|c| format!("the model does not fit {}", c.name));
        let few = (status.members_alive < status.members)
            .then(|| format!("{} of {} members", status.members_alive, status.members));
        let all: Vec<String> = unusable.iter().cloned().chain(misfit).chain(few).collect();
        let quality = match () {
            () if unusable.len() >= status.channels.len() => Quality::Bad,
            () if !all.is_empty() => Quality::Degraded,
            () => Quality::Good,
        };
        (quality, all.join(", "))
    }

    /// How often event time has begun anew.
    pub(super) fn generation(&self) -> u64 {
        self.history.restarts()
    }

    /// Whether what is shown is the present.
    pub(super) fn liveness(&self, now: Duration) -> Liveness {
        let is_recent = |arrival: Duration| now.saturating_sub(arrival) < STALE_AFTER;
        let newest = self.estimate_arrival.max(self.sample_arrival);
        match (newest, self.estimate_arrival) {
            (_, Some(estimate)) if is_recent(estimate) => {
                let since_data_s = self.state.as_ref().map_or(0.0, |(_, row)| row.since_data_s);
                Liveness::Live { since_data_s }
            }
            (Some(newest), _) if is_recent(newest) => Liveness::NoEstimate,
            (Some(newest), _) => Liveness::Stale(now.saturating_sub(newest)),
            (None, _) => Liveness::NotHeard,
        }
    }

    /// How long ago the newest estimate arrived, or without one the newest sample; None if nothing has.
    pub(super) fn silence(&self, now: Duration) -> Option<Duration> {
        Some(now.saturating_sub(self.estimate_arrival.or(self.sample_arrival)?))
    }

    /// Age of the data behind the newest estimate: how long ago it arrived, and how far it is behind the samples.
    pub(super) fn age(&self, now: Duration) -> Option<Duration> {
        let since_arrival = self.silence(now)?;
        let (Some((estimate_ns, _)), Some(sample_ns)) = (&self.state, self.newest_sample_ns()) else {
            return Some(since_arrival);
        };
        let behind_ns = u64::try_from(sample_ns.saturating_sub(*estimate_ns)).unwrap_or(0);
        Some(since_arrival + Duration::from_nanos(behind_ns))
    }

    fn newest_sample_ns(&self) -> Option<i64> {
        self.samples.iter().filter_map(History::newest_ns).max()
    }

    /// The true value at the time of the newest estimate, which may be behind; NaN if not known there.
    pub(super) fn truth_now(&self, quantity: usize) -> f64 {
        const CLOSE_NS: u64 = 20_000_000;
        const BRIDGED_NS: i64 = 200_000_000;
        let Some(time_ns) = self.state.as_ref().map(|(t, _)| *t) else { return f64::NAN };
        let mut rows = self.truth.since(time_ns).map(|(t, row)| (t, f64::from(row[quantity])));
        match (rows.next(), rows.next()) {
            (Some((t0, before)), Some((t1, after))) if t0 <= time_ns && t1.saturating_sub(t0) <= BRIDGED_NS => {
                before + (after - before) * seconds(time_ns - t0) / seconds(t1 - t0)
            }
            (Some((t, value)), _) if t.abs_diff(time_ns) <= CLOSE_NS => value,
            _ => f64::NAN,
        }
    }

    /// The event time at the right edge of the picture.
    pub(super) fn newest_ns(&self, now: Duration) -> Option<i64> {
        let estimate = self.state.as_ref().map(|(t, _)| *t);
        match self.liveness(now) {
            // The silence of the estimator must be seen as a gap.
            Liveness::NoEstimate => self.newest_sample_ns().max(estimate),
            _ => estimate.or_else(|| self.newest_sample_ns()),
        }
    }

    /// Where a quantity comes from; flows and volumes have no sensors.
    pub(super) fn origin(&self, quantity: usize) -> Origin {
        let Some(samples) = self.samples.get(quantity) else { return Origin::Inferred };
        let listed =
            self.status.as_ref().and_then(|s| s.channels.iter().find(|c| self::quantity(&c.name) == Some(quantity)));
        match listed.map(|c| (c.state.as_str(), c.artefact.as_str())) {
            Some(("live", "")) => Origin::Observed,
            Some(_) => Origin::Silent,
            None if self.status.is_some() || samples.newest_ns().is_none() => Origin::Inferred,
            None => Origin::Observed,
        }
    }

    /// Beats per minute: estimated, or else that of the last beat, or counted on the left ventricle; None where beats have
    /// been told and none comes any more.
    pub(super) fn heart_rate_bpm(&self) -> Option<f64> {
        if self.has_beats() && !self.is_beating() {
            return None;
        }
        let estimated = self.parameters.iter().find(|p| p.name == "heart_rate").map(|p| p.mean);
        let of_beat = || self.of_beat("heart_rate").map(|reading| f64::from(reading.band.mean));
        estimated.or_else(of_beat).or_else(|| self.counted_beats_bpm())
    }

    fn counted_beats_bpm(&self) -> Option<f64> {
        const LOOK_BACK_S: i64 = 10;
        const LEAST_SWING_MMHG: f32 = 10.0;
        let from_ns = self.history.newest_ns()?.saturating_sub(LOOK_BACK_S * NS_PER_S);
        let left_ventricle = quantity("p_l")?;
        let means = || self.history.since(from_ns).map(|(t, row)| (t, row.bands[left_ventricle].mean));
        let (low, high) = means().fold((f32::MAX, f32::MIN), |(low, high), (_, p)| (low.min(p), high.max(p)));
        if high - low < LEAST_SWING_MMHG {
            return None;
        }
        // Two thresholds, so that ripples on one are not beats.
        let (armed_below, counted_above) = (low + 0.3 * (high - low), low + 0.6 * (high - low));
        let (mut armed, mut onsets) = (false, Vec::new());
        for (time_ns, p) in means() {
            if p < armed_below {
                armed = true;
            } else if armed && p > counted_above {
                armed = false;
                onsets.push(time_ns);
            }
        }
        let (first, last) = (onsets.first()?, onsets.last()?);
        (onsets.len() > 2).then(|| 60.0 * (onsets.len() - 1) as f64 / seconds(last - first))
    }

    /// Largest and smallest mean of a quantity over the last two beats.
    pub(super) fn extremes(&self, quantity: usize) -> Option<(f32, f32)> {
        const WITHOUT_RATE_S: f64 = 2.0;
        let look_back_s = self.heart_rate_bpm().map_or(WITHOUT_RATE_S, |bpm| (120.0 / bpm).clamp(0.5, 6.0));
        let from_ns = self.history.newest_ns()?.saturating_sub((look_back_s * 1e9) as i64);
        let means = self.history.since(from_ns).map(|(_, row)| row.bands[quantity].mean).filter(|p| p.is_finite());
        let (low, high) = means.fold((f32::MAX, f32::MIN), |(low, high), p| (low.min(p), high.max(p)));
        (low <= high).then_some((high, low))
    }
}

impl Parameter {
    fn new(name: String) -> Self {
        let unit = PARAMETERS.iter().find(|p| p.name == name).map_or("", |p| p.unit);
        let [mean, low, high, since_informed_s] = [f64::NAN; 4];
        Self { name, unit, mean, low, high, since_informed_s, is_identifiable: true, trend: History::default() }
    }

    /// Whether data rather than settings say what it is, and did so lately.
    pub(super) fn is_informed(&self) -> bool {
        self.is_identifiable && self.since_informed_s <= UNINFORMED_AFTER_S
    }

    fn update(&mut self, time_ns: i64, row: &[f64], truth: f32) {
        let fields = ["mean", "q05", "q95", "since_informed_s", "identifiable"];
        let [mean, low, high, since_informed_s, identifiable] =
            fields.map(|name| statistic(&PARAMETER_STATISTICS, row, name));
        let is_informed = identifiable > 0.5 && since_informed_s <= UNINFORMED_AFTER_S;
        let band = Band::from_row(&PARAMETER_STATISTICS, row);
        self.trend.push(time_ns, TrendPoint { band, is_informed, truth }, TREND);
        let (name, unit, trend) = (std::mem::take(&mut self.name), self.unit, std::mem::take(&mut self.trend));
        *self = Self { name, unit, mean, low, high, since_informed_s, is_identifiable: identifiable > 0.5, trend };
    }
}

fn tame_status(mut status: Status) -> Status {
    status.counters.truncate(MAX_STATUS_ENTRIES);
    status.channels.truncate(MAX_STATUS_ENTRIES);
    for (name, _) in &mut status.counters {
        *name = tame(name, MAX_NAME);
    }
    for ChannelStatus { name, state, artefact, .. } in &mut status.channels {
        (*name, *state, *artefact) = (tame(name, MAX_NAME), tame(state, MAX_NAME), tame(artefact, MAX_NAME));
    }
    status
}

/// `[QUANTITIES]`, NaN where not published.
fn spread(columns: &[Option<usize>], row: &[f64]) -> Vec<Spread> {
    let unknown = Spread { total: f64::NAN, epistemic: f64::NAN, aleatoric: f64::NAN, model: f64::NAN };
    let mut all = vec![unknown; QUANTITIES];
    for (column, statistics) in columns.iter().zip(row.chunks(STATE_STATISTICS.len())) {
        if let Some(q) = column {
            let [total, epistemic, aleatoric, model] =
                ["sd", "epistemic_sd", "aleatoric_sd", "model_sd"].map(|s| statistic(&STATE_STATISTICS, statistics, s));
            all[*q] = Spread { total, epistemic, aleatoric, model };
        }
    }
    all
}

/// Nanoseconds as seconds.
pub(super) fn seconds(ns: i64) -> f64 {
    ns as f64 * 1e-9
}

/// Event time: of day if it counts from 1970, else seconds since whatever it counts from.
pub(super) fn event_time(time_ns: i64) -> String {
    const YEAR_2001_NS: i64 = 1_000_000_000_000_000_000;
    if time_ns < YEAR_2001_NS {
        return format!("{:.1} s", seconds(time_ns));
    }
    let tenths = time_ns / 100_000_000;
    let (second, tenth) = (tenths / 10 % 86_400, tenths % 10);
    format!("{:02}:{:02}:{:02}.{tenth} UTC", second / 3600, second / 60 % 60, second % 60)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantities_are_those_of_the_model() {
        assert_eq!(quantity_names().count(), QUANTITIES);
        assert!(quantity_names().eq(Pressures::NAMES.iter().chain(FlowsAndVolumes::NAMES).copied()));
    }

    #[test]
    fn event_time_is_of_day_or_since_the_start() {
        assert_eq!(event_time(12_340_000_000), "12.3 s");
        assert_eq!(event_time(1_700_000_000_500_000_000), "22:13:20.5 UTC");
        assert_eq!(event_time(i64::MIN), "-9223372036.9 s");
    }
}
