//! What an operator tells a running daemon: a note about a bed, or that an alarm was seen.
//!
//! Guarantees: a bed or an alarm that is not known is refused and nothing is published.
//! Deliberately absent: who the operator is and what they may do; an author is a name and no more.

use std::time::Duration;

use super::bus::{Bus, BusError, Delivery, Encoding, Message};
use super::wire::{self, Acknowledge, Alarm, Alarms, Note, SCHEMA, StateEstimate, WireError};
use crate::estimate::time::EventTime;

/// Longest wait for an answer of the daemon.
const PATIENCE: Duration = Duration::from_secs(3);

/// How often, and how many times, it is looked whether something has come through.
const LOOK_EVERY: Duration = Duration::from_millis(50);
const LOOKS: u32 = 40;

/// Longest note \[bytes\].
const MAX_TEXT: usize = 4096;

/// Longest name of an author \[bytes\].
pub const MAX_AUTHOR: usize = 256;

/// Why the daemon was not told.
#[derive(Debug, thiserror::Error)]
pub enum OperatorError {
    /// Not the name of a bed.
    #[error("bed: found {0:?}, expected a name without `/ * $ # ?`")]
    Bed(String),
    /// Nothing is known of the bed.
    #[error("bed: found \"{bed}\", of which nobody says anything under {key}; is the daemon there, and the bed?")]
    UnknownBed {
        /// The bed.
        bed: String,
        /// Where its estimates would be.
        key: String,
    },
    /// The bed has no such alarm.
    #[error("alarm: found \"{found}\", expected one of {}", .known.join(", "))]
    UnknownAlarm {
        /// What was asked for.
        found: String,
        /// Those of the bed.
        known: Vec<String>,
    },
    /// No alarm is configured.
    #[error("bed: found \"{0}\", of which no alarm is configured")]
    NoAlarms(String),
    /// Too little or too much text.
    #[error("{what}: found {found} bytes, expected {low} to {high}")]
    Length {
        /// Which.
        what: &'static str,
        /// Its length.
        found: usize,
        /// Shortest.
        low: usize,
        /// Longest.
        high: usize,
    },
    /// The daemon has not taken it.
    #[error("the acknowledgement was published and the daemon does not confirm it")]
    NotConfirmed,
    /// The bus.
    #[error(transparent)]
    Bus(#[from] BusError),
    /// An answer that cannot be understood.
    #[error(transparent)]
    Wire(#[from] WireError),
}

impl OperatorError {
    /// Whether it is the operator's input that is wrong.
    #[must_use]
    pub fn is_input(&self) -> bool {
        !matches!(self, Self::NotConfirmed | Self::Bus(_) | Self::Wire(_))
    }
}

/// The beds of a daemon, as an operator reaches them.
pub struct Operator<'a> {
    /// The bus that the daemon is on.
    pub bus: &'a dyn Bus,
    /// First chunks of its topics.
    pub prefix: &'a str,
    /// The bed.
    pub bed: &'a str,
}

impl Operator<'_> {
    /// Publishes a note about the bed, at its newest event time unless one is given; returns that time and whether
    /// anybody listens.
    ///
    /// # Errors
    /// When the bed is not known, the note is empty or too long, or the bus fails.
    pub fn note(&self, text: &str, author: &str, time: Option<EventTime>) -> Result<(EventTime, bool), OperatorError> {
        self.check()?;
        check_length("text", text, 1..=MAX_TEXT)?;
        check_length("author", author, 0..=MAX_AUTHOR)?;
        let newest = self.newest_time()?;
        let time = time.unwrap_or(newest);
        let note = Note { schema: SCHEMA, time_ns: time.0, author: author.to_owned(), text: text.to_owned() };
        let message = self.message("note", wire::encode(&note)?);
        let heard = self.looks(|| Ok(self.bus.is_wanted(&message.key)))?;
        self.bus.publish(message, Delivery::Events)?;
        Ok((time, heard))
    }

