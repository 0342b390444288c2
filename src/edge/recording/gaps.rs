//! Messages that the network dropped, and the line in which the others wait for them.
//!
//! What arrives stands in line for a second, so that what was missed finds its place: sequence numbers show a gap, the
//! daemon is [asked](crate::edge::recent) for it, and the answer is spread over the time between the messages before and
//! after. A message stays in line for as long as something before it is asked for, [`PATIENCE_NS`] at most; what has not
//! come by then is lost. Messages leave in the order of their arrivals, all keys together.
//!
//! A number that went back is that of a sender that began again. What is before the first of a run may never have been
//! sent to us: it is asked for if it is little, and not missed. What is after the last is asked for once when a key has
//! gone quiet.
//!
//! Knows no clock and no bus: times and answers are arguments.

use std::collections::{BTreeMap, VecDeque};
use std::ops::RangeInclusive;

use crate::edge::bus::Message;
use crate::edge::recent::{self, MAX_ASKED, MAX_END};
use crate::estimate::time::NS_PER_S;

/// Longest wait for an answer, in arrivals \[ns\]. An answer is behind all that is on the way already, which is what a link
/// that drops has much of.
pub const PATIENCE_NS: i64 = 5_000_000_000;

/// Time in line where nothing is missing \[ns\].
const HOLD_NS: i64 = 1_000_000_000;

/// A key is quiet if nothing came for so long \[ns\], and for so many times the time between its last two messages.
const QUIET_NS: i64 = 500_000_000;
const QUIET_SPACINGS: i64 = 4;

/// Taken for the time between two messages where there was only one \[ns\].
const FIRST_SPACING_NS: i64 = 1_000_000_000;

/// Time between looks at what is over \[ns\]. Between two that are farther apart nobody listened, and silence means
/// nothing.
const LOOK_NS: i64 = 50_000_000;
const LONGEST_LOOK_NS: i64 = 250_000_000;

/// Most messages that are asked for before the first of a run: a recorder that came late does not ask.
const MAX_BEGINNING: u64 = 256;

/// What has been silent for so long \[ns\] is forgotten: keys come and go with patients.
pub const FORGET_NS: i64 = 3600 * NS_PER_S;

/// Keys whose numbers are followed, and gaps that are asked for at a time; what is beyond is lost at once.
const MAX_KEYS: usize = 16_384;
const MAX_GAPS: usize = 4096;

/// Messages in line and their bytes. Those in front leave when there are more, and nothing before them is waited for.
const MAX_LINE: usize = 1 << 18;
const MAX_LINE_BYTES: usize = 256 << 20;

/// What to ask the daemon for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Request {
    /// Names the answer.
    pub id: u64,
    /// What is missed.
    pub missed: recent::Request,
}

/// What is known of a sender under a key.
#[derive(Default)]
struct Run {
    newest: u64,
    /// Arrival of the newest, and time between it and the one before \[ns\].
    heard_ns: Option<i64>,
    spacing_ns: i64,
    /// Whether daemons remember its messages.
    is_kept: bool,
    /// What was there after the last one when the key was quiet, and may come by itself as well: a key is quiet also when
    /// the link is slow.
    returned: Option<RangeInclusive<u64>>,
    /// Gaps that are open, and that after the newest.
    gaps: Vec<u64>,
    end: Option<u64>,
    /// Whether what is after the newest has been asked for.
    is_end_asked: bool,
}

/// Messages that are missing between two others.
struct Gap {
    key: String,
    /// Their numbers; at the end of a run all that there may be.
    numbers: RangeInclusive<u64>,
    is_end: bool,
    /// Whether they are known to have been sent to us.
    is_missed: bool,
    /// Arrival of the message before and time from message to message \[ns\].
    after_ns: i64,
    step_ns: i64,
    /// Arrival before which nothing has to wait: from there on there is a place for each that nobody else takes.
    reserved_ns: i64,
    /// When it was seen.
    since_ns: i64,
    found: BTreeMap<u64, Message>,
}

impl Gap {
    fn count(&self) -> u64 {
        (self.numbers.end() - self.numbers.start()).saturating_add(1)
    }

