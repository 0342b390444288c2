//! From topics to tasks: samples are decoded and named here, and whatever is not understood becomes a counted
//! refusal of the bed it was sent to. Blocks of samples are remembered as they came, for recorders that missed them.

use std::sync::Arc;

use super::bus::{Bus, BusError, Handler, Message, Subscription};
use super::config::{Config, Timing};
use super::operator::MAX_AUTHOR;
use super::recent::Recent;
use super::wire::{self, Acknowledge, Beats, FLAG_LAST_BLOCK, PressureBlock, WireError, decode};
use crate::estimate::time::EventTime;
use crate::estimate::window::RawSample;
use crate::model::Model;
use crate::runtime::bed::Task;
use crate::runtime::service::{Event, Inlet};

/// Samples accepted in one block.
const MAX_BLOCK_SAMPLES: usize = 16_384;

/// Knows which label is which channel.
struct Decoder {
    prefix: String,
    /// Label and index of the channel.
    labels: Vec<(String, usize)>,
    /// Labels of states that are known but not listened to.
    ignored: Vec<String>,
    /// Whether beats are told.
    told: bool,
    /// Names of the alarms.
    alarms: Vec<String>,
}

impl Decoder {
    fn new(config: &Config) -> Self {
        let model = config.patient.model();
        let states: Vec<&str> = model.states().iter().map(|q| q.name).collect();
        let channels: Vec<&str> =
            states.iter().copied().filter(|name| config.observed.iter().any(|o| o == name)).collect();
        let names = states.iter().map(|name| (*name).to_owned()).chain(config.labels.keys().cloned());
        let (mut labels, mut ignored) = (Vec::new(), Vec::new());
        for label in names {
            let state = config.state_of_label(&label).map(str::to_owned);
            match channels.iter().position(|c| Some(*c) == state.as_deref()) {
                Some(channel) => labels.push((label, channel)),
                None => ignored.push(label),
            }
        }
        let told = config.estimator.timing == Timing::Beats;
        let alarms = config.alarms.iter().map(|alarm| alarm.name.clone()).collect();
        Self { prefix: config.publish.prefix.clone(), labels, ignored, told, alarms }
    }

    /// The bed and what to do; None for what is not meant for this service.
    fn event(&self, message: &Message) -> Option<Event> {
        let rest = message.key.strip_prefix(&self.prefix)?.strip_prefix('/')?;
        if let Some(bed) = rest.strip_suffix("/beat") {
            let task = if self.told { beats(message).unwrap_or_else(Task::Refused) } else { return None };
            return Some(Event::Task { bed: bed.to_owned(), task });
        }
        // A label may be called so as well.
        if let Some(bed) = rest.strip_suffix("/acknowledge").filter(|bed| !bed.contains('/')) {
            let task = self.acknowledge(message).unwrap_or_else(Task::Refused);
            return Some(Event::Task { bed: bed.to_owned(), task });
        }
        let (bed, channel) = rest.split_once("/pressure/")?;
        if self.ignored.iter().any(|label| label == channel) {
            return None;
        }
        let task = match self.labels.iter().find(|(label, _)| label == channel) {
            None => Task::Refused("unknown_channel"),
            Some((_, channel)) => task(message, *channel).unwrap_or_else(Task::Refused),
        };
        Some(Event::Task { bed: bed.to_owned(), task })
    }

    /// Sequence number of a message that has one.
    fn sequence(&self, message: &Message) -> Option<u64> {
        let (_, topic) = message.key.strip_prefix(&self.prefix)?.strip_prefix('/')?.split_once('/')?;
        wire::sequence(topic, &message.payload, message.encoding)
    }

    fn acknowledge(&self, message: &Message) -> Result<Task, &'static str> {
        let Acknowledge { alarm, author, .. } =
            decode(&message.payload, message.encoding).map_err(|error| refusal(&error))?;
        if author.len() > MAX_AUTHOR {
            return Err("oversized");
        }
        let alarm = Some(alarm).filter(|name| !name.is_empty());
        if alarm.as_ref().is_some_and(|name| !self.alarms.contains(name)) {
            return Err("unknown_alarm");
        }
        Ok(Task::Acknowledge { alarm, author })
    }
}

fn refusal(error: &WireError) -> &'static str {
    match error {
        WireError::TooLong(_) => "oversized",
        WireError::Malformed(_) => "malformed",
        WireError::Schema(_) => "wrong_schema",
    }
}

fn beats(message: &Message) -> Result<Task, &'static str> {
    let beats: Beats = decode(&message.payload, message.encoding).map_err(|error| refusal(&error))?;
    if beats.onsets_ns.len() > MAX_BLOCK_SAMPLES {
        return Err("oversized");
    }
    Ok(Task::Beats(beats.onsets_ns.into_iter().map(EventTime).collect()))
}

fn task(message: &Message, channel: usize) -> Result<Task, &'static str> {
    let block: PressureBlock = decode(&message.payload, message.encoding).map_err(|error| refusal(&error))?;
    if block.values.len() > MAX_BLOCK_SAMPLES {
        return Err("oversized");
    }
    let last = block.flags & FLAG_LAST_BLOCK != 0;
    let samples = samples(&block).ok_or("malformed")?;
    Ok(Task::Samples { channel, sequence: block.sequence, last, samples })
}

/// Samples with their times; None if the block does not say when they were taken.
fn samples(block: &PressureBlock) -> Option<Vec<RawSample>> {
    let explicit = block.period_ns == 0;
    if explicit && block.values.len() > 1 && block.offsets_ns.len() != block.values.len() {
        return None;
    }
    if block.period_ns < 0 || (!explicit && !block.offsets_ns.is_empty()) {
        return None;
    }
    let offset = |i: usize| -> Option<i64> {
        if explicit {
            Some(block.offsets_ns.get(i).copied().unwrap_or(0))
        } else {
            block.period_ns.checked_mul(i64::try_from(i).ok()?)
        }
    };
    let sample = |(i, value): (usize, &f64)| {
        let time = EventTime(block.start_ns.checked_add(offset(i)?)?);
        Some(RawSample { time, value: *value })
    };
    block.values.iter().enumerate().map(sample).collect()
}

/// Listens to the pressures of all beds and to those who acknowledge alarms, and to beats where these are told. `recent`
/// remembers the pressures.
///
/// # Errors
/// When the bus does not take the subscription.
pub fn listen(
    bus: &dyn Bus,
    config: &Config,
    inlet: Inlet,
    recent: Arc<Recent>,
) -> Result<Vec<Subscription>, BusError> {
    let decoder = Decoder::new(config);
    let prefix = &config.publish.prefix;
    let mut patterns = vec![format!("{prefix}/*/pressure/*"), format!("{prefix}/*/acknowledge")];
    if decoder.told {
        patterns.push(format!("{prefix}/*/beat"));
    }
    let take: Handler = Arc::new(move |message| {
        if let Some(event) = decoder.event(&message) {
            inlet.offer(event);
        }
        if recent.is_wanted()
            && let Some(sequence) = decoder.sequence(&message)
        {
            recent.keep(&message.key, sequence, message.encoding, message.payload.into());
        }
    });
    patterns.iter().map(|pattern| bus.subscribe(pattern, Arc::clone(&take))).collect()
}
