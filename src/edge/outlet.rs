//! From outputs to topics: encoding, sequence numbers, last values for late joiners, recent ones for recorders that missed
//! some.
//!
//! Workers encode and hand over to one publishing thread through a bounded queue. Estimates that do not fit are dropped
//! and counted; events have room of their own behind them, so that a subscriber that hangs costs estimates first. JSON twins are made only while somebody subscribes to them.

use std::collections::HashMap;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};

use serde::Serialize;
use serde::de::DeserializeOwned;

use super::bus::{self, Bus, BusError, Delivery, Encoding, Message, Subscription};
use super::config::Config;
use super::recent::{self, Payload, Recent};
use super::wire::{
    self, Alarm, Alarms, BeatEstimate, ChannelStatus, Event, GONE, Header, Members, ParameterEstimate, SCHEMA,
    StateEstimate, Status, ToJson,
};
use crate::estimate::alarm::{AlarmReport, AlarmSettings};
use crate::estimate::beat;
use crate::estimate::estimator::{AlarmsNow, Estimate, Notice, NoticeKind, Output};
use crate::estimate::signal::quality::Artefact;
use crate::estimate::statistics::Summary;
use crate::estimate::time::{EventTime, s_from_ns};
use crate::estimate::window::Liveness;
use crate::model::Model;
use crate::model::discrepancy::Circulation;
use crate::runtime::bed::{Bed, Health};
use crate::runtime::service::Sink;

/// Messages that may wait for the publishing thread, and how many more if they are events.
const QUEUE: usize = 4096;
const EVENTS: usize = 1024;

/// Keys whose last value is kept.
const MAX_LAST_VALUES: usize = 65_536;

type LastStore = Arc<Mutex<HashMap<String, Payload>>>;

/// Publishes what beds put out.
pub struct Outlet {
    bus: Arc<dyn Bus>,
    prefix: String,
    seed: u64,
    config_hash: u64,
    json: bool,
    model: Circulation,
    queue: Option<SyncSender<(Message, Delivery)>>,
    waiting: Arc<AtomicUsize>,
    dropped: AtomicU64,
    last: LastStore,
    recent: Arc<Recent>,
    sequences: Mutex<HashMap<String, u64>>,
    thread: Option<std::thread::JoinHandle<()>>,
    _answers: [Subscription; 3],
}

impl Outlet {
    /// Starts the publishing thread and offers last values and recent messages.
    ///
    /// # Errors
    /// When the bus does not take the offer.
    pub fn start(bus: Arc<dyn Bus>, config: &Config) -> Result<Self, BusError> {
        let (last, recent) = (LastStore::default(), Recent::start());
        let prefix = config.publish.prefix.clone();
        let [recent_answers, presence] = recent.offer(bus.as_ref(), &prefix)?;
        let answers = [offer_last_values(bus.as_ref(), &prefix, &last)?, recent_answers, presence];
        let (queue, messages) = sync_channel(QUEUE + EVENTS);
        let waiting = Arc::<AtomicUsize>::default();
        let (publisher, left) = (Arc::clone(&bus), Arc::clone(&waiting));
        let thread = std::thread::Builder::new()
            .name("publish".to_owned())
            .spawn(move || publish_all(publisher.as_ref(), &messages, &left))
            .map_err(|e| BusError::Transport(e.to_string()))?;
        Ok(Self {
            bus,
            prefix,
            seed: config.estimator.seed,
            config_hash: config.hash(),
            json: config.publish.json,
            model: config.circulation().map_err(|e| BusError::Transport(e.to_string()))?,
            queue: Some(queue),
            waiting,
            dropped: AtomicU64::new(0),
            last,
            recent,
            sequences: Mutex::default(),
            thread: Some(thread),
            _answers: answers,
        })
    }

    /// What is remembered for recorders; whoever takes samples in feeds it as well.
    #[must_use]
    pub fn recent(&self) -> Arc<Recent> {
        Arc::clone(&self.recent)
    }