    /// Where a message of it belongs: between its neighbours, and at its own place if they are too close.
    fn arrival(&self, sequence: u64) -> i64 {
        let i = (sequence - self.numbers.start()).cast_signed();
        let spread = self.after_ns.saturating_add(self.step_ns.saturating_mul(i + 1));
        if self.is_end { spread } else { spread.min(self.reserved_ns + i) }
    }
}

/// What a number says.
enum Sight {
    /// Nothing is missing before it.
    Next,
    /// A sender that began again, or one never seen.
    Begins,
    /// These are missing before it.
    Behind(RangeInclusive<u64>),
    /// It fills an open gap.
    Late(u64),
    /// It is there already.
    Again,
}

/// The line, and what is missing in it.
pub struct Gaps {
    /// By arrival.
    line: BTreeMap<i64, Message>,
    line_bytes: usize,
    runs: BTreeMap<String, Run>,
    open: BTreeMap<u64, Gap>,
    requests: VecDeque<Request>,
    next_id: u64,
    /// Time until which everything has been taken, and when was looked last.
    now_ns: i64,
    looked_ns: i64,
    /// Time since which somebody listens.
    awake_ns: i64,
    /// Latest arrivals given and left.
    last_ns: i64,
    left_ns: i64,
    is_ending: bool,
    lost: u64,
    recovered: u64,
}

impl Default for Gaps {
    fn default() -> Self {
        Self {
            line: BTreeMap::new(),
            line_bytes: 0,
            runs: BTreeMap::new(),
            open: BTreeMap::new(),
            requests: VecDeque::new(),
            next_id: 0,
            now_ns: i64::MIN,
            looked_ns: i64::MIN,
            awake_ns: i64::MIN,
            last_ns: i64::MIN,
            left_ns: i64::MIN,
            is_ending: false,
            lost: 0,
            recovered: 0,
        }
    }
}

impl Gaps {
    /// Messages that were sent to us and are lost.
    #[must_use]
    pub fn lost(&self) -> u64 {
        self.lost
    }

    /// Messages that came when they were asked for.
    #[must_use]
    pub fn recovered(&self) -> u64 {
        self.recovered
    }

    /// Whether an answer is waited for.
    #[must_use]
    pub fn is_waiting(&self) -> bool {
        !self.open.is_empty()
    }

    /// Takes a message that arrived \[ns\], with its number if it has one; `is_kept` says whether daemons remember it. No
    /// two messages get the same arrival: one that is not after the last gets the next nanosecond that is free.
    pub fn take(&mut self, message: Message, sequence: Option<u64>, is_kept: bool, arrival_ns: i64) {
        let mut arrival = arrival_ns.max(self.last_ns.saturating_add(1));
        if let Some(sequence) = sequence {
            // It tells itself what is after the newest.
            if let Some(run) = self.runs.get_mut(&message.key) {
                run.is_end_asked = false;
                if let Some(id) = run.end.take() {
                    self.open.remove(&id);
                }
            }
            match self.sight(&message.key, sequence) {
                Sight::Again => return,
                Sight::Late(id) => {
                    self.fill(id, sequence, message);
                    return;
                }
                Sight::Next => {}
                Sight::Begins => arrival = self.begin(&message.key, sequence, is_kept, arrival),
                Sight::Behind(numbers) => arrival = self.miss(&message.key, numbers, true, is_kept, arrival),
            }
            self.hear(&message.key, sequence, is_kept, arrival);
        }
        self.insert(arrival, message);
        self.advance(arrival_ns);
    }

    fn sight(&self, key: &str, sequence: u64) -> Sight {
        let Some(run) = self.runs.get(key) else {
            return if self.runs.len() < MAX_KEYS { Sight::Begins } else { Sight::Next };
        };
        if run.returned.as_ref().is_some_and(|returned| returned.contains(&sequence)) {
            return Sight::Again;
        }
        let misses = |id: &&u64| {
            self.open.get(id).is_some_and(|g| g.numbers.contains(&sequence) && !g.found.contains_key(&sequence))
        };
        if let Some(id) = run.gaps.iter().find(misses) {
            return Sight::Late(*id);
        }
        match sequence.checked_sub(run.newest) {
            None => Sight::Begins,
            Some(0 | 1) => Sight::Next,
            Some(_) => Sight::Behind(run.newest + 1..=sequence - 1),
        }
    }

