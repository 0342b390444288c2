//! From the bus to a dashboard: a bounded queue, last values first.
//!
//! A dashboard subscribes to what it shows and no more, so that neither JSON twins nor whole ensembles are sent on its
//! account.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::SyncSender;
use std::time::Duration;

use crate::edge::bus::{Bus, BusError, Handler, Message, Subscription};

/// What is shown, under `PREFIX/BED/`.
const TOPICS: [&str; 9] = [
    "pressure/*",
    "estimate/state",
    "estimate/parameters",
    "estimate/beat",
    "truth",
    "status",
    "event",
    "alarm",
    "note",
];
/// What tells how the daemon does.
const HEALTH_TOPICS: [&str; 4] = ["estimate/beat", "status", "event", "alarm"];
/// Messages between the bus and a dashboard; more are dropped and counted.
pub(super) const QUEUE: usize = 16_384;
const LAST_VALUES_TIMEOUT: Duration = Duration::from_secs(1);

/// Which topics are listened to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Topics {
    /// All that a picture shows.
    All,
    /// What tells how the daemon and the patients do, without waveforms.
    Health,
}

impl Topics {
    fn names(self) -> &'static [&'static str] {
        match self {
            Self::All => &TOPICS,
            Self::Health => &HEALTH_TOPICS,
        }
    }
}

/// Subscribes to the beds under `prefix`; what does not fit into the queue is counted.
pub(super) fn subscribe(
    bus: &dyn Bus,
    prefix: &str,
    topics: Topics,
    sender: &SyncSender<Message>,
    dropped: &Arc<AtomicU64>,
) -> Result<Vec<Subscription>, BusError> {
    let handler: Handler = {
        let (sender, dropped) = (sender.clone(), Arc::clone(dropped));
        Arc::new(move |message| {
            if sender.try_send(message).is_err() {
                dropped.fetch_add(1, Ordering::Relaxed);
            }
        })
    };
    topics.names().iter().map(|topic| bus.subscribe(&format!("{prefix}/*/{topic}"), Arc::clone(&handler))).collect()
}

/// Asks for the last values; nothing if nobody answers in time.
pub(super) fn last_values(bus: &dyn Bus, prefix: &str) -> Vec<Message> {
    bus.last_values(&format!("{prefix}/**"), LAST_VALUES_TIMEOUT).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::sync_channel;

    use super::*;
    use crate::edge::bus::{Delivery, Encoding, MemoryBus};

    #[test]
    fn nobody_makes_twins_or_ensembles_for_a_watcher_and_a_full_queue_is_counted() {
        let (bus, dropped) = (MemoryBus::new(), Arc::new(AtomicU64::new(0)));
        let (sender, receiver) = sync_channel(2);
        let subscriptions = subscribe(&bus, "some/ward", Topics::All, &sender, &dropped).unwrap();
        for wanted in TOPICS.iter().filter(|t| !t.contains('*')).chain(&["pressure/p_a"]) {
            assert!(bus.is_wanted(&format!("some/ward/bed1/{wanted}")), "{wanted}");
        }
        for unwanted in ["estimate/state/json", "estimate/members", "status/json"] {
            assert!(!bus.is_wanted(&format!("some/ward/bed1/{unwanted}")), "{unwanted}");
        }
        let message = Message { key: "some/ward/bed1/status".to_owned(), encoding: Encoding::Bincode, payload: vec![] };
        for _ in 0..5 {
            bus.publish(message.clone(), Delivery::Estimates).unwrap();
        }
        assert_eq!((receiver.try_iter().count(), dropped.load(Ordering::Relaxed)), (2, 3));
        drop(subscriptions);
        assert!(!bus.is_wanted("some/ward/bed1/status"));
    }
}
