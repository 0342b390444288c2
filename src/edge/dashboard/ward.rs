//! What a dashboard knows: the beds heard so far and the recent past of each.
//!
//! Nothing here grows without a limit, whatever arrives: beds, rows, names and texts are capped, and what cannot
//! be understood is counted. Time is an argument.

use std::collections::BTreeMap;
use std::time::Duration;

use super::bed::{Bed, tame};
use super::history::Limits;
use crate::edge::bus::{Encoding, Message};
use crate::edge::config::Config;
use crate::edge::wire::{
    self, Alarms, BEAT_STATISTICS, BeatEstimate, Event, Note, PARAMETER_STATISTICS, ParameterEstimate, PressureBlock,
    STATE_STATISTICS, StateEstimate, Status, Truth,
};
use crate::model::cvsim6::Pressures;

/// Beds that are shown; further ones are counted.
pub(super) const MAX_BEDS: usize = 1000;

/// Characters of a name.
pub(super) const MAX_NAME: usize = 40;

const NS_PER_S: i64 = 1_000_000_000;
/// 8 ms, finer than a dot of the widest screen at a few seconds across.
const SPACING_NS: i64 = NS_PER_S / 125;

/// How much of the past of the waveforms is kept.
#[derive(Debug, Clone, Copy)]
pub(super) struct Memory {
    /// Longest past \[s\].
    pub(super) history_s: i64,
    /// Rows of all beds together; a row of all quantities takes about 300 bytes, truth included.
    pub(super) rows: usize,
}

/// All beds under a prefix.
#[derive(Debug)]
pub(super) struct Ward {
    prefix: String,
    memory: Memory,
    /// The pressure that each label of a channel stands for.
    labels: BTreeMap<String, usize>,
    pub(super) beds: BTreeMap<String, Bed>,
    /// Messages of the kinds shown here.
    pub(super) messages: u64,
    /// Of these, not understood.
    pub(super) unreadable: u64,
    /// Of these, from beds beyond [`MAX_BEDS`].
    pub(super) refused: u64,
}

/// A message that passed every check of its shape.
pub(super) enum Content {
    State(StateEstimate),
    Parameters(ParameterEstimate),
    Beat(BeatEstimate),
    Status(Status),
    Event(Event),
    Alarms(Alarms),
    Note(Note),
    Truth(Truth),
    Samples(usize, PressureBlock),
}

impl Content {
    /// `None` for topics that are not shown.
    fn read(topic: &str, message: &Message, labels: &BTreeMap<String, usize>) -> Option<Result<Self, ()>> {
        let Message { payload, encoding, .. } = message;
        if let Some(label) = topic.strip_prefix("pressure/") {
            let channel = *labels.get(label)?;
            return Some(wire::decode(payload, *encoding).map(|b| Self::Samples(channel, b)).map_err(drop));
        }
        if topic == "note" {
            return Some(wire::decode(payload, *encoding).map(Self::Note).map_err(drop));
        }
        if *encoding != Encoding::Bincode {
            return None;
        }
        let read = match topic {
            "estimate/state" => wire::decode(payload, *encoding).map(Self::State),
            "estimate/parameters" => wire::decode(payload, *encoding).map(Self::Parameters),
            "estimate/beat" => wire::decode(payload, *encoding).map(Self::Beat),
            "status" => wire::decode(payload, *encoding).map(Self::Status),
            "event" => wire::decode(payload, *encoding).map(Self::Event),
            "alarm" => wire::decode(payload, *encoding).map(Self::Alarms),
            "truth" => wire::decode(payload, *encoding).map(Self::Truth),
            _ => return None,
        };
        Some(read.ok().filter(Self::is_consistent).ok_or(()))
    }

    /// Whether the lengths of the tables agree.
    fn is_consistent(&self) -> bool {
        let product = |a: usize, b: usize| a.checked_mul(b);
        match self {
            Self::State(s) => {
                let cells = product(s.times_ns.len(), s.names.len()).and_then(|n| product(n, STATE_STATISTICS.len()));
                cells == Some(s.values.len()) && s.since_data_s.len() == s.times_ns.len() && !s.names.is_empty()
            }
            Self::Parameters(p) => product(p.names.len(), PARAMETER_STATISTICS.len()) == Some(p.values.len()),
            Self::Beat(b) => {
                product(b.names.len(), BEAT_STATISTICS.len()) == Some(b.values.len()) && b.units.len() == b.names.len()
            }
            Self::Truth(t) => t.names.len() == t.values.len(),
            Self::Samples(_, b) => b.offsets_ns.is_empty() || b.offsets_ns.len() == b.values.len(),
            Self::Status(_) | Self::Event(_) | Self::Alarms(_) | Self::Note(_) => true,
        }
    }
}