    fn header(&self, key: &str, time: EventTime) -> Header {
        let mut sequences = self.sequences.lock().unwrap_or_else(PoisonError::into_inner);
        let next = match sequences.get_mut(key) {
            Some(next) => next,
            None => sequences.entry(key.to_owned()).or_default(),
        };
        let sequence = *next;
        *next += 1;
        Header { schema: SCHEMA, seed: self.seed, config_hash: self.config_hash, sequence, time_ns: time.0 }
    }

    fn key(&self, bed: &str, topic: &str) -> String {
        format!("{}/{bed}/{topic}", self.prefix)
    }

    /// Encodes, remembers and queues a message, and its JSON twin if somebody wants it.
    fn send<T: Serialize + ToJson>(&self, key: String, message: &T, delivery: Delivery) {
        let Ok(payload) = wire::encode(message) else {
            self.dropped.fetch_add(1, Ordering::Relaxed);
            return;
        };
        self.remember(&key, Payload::from(payload.as_slice()));
        let twin = format!("{key}/json");
        if self.json && self.bus.is_wanted(&twin) {
            let payload = message.to_json().to_string().into_bytes();
            self.queue(Message { key: twin, encoding: Encoding::Json, payload }, delivery);
        }
        self.queue(Message { key, encoding: Encoding::Bincode, payload }, delivery);
    }

    fn remember(&self, key: &str, payload: Payload) {
        let topic = key.strip_prefix(&self.prefix).and_then(|rest| rest.splitn(3, '/').nth(2)).unwrap_or_default();
        // Ensembles would take the place of much else.
        if topic != "estimate/members"
            && let Some(sequence) = wire::sequence(topic, &payload, Encoding::Bincode)
        {
            self.recent.keep(key, sequence, Encoding::Bincode, Arc::clone(&payload));
        }
        let mut last = self.last.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(value) = last.get_mut(key) {
            *value = payload;
        } else if last.len() < MAX_LAST_VALUES {
            last.insert(key.to_owned(), payload);
        }
    }