    /// A run begins: the arrival of its first message, after places for those before it.
    fn begin(&mut self, key: &str, sequence: u64, is_kept: bool, arrival: i64) -> i64 {
        self.runs.insert(key.to_owned(), Run::default());
        match sequence {
            1..=MAX_BEGINNING => self.miss(key, 0..=sequence - 1, false, is_kept, arrival),
            _ => arrival,
        }
    }

    /// Asks for what is missing before a message: the arrival of that message, after places for them.
    fn miss(&mut self, key: &str, numbers: RangeInclusive<u64>, is_missed: bool, is_kept: bool, arrival: i64) -> i64 {
        let count = (numbers.end() - numbers.start()).saturating_add(1);
        if !is_kept || count > MAX_ASKED || self.open.len() >= MAX_GAPS {
            self.lost = self.lost.saturating_add(if is_missed { count } else { 0 });
            return arrival;
        }
        let count = count.cast_signed();
        let arrival = arrival.max(self.last_ns.saturating_add(count + 1));
        let before = self.runs.get(key).filter(|_| is_missed).and_then(|run| run.heard_ns);
        let after_ns = before.unwrap_or(arrival - count - 1);
        let gap = Gap {
            key: key.to_owned(),
            is_end: false,
            is_missed,
            after_ns,
            step_ns: arrival.saturating_sub(after_ns) / (count + 1),
            reserved_ns: arrival - count,
            since_ns: arrival,
            found: BTreeMap::new(),
            numbers,
        };
        let id = self.ask(gap);
        if let Some(run) = self.runs.get_mut(key) {
            run.gaps.push(id);
        }
        arrival
    }

    fn ask(&mut self, gap: Gap) -> u64 {
        let id = self.next_id;
        self.next_id += 1;
        let (from, to) = (*gap.numbers.start(), (!gap.is_end).then_some(*gap.numbers.end()));
        let missed = recent::Request { key: gap.key.clone(), from, to };
        self.requests.push_back(Request { id, missed });
        self.open.insert(id, gap);
        id
    }

    fn hear(&mut self, key: &str, sequence: u64, is_kept: bool, arrival: i64) {
        let Some(run) = self.runs.get_mut(key) else { return };
        run.gaps.retain(|id| self.open.contains_key(id));
        // Messages under a key keep their order: of those no more will come.
        run.returned = None;
        run.spacing_ns = run.heard_ns.map_or(FIRST_SPACING_NS, |heard| arrival.saturating_sub(heard));
        (run.newest, run.heard_ns, run.is_kept) = (sequence, Some(arrival), is_kept);
    }

    /// A message that was late rather than lost.
    fn fill(&mut self, id: u64, sequence: u64, message: Message) {
        let Some(gap) = self.open.get_mut(&id) else { return };
        gap.found.insert(sequence, message);
        if gap.found.len() as u64 == gap.count()
            && let Some(gap) = self.open.remove(&id)
        {
            self.settle(gap);
        }
    }

    fn insert(&mut self, arrival: i64, message: Message) {
        self.line_bytes += bytes(&message);
        self.line.insert(arrival, message);
        self.last_ns = self.last_ns.max(arrival);
    }

    /// What is to be asked for next.
    pub fn request(&mut self) -> Option<Request> {
        self.requests.pop_front()
    }

    /// Takes the answer to a request, messages with their numbers; what is not among them is lost.
    pub fn answer(&mut self, id: u64, messages: Vec<(u64, Message)>) {
        let Some(mut gap) = self.open.remove(&id) else { return };
        for (sequence, message) in messages {
            if gap.numbers.contains(&sequence) && !gap.found.contains_key(&sequence) {
                self.recovered += 1;
                gap.found.insert(sequence, message);
            }
        }
        self.settle(gap);
    }

