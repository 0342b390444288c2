//! The newest messages of a daemon, for those who missed some.
//!
//! Samples and estimates are dropped on the way to a subscriber when the network is busy, and sequence numbers tell the
//! subscriber so. The daemon remembers for a while what it got and what it said, and answers requests (a `get`) under
//!
//! ```text
//! PREFIX/BED/recent/TOPIC/FROM/TO      sequence numbers, both included
//! PREFIX/BED/recent/TOPIC/FROM/end     those from this one on
//! ```
//!
//! with the messages as they were, one reply each, all under the key of the request, in order. Who asks for `FROM/TO` got
//! `TO + 1`, and who asks for the end got `FROM - 1`: these numbers say which run of a sender is meant that has begun again
//! since. (`TO + 1` may have got to who asks a moment before it gets here.) Nothing is said to requests that are not
//! understood, and of messages that never came or are forgotten.
//!
//! Remembering is a tenth of all that a daemon does, so that it does so for those only who say under `PREFIX/recorder`,
//! once a second, that they are there.
//!
//! Deliberately absent: history. What is kept is bounded by age and bytes, the oldest goes first.

use std::collections::{HashMap, VecDeque};
use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use super::bus::{Bus, BusError, Encoding, Message, Subscription};
use crate::runtime::clock::Clock;

/// Most messages that one request may ask for.
pub const MAX_ASKED: u64 = 4096;

/// Most messages that are said to who asks for the end.
pub const MAX_END: u64 = 256;

/// What is remembered, at most. A hundred beds with three channels at 125 Hz and estimates at 50 Hz are 13 MB/s.
const BOUNDS: Bounds = Bounds { age_ns: 10_000_000_000, bytes: 64 << 20, bytes_per_key: 8 << 20, keys: 16_384 };

/// What an entry takes besides its payload \[bytes\].
const OVERHEAD: usize = 96;

/// Which messages somebody missed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Request {
    /// Their key, `PREFIX/BED/TOPIC`.
    pub key: String,
    /// Sequence number of the first.
    pub from: u64,
    /// That of the last; None for those that there are.
    pub to: Option<u64>,
}

impl Request {
    /// Key to ask under; None if the messages are not those of a bed under `prefix`.
    #[must_use]
    pub fn pattern(&self, prefix: &str) -> Option<String> {
        let (bed, topic) = self.key.strip_prefix(prefix)?.strip_prefix('/')?.split_once('/')?;
        let to = self.to.map_or_else(|| "end".to_owned(), |to| to.to_string());
        Some(format!("{prefix}/{bed}/recent/{topic}/{}/{to}", self.from))
    }

    /// The request of a key that somebody asks under.
    fn parse(prefix: &str, asked: &str) -> Option<Self> {
        let (bed, rest) = asked.strip_prefix(prefix)?.strip_prefix('/')?.split_once('/')?;
        let (rest, to) = rest.strip_prefix("recent/")?.rsplit_once('/')?;
        let (topic, from) = rest.rsplit_once('/')?;
        let from = from.parse().ok()?;
        let to = if to == "end" { None } else { Some(to.parse().ok()?) };
        let is_bounded = to.is_none_or(|to: u64| to.checked_sub(from).is_some_and(|more| more < MAX_ASKED));
        is_bounded.then(|| Self { key: format!("{prefix}/{bed}/{topic}"), from, to })
    }
}

/// Whether somebody who asks under this key means recent messages, and not last values.
#[must_use]
pub fn is_request(prefix: &str, asked: &str) -> bool {
    let rest = asked.strip_prefix(prefix).and_then(|rest| rest.strip_prefix('/'));
    rest.and_then(|rest| rest.split_once('/')).is_some_and(|(_, topic)| topic.starts_with("recent/"))
}

/// Bytes that several may hold on to.
pub type Payload = Arc<[u8]>;

/// Key under which those who may ask say that they are there.
#[must_use]
pub fn presence(prefix: &str) -> String {
    format!("{prefix}/recorder")
}

