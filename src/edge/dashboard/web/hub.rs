//! What all pages share: the ward, and the way to the bus.

use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::time::Duration;

use super::super::feed::{self, QUEUE, Topics};
use super::super::ward::{Memory, Ward};
use crate::edge::bus::{Bus, BusError, Message};
use crate::edge::config::Config;
use crate::runtime::clock::Clock;

/// Two minutes of 50 beds at 50 rows a second: about 150 MB with samples and truth.
const MEMORY: Memory = Memory { history_s: 120, rows: 300_000 };
/// Messages taken in while the ward is locked.
const BATCH: usize = 256;
/// Time between two attempts to reach the daemon, and between two looks whether to stop.
const RETRY: Duration = Duration::from_millis(500);
const LOOK: Duration = Duration::from_millis(100);

/// Opens the bus; called again until it succeeds.
pub type Connect = Box<dyn Fn() -> Result<Arc<dyn Bus>, BusError> + Send>;

/// The ward behind a lock, and the bus once it is reached.
pub(super) struct Hub {
    topics: Topics,
    ward: Mutex<Ward>,
    clock: Clock,
    bus: OnceLock<Arc<dyn Bus>>,
    dropped: Arc<AtomicU64>,
    stop: AtomicBool,
    /// Pages that are open.
    pub(super) pages: AtomicUsize,
}

impl Hub {
    pub(super) fn new(config: &Config, topics: Topics) -> Self {
        Self {
            topics,
            ward: Mutex::new(Ward::of(config, MEMORY)),
            clock: Clock::start(),
            bus: OnceLock::new(),
            dropped: Arc::default(),
            stop: AtomicBool::new(false),
            pages: AtomicUsize::new(0),
        }
    }

    /// Time since the start.
    pub(super) fn now(&self) -> Duration {
        Duration::from_nanos(self.clock.now().0.unsigned_abs())
    }

    /// Looks at the ward; nothing slow may happen in `look`.
    pub(super) fn with_ward<T>(&self, look: impl FnOnce(&Ward) -> T) -> T {
        look(&self.ward.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// The bus, once it is reached.
    pub(super) fn bus(&self) -> Option<&Arc<dyn Bus>> {
        self.bus.get()
    }

    /// Whether there is a page, rather than metrics and health alone.
    pub(super) fn has_page(&self) -> bool {
        self.topics == Topics::All
    }

    /// Whether the bus is reached at all.
    pub(super) fn has_bus(&self) -> bool {
        self.bus().is_some()
    }

    /// Whether there is a link to somebody on the bus.
    pub(super) fn is_connected(&self) -> bool {
        self.bus().is_some_and(|bus| bus.is_connected())
    }

    /// Messages that came faster than they were taken in.
    pub(super) fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }

    pub(super) fn stop(&self) {
        self.stop.store(true, Ordering::Relaxed);
    }

    fn is_stopping(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    /// Takes in what is on the bus until it is told to stop; a thread of its own runs it.
    pub(super) fn feed(&self, connect: &Connect) {
        let Some(bus) = self.reach(connect) else { return };
        let prefix = self.with_ward(|ward| ward.prefix().to_owned());
        let (sender, receiver) = sync_channel(QUEUE);
        let subscriptions = match feed::subscribe(bus.as_ref(), &prefix, self.topics, &sender, &self.dropped) {
            Ok(subscriptions) => subscriptions,
            Err(error) => {
                tracing::error!(%error, "the dashboard cannot subscribe");
                return;
            }
        };
        // What is older must come first.
        for message in feed::last_values(bus.as_ref(), &prefix) {
            self.ward.lock().unwrap_or_else(PoisonError::into_inner).apply_last_value(&message);
        }
        while !self.is_stopping() {
            self.take_messages(&receiver);
        }
        drop(subscriptions);
    }

    fn reach(&self, connect: &Connect) -> Option<Arc<dyn Bus>> {
        let mut told = false;
        while !self.is_stopping() {
            match connect() {
                Ok(bus) => {
                    let _ = self.bus.set(Arc::clone(&bus));
                    return Some(bus);
                }
                Err(error) if !told => {
                    told = true;
                    tracing::warn!(%error, "the daemon is not reached yet");
                }
                Err(_) => {}
            }
            std::thread::sleep(RETRY);
        }
        None
    }

    fn take_messages(&self, receiver: &Receiver<Message>) {
        let first = match receiver.recv_timeout(LOOK) {
            Ok(message) => message,
            Err(RecvTimeoutError::Timeout) => return,
            Err(RecvTimeoutError::Disconnected) => {
                self.stop();
                return;
            }
        };
        let now = self.now();
        let mut ward = self.ward.lock().unwrap_or_else(PoisonError::into_inner);
        for message in std::iter::once(first).chain(receiver.try_iter().take(BATCH - 1)) {
            ward.apply(&message, now);
        }
    }
}