    /// Puts what was found in line, and counts what was not.
    fn settle(&mut self, mut gap: Gap) {
        if gap.is_end {
            let Some((last, _)) = gap.found.last_key_value() else { return };
            gap.numbers = *gap.numbers.start()..=*last;
            // Nothing has been sent after now.
            let silence_ns = self.now_ns.saturating_sub(gap.after_ns).max(0);
            gap.step_ns = gap.step_ns.min(silence_ns / (gap.count().cast_signed() + 1));
            if let Some(run) = self.runs.get_mut(&gap.key) {
                // Those of the answer before may not have come either.
                let first = run.returned.as_ref().map_or(*gap.numbers.start(), |before| *before.start());
                (run.newest, run.end, run.returned) = (*last, None, Some(first..=*last));
            }
        }
        if gap.is_missed {
            self.lost = self.lost.saturating_add(gap.count() - gap.found.len() as u64);
        }
        let mut earliest = self.left_ns.saturating_add(1);
        for (sequence, message) in std::mem::take(&mut gap.found) {
            let mut arrival = gap.arrival(sequence).max(earliest);
            while self.line.contains_key(&arrival) {
                arrival += 1;
            }
            earliest = arrival + 1;
            self.insert(arrival, message);
        }
        if gap.is_end
            && let Some(run) = self.runs.get_mut(&gap.key)
        {
            run.heard_ns = Some(earliest - 1);
        }
    }

    /// Everything until this time \[ns\] has been taken: gives up what has not come in time, asks for what is after the
    /// last message of keys that are quiet, and forgets those that have been for an hour.
    pub fn advance(&mut self, now_ns: i64) {
        self.now_ns = self.now_ns.max(now_ns);
        if self.now_ns.saturating_sub(self.looked_ns) < LOOK_NS {
            return;
        }
        if self.now_ns.saturating_sub(self.looked_ns) > LONGEST_LOOK_NS {
            self.awake_ns = self.now_ns;
        }
        self.looked_ns = self.now_ns;
        self.give_up(|gap| now_ns.saturating_sub(gap.since_ns) >= PATIENCE_NS);
        let forgotten_ns = now_ns.saturating_sub(FORGET_NS);
        self.runs.retain(|_, run| run.heard_ns.is_none_or(|heard| heard >= forgotten_ns));
        let awake_ns = self.awake_ns;
        self.ask_ends(|run| {
            let silence = now_ns.saturating_sub(run.heard_ns.unwrap_or(now_ns).max(awake_ns));
            silence >= QUIET_NS && silence >= run.spacing_ns.saturating_mul(QUIET_SPACINGS)
        });
    }

    /// No more messages come, only answers: asks for the end of all keys, quiet or not.
    pub fn end(&mut self) {
        self.ask_ends(|_| true);
    }

    fn ask_ends(&mut self, is_due: impl Fn(&Run) -> bool) {
        let is_asked = |run: &Run| run.is_kept && !run.is_end_asked && run.newest < u64::MAX && is_due(run);
        let due: Vec<String> = self.runs.iter().filter(|(_, r)| is_asked(r)).map(|(key, _)| key.clone()).collect();
        for key in due {
            let Some(run) = self.runs.get_mut(&key) else { continue };
            run.is_end_asked = true;
            let (first, after_ns) = (run.newest + 1, run.heard_ns.unwrap_or(self.now_ns));
            let gap = Gap {
                key: key.clone(),
                numbers: first..=first.saturating_add(MAX_END - 1),
                is_end: true,
                is_missed: true,
                after_ns,
                step_ns: run.spacing_ns,
                reserved_ns: after_ns.saturating_add(1),
                since_ns: self.now_ns,
                found: BTreeMap::new(),
            };
            if self.open.len() < MAX_GAPS {
                let id = self.ask(gap);
                if let Some(run) = self.runs.get_mut(&key) {
                    run.end = Some(id);
                }
            }
        }
    }

    fn give_up(&mut self, is_over: impl Fn(&Gap) -> bool) {
        let over: Vec<u64> = self.open.iter().filter(|(_, gap)| is_over(gap)).map(|(id, _)| *id).collect();
        for gap in over.iter().filter_map(|id| self.open.remove(id)).collect::<Vec<_>>() {
            self.settle(gap);
        }
    }

    /// Waits for nothing any more: all that is in line may leave.
    pub fn close(&mut self) {
        self.is_ending = true;
        self.give_up(|_| true);
    }