/// Time between two such messages, and time after which who says nothing is gone.
pub const PRESENT_EVERY: Duration = Duration::from_secs(1);
const GONE_AFTER_NS: i64 = 10_000_000_000;

/// Time for which a daemon that starts takes somebody to be there: who is has said so by then.
const FIRST_NS: i64 = 2_000_000_000;

/// Remembers; may be fed and asked from any thread.
pub struct Recent {
    clock: Clock,
    /// Until when somebody may ask \[ns\].
    wanted_until_ns: AtomicI64,
    is_empty: AtomicBool,
    memory: Mutex<Memory>,
}

impl Recent {
    /// Remembers nothing yet.
    #[must_use]
    pub fn start() -> Arc<Self> {
        Self::wanted_for(FIRST_NS)
    }

    fn wanted_for(time_ns: i64) -> Arc<Self> {
        let clock = Clock::start();
        Arc::new(Self {
            clock,
            wanted_until_ns: AtomicI64::new(clock.now().0.saturating_add(time_ns)),
            is_empty: AtomicBool::new(true),
            memory: Mutex::new(Memory::new(BOUNDS)),
        })
    }

    /// Whether somebody may ask; forgets everything once nobody does.
    pub fn is_wanted(&self) -> bool {
        let is_wanted = self.clock.now().0 < self.wanted_until_ns.load(Ordering::Relaxed);
        if !is_wanted && !self.is_empty.swap(true, Ordering::Relaxed) {
            *self.lock() = Memory::new(BOUNDS);
        }
        is_wanted
    }

    fn lock(&self) -> MutexGuard<'_, Memory> {
        self.memory.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Remembers a message, if it is wanted.
    pub fn keep(&self, key: &str, sequence: u64, encoding: Encoding, payload: Payload) {
        if !self.is_wanted() {
            return;
        }
        self.is_empty.store(false, Ordering::Relaxed);
        self.lock().keep(key, Remembered { sequence, encoding, payload }, self.clock.now().0);
    }

    /// Answers requests under `prefix`, and hears who may ask, for as long as the subscriptions live.
    ///
    /// # Errors
    /// When the bus does not take them.
    pub fn offer(self: &Arc<Self>, bus: &dyn Bus, prefix: &str) -> Result<[Subscription; 2], BusError> {
        let (recent, own) = (Arc::clone(self), prefix.to_owned());
        let answers =
            bus.offer_last_values(&format!("{prefix}/*/recent/**"), Arc::new(move |asked| recent.answer(&own, asked)))?;
        let recent = Arc::clone(self);
        let hear = move |_: Message| {
            recent.wanted_until_ns.store(recent.clock.now().0.saturating_add(GONE_AFTER_NS), Ordering::Relaxed);
        };
        Ok([answers, bus.subscribe(&presence(prefix), Arc::new(hear))?])
    }

    fn answer(&self, prefix: &str, asked: &str) -> Vec<Message> {
        let Some(request) = Request::parse(prefix, asked) else { return Vec::new() };
        let found = self.lock().find(&request);
        // Copied outside the lock, which those who feed wait for.
        let message =
            |m: Remembered| Message { key: asked.to_owned(), encoding: m.encoding, payload: m.payload.to_vec() };
        found.into_iter().map(message).collect()
    }
}

/// Limits of a [`Memory`].
#[derive(Debug, Clone, Copy)]
struct Bounds {
    age_ns: i64,
    bytes: usize,
    bytes_per_key: usize,
    keys: usize,
}

#[derive(Debug, Clone, PartialEq, Eq)]
struct Remembered {
    sequence: u64,
    encoding: Encoding,
    payload: Payload,
}

/// A message in the order of all, the oldest first.
struct Entry {
    key: Arc<str>,
    at_ns: i64,
    /// None if it had to go before its time because of its own key.
    message: Option<Remembered>,
}

