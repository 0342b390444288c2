//! What an operator tells the daemon from a dashboard. The daemon may take seconds to answer: it happens beside the
//! screen, or beside the page.

use std::sync::mpsc::{Receiver, SyncSender};

use super::bed::event_time;
use crate::edge::bus::Bus;
use crate::edge::operator::{Operator, OperatorError};
use crate::estimate::time::EventTime;

/// Errands that may wait for the one under way; a further one is refused.
pub(super) const QUEUE: usize = 8;

/// Something to tell the daemon.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Errand {
    /// These alarms were seen; those raised meanwhile were not.
    Acknowledge { bed: String, alarms: Vec<String> },
    /// Something about a bed at an event time, or now.
    Note { bed: String, time: Option<EventTime>, text: String },
}

/// What has become of an errand, for people.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Outcome {
    pub(super) text: String,
    pub(super) is_failure: bool,
}

impl Errand {
    /// The bed that it is about.
    pub(super) fn bed(&self) -> &str {
        let (Self::Acknowledge { bed, .. } | Self::Note { bed, .. }) = self;
        bed
    }

    /// What is under way.
    pub(super) fn announcement(&self) -> String {
        match self {
            Self::Acknowledge { bed, alarms } => format!("acknowledging in {bed}: {} ...", alarms.join(", ")),
            Self::Note { bed, .. } => format!("sending a note about {bed} ..."),
        }
    }

    /// Runs it; takes as long as the daemon takes to answer, a few seconds at most.
    pub(super) fn run(&self, bus: &dyn Bus, prefix: &str, author: &str) -> Outcome {
        match self.tell(bus, prefix, author) {
            Ok(text) => Outcome { text, is_failure: false },
            Err(error) => Outcome { text: format!("failed: {error}"), is_failure: true },
        }
    }

    fn tell(&self, bus: &dyn Bus, prefix: &str, author: &str) -> Result<String, OperatorError> {
        match self {
            Self::Acknowledge { bed, alarms } => {
                let seen = Operator { bus, prefix, bed }.acknowledge(alarms, author)?;
                let names: Vec<&str> = seen.iter().map(|alarm| alarm.name.as_str()).collect();
                Ok(match names.join(", ") {
                    names if names.is_empty() => format!("nothing sent: no alarm of {bed} waits any more"),
                    names => format!("sent and confirmed by the daemon: {names} of {bed} acknowledged"),
                })
            }
            Self::Note { bed, time, text } => {
                let (time, heard) = Operator { bus, prefix, bed }.note(text, author, *time)?;
                let unheard = if heard { "" } else { "; nobody listens" };
                Ok(format!("sent: note about {bed} at {}{unheard}", event_time(time.0)))
            }
        }
    }
}

/// Runs errands until there will be no more, and says what has become of each.
pub(super) fn serve(
    bus: &dyn Bus,
    prefix: &str,
    author: &str,
    errands: &Receiver<Errand>,
    outcomes: &SyncSender<Outcome>,
) {
    for errand in errands {
        // A screen that takes none is gone.
        if outcomes.send(errand.run(bus, prefix, author)).is_err() {
            return;
        }
    }
}