    /// The next message that may leave the line, and its arrival.
    pub fn leave(&mut self) -> Option<(i64, Message)> {
        let (first, _) = self.line.first_key_value()?;
        let first = *first;
        if self.line.len() > MAX_LINE || self.line_bytes > MAX_LINE_BYTES {
            self.give_up(|gap| gap.reserved_ns <= first);
        } else {
            let is_held = !self.is_ending && first > self.now_ns.saturating_sub(HOLD_NS);
            if is_held || self.open.values().any(|gap| gap.reserved_ns <= first) {
                return None;
            }
        }
        let (arrival, message) = self.line.pop_first()?;
        self.line_bytes -= bytes(&message);
        self.left_ns = arrival;
        Some((arrival, message))
    }
}

fn bytes(message: &Message) -> usize {
    message.key.len() + message.payload.len() + std::mem::size_of::<(i64, Message)>()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::edge::bus::Encoding;

    const MS: i64 = 1_000_000;

    /// A message whose payload is its number.
    fn message(key: &str, number: u64) -> Message {
        let payload = number.to_le_bytes().to_vec();
        Message { key: key.to_owned(), encoding: Encoding::Bincode, payload }
    }

    fn take(gaps: &mut Gaps, key: &str, number: u64, ms: i64) {
        gaps.take(message(key, number), Some(number), true, ms * MS);
    }

    fn answer(gaps: &mut Gaps, request: &Request, numbers: impl IntoIterator<Item = u64>) {
        let messages = numbers.into_iter().map(|n| (n, message(&request.missed.key, n)));
        gaps.answer(request.id, messages.collect());
    }

    /// Listens to silence until a time.
    fn wait(gaps: &mut Gaps, ms: i64) {
        let from = gaps.now_ns / MS;
        (from..=ms).step_by(10).chain([ms]).for_each(|ms| gaps.advance(ms * MS));
    }

    /// Key, number and arrival of all that may leave.
    fn left(gaps: &mut Gaps) -> Vec<(String, u64, i64)> {
        let number = |m: &Message| u64::from_le_bytes(*m.payload.first_chunk().unwrap());
        std::iter::from_fn(|| gaps.leave()).map(|(at, m)| (m.key.clone(), number(&m), at)).collect()
    }

    fn numbers(gaps: &mut Gaps, key: &str) -> Vec<u64> {
        left(gaps).into_iter().filter(|(k, ..)| k == key).map(|(_, number, _)| number).collect()
    }

    fn missed(request: &Request) -> (&str, u64, Option<u64>) {
        (&request.missed.key, request.missed.from, request.missed.to)
    }

    #[test]
    fn what_was_dropped_gets_its_place_between_its_neighbours() {
        let mut gaps = Gaps::default();
        for (key, number, ms) in [("a", 0, 0), ("a", 1, 10), ("b", 0, 12), ("b", 1, 22), ("b", 2, 42), ("a", 5, 50)] {
            take(&mut gaps, key, number, ms);
        }
        let request = gaps.request().unwrap();
        assert_eq!((missed(&request), gaps.request()), (("a", 2, Some(4)), None));
        assert_eq!(left(&mut gaps), [], "all wait for a second");
        wait(&mut gaps, 1022);
        assert_eq!(left(&mut gaps).len(), 4, "those before the message behind the gap do not wait longer");
        wait(&mut gaps, 1060);
        assert_eq!(numbers(&mut gaps, "b"), [2]);
        answer(&mut gaps, &request, 2..=4);
        assert_eq!(left(&mut gaps), [], "both are quiet, and their ends asked for");
        while let Some(end) = gaps.request() {
            answer(&mut gaps, &end, []);
        }
        // Later than they would have been, as something has left already.
        assert_eq!(numbers(&mut gaps, "a"), [2, 3, 4, 5]);
        assert_eq!((gaps.lost(), gaps.recovered()), (0, 3));

        let mut gaps = Gaps::default();
        take(&mut gaps, "a", 0, 10);
        take(&mut gaps, "b", 0, 25);
        take(&mut gaps, "a", 3, 40);
        let request = gaps.request().unwrap();
        answer(&mut gaps, &request, 1..=2);
        gaps.close();
        let places: Vec<_> = left(&mut gaps).into_iter().map(|(key, number, at)| (key, number, at / MS)).collect();
        let expected = [("a", 0, 10), ("a", 1, 20), ("b", 0, 25), ("a", 2, 30), ("a", 3, 40)];
        assert_eq!(places, expected.map(|(key, number, at)| (key.to_owned(), number, at)));
    }

    #[test]
    fn arrivals_are_distinct_and_in_order_however_close() {
        let mut gaps = Gaps::default();
        for (key, number) in [("a", 0), ("b", 0), ("a", 5), ("b", 1), ("b", 7), ("a", 6), ("a", 8), ("b", 8)] {
            take(&mut gaps, key, number, 0);
        }
        while let Some(request) = gaps.request() {
            answer(&mut gaps, &request, 0..20);
        }
        gaps.close();
        let left = left(&mut gaps);
        assert!(left.is_sorted_by(|a, b| a.2 < b.2));
        for key in ["a", "b"] {
            let of_key: Vec<u64> = left.iter().filter(|(k, ..)| k == key).map(|(_, number, _)| *number).collect();
            assert_eq!(of_key, (0..=8).collect::<Vec<_>>());
        }
    }

    #[test]
    fn what_is_not_answered_or_not_in_the_answer_is_lost() {
        let mut gaps = Gaps::default();
        for (number, ms) in [(0, 0), (4, 1), (10, 2)] {
            take(&mut gaps, "a", number, ms);
        }
        let request = gaps.request().unwrap();
        answer(&mut gaps, &request, [0, 2, 3, 3, 9]);
        assert_eq!((gaps.lost(), gaps.recovered()), (1, 2));
        let late = gaps.request().unwrap();
        gaps.advance(5001 * MS);
        assert_eq!((numbers(&mut gaps, "a"), gaps.is_waiting()), (vec![0, 2, 3, 4], true));
        gaps.advance(5060 * MS);
        assert_eq!((numbers(&mut gaps, "a"), gaps.lost()), (vec![10], 6));
        answer(&mut gaps, &late, 5..=9);
        assert_eq!((left(&mut gaps), gaps.lost(), gaps.recovered()), (vec![], 6, 2));
        // More than may be asked for, and what nobody remembers.
        take(&mut gaps, "a", 1_000_010, 5100);
        gaps.take(message("members", 0), Some(0), false, 5100 * MS);
        gaps.take(message("members", 2), Some(2), false, 5100 * MS);
        assert_eq!(gaps.request(), None, "nobody listened while it was quiet");
        assert_eq!(gaps.lost(), 6 + 999_999 + 1);
    }

    #[test]
    fn a_late_message_fills_its_gap() {
        let mut gaps = Gaps::default();
        for number in [0, 3, 1, 2, 4] {
            take(&mut gaps, "a", number, 0);
        }
        assert!(!gaps.is_waiting());
        gaps.close();
        assert_eq!((numbers(&mut gaps, "a"), gaps.lost(), gaps.recovered()), (vec![0, 1, 2, 3, 4], 0, 0));
    }

    #[test]
    fn a_sender_that_begins_again_leaves_no_gap_and_its_beginning_is_asked_for() {
        let mut gaps = Gaps::default();
        take(&mut gaps, "a", 7000, 0);
        take(&mut gaps, "a", 7002, 1);
        let old = gaps.request().unwrap();
        for number in [2, 3, 3] {
            take(&mut gaps, "a", number, 2);
        }
        let new = gaps.request().unwrap();
        assert_eq!((missed(&old), missed(&new)), (("a", 7001, Some(7001)), ("a", 0, Some(1))));
        assert_eq!(gaps.request(), None);
        answer(&mut gaps, &new, 0..2);
        answer(&mut gaps, &old, [7001]);
        take(&mut gaps, "a", 0, 3);
        take(&mut gaps, "b", 9, 3);
        gaps.close();
        assert_eq!(numbers(&mut gaps, "a"), [7000, 7001, 7002, 0, 1, 2, 3, 3, 0]);
        assert_eq!((gaps.lost(), gaps.recovered()), (0, 3), "before the first of `b` nothing is missed");
    }

    #[test]
    fn the_end_is_asked_for_once_when_it_is_quiet() {
        let mut gaps = Gaps::default();
        for (number, ms) in [(0, -1200), (1, -800), (2, -400)] {
            take(&mut gaps, "slow", number, ms);
        }
        for (number, ms) in [(0, 0), (1, 10), (2, 20), (3, 30)] {
            take(&mut gaps, "a", number, ms);
        }
        take(&mut gaps, "slow", 3, 35);
        wait(&mut gaps, 600);
        let request = gaps.request().unwrap();
        assert_eq!((missed(&request), gaps.request()), (("a", 4, None), None));
        answer(&mut gaps, &request, [4, 6]);
        assert_eq!((gaps.lost(), gaps.recovered()), (1, 2));
        // Messages that were only late.
        take(&mut gaps, "a", 4, 1300);
        take(&mut gaps, "a", 6, 1301);
        take(&mut gaps, "a", 7, 1302);
        gaps.end();
        let ends: Vec<_> = std::iter::from_fn(|| gaps.request()).collect();
        assert_eq!(ends.iter().map(missed).collect::<Vec<_>>(), [("a", 8, None), ("slow", 4, None)]);
        // It goes on before there is an answer, and after.
        take(&mut gaps, "slow", 5, 1400);
        answer(&mut gaps, &ends[1], [4, 5, 6]);
        let request = gaps.request().unwrap();
        assert_eq!(missed(&request), ("slow", 4, Some(4)));
        answer(&mut gaps, &request, [4]);
        gaps.close();
        let left = left(&mut gaps);
        let of_key = |key| left.iter().filter(|(k, ..)| k == key).map(|(_, n, at)| (*n, at / MS)).collect::<Vec<_>>();
        assert_eq!(of_key("a"), [(0, 0), (1, 10), (2, 20), (3, 30), (4, 40), (6, 60), (7, 1302)]);
        assert_eq!(of_key("slow").iter().map(|(n, _)| *n).collect::<Vec<_>>(), [0, 1, 2, 3, 4, 5]);
    }

    #[test]
    fn what_is_slow_and_was_asked_for_meanwhile_is_not_taken_twice() {
        let mut gaps = Gaps::default();
        take(&mut gaps, "a", 0, 0);
        let mut now = 0;
        for (from, to, arrives) in [(1, 4, 1), (5, 9, 2), (10, 12, 3)] {
            now += 4100;
            wait(&mut gaps, now);
            let request = gaps.request().unwrap();
            assert_eq!(missed(&request), ("a", from, None));
            answer(&mut gaps, &request, from..=to);
            take(&mut gaps, "a", arrives, now);
        }
        (4..=14).for_each(|number| take(&mut gaps, "a", number, now));
        take(&mut gaps, "a", 13, now);
        gaps.close();
        assert_eq!(numbers(&mut gaps, "a"), (0..=14).chain([13]).collect::<Vec<_>>());
        assert_eq!(gaps.lost(), 0);
    }

    #[test]
    fn a_key_that_is_silent_for_an_hour_is_forgotten() {
        let (mut gaps, hour) = (Gaps::default(), FORGET_NS / MS);
        take(&mut gaps, "a", 7000, 0);
        take(&mut gaps, "b", 7000, 1000);
        gaps.advance((hour + 500) * MS);
        assert_eq!(gaps.runs.keys().collect::<Vec<_>>(), ["b"]);
        // What it sends then is taken for a beginning, and what came before is not missed.
        take(&mut gaps, "a", 9000, hour + 500);
        take(&mut gaps, "a", 9001, hour + 501);
        gaps.close();
        assert_eq!((numbers(&mut gaps, "a"), gaps.lost()), (vec![7000, 9000, 9001], 0));
        assert_eq!(gaps.request(), None);
    }

    #[test]
    fn a_line_that_is_full_waits_for_nothing() {
        let mut gaps = Gaps::default();
        take(&mut gaps, "a", 0, 0);
        take(&mut gaps, "a", 2, 0);
        for number in 0..MAX_LINE as u64 {
            take(&mut gaps, "b", number, 0);
        }
        assert_eq!(left(&mut gaps).iter().map(|(key, ..)| key.as_str()).collect::<Vec<_>>(), ["a", "a"]);
        assert_eq!((gaps.lost(), gaps.is_waiting()), (1, false));
    }
}