/// Entries of a key by their numbers, the oldest first.
#[derive(Default)]
struct Ring {
    entries: VecDeque<u64>,
    bytes: usize,
}

/// Knows no clock and no bus.
struct Memory {
    bounds: Bounds,
    entries: VecDeque<Entry>,
    /// Number of the oldest entry.
    first: u64,
    rings: HashMap<Arc<str>, Ring>,
    bytes: usize,
}

impl Memory {
    fn new(bounds: Bounds) -> Self {
        Self { bounds, entries: VecDeque::new(), first: 0, rings: HashMap::new(), bytes: 0 }
    }

    fn keep(&mut self, key: &str, message: Remembered, now_ns: i64) {
        let key = match self.rings.get_key_value(key) {
            Some((key, _)) => Arc::clone(key),
            None if self.rings.len() >= self.bounds.keys => return,
            None => Arc::from(key),
        };
        let number = self.first + self.entries.len() as u64;
        let length = message.payload.len();
        let ring = self.rings.entry(Arc::clone(&key)).or_default();
        ring.entries.push_back(number);
        ring.bytes += length;
        self.bytes += length + OVERHEAD;
        self.entries.push_back(Entry { key: Arc::clone(&key), at_ns: now_ns, message: Some(message) });
        self.shorten(&key);
        let is_over = |memory: &Self| {
            let is_old = |oldest: &Entry| now_ns.saturating_sub(oldest.at_ns) > memory.bounds.age_ns;
            memory.bytes > memory.bounds.bytes || memory.entries.front().is_some_and(is_old)
        };
        while is_over(self) && !self.entries.is_empty() {
            self.forget_oldest();
        }
    }

    /// Takes the oldest of a key that has too much; their places are left until it is their turn.
    fn shorten(&mut self, key: &str) {
        let Some(ring) = self.rings.get_mut(key) else { return };
        while ring.bytes > self.bounds.bytes_per_key {
            let Some(number) = ring.entries.pop_front() else { return };
            let entry = self.entries.get_mut(place(number, self.first));
            let length = entry.and_then(|entry| entry.message.take()).map_or(0, |m| m.payload.len());
            ring.bytes -= length;
            self.bytes -= length;
        }
    }

    fn forget_oldest(&mut self) {
        let Some(entry) = self.entries.pop_front() else { return };
        self.first += 1;
        self.bytes -= OVERHEAD;
        let Some(ring) = self.rings.get_mut(&entry.key) else { return };
        if let Some(message) = entry.message {
            ring.entries.pop_front();
            ring.bytes -= message.payload.len();
            self.bytes -= message.payload.len();
        }
        if ring.entries.is_empty() {
            self.rings.remove(&entry.key);
        }
    }

    /// What is asked for, in order, of the newest run that the one who asks can mean.
    fn find(&self, request: &Request) -> Vec<Remembered> {
        let Some(ring) = self.rings.get(request.key.as_str()) else { return Vec::new() };
        let newest_first = ring.entries.iter().rev();
        let messages = newest_first.filter_map(|n| self.entries.get(place(*n, self.first))?.message.as_ref());
        let found = match request.to {
            Some(to) => before(messages, request.from, to),
            None => after(messages, request.from),
        };
        found.into_iter().rev().cloned().collect()
    }
}

fn place(number: u64, first: u64) -> usize {
    usize::try_from(number.saturating_sub(first)).unwrap_or(usize::MAX)
}

/// Of the newest run that has the message after `to`, or may be about to have it: those from `from` to `to`, the newest
/// first. A run ends where a number is greater than the one that came after it.
fn before<'a>(newest_first: impl Iterator<Item = &'a Remembered>, from: u64, to: u64) -> Vec<&'a Remembered> {
    let mut newest_first = newest_first.peekable();
    let mut is_meant = newest_first.peek().is_some_and(|newest| (from..=to).contains(&newest.sequence));
    let (mut found, mut later) = (Vec::new(), u64::MAX);
    for message in newest_first {
        if message.sequence > later {
            if is_meant {
                break;
            }
            found.clear();
        }
        is_meant |= to.checked_add(1) == Some(message.sequence);
        if (from..=to).contains(&message.sequence) && message.sequence != later {
            found.push(message);
        }
        later = message.sequence;
    }
    if is_meant { found } else { Vec::new() }
}