    fn queue(&self, message: Message, delivery: Delivery) {
        let Some(queue) = &self.queue else { return };
        let has_room = delivery == Delivery::Events || self.waiting.load(Ordering::Relaxed) < QUEUE;
        self.waiting.fetch_add(1, Ordering::Relaxed);
        if !has_room || queue.try_send((message, delivery)).is_err() {
            self.waiting.fetch_sub(1, Ordering::Relaxed);
            self.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }

    fn estimate(&self, bed: &Bed, estimate: &Estimate) {
        let key = self.key(&bed.name, "estimate/state");
        let header = self.header(&key, estimate.time);
        self.send(key, &state_message(header, &self.model, estimate), Delivery::Estimates);

        let key = self.key(&bed.name, "estimate/parameters");
        let header = self.header(&key, estimate.time);
        self.send(key, &parameter_message(header, &self.model, estimate), Delivery::Estimates);

        if let Some(values) = &estimate.ensemble {
            let key = self.key(&bed.name, "estimate/members");
            let header = self.header(&key, estimate.time);
            let parameters = estimate.parameters.iter().map(|(p, _)| self.model.parameters()[p.parameter].name);
            let names = self.model.states().iter().map(|q| q.name).chain(parameters).map(str::to_owned).collect();
            self.send(key, &Members { header, names, values: values.clone() }, Delivery::Estimates);
        }
    }

    fn smoothed(&self, bed: &Bed, estimate: &Estimate) {
        let key = self.key(&bed.name, "estimate/smoothed");
        let header = self.header(&key, estimate.time);
        let mut message = state_message(header, &self.model, estimate);
        for (p, _) in &estimate.parameters {
            message.names.push(self.model.parameters()[p.parameter].name.to_owned());
            message.values.extend(state_statistics(&p.summary));
        }
        self.send(key, &message, Delivery::Estimates);
    }

    fn beat(&self, bed: &Bed, beat: &beat::BeatEstimate) {
        let key = self.key(&bed.name, "estimate/beat");
        let message = BeatEstimate {
            header: self.header(&key, beat.start),
            members: count(bed.estimator().members()),
            end_ns: beat.end.0,
            names: self.model.clinical().iter().map(|q| q.name.to_owned()).collect(),
            units: self.model.clinical().iter().map(|q| q.unit.to_owned()).collect(),
            values: beat.values.iter().flat_map(|s| [s.mean, s.sd, s.q05, s.q95]).collect(),
        };
        self.send(key, &message, Delivery::Estimates);
    }

    fn notice(&self, bed: &str, channels: &[&str], notice: &Notice) {
        let channel = notice.channel.and_then(|c| channels.get(c)).copied().unwrap_or_default();
        let (kind, text) = (notice.kind.name(), notice_text(&self.model, notice));
        tracing::info!(bed, kind, channel, time_s = notice.time.as_s(), "{text}");
        let key = self.key(bed, "event");
        let header = self.header(&key, notice.time);
        let event = Event { header, kind: kind.to_owned(), channel: channel.to_owned(), text };
        self.send(key, &event, Delivery::Events);
    }

    fn alarms(&self, bed: &Bed, now: &AlarmsNow) {
        let key = self.key(&bed.name, "alarm");
        let settings = &bed.estimator().settings().live.alarms;
        let alarms = settings.iter().zip(&now.alarms).map(|(alarm, report)| alarm_message(&self.model, alarm, report));
        let message = Alarms { header: self.header(&key, now.time), alarms: alarms.collect() };
        self.send(key, &message, Delivery::Events);
    }

    /// Event time of the newest estimate of a bed.
    fn newest_time(&self, bed: &str) -> EventTime {
        let last = self.last.lock().unwrap_or_else(PoisonError::into_inner);
        let state = last.get(&self.key(bed, "estimate/state"));
        let state = state.and_then(|payload| wire::decode::<StateEstimate>(payload, Encoding::Bincode).ok());
        state.map_or(EventTime(0), |state| EventTime(state.header.time_ns))
    }

    fn status(&self, bed: &Bed, health: &Health) {
        let key = self.key(&bed.name, "status");
        let header = self.header(&key, health.time);
        let mut status = status_message(header, &self.model, health);
        let dropped = self.dropped.load(Ordering::Relaxed);
        if dropped > 0 {
            status.counters.push(("publish_dropped".to_owned(), dropped));
        }
        self.send(key, &status, Delivery::Estimates);
    }
}

impl Sink for Outlet {
    fn put(&self, bed: &Bed, outputs: &[Output], health: Option<&Health>) {
        let channels: Vec<&str> = bed
            .estimator()
            .settings()
            .channels
            .iter()
            .map(|c| self.model.states().get(c.state).map_or("", |q| q.name))
            .collect();
        for output in outputs {
            match output {
                Output::Estimate(estimate) => self.estimate(bed, estimate),
                Output::Notice(notice) => self.notice(&bed.name, &channels, notice),
                Output::Smoothed(estimate) => self.smoothed(bed, estimate),
                Output::Beat(beat) => self.beat(bed, beat),
                Output::Alarms(now) => self.alarms(bed, now),
                Output::Window(_) => {}
            }
        }
        if let Some(health) = health {
            self.status(bed, health);
            // Said on every change, and again with every status: whoever was away, or lost a message, does not go on with
            // what was.
            if let Some(now) = bed.estimator().alarms() {
                self.alarms(bed, &now);
            }
        }
    }

    fn wants_members(&self, bed: &str) -> bool {
        let key = self.key(bed, "estimate/members");
        self.bus.is_wanted(&key) || (self.json && self.bus.is_wanted(&format!("{key}/json")))
    }

    fn gone(&self, bed: &str) {
        tracing::info!(bed, "let go: silent for long, and there is a new bed");
        let key = self.key(bed, "event");
        let header = self.header(&key, self.newest_time(bed));
        let text = "let go: silent for long, and there is a new bed".to_owned();
        let event = Event { header, kind: GONE.to_owned(), channel: String::new(), text };
        self.send(key, &event, Delivery::Events);
        let below = self.key(bed, "");
        self.last.lock().unwrap_or_else(PoisonError::into_inner).retain(|key, _| !key.starts_with(&below));
        self.sequences.lock().unwrap_or_else(PoisonError::into_inner).retain(|key, _| !key.starts_with(&below));
    }

