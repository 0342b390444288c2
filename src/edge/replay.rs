//! Publishes a patient, synthetic or recorded, at the pace of a clock.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use super::bus::{Bus, BusError, Delivery, Encoding, Message};
use super::config::{Config, ConfigError};
use super::files::csv::Row;
use super::files::error::FileError;
use super::files::record::Record;
use super::synthetic::SyntheticPatient;
use super::wire::{self, FLAG_LAST_BLOCK, PressureBlock, SCHEMA, ToJson, Truth, WireError};
use crate::estimate::time::{EventTime, ns_from_s, s_from_ns};
use crate::model::Model;
use crate::model::cvsim6::Pressures;
use crate::model::truth::SimulationError;
use crate::runtime::clock::Clock;

/// Longest sleep before looking whether to stop.
const MAX_SLEEP: Duration = Duration::from_millis(50);

/// How often to look for a listener.
const LISTENER_LOOKS: u32 = 100;

/// Longest wait for a daemon to take the end.
const TAKEN_WITHIN: Duration = Duration::from_secs(5);

/// What cannot be replayed.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// The record.
    #[error(transparent)]
    Record(#[from] FileError),
    /// The patient's start.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The patient on the way.
    #[error(transparent)]
    Simulation(#[from] SimulationError),
    /// The bus.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// A block too large to send.
    #[error(transparent)]
    Wire(#[from] WireError),
}

/// How to replay.
#[derive(Debug, Clone, PartialEq)]
pub struct ReplayOptions {
    /// Samples per second of a synthetic patient.
    pub rate_hz: f64,
    /// Patient-seconds per second.
    pub speed: f64,
    /// Patient-seconds; None for ever (or to the end of the record).
    pub seconds: Option<f64>,
    /// Length of a block \[s\].
    pub block_s: f64,
    /// Time from one bed to the next \[s\]: patients are not connected in the same instant, and their monitors do not send
    /// at the same moment.
    pub stagger_s: f64,
    /// Event time of the start \[s\].
    pub start_s: f64,
    /// What is true, this often per second; 0 never.
    pub truth_rate_hz: f64,
    /// Begin a record again when it ends.
    pub repeat: bool,
}

impl Default for ReplayOptions {
    fn default() -> Self {
        Self {
            rate_hz: 200.0,
            speed: 1.0,
            seconds: None,
            block_s: 0.01,
            stagger_s: 0.0,
            start_s: 0.0,
            truth_rate_hz: 50.0,
            repeat: false,
        }
    }
}

/// Where the samples of a bed come from.
pub enum Source {
    /// A patient of the truth simulator.
    Synthetic(Box<SyntheticPatient>),
    /// A record; its path is read again for every pass.
    Record {
        /// Where it is.
        path: std::path::PathBuf,
        /// Where it stands.
        reader: Box<Record>,
        /// Added to the times of this pass \[ns\].
        shift_ns: i64,
        /// Time of the first row, and of the latest \[ns\].
        span: Option<(i64, i64)>,
    },
}

impl Source {
    /// A synthetic patient.
    ///
    /// # Errors
    /// When its initial pressures have no solution.
    pub fn synthetic(config: &Config, seed: u64) -> Result<Self, ConfigError> {
        Ok(Self::Synthetic(Box::new(SyntheticPatient::new(config, seed)?)))
    }

    /// A record.
    ///
    /// # Errors
    /// When it cannot be read.
    pub fn record(path: &std::path::Path, config: &Config) -> Result<Self, FileError> {
        let reader = Box::new(Record::open(path, config)?);
        Ok(Self::Record { path: path.to_owned(), reader, shift_ns: 0, span: None })
    }
}

/// A bed on its way.
pub struct Bed {
    name: String,
    source: Source,
    /// Rows made so far (synthetic).
    ticks: u64,
    /// Next block of each state.
    sequences: Vec<u64>,
    /// Rows waiting to be sent: event time and values by state.
    waiting: Vec<(EventTime, Vec<Option<f64>>)>,
    /// True values at some of these times.
    truths: Vec<(EventTime, Vec<f64>)>,
    next_truth_ns: i64,
    done: bool,
}

impl Bed {
    /// A bed under a name.
    #[must_use]
    pub fn new(name: impl Into<String>, source: Source) -> Self {
        Self {
            name: name.into(),
            source,
            ticks: 0,
            sequences: vec![0; Pressures::LEN],
            waiting: Vec::new(),
            truths: Vec::new(),
            next_truth_ns: 0,
            done: false,
        }
    }

    /// Its name.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Makes the next row; false at the end.
    #[allow(clippy::cast_precision_loss)]
    fn make_row(&mut self, config: &Config, options: &ReplayOptions) -> Result<bool, ReplayError> {
        let start_ns = ns_from_s(options.start_s);
        let limit_ns = options.seconds.map_or(i64::MAX, ns_from_s);
        match &mut self.source {
            Source::Synthetic(patient) => {
                let t = self.ticks as f64 / options.rate_hz;
                let elapsed_ns = ns_from_s(t);
                if elapsed_ns > limit_ns {
                    return Ok(false);
                }
                self.ticks += 1;
                patient.advance_to(t)?;
                let observed = patient.observe().into_iter().map(Some).collect();
                let time = EventTime(start_ns + elapsed_ns);
                if options.truth_rate_hz > 0.0 && elapsed_ns >= self.next_truth_ns {
                    let values = patient.truth().into_iter().chain(patient.parameters().iter().copied());
                    self.truths.push((time, values.collect()));
                    self.next_truth_ns += ns_from_s(1.0 / options.truth_rate_hz);
                }
                self.waiting.push((time, observed));
                Ok(true)
            }
            Source::Record { path, reader, shift_ns, span } => {
                let row = match reader.next_row()? {
                    Some(row) => row,
                    None if !options.repeat => return Ok(false),
                    None => {
                        let (first, last) = span.unwrap_or((0, 0));
                        **reader = Record::open(path, config)?;
                        let Some(row) = reader.next_row()? else { return Ok(false) };
                        // The next pass begins one typical spacing after the last row.
                        *shift_ns += last - first + ns_from_s(1.0 / options.rate_hz);
                        row
                    }
                };
                let (first, _) = span.get_or_insert((row.time.0, row.time.0));
                let first = *first;
                *span = Some((first, row.time.0));
                let time = EventTime(start_ns + row.time.0 + *shift_ns);
                if time.0 - start_ns - first > limit_ns {
                    return Ok(false);
                }
                let states = reader.states().to_vec();
                self.waiting.push((time, by_state(&states, &row)));
                Ok(true)
            }
        }
    }

    /// Sends the waiting rows from before `until` as one block per observed state; all that are left if this is the
    /// `last` time.
    fn flush(&mut self, bus: &dyn Bus, config: &Config, until: EventTime, last: bool) -> Result<(), ReplayError> {
        let is_due = |time: EventTime| last || time < until;
        let n_rows = self.waiting.iter().take_while(|(time, _)| is_due(*time)).count();
        let rows: Vec<_> = self.waiting.drain(..n_rows).collect();
        let n_truths = self.truths.iter().take_while(|(time, _)| is_due(*time)).count();
        if n_rows + n_truths == 0 && !last {
            return Ok(());
        }
        for (state, name) in Pressures::NAMES.iter().enumerate() {
            if !config.observed.iter().any(|o| o == name) {
                continue;
            }
            let samples: Vec<(i64, f64)> = rows.iter().filter_map(|(t, row)| row[state].map(|v| (t.0, v))).collect();
            if samples.is_empty() && !(last && self.sequences[state] > 0) {
                continue;
            }
            let start_ns = samples.first().map_or(0, |(t, _)| *t);
            let block = PressureBlock {
                schema: SCHEMA,
                sequence: self.sequences[state],
                flags: if last { FLAG_LAST_BLOCK } else { 0 },
                start_ns,
                period_ns: 0,
                offsets_ns: samples.iter().map(|(t, _)| t - start_ns).collect(),
                values: samples.iter().map(|(_, v)| *v).collect(),
            };
            self.sequences[state] += 1;
            let key = format!("{}/{}/pressure/{name}", config.publish.prefix, self.name);
            let message = Message { key, encoding: Encoding::Bincode, payload: wire::encode(&block)? };
            bus.publish(message, Delivery::Samples)?;
        }
        let key = format!("{}/{}/truth", config.publish.prefix, self.name);
        let twin = format!("{key}/json");
        let (wanted, twin_wanted) = (bus.is_wanted(&key), config.publish.json && bus.is_wanted(&twin));
        for (time, values) in self.truths.drain(..n_truths) {
            if !(wanted || twin_wanted) {
                continue;
            }
            let Source::Synthetic(patient) = &self.source else { continue };
            let truth = Truth { schema: SCHEMA, time_ns: time.0, names: truth_names(patient), values };
            if twin_wanted {
                let payload = truth.to_json().to_string().into_bytes();
                bus.publish(Message { key: twin.clone(), encoding: Encoding::Json, payload }, Delivery::Estimates)?;
            }
            let payload = wire::encode(&truth)?;
            bus.publish(Message { key: key.clone(), encoding: Encoding::Bincode, payload }, Delivery::Estimates)?;
        }
        Ok(())
    }
}

fn by_state(states: &[usize], row: &Row) -> Vec<Option<f64>> {
    let mut values = vec![None; Pressures::LEN];
    for (state, value) in states.iter().zip(&row.values) {
        values[*state] = *value;
    }
    values
}

fn truth_names(patient: &SyntheticPatient) -> Vec<String> {
    let model = patient.model();
    let quantities = model.states().iter().chain(model.derived()).map(|q| q.name.to_owned());
    quantities.chain(model.parameters().iter().map(|p| p.name.to_owned())).collect()
}

/// Waits for somebody to listen to a bed: a subscription takes a moment to get here, and what is published before it
/// has is lost. False if nobody did within a few seconds.
pub fn wait_for_listener(bus: &dyn Bus, config: &Config, bed: &str, stop: &AtomicBool) -> bool {
    let channel = config.observed.first().map_or("", String::as_str);
    wait_for_listener_at(bus, &format!("{}/{bed}/pressure/{channel}", config.publish.prefix), stop)
}

/// The same for a key.
pub fn wait_for_listener_at(bus: &dyn Bus, key: &str, stop: &AtomicBool) -> bool {
    for _ in 0..LISTENER_LOOKS {
        if bus.is_wanted(key) {
            return true;
        }
        if stop.load(Ordering::Relaxed) {
            break;
        }
        std::thread::sleep(MAX_SLEEP);
    }
    false
}

/// Waits until a daemon has taken what was sent to it, for a few seconds at most: what is still on its way when a session is
/// closed is lost. It answers questions, whatever under, after the samples and events before them, which come first.
pub(super) fn wait_until_taken(bus: &dyn Bus, key: &str) {
    if let Err(error) = bus.last_values(key, TAKEN_WITHIN) {
        tracing::debug!(%error, "nobody says whether the end has arrived");
    }
}

/// Publishes all beds side by side until they end or `stop` is set; returns the patient-seconds published.
///
/// # Errors
/// When a source cannot go on or the bus is closed.
#[allow(clippy::cast_precision_loss)]
pub fn run(
    bus: &dyn Bus,
    config: &Config,
    options: &ReplayOptions,
    beds: &mut [Bed],
    stop: &AtomicBool,
) -> Result<f64, ReplayError> {
    let clock = Clock::start();
    let block_ns = ns_from_s(options.block_s).max(1);
    let stagger_ns = ns_from_s(options.stagger_s);
    let mut origin: Option<i64> = None;
    // How far each bed has got, and when the clock says that its next block exists.
    let mut sent_ns = vec![0_i64; beds.len()];
    let due_ns = |bed: usize, sent_ns: i64| {
        let delay_ns = stagger_ns.saturating_mul(i64::try_from(bed).unwrap_or(i64::MAX));
        sent_ns.saturating_add(block_ns).saturating_add(delay_ns)
    };
    while !stop.load(Ordering::Relaxed) {
        let under_way = (0..beds.len()).filter(|&i| !beds[i].done);
        let Some(next) = under_way.min_by_key(|&i| due_ns(i, sent_ns[i])) else { break };
        let bed = &mut beds[next];
        let until = sent_ns[next].saturating_add(block_ns);
        let mut more = true;
        while more && bed.waiting.last().is_none_or(|(t, _)| t.0 - origin.unwrap_or(t.0) < until) {
            more = bed.make_row(config, options)?;
            if let Some((t, _)) = bed.waiting.first() {
                origin.get_or_insert(t.0);
            }
        }
        bed.done = !more;
        wait_until(&clock, s_from_ns(due_ns(next, sent_ns[next])) / options.speed, stop);
        bed.flush(bus, config, EventTime(origin.unwrap_or(0).saturating_add(until)), bed.done)?;
        if bed.done {
            bed.sequences.fill(0);
        }
        sent_ns[next] = until;
    }
    if let Some(bed) = beds.first() {
        wait_until_taken(bus, &format!("{}/{}/status", config.publish.prefix, bed.name));
    }
    Ok(s_from_ns(sent_ns.into_iter().max().unwrap_or(0)))
}

pub(super) fn wait_until(clock: &Clock, seconds: f64, stop: &AtomicBool) {
    while !stop.load(Ordering::Relaxed) {
        let left = seconds - s_from_ns(clock.now().0);
        if left <= 0.0 {
            return;
        }
        std::thread::sleep(Duration::from_secs_f64(left).min(MAX_SLEEP));
    }
}

#[cfg(test)]
mod tests {
    use std::sync::{Arc, Mutex};

    use super::*;
    use crate::edge::bus::MemoryBus;

    #[test]
    fn rows_further_apart_than_blocks_keep_their_pace() {
        let config = Config::default();
        let bus = MemoryBus::new();
        let blocks = Arc::new(Mutex::new(Vec::new()));
        let heard = Arc::clone(&blocks);
        let hear = move |message: Message| {
            let block: PressureBlock = wire::decode(&message.payload, message.encoding).unwrap();
            heard.lock().unwrap().push(block);
        };
        let channel = &config.observed[0];
        let _heard = bus.subscribe(&format!("*/bed1/pressure/{channel}"), Arc::new(hear)).unwrap();
        let mut beds = [Bed::new("bed1", Source::synthetic(&config, 1).unwrap())];
        let options = ReplayOptions { rate_hz: 40.0, speed: 1000.0, seconds: Some(2.0), ..ReplayOptions::default() };
        let seconds = run(&bus, &config, &options, &mut beds, &AtomicBool::new(false)).unwrap();
        // Sent at the end of the block that a row is in: blocks of 10 ms, most of which are empty.
        assert!((2.0..2.02).contains(&seconds), "{seconds} s for rows from 0 to 2 s");
        let blocks = blocks.lock().unwrap();
        let times: Vec<i64> = blocks.iter().flat_map(|b| b.offsets_ns.iter().map(|o| b.start_ns + o)).collect();
        assert_eq!(times, (0..=80).map(|k| k * 25_000_000).collect::<Vec<_>>());
        assert!(blocks.iter().all(|block| block.values.len() <= 1), "one at a time");
    }
}