/// Of the newest run, if it has the message before `from`: those from `from` on, the newest first.
fn after<'a>(newest_first: impl Iterator<Item = &'a Remembered>, from: u64) -> Vec<&'a Remembered> {
    let (mut found, mut later) = (Vec::new(), u64::MAX);
    for message in newest_first {
        if message.sequence > later {
            break;
        }
        if message.sequence.checked_add(1) == Some(from) {
            let too_many = found.len().saturating_sub(usize::try_from(MAX_END).unwrap_or(usize::MAX));
            return found.split_off(too_many);
        }
        if message.sequence != later {
            found.push(message);
        }
        later = message.sequence;
    }
    Vec::new()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::edge::bus::{Delivery, MemoryBus};

    const SMALL: Bounds = Bounds { age_ns: 100, bytes: 10_000, bytes_per_key: 1000, keys: 3 };

    fn keep(memory: &mut Memory, key: &str, sequence: u64, length: usize, now_ns: i64) {
        let payload = vec![u8::try_from(sequence % 256).unwrap(); length].into();
        memory.keep(key, Remembered { sequence, encoding: Encoding::Bincode, payload }, now_ns);
    }

    fn found(memory: &Memory, key: &str, from: u64, to: Option<u64>) -> Vec<u64> {
        let found = memory.find(&Request { key: key.to_owned(), from, to });
        found.iter().map(|m| m.sequence).collect()
    }

    #[test]
    fn what_is_asked_for_is_found_in_order_and_nothing_else() {
        let mut memory = Memory::new(SMALL);
        for sequence in [3, 4, 6, 7, 8, 9] {
            keep(&mut memory, "a", sequence, 1, 0);
            keep(&mut memory, "b", sequence + 100, 1, 0);
        }
        assert_eq!(found(&memory, "a", 4, Some(7)), [4, 6, 7]);
        assert_eq!(found(&memory, "b", 108, Some(108)), [108]);
        assert_eq!(found(&memory, "a", 0, Some(2)), [0; 0]);
        assert_eq!(found(&memory, "a", 8, None), [8, 9]);
        assert_eq!(found(&memory, "a", 10, None), [0; 0]);
        assert_eq!(found(&memory, "c", 0, Some(9)), [0; 0]);
        // Who asks has the message after, which is on its way here at most.
        assert_eq!(found(&memory, "a", 8, Some(9)), [8, 9]);
        assert_eq!(found(&memory, "a", 7, Some(8)), [7, 8]);
        assert_eq!(found(&memory, "a", 10, Some(12)), [0; 0]);
        assert_eq!(found(&memory, "a", 4, Some(4)), [0; 0]);
    }

    #[test]
    fn the_run_that_is_meant_is_known_by_the_message_beside() {
        let mut memory = Memory::new(SMALL);
        for sequence in [0, 1, 2, 3, 4, 5, 2, 3, 3, 4] {
            keep(&mut memory, "a", sequence, 1, 0);
        }
        assert_eq!(found(&memory, "a", 0, Some(1)), [0; 0], "the newest run began at 2");
        assert_eq!(found(&memory, "a", 2, Some(3)), [2, 3]);
        assert_eq!(found(&memory, "a", 3, Some(4)), [3, 4], "before 5 of the run before");
        assert_eq!(found(&memory, "a", 4, None), [4]);
        assert_eq!(found(&memory, "a", 6, None), [0; 0]);
    }

    #[test]
    fn the_oldest_goes_by_age_by_bytes_and_by_key() {
        let mut memory = Memory::new(SMALL);
        for sequence in 0..20 {
            keep(&mut memory, "a", sequence, 100, 10 * sequence.cast_signed());
        }
        assert_eq!(found(&memory, "a", 0, Some(18)), (10..19).collect::<Vec<_>>(), "1000 bytes of a key");
        keep(&mut memory, "b", 0, 1, 290);
        assert_eq!(found(&memory, "a", 0, Some(18)), [0; 0], "older than 100 ns");
        assert_eq!(memory.entries.len(), 2);
        for sequence in 0..1000 {
            keep(&mut memory, ["b", "c"][sequence as usize % 2], sequence, 10, 300);
        }
        assert!(memory.bytes <= SMALL.bytes && memory.entries.len() > 90, "{} bytes", memory.bytes);
        let counted = memory.entries.iter().map(|e| OVERHEAD + e.message.as_ref().map_or(0, |m| m.payload.len()));
        assert_eq!(memory.bytes, counted.sum::<usize>());
        keep(&mut memory, "d", 0, 1, 300);
        keep(&mut memory, "e", 0, 1, 300);
        assert_eq!((memory.rings.len(), memory.rings.contains_key("e")), (3, false));
        keep(&mut memory, "d", 1, 100_000, 300);
        assert!(memory.bytes <= SMALL.bytes && memory.rings.values().all(|ring| ring.bytes <= SMALL.bytes_per_key));
    }

    #[test]
    fn requests_come_back_and_others_are_not_answered() {
        let asked = |from, to| Request { key: "some/ward/bed1/estimate/state".to_owned(), from, to };
        for request in [asked(0, Some(0)), asked(7, None), asked(5, Some(4100))] {
            let pattern = request.pattern("some/ward").unwrap();
            assert!(is_request("some/ward", &pattern));
            assert_eq!(Request::parse("some/ward", &pattern), Some(request));
        }
        assert_eq!(asked(7, Some(9)).pattern("some/ward").unwrap(), "some/ward/bed1/recent/estimate/state/7/9");
        for malformed in [
            "p/bed1/recent/estimate/state/9/7",
            "p/bed1/recent/estimate/state/0/4096",
            "p/bed1/recent/estimate/state/x/7",
            "p/bed1/recent/7/9",
            "p/bed1/recent/**",
            "p/bed1/estimate/state/7/9",
            "q/bed1/recent/estimate/state/7/9",
            "p/**",
        ] {
            assert_eq!(Request::parse("p", malformed), None, "{malformed}");
        }
        assert!(["p/**", "p/bed1/estimate/state", "p/*/status", "p/recent/status"].iter().all(|k| !is_request("p", k)));
    }

    #[test]
    fn answers_are_the_messages_under_the_key_of_the_request() {
        let (bus, recent) = (MemoryBus::new(), Recent::wanted_for(0));
        let offered = recent.offer(&bus, "p").unwrap();
        recent.keep("p/bed1/pressure/ART", 1, Encoding::Json, vec![b'0'].into());
        assert!(!recent.is_wanted(), "nobody is there");
        let present = Message { key: presence("p"), encoding: Encoding::Bincode, payload: Vec::new() };
        bus.publish(present, Delivery::Events).unwrap();
        assert!(recent.is_wanted());
        for sequence in 0..4 {
            recent.keep("p/bed1/pressure/ART", sequence, Encoding::Json, vec![b'0'; 1 + sequence as usize].into());
        }
        let ask = |key: &str| bus.last_values(key, Duration::ZERO).unwrap();
        let key = "p/bed1/recent/pressure/ART/1/2";
        let message = |n| Message { key: key.to_owned(), encoding: Encoding::Json, payload: vec![b'0'; n] };
        assert_eq!(ask(key), [message(2), message(3)]);
        for other in ["p/**", "p/*/recent/**", "p/bed1/recent/pressure/*/1/2", "p/bed2/recent/pressure/ART/1/2"] {
            assert_eq!(ask(other), [], "{other}");
        }
        drop(offered);
        assert_eq!(ask(key), []);
    }
}