    fn lost(&self, bed: &str) {
        tracing::error!(bed, "the bed was lost to a defect in the program and starts anew");
        let key = self.key(bed, "event");
        let header = self.header(&key, self.newest_time(bed));
        let text = "lost to a defect in the program; starts anew".to_owned();
        self.send(key, &Event { header, kind: "lost".to_owned(), channel: String::new(), text }, Delivery::Events);
    }
}

impl Drop for Outlet {
    /// Publishes what is queued before it goes.
    fn drop(&mut self) {
        self.queue = None;
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn publish_all(bus: &dyn Bus, messages: &Receiver<(Message, Delivery)>, waiting: &AtomicUsize) {
    let mut failures = 0_u64;
    for (message, delivery) in messages {
        waiting.fetch_sub(1, Ordering::Relaxed);
        if let Err(error) = bus.publish(message, delivery) {
            failures += 1;
            if failures.is_power_of_two() {
                tracing::warn!(%error, failures, "publishing failed");
            }
        }
    }
}

fn offer_last_values(bus: &dyn Bus, prefix: &str, last: &LastStore) -> Result<Subscription, BusError> {
    let (last, own) = (Arc::clone(last), prefix.to_owned());
    // Requests for recent messages come here as well, and often; others answer them.
    let answer = move |asked: &str| if recent::is_request(&own, asked) { Vec::new() } else { answer(&last, asked) };
    bus.offer_last_values(&format!("{prefix}/**"), Arc::new(answer))
}

/// Last values under a pattern, of what this service says only; the JSON twins are made on demand.
fn answer(store: &LastStore, asked: &str) -> Vec<Message> {
    let values: Vec<(String, Payload)> = {
        let last = store.lock().unwrap_or_else(PoisonError::into_inner);
        last.iter().map(|(key, payload)| (key.clone(), Arc::clone(payload))).collect()
    };
    let mut out = Vec::new();
    for (key, payload) in values {
        let twin = format!("{key}/json");
        if bus::matches(asked, &twin)
            && let Some(json) = to_json(&key, &payload)
        {
            out.push(Message { key: twin, encoding: Encoding::Json, payload: json });
        }
        if bus::matches(asked, &key) {
            out.push(Message { key, encoding: Encoding::Bincode, payload: payload.to_vec() });
        }
    }
    out
}

fn to_json(key: &str, payload: &[u8]) -> Option<Vec<u8>> {
    fn twin<T: DeserializeOwned + ToJson>(payload: &[u8]) -> Option<Vec<u8>> {
        let message: T = wire::decode(payload, Encoding::Bincode).ok()?;
        Some(message.to_json().to_string().into_bytes())
    }
    if key.ends_with("/estimate/state") || key.ends_with("/estimate/smoothed") {
        twin::<StateEstimate>(payload)
    } else if key.ends_with("/estimate/beat") {
        twin::<BeatEstimate>(payload)
    } else if key.ends_with("/estimate/parameters") {
        twin::<ParameterEstimate>(payload)
    } else if key.ends_with("/estimate/members") {
        twin::<Members>(payload)
    } else if key.ends_with("/status") {
        twin::<Status>(payload)
    } else if key.ends_with("/event") {
        twin::<Event>(payload)
    } else if key.ends_with("/alarm") {
        twin::<Alarms>(payload)
    } else {
        None
    }
}

fn count(n: usize) -> u32 {
    u32::try_from(n).unwrap_or(u32::MAX)
}

/// What happened, for people: with the name of the parameter, which the core does not write.
#[must_use]
pub fn notice_text(model: &Circulation, notice: &Notice) -> String {
    match (&notice.text, notice.kind) {
        (Some(text), _) => text.clone(),
        (None, NoticeKind::ParameterShift(p)) => format!("{} has begun to move", model.parameters()[p].name),
        (None, other) => other.text(),
    }
}

fn alarm_message(model: &Circulation, settings: &AlarmSettings, report: &AlarmReport) -> Alarm {
    let quantity = settings.watched.info(model);
    Alarm {
        name: settings.name.clone(),
        quantity: quantity.name.to_owned(),
        unit: quantity.unit.to_owned(),
        priority: settings.priority.name().to_owned(),
        state: report.state.name().to_owned(),
        acknowledged: report.acknowledged,
        side: settings.limit.side().to_owned(),
        limit: settings.limit.value(),
        since_ns: report.since.0,
        band: [report.band.mean, report.band.q05, report.band.q95],
        text: settings.text(model, report),
    }
}

fn state_statistics(s: &Summary) -> [f64; 7] {
    [s.mean, s.sd, s.epistemic_sd, s.aleatoric_sd, s.model_sd, s.q05, s.q95]
}

/// One published time as a message.
fn state_message(header: Header, model: &Circulation, estimate: &Estimate) -> StateEstimate {
    StateEstimate {
        header,
        members: count(estimate.members),
        times_ns: vec![estimate.time.0],
        since_data_s: vec![s_from_ns(estimate.since_data_ns)],
        names: model.states().iter().chain(model.derived()).map(|q| q.name.to_owned()).collect(),
        values: estimate.quantities.iter().flat_map(state_statistics).collect(),
    }
}

fn parameter_message(header: Header, model: &Circulation, estimate: &Estimate) -> ParameterEstimate {
    let row = |(p, since): &(crate::estimate::ensemble::ParameterSummary, i64)| {
        let s = &p.summary;
        let identifiable = if p.is_identifiable() { 1.0 } else { 0.0 };
        [s.mean, s.sd, s.q05, s.q95, p.identifiability, s_from_ns(*since), identifiable]
    };
    let name = |p: usize| model.parameters()[p].name.to_owned();
    ParameterEstimate {
        header,
        members: count(estimate.members),
        names: estimate.parameters.iter().map(|(p, _)| name(p.parameter)).collect(),
        values: estimate.parameters.iter().flat_map(row).collect(),
    }
}

fn status_message(header: Header, model: &Circulation, health: &Health) -> Status {
    let channel = |c: &crate::estimate::estimator::ChannelHealth| ChannelStatus {
        name: model.states().get(c.state).map_or_else(String::new, |q| q.name.to_owned()),
        state: match c.liveness {
            Liveness::Never => "never",
            Liveness::Live => "live",
            Liveness::Silent => "silent",
        }
        .to_owned(),
        last_sample_ns: c.last_sample.map_or(0, |t| t.0),
        samples_used: c.samples_used,
        innovation_rms: c.innovation_rms,
        noise_sd: c.noise_sd_mmhg,
        whiteness: c.whiteness,
        recurrence: c.recurrence,
        misfit: c.misfit,
        artefact: c.artefact.map_or("", Artefact::name).to_owned(),
    };
    let disagreement = health.disagreement.iter().flat_map(|(disagreement, estimated)| {
        let states = model.states().iter().map(|q| q.name).zip(&disagreement.states);
        let parameters = estimated.iter().map(|p| model.parameters()[*p].name).zip(&disagreement.parameters);
        states.chain(parameters).map(|(name, apart)| (name.to_owned(), *apart))
    });
    Status {
        header,
        members_alive: count(health.members_alive),
        members: count(health.members),
        windows: health.windows,
        windows_without_data: health.windows_without_data,
        lag_p50_ms: health.lag_p50_ms,
        lag_p99_ms: health.lag_p99_ms,
        lag_max_ms: health.lag_max_ms,
        solve_ms: health.solve_ms,
        iterations: health.iterations,
        not_converged: health.not_converged,
        queue_depth: count(health.queue_depth),
        counters: health.counters.iter().map(|(cause, n)| ((*cause).to_owned(), *n)).collect(),
        channels: health.channels.iter().map(channel).collect(),
        disagreement: disagreement.collect(),
    }
}