impl Ward {
    /// An empty ward; `prefix` is the common start of the keys.
    pub(super) fn new(prefix: &str, memory: Memory) -> Self {
        let prefix = prefix.trim_end_matches('/').to_owned();
        let labels = Pressures::NAMES.iter().enumerate().map(|(q, name)| ((*name).to_owned(), q)).collect();
        Self { prefix, memory, labels, beds: BTreeMap::new(), messages: 0, unreadable: 0, refused: 0 }
    }

    /// The ward of a daemon with this configuration: its topics, its labels.
    pub(super) fn of(config: &Config, memory: Memory) -> Self {
        let mut ward = Self::new(&config.publish.prefix, memory);
        for label in config.labels.keys() {
            let pressure = config.state_of_label(label).and_then(|state| ward.labels.get(state).copied());
            ward.labels.extend(pressure.map(|pressure| (label.clone(), pressure)));
        }
        ward
    }

    /// Takes in a message that arrived just now.
    pub(super) fn apply(&mut self, message: &Message, now: Duration) {
        self.take(message, Some(now));
    }

    /// Takes in a value from before: it is shown, but is no sign of life.
    pub(super) fn apply_last_value(&mut self, message: &Message) {
        self.take(message, None);
    }

    fn take(&mut self, message: &Message, arrival: Option<Duration>) {
        let below_prefix = message.key.strip_prefix(&self.prefix).and_then(|rest| rest.strip_prefix('/'));
        let Some((name, topic)) = below_prefix.and_then(|rest| rest.split_once('/')) else { return };
        let Some(content) = Content::read(topic, message, &self.labels) else { return };
        self.messages += 1;
        // Read before the bed is made: noise under a new name is no bed.
        let Ok(content) = content else {
            self.unreadable += 1;
            return;
        };
        let name = tame(name, MAX_NAME);
        if matches!(&content, Content::Event(event) if event.kind == wire::GONE) {
            self.beds.remove(&name);
            return;
        }
        let is_new = !self.beds.contains_key(&name);
        if is_new && self.beds.len() >= MAX_BEDS {
            self.refused += 1;
            return;
        }
        let beds = self.beds.len() + usize::from(is_new);
        self.beds.entry(name).or_default().take(content, arrival, self.memory.shared_by(beds));
    }

    /// The common start of the keys.
    pub(super) fn prefix(&self) -> &str {
        &self.prefix
    }
}

impl Memory {
    /// The limits of the waveforms of one bed, given how many share the memory.
    fn shared_by(self, beds: usize) -> Limits {
        let longest = usize::try_from(self.history_s * NS_PER_S / SPACING_NS).unwrap_or(usize::MAX);
        let rows = longest.min(self.rows / beds.max(1));
        Limits { age_ns: self.history_s * NS_PER_S, spacing_ns: SPACING_NS, rows }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::edge::wire::{Header, SCHEMA};

    #[test]
    fn a_bed_that_the_daemon_has_let_go_leaves() {
        let mut ward = Ward::new("icu", Memory { history_s: 10, rows: 100 });
        for kind in ["start", wire::GONE] {
            let header = Header { schema: SCHEMA, seed: 1, config_hash: 2, sequence: 0, time_ns: 0 };
            let (kind, channel, text) = (kind.to_owned(), String::new(), String::new());
            let payload = wire::encode(&Event { header, kind, channel, text }).unwrap();
            let message = Message { key: "icu/bed1/event".to_owned(), encoding: Encoding::Bincode, payload };
            ward.apply(&message, Duration::ZERO);
            assert_eq!(ward.beds.len(), usize::from(ward.messages == 1));
        }
    }

    #[test]
    fn samples_are_those_of_the_pressure_that_their_label_stands_for() {
        let sets = ["publish.prefix=icu".to_owned(), "labels.A1=p_pa".to_owned()];
        let config = Config::load_from(None, [], &sets).unwrap().0;
        let mut ward = Ward::of(&config, Memory { history_s: 10, rows: 100 });
        let block = PressureBlock {
            schema: SCHEMA,
            sequence: 0,
            start_ns: 0,
            period_ns: 8_000_000,
            offsets_ns: Vec::new(),
            values: vec![20.0],
            flags: 0,
        };
        let payload = wire::encode(&block).unwrap();
        for label in ["A1", "ABP", "ICP"] {
            let key = format!("icu/bed1/pressure/{label}");
            let message = Message { key, encoding: Encoding::Bincode, payload: payload.clone() };
            ward.apply(&message, Duration::ZERO);
        }
        let heard: Vec<bool> = ward.beds["bed1"].samples.iter().map(|s| s.newest_ns().is_some()).collect();
        let expected: Vec<bool> = Pressures::NAMES.iter().map(|name| ["p_a", "p_pa"].contains(name)).collect();
        assert_eq!(heard, expected);
    }
}