    /// Acknowledges alarms of the bed by their names, or without names all that wait now; returns those that nobody had seen
    /// before. One that is raised meanwhile stays unseen: each is acknowledged by its name.
    ///
    /// # Errors
    /// When the bed or the alarm is not known, the bus fails, or the daemon does not confirm it.
    pub fn acknowledge(&self, names: &[String], author: &str) -> Result<Vec<Alarm>, OperatorError> {
        self.check()?;
        check_length("author", author, 0..=MAX_AUTHOR)?;
        let Some(alarms) = self.alarms()? else {
            self.newest_time()?;
            return Err(OperatorError::NoAlarms(self.bed.to_owned()));
        };
        if let Some(found) = names.iter().find(|name| !alarms.iter().any(|alarm| alarm.name == **name)) {
            let known = alarms.iter().map(|alarm| alarm.name.clone()).collect();
            return Err(OperatorError::UnknownAlarm { found: found.clone(), known });
        }
        let waits = |a: &Alarm| {
            let unseen = (a.state == "active" && !a.acknowledged) || a.state == "latched";
            unseen && (names.is_empty() || names.contains(&a.name))
        };
        let unseen: Vec<Alarm> = alarms.into_iter().filter(&waits).collect();
        if unseen.is_empty() {
            return Ok(unseen);
        }
        for alarm in &unseen {
            let message = Acknowledge { schema: SCHEMA, alarm: alarm.name.clone(), author: author.to_owned() };
            self.bus.publish(self.message("acknowledge", wire::encode(&message)?), Delivery::Events)?;
        }
        // One that is raised anew meanwhile is another one.
        let still = |now: &[Alarm]| {
            now.iter().filter(|a| waits(a)).any(|a| unseen.iter().any(|b| a.name == b.name && a.since_ns == b.since_ns))
        };
        if self.looks(|| Ok(self.alarms()?.is_some_and(|now| !still(&now))))? {
            Ok(unseen)
        } else {
            Err(OperatorError::NotConfirmed)
        }
    }

    fn check(&self) -> Result<(), OperatorError> {
        if self.bed.is_empty() || self.bed.contains(['/', '*', '$', '#', '?']) {
            return Err(OperatorError::Bed(self.bed.to_owned()));
        }
        Ok(())
    }

    fn message(&self, topic: &str, payload: Vec<u8>) -> Message {
        Message { key: self.key(topic), encoding: Encoding::Bincode, payload }
    }

    fn key(&self, topic: &str) -> String {
        format!("{}/{}/{topic}", self.prefix, self.bed)
    }

    /// Newest event time that the daemon has an estimate of.
    fn newest_time(&self) -> Result<EventTime, OperatorError> {
        let key = self.key("estimate/state");
        let mut newest = None;
        for message in self.bus.last_values(&key, PATIENCE)? {
            let state: StateEstimate = wire::decode(&message.payload, message.encoding)?;
            newest = newest.max(state.times_ns.last().copied());
        }
        newest.map(EventTime).ok_or(OperatorError::UnknownBed { bed: self.bed.to_owned(), key })
    }

    /// The alarms of the bed; None if nobody says anything of them.
    fn alarms(&self) -> Result<Option<Vec<Alarm>>, OperatorError> {
        let Some(message) = self.bus.last_values(&self.key("alarm"), PATIENCE)?.pop() else { return Ok(None) };
        Ok(Some(wire::decode::<Alarms>(&message.payload, message.encoding)?.alarms))
    }

    /// Looks a few times whether something has come through.
    fn looks(&self, mut is_there: impl FnMut() -> Result<bool, OperatorError>) -> Result<bool, OperatorError> {
        for _ in 0..LOOKS {
            if is_there()? {
                return Ok(true);
            }
            std::thread::sleep(LOOK_EVERY);
        }
        Ok(false)
    }
}

fn check_length(
    what: &'static str,
    text: &str,
    expected: std::ops::RangeInclusive<usize>,
) -> Result<(), OperatorError> {
    if expected.contains(&text.len()) {
        return Ok(());
    }
    Err(OperatorError::Length { what, found: text.len(), low: *expected.start(), high: *expected.end() })
}
