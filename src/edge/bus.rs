//! A publish/subscribe bus, small enough to have two implementations: zenoh and this process's memory.
//!
//! Handlers are called on a thread of the bus and must not block: they hand the message to a bounded queue of
//! their own and count what does not fit.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use zenoh::key_expr::keyexpr;

/// How the payload of a message is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Encoding {
    /// Bincode 2, fixed-size little-endian integers; see [`wire`](crate::edge::wire).
    Bincode,
    /// JSON of the same content.
    Json,
}

/// A payload under a key.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Message {
    /// Full key, for example `hemostream/bed1/pressure/p_a`.
    pub key: String,
    /// How `payload` is written.
    pub encoding: Encoding,
    /// The bytes.
    pub payload: Vec<u8>,
}

/// What a message is worth when the network is busy.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Delivery {
    /// Raw pressures: at once, dropped under congestion.
    Samples,
    /// Estimates and status: high priority, dropped under congestion.
    Estimates,
    /// Events: not dropped; publishing may block for a while.
    Events,
}

/// The bus could not do what was asked.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum BusError {
    /// A key or pattern that the bus does not accept.
    #[error("`{key}` is not a valid key: {reason}")]
    Key {
        /// The key as given.
        key: String,
        /// What the bus said.
        reason: String,
    },
    /// The connection cannot be opened or does not work.
    #[error("transport: {0}")]
    Transport(String),
}

/// Called for every message; must not block.
pub type Handler = Arc<dyn Fn(Message) + Send + Sync>;

/// Answers a request for the last values under a pattern.
pub type LastValues = Arc<dyn Fn(&str) -> Vec<Message> + Send + Sync>;

/// Ends a subscription (or an answering service) when dropped.
pub struct Subscription {
    _guard: Box<dyn std::any::Any + Send + Sync>,
}

impl Subscription {
    /// Wraps whatever undeclares the subscription on drop.
    pub fn new(guard: impl std::any::Any + Send + Sync) -> Self {
        Self { _guard: Box::new(guard) }
    }
}

/// The bus.
pub trait Bus: Send + Sync {
    /// Publishes a message.
    ///
    /// # Errors
    /// When the key is invalid or the transport is closed. Congestion is not an error.
    fn publish(&self, message: Message, delivery: Delivery) -> Result<(), BusError>;

    /// Whether there is a link to anybody else; true where there is nothing to be linked.
    fn is_connected(&self) -> bool {
        true
    }

    /// Whether anyone subscribes to `key` now; true where the bus cannot know.
    fn is_wanted(&self, key: &str) -> bool;

    /// Calls `handler` for every message whose key matches `pattern` (`*` one chunk, `**` any number).
    ///
    /// # Errors
    /// When the pattern is invalid or the transport is closed.
    fn subscribe(&self, pattern: &str, handler: Handler) -> Result<Subscription, BusError>;

    /// Offers last values to late joiners.
    ///
    /// # Errors
    /// When the pattern is invalid or the transport is closed.
    fn offer_last_values(&self, pattern: &str, answer: LastValues) -> Result<Subscription, BusError>;

    /// Asks whoever offers them for the last values under `pattern`; waits at most `timeout`.
    ///
    /// # Errors
    /// When the pattern is invalid or the transport is closed.
    fn last_values(&self, pattern: &str, timeout: Duration) -> Result<Vec<Message>, BusError>;
}

/// Whether `key` matches `pattern`; both must be valid zenoh key expressions.
#[must_use]
pub fn matches(pattern: &str, key: &str) -> bool {
    match (keyexpr::new(pattern), keyexpr::new(key)) {
        (Ok(pattern), Ok(key)) => pattern.intersects(key),
        _ => false,
    }
}

pub(crate) fn check_key(key: &str) -> Result<(), BusError> {
    keyexpr::new(key).map(|_| ()).map_err(|error| BusError::Key { key: key.to_owned(), reason: error.to_string() })
}

/// Handlers of a [`MemoryBus`].
#[derive(Default)]
struct Registry {
    next_id: u64,
    subscribers: Vec<(u64, String, Handler)>,
    answers: Vec<(u64, String, LastValues)>,
}

/// A bus within this process: synchronous, ordered, lossless. For tests and for embedding.
#[derive(Clone, Default)]
pub struct MemoryBus {
    registry: Arc<Mutex<Registry>>,
}

/// Removes one handler on drop.
struct Unregister {
    registry: Arc<Mutex<Registry>>,
    id: u64,
}

impl Drop for Unregister {
    fn drop(&mut self) {
        let mut registry = self.registry.lock().unwrap_or_else(PoisonError::into_inner);
        registry.subscribers.retain(|(id, ..)| *id != self.id);
        registry.answers.retain(|(id, ..)| *id != self.id);
    }
}

impl MemoryBus {
    /// An empty bus; clones share it.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    fn with<T>(&self, f: impl FnOnce(&mut Registry) -> T) -> T {
        f(&mut self.registry.lock().unwrap_or_else(PoisonError::into_inner))
    }

    fn register(&self, f: impl FnOnce(&mut Registry, u64)) -> Subscription {
        let id = self.with(|registry| {
            registry.next_id += 1;
            let id = registry.next_id;
            f(registry, id);
            id
        });
        Subscription::new(Unregister { registry: Arc::clone(&self.registry), id })
    }
}

impl Bus for MemoryBus {
    fn publish(&self, message: Message, _: Delivery) -> Result<(), BusError> {
        check_key(&message.key)?;
        // Handlers run outside the lock: they may publish or subscribe themselves.
        let handlers: Vec<Handler> = self.with(|registry| {
            let matching = registry.subscribers.iter().filter(|(_, pattern, _)| matches(pattern, &message.key));
            matching.map(|(.., handler)| Arc::clone(handler)).collect()
        });
        for handler in handlers {
            handler(message.clone());
        }
        Ok(())
    }

    fn is_wanted(&self, key: &str) -> bool {
        self.with(|registry| registry.subscribers.iter().any(|(_, pattern, _)| matches(pattern, key)))
    }

    fn subscribe(&self, pattern: &str, handler: Handler) -> Result<Subscription, BusError> {
        check_key(pattern)?;
        Ok(self.register(|registry, id| registry.subscribers.push((id, pattern.to_owned(), handler))))
    }

    fn offer_last_values(&self, pattern: &str, answer: LastValues) -> Result<Subscription, BusError> {
        check_key(pattern)?;
        Ok(self.register(|registry, id| registry.answers.push((id, pattern.to_owned(), answer))))
    }

    fn last_values(&self, pattern: &str, _: Duration) -> Result<Vec<Message>, BusError> {
        check_key(pattern)?;
        let answers: Vec<LastValues> = self.with(|registry| {
            let matching = registry.answers.iter().filter(|(_, offered, _)| matches(offered, pattern));
            matching.map(|(.., answer)| Arc::clone(answer)).collect()
        });
        Ok(answers.iter().flat_map(|answer| answer(pattern)).collect())
    }
}
