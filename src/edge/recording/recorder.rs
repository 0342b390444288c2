//! From the bus to the files of a recording.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{File, TryLockError};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use super::arrival::ArrivalClock;
use super::gaps::{FORGET_NS, Gaps, PATIENCE_NS, Request};
use super::layout::{self, Part, Parts};
use super::merge::{Job, Merger};
use super::tables::{self, BedMemory, Entry, Table};
use crate::edge::bus::{Bus, BusError, Delivery, Encoding, Handler, Message, Subscription};
use crate::edge::files::columnar::{Batch, Field, Writer};
use crate::edge::files::error::FileError;
use crate::edge::files::units::Units;
use crate::edge::recent;
use crate::edge::wire;
use crate::estimate::time::{NS_PER_S, ns_from_s};

/// What is recorded, under `PREFIX/BED/`. No JSON twins, which would be made for the recorder only.
const TOPICS: [&str; 12] = [
    "pressure/*",
    "beat",
    "truth",
    "note",
    "acknowledge",
    "estimate/state",
    "estimate/parameters",
    "estimate/beat",
    "estimate/smoothed",
    "status",
    "event",
    "alarm",
];
/// Recorded if asked for: the whole ensemble is made only for those who subscribe.
const MEMBERS: &str = "estimate/members";

/// Threads that ask the daemon for what is missing, each for one gap at a time: when the link is busy an answer takes long,
/// and many keys have gaps.
const ASKERS: usize = 16;

/// Gaps that wait for them; more are lost.
const ASKED: usize = 1024;

/// Messages between the bus and the recorder, and their bytes; more are dropped and counted.
const QUEUE: usize = 1 << 17;
const QUEUE_BYTES: usize = 256 << 20;

/// Longest wait for a message before looking at what is due.
const LOOK: Duration = Duration::from_millis(50);

/// Time between looks at the system clock \[ns\].
const COMPARE_NS: i64 = NS_PER_S;

const HOUR_NS: i64 = 3600 * NS_PER_S;

/// Parts of an hour that were never merged, at most: then they are.
const SMALL_PARTS: u64 = 32;

/// Cells of one table and bed, and of all, that wait to be written: 4 MiB and 256 MiB.
const MAX_CELLS: usize = 1 << 18;
const MAX_ALL_CELLS: usize = 1 << 24;

/// Says which schema of the wire the rows come from, and which table they are.
const WIRE_KEY: &str = "hemostream.wire";
const TABLE_KEY: &str = "hemostream.table";

/// How to record.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordOptions {
    /// First part of the keys.
    pub prefix: String,
    /// Beds to record; empty for all.
    pub beds: Vec<String>,
    /// Whether whole ensembles are recorded.
    pub members: bool,
    /// Longest time that a row waits in memory \[s\].
    pub flush_s: f64,
    /// Most beds at a time; messages of others are refused. One that has been silent for an hour makes room.
    pub max_beds: usize,
}

/// What was recorded.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Summary {
    /// Rows by table.
    pub rows: BTreeMap<&'static str, u64>,
    /// Beds seen.
    pub beds: usize,
    /// Files written, before merging.
    pub parts: u64,
    /// Their bytes.
    pub bytes: u64,
    /// Messages that were not recorded, by cause.
    pub refused: BTreeMap<&'static str, u64>,
    /// Messages that found the queue full.
    pub dropped: u64,
    /// Messages that did not come and were got from the daemon: samples and estimates are dropped by a network that is
    /// busy. Those that found the queue full are among them.
    pub recovered: u64,
    /// Messages that sequence numbers say were sent, and that the daemon did not have.
    pub lost: u64,
}

/// Why a recording ends badly.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// The disk.
    #[error("recording: {0}")]
    File(#[from] FileError),
    /// The bus.
    #[error(transparent)]
    Bus(#[from] BusError),
}

/// A bed that is recorded.
#[derive(Default)]
struct Bed {
    memory: BedMemory,
    /// Arrival of the last message of it that was understood \[ns\].
    heard_ns: i64,
}

/// Rows of one table and bed that wait to be written.
struct Buffer {
    hour: String,
    folder: PathBuf,
    names: Vec<String>,
    units: Vec<String>,
    fields: Vec<Field>,
    batch: Batch,
    /// Arrival of its first row \[ns\].
    since_ns: i64,
    next_part: u64,
    /// Parts since the last merge.
    small: u64,
}

impl Buffer {
    fn cells(&self) -> usize {
        self.batch.rows() * self.fields.len()
    }
}

/// Writes what it is told. Knows no clock: times of arrival are arguments.
pub struct Recorder {
    directory: PathBuf,
    options: RecordOptions,
    units: Units,
    buffers: BTreeMap<(String, Table), Buffer>,
    beds: BTreeMap<String, Bed>,
    /// Names of all beds so far, also of those that are forgotten: as many as there are folders on the disk.
    seen: BTreeSet<String>,
    /// Where messages wait for those that are missing.
    gaps: Gaps,
    /// Cells in all buffers.
    cells: usize,
    summary: Summary,
    /// Whether no more messages come.
    is_ending: bool,
    merger: Merger,
    /// Held for as long as this recorder writes here.
    _lock: File,
}

impl Recorder {
    /// Opens a directory, new or recorded into before; removes what an interruption left about `now_ns`. What it left
    /// before is removed, and hours that are over are merged, beside the recording.
    ///
    /// # Errors
    /// When it cannot be written, or somebody else records into it.
    pub fn open(directory: &Path, options: RecordOptions, units: Units, now_ns: i64) -> Result<Self, FileError> {
        std::fs::create_dir_all(directory).map_err(|e| FileError::file(directory, &e))?;
        let lock = lock(directory)?;
        let old = hours_before(directory, &layout::hour(now_ns.saturating_sub(HOUR_NS)));
        let merger = Merger::start(old).map_err(|e| FileError::file(directory, &e))?;
        tidy_recent(directory, now_ns, &merger)?;
        Ok(Self {
            directory: directory.to_owned(),
            options,
            units,
            buffers: BTreeMap::new(),
            beds: BTreeMap::new(),
            seen: BTreeSet::new(),
            gaps: Gaps::default(),
            cells: 0,
            summary: Summary::default(),
            is_ending: false,
            merger,
            _lock: lock,
        })
    }

    /// Takes a message that arrived at a unix time \[ns\]; it is recorded in its turn. No two messages share an arrival: one
    /// that is not after the last gets the next nanosecond that is free.
    ///
    /// # Errors
    /// When the disk does not take what is due.
    pub fn take(&mut self, message: Message, arrival_ns: i64) -> Result<(), FileError> {
        let Some((_, topic)) = self.address(&message.key) else { return Ok(()) };
        let sequence = wire::sequence(topic, &message.payload, message.encoding);
        let is_kept = topic != MEMBERS;
        self.gaps.take(message, sequence, is_kept, arrival_ns);
        self.add_due()
    }

    /// What to ask the daemon for, if there is something.
    pub fn request(&mut self) -> Option<Request> {
        self.gaps.request()
    }

    /// Takes the answer to a request: messages under the key that was asked for.
    ///
    /// # Errors
    /// When the disk does not take what is due.
    pub fn answer(&mut self, id: u64, messages: Vec<Message>) -> Result<(), FileError> {
        let numbered = messages.into_iter().filter_map(|message| {
            let (_, topic) = self.address(&message.key)?;
            Some((wire::sequence(topic, &message.payload, message.encoding)?, message))
        });
        let numbered = numbered.collect();
        self.gaps.answer(id, numbered);
        self.add_due()
    }

    /// No more messages come, only answers: there may be more requests.
    pub fn end(&mut self) {
        self.gaps.end();
    }

    /// Whether an answer is waited for.
    #[must_use]
    pub fn is_waiting(&self) -> bool {
        self.gaps.is_waiting()
    }

    /// Makes rows of the messages whose turn it is.
    fn add_due(&mut self) -> Result<(), FileError> {
        while let Some((arrival, message)) = self.gaps.leave() {
            let Some((bed, topic)) = self.address(&message.key) else { continue };
            let (bed, topic) = (bed.to_owned(), topic.to_owned());
            if let Err(cause) = self.add(&bed, &topic, &message, arrival)? {
                *self.summary.refused.entry(cause).or_default() += 1;
            }
        }
        Ok(())
    }

    /// Bed and topic of a key, if it is recorded.
    fn address<'a>(&self, key: &'a str) -> Option<(&'a str, &'a str)> {
        let (bed, topic) = key.strip_prefix(&self.options.prefix)?.strip_prefix('/')?.split_once('/')?;
        let wanted = self.options.beds.is_empty() || self.options.beds.iter().any(|b| b == bed);
        wanted.then_some((bed, topic))
    }

    fn add(
        &mut self,
        bed: &str,
        topic: &str,
        message: &Message,
        arrival: i64,
    ) -> Result<Result<(), tables::Refused>, FileError> {
        let known = self.beds.contains_key(bed);
        if !known && self.beds.len() >= self.options.max_beds {
            return Ok(Err("too_many_beds"));
        }
        let Bed { memory, .. } = self.beds.entry(bed.to_owned()).or_default();
        let outcome = match tables::entry(topic, message, arrival, memory) {
            Ok(entry) => self.add_entry(bed, entry, arrival)?,
            Err(cause) => Err(cause),
        };
        if outcome.is_ok() {
            self.hear(bed, arrival);
        } else if !known {
            // What nobody understands makes no bed.
            self.beds.remove(bed);
        }
        Ok(outcome)
    }

    fn hear(&mut self, name: &str, arrival: i64) {
        if let Some(bed) = self.beds.get_mut(name) {
            bed.heard_ns = arrival;
        }
        if !self.seen.contains(name) {
            self.seen.insert(name.to_owned());
        }
    }

    /// Makes room for other beds: forgets those that have been silent for long and have nothing to be written.
    fn forget(&mut self, now_ns: i64) {
        let (buffers, since_ns) = (&self.buffers, now_ns.saturating_sub(FORGET_NS));
        let is_buffered = |name: &String| buffers.keys().any(|(bed, _)| bed == name);
        self.beds.retain(|name, bed| bed.heard_ns >= since_ns || is_buffered(name));
    }

    fn add_entry(&mut self, bed: &str, entry: Entry, arrival: i64) -> Result<Result<(), tables::Refused>, FileError> {
        let Some(folder) = layout::escape(bed) else { return Ok(Err("bed_name")) };
        if entry.rows.is_empty() {
            return Ok(Ok(()));
        }
        let key = (bed.to_owned(), entry.table);
        let hour = layout::hour(arrival);
        let fits = |b: &Buffer| b.hour == hour && b.names == entry.names && b.units == entry.units;
        if !self.buffers.get(&key).is_some_and(fits) {
            let fields = match tables::fields(&entry, &self.units) {
                Ok(fields) => fields,
                Err(cause) => return Ok(Err(cause)),
            };
            self.begin(&key, &folder, hour, &entry, fields)?;
        }
        self.push(&key, entry, arrival)?;
        Ok(Ok(()))
    }

    /// Begins a buffer; what is in one of another hour or of other columns is written.
    fn begin(
        &mut self,
        key: &(String, Table),
        folder: &str,
        hour: String,
        entry: &Entry,
        fields: Vec<Field>,
    ) -> Result<(), FileError> {
        self.write(key)?;
        let folder = layout::folder(&self.directory, entry.table.name(), folder, &hour);
        let before = self.buffers.remove(key);
        let (next_part, small) = match &before {
            Some(before) if before.hour == hour => (before.next_part, before.small),
            _ => (Parts::of(&folder)?.next(), 0),
        };
        if let Some(before) = before.filter(|before| before.hour != hour) {
            // An hour that finds no place is merged at the next start.
            let _ = self.merger.ask(Job { folder: before.folder, all: true });
        }
        let (names, units, batch) = (entry.names.clone(), entry.units.clone(), Batch::new(&fields));
        let buffer = Buffer { hour, folder, names, units, fields, batch, since_ns: 0, next_part, small };
        self.buffers.insert(key.clone(), buffer);
        Ok(())
    }

    fn push(&mut self, key: &(String, Table), entry: Entry, arrival: i64) -> Result<(), FileError> {
        let Some(buffer) = self.buffers.get_mut(key) else { return Ok(()) };
        if buffer.batch.rows() == 0 {
            buffer.since_ns = arrival;
        }
        *self.summary.rows.entry(entry.table.name()).or_default() += entry.rows.len() as u64;
        let before = buffer.cells();
        entry.rows.into_iter().for_each(|row| buffer.batch.push(row));
        self.cells += buffer.cells() - before;
        // What is in line at the end is bounded, and is written with the rest.
        if self.is_ending {
            return Ok(());
        }
        if buffer.cells() >= MAX_CELLS {
            self.write(key)?;
        }
        if self.cells >= MAX_ALL_CELLS { self.write_all() } else { Ok(()) }
    }

    /// Writes what has waited long enough by a unix time up to which all messages have been taken, and lets go of hours
    /// that are over and of beds that are silent.
    ///
    /// # Errors
    /// When the disk does not take it.
    pub fn flush_due(&mut self, now_ns: i64) -> Result<(), FileError> {
        self.gaps.advance(now_ns);
        self.add_due()?;
        let flush_ns = ns_from_s(self.options.flush_s);
        let waits = |b: &Buffer| b.batch.rows() > 0 && now_ns.saturating_sub(b.since_ns) >= flush_ns;
        let due: Vec<_> = self.buffers.iter().filter(|(_, b)| waits(b)).map(|(key, _)| key.clone()).collect();
        due.iter().try_for_each(|key| self.write(key))?;
        let hour = layout::hour(now_ns);
        let over = |b: &Buffer| b.batch.rows() == 0 && b.hour < hour;
        let over: Vec<_> = self.buffers.iter().filter(|(_, b)| over(b)).map(|(key, _)| key.clone()).collect();
        for buffer in over.iter().filter_map(|key| self.buffers.remove(key)) {
            let _ = self.merger.ask(Job { folder: buffer.folder, all: true });
        }
        self.forget(now_ns);
        Ok(())
    }

    /// Writes all buffers, also after one that cannot be written; the first error.
    fn write_all(&mut self) -> Result<(), FileError> {
        let keys: Vec<_> = self.buffers.keys().cloned().collect();
        let mut outcome = Ok(());
        for key in &keys {
            outcome = outcome.and(self.write(key));
        }
        outcome
    }

    /// Makes a file of what waits in a buffer, where it stays if that fails.
    fn write(&mut self, key: &(String, Table)) -> Result<(), FileError> {
        let Some(buffer) = self.buffers.get_mut(key).filter(|b| b.batch.rows() > 0) else { return Ok(()) };
        std::fs::create_dir_all(&buffer.folder).map_err(|e| FileError::file(&buffer.folder, &e))?;
        let part = Part::new(&buffer.folder, buffer.next_part, buffer.next_part);
        let about = [(WIRE_KEY, wire::SCHEMA.to_string()), (TABLE_KEY, key.1.name().to_owned())];
        let mut writer = Writer::create(&part.path, buffer.fields.clone(), &about)?;
        writer.batch(buffer.batch.clone())?;
        self.summary.bytes += writer.finish()?;
        self.summary.parts += 1;
        self.cells -= buffer.cells();
        buffer.batch = Batch::new(&buffer.fields);
        buffer.next_part += 1;
        buffer.small += 1;
        if buffer.small >= SMALL_PARTS && self.merger.ask(Job { folder: buffer.folder.clone(), all: false }) {
            buffer.small = 0;
        }
        Ok(())
    }

    /// Writes what is left, gives up what is missing, and merges what is small. What one folder does not take keeps
    /// nothing else from the disk.
    ///
    /// # Errors
    /// When the disk does not take all of it.
    pub fn close(mut self) -> Result<Summary, FileError> {
        self.is_ending = true;
        self.gaps.close();
        let added = self.add_rest();
        let written = self.write_all();
        let left: usize = self.buffers.values().map(|buffer| buffer.batch.rows()).sum();
        if left > 0 || added.is_err() {
            tracing::warn!(rows = left, "these rows could not be written, and messages that were to follow them");
        }
        added.and(written)?;
        for buffer in self.buffers.values() {
            let _ = self.merger.ask(Job { folder: buffer.folder.clone(), all: false });
        }
        let (recovered, lost) = (self.gaps.recovered(), self.gaps.lost());
        Ok(Summary { beds: self.seen.len(), recovered, lost, ..self.summary })
    }

    /// Makes rows of all messages in line, also after one that failed; the first error.
    fn add_rest(&mut self) -> Result<(), FileError> {
        let mut outcome = Ok(());
        loop {
            match self.add_due() {
                Ok(()) => return outcome,
                failed => outcome = outcome.and(failed),
            }
        }
    }
}

/// One recorder per directory: two would give their parts the same names.
fn lock(directory: &Path) -> Result<File, FileError> {
    let path = directory.join(".lock");
    let file = File::create(&path).map_err(|e| FileError::file(&path, &e))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => {
            Err(FileError::content(directory, None, "another recorder at work", "a directory of its own for each"))
        }
        Err(TryLockError::Error(error)) => Err(FileError::file(&path, &error)),
    }
}

/// Removes what an interruption left in this hour, into which is written, and in the one before, where a quick restart
/// finds most of it; the parts of the latter are merged by and by.
fn tidy_recent(directory: &Path, now_ns: i64, merger: &Merger) -> Result<(), FileError> {
    let (current, before) = (layout::hour(now_ns), layout::hour(now_ns.saturating_sub(HOUR_NS)));
    for table in Table::ALL {
        for (_, bed) in layout::beds(directory, table.name())? {
            Parts::of(&layout::hour_folder(&bed, &current))?.clean()?;
            let folder = layout::hour_folder(&bed, &before);
            let parts = Parts::of(&folder)?;
            parts.clean()?;
            if parts.live.len() > 1 {
                let _ = merger.ask(Job { folder, all: true });
            }
        }
    }
    Ok(())
}

/// Folders of the hours before this one, listed bed by bed as they are asked for: into these nobody writes.
fn hours_before(directory: &Path, hour: &str) -> impl Iterator<Item = PathBuf> + Send + use<> {
    let (directory, end) = (directory.to_owned(), layout::hour_folder(Path::new(""), hour));
    let beds = Table::ALL.into_iter().flat_map(move |table| listed(layout::beds(&directory, table.name())));
    beds.flat_map(move |(_, bed)| {
        let mut hours = listed(layout::hours(&bed));
        hours.retain(|folder| folder.file_name().is_some_and(|name| name < end.as_os_str()));
        hours
    })
}

/// What was listed; nothing where a folder cannot be read, which is no reason not to record into others.
fn listed<T>(found: Result<Vec<T>, FileError>) -> Vec<T> {
    found.unwrap_or_else(|error| {
        tracing::warn!("older hours are left as they are: {error}");
        Vec::new()
    })
}

/// A bounded queue between the threads of the bus and the recorder.
struct Queue {
    receiver: Receiver<(i64, Message)>,
    bytes: Arc<AtomicUsize>,
    dropped: Arc<AtomicU64>,
}

fn subscribe(
    bus: &dyn Bus,
    options: &RecordOptions,
    clock: Arc<ArrivalClock>,
) -> Result<(Vec<Subscription>, Queue), BusError> {
    let (sender, receiver): (SyncSender<(i64, Message)>, _) = sync_channel(QUEUE);
    let queue = Queue { receiver, bytes: Arc::default(), dropped: Arc::default() };
    let (bytes, dropped) = (Arc::clone(&queue.bytes), Arc::clone(&queue.dropped));
    let handler: Handler = Arc::new(move |message| {
        let length = message.payload.len() + message.key.len();
        let has_room = bytes.fetch_add(length, Ordering::Relaxed) + length <= QUEUE_BYTES;
        if !has_room || sender.try_send((clock.now_ns(), message)).is_err() {
            bytes.fetch_sub(length, Ordering::Relaxed);
            dropped.fetch_add(1, Ordering::Relaxed);
        }
    });
    let topics = TOPICS.iter().copied().chain(options.members.then_some(MEMBERS));
    let beds: Vec<&str> = match options.beds.as_slice() {
        [] => vec!["*"],
        beds => beds.iter().map(String::as_str).collect(),
    };
    let patterns = topics.flat_map(|topic| beds.iter().map(move |bed| format!("{}/{bed}/{topic}", options.prefix)));
    let subscriptions = patterns.map(|pattern| bus.subscribe(&pattern, Arc::clone(&handler)));
    Ok((subscriptions.collect::<Result<_, _>>()?, queue))
}

/// Records until `stop` is set. `progress` is told rows and dropped messages now and then.
///
/// # Errors
/// When the bus refuses the subscription or the disk does not take what is due.
pub fn run(
    bus: &dyn Bus,
    directory: &Path,
    options: RecordOptions,
    units: Units,
    stop: &AtomicBool,
    progress: &mut dyn FnMut(u64, u64),
) -> Result<Summary, RecordError> {
    let clock = Arc::new(ArrivalClock::start());
    let recorder = Recorder::open(directory, options.clone(), units, clock.now_ns())?;
    let (subscriptions, queue) = subscribe(bus, &options, Arc::clone(&clock))?;
    let (requests, waiting) = sync_channel(ASKED);
    let (found, answers) = sync_channel(ASKED);
    let asker = Asker { bus, prefix: &options.prefix, requests: Mutex::new(waiting), answers: found };
    let (working, ended) = sync_channel(0);
    std::thread::scope(|scope| {
        let prefix = &options.prefix;
        scope.spawn(move || announce(bus, prefix, &ended));
        for _ in 0..ASKERS {
            scope.spawn(|| asker.work());
        }
        // These threads end when nobody asks and nobody listens any more: with this loop, however it ends.
        let _working: SyncSender<()> = working;
        let now_ns = clock.now_ns();
        let (looked_ns, compared_ns, said) = (now_ns, now_ns, Said::default());
        let mut work = Loop { recorder, queue, requests, answers, clock, looked_ns, compared_ns, said };
        let ran = work.run(stop, progress);
        drop(subscriptions);
        work.finish(ran)
    })
}

/// Tells daemons that somebody is here who may ask, until there is nobody at work any more.
fn announce(bus: &dyn Bus, prefix: &str, ended: &Receiver<()>) {
    let mut is_told = true;
    loop {
        let message = Message { key: recent::presence(prefix), encoding: Encoding::Bincode, payload: Vec::new() };
        let told = bus.publish(message, Delivery::Events);
        if let Err(error) = &told
            && is_told
        {
            tracing::warn!(%error, "daemons are not told of this recorder; what the network drops is lost");
        }
        is_told = told.is_ok();
        if ended.recv_timeout(recent::PRESENT_EVERY) != Err(RecvTimeoutError::Timeout) {
            return;
        }
    }
}

/// The answer to a request, by its name.
type Answer = (u64, Vec<Message>);

/// Asks the daemon, on threads of its own: an answer may take a while.
struct Asker<'a> {
    bus: &'a dyn Bus,
    prefix: &'a str,
    requests: Mutex<Receiver<Request>>,
    answers: SyncSender<Answer>,
}

impl Asker<'_> {
    fn work(&self) {
        loop {
            let request = self.requests.lock().unwrap_or_else(PoisonError::into_inner).recv();
            let Ok(request) = request else { return };
            if self.answers.send((request.id, self.ask(&request))).is_err() {
                return;
            }
        }
    }

    /// The messages that are there, under their own key.
    fn ask(&self, request: &Request) -> Vec<Message> {
        let Some(pattern) = request.missed.pattern(self.prefix) else { return Vec::new() };
        let patience = Duration::from_nanos(PATIENCE_NS.unsigned_abs());
        let answer = self.bus.last_values(&pattern, patience).unwrap_or_default();
        answer.into_iter().map(|m| Message { key: request.missed.key.clone(), ..m }).collect()
    }
}

/// The recorder at work.
struct Loop {
    recorder: Recorder,
    queue: Queue,
    requests: SyncSender<Request>,
    /// Beside the queue: behind the messages in it they might come too late.
    answers: Receiver<Answer>,
    clock: Arc<ArrivalClock>,
    /// When was last looked at what is due, and at the system clock.
    looked_ns: i64,
    compared_ns: i64,
    said: Said,
}

/// Counts as they were last said, by what they count.
#[derive(Default)]
struct Said(BTreeMap<&'static str, u64>);

impl Said {
    /// Whether a count is said now: when there is something at first, and whenever that has doubled.
    fn is_due(&mut self, what: &'static str, count: u64) -> bool {
        let said = self.0.entry(what).or_default();
        let is_due = count > 0 && count / 2 >= *said;
        if is_due {
            *said = count;
        }
        is_due
    }
}

impl Loop {
    fn run(&mut self, stop: &AtomicBool, progress: &mut dyn FnMut(u64, u64)) -> Result<(), FileError> {
        while !stop.load(Ordering::Relaxed) {
            let taken_ns = match self.queue.receiver.recv_timeout(LOOK) {
                Ok((arrival, message)) => {
                    self.take(message, arrival)?;
                    arrival
                }
                // Nothing is on the way that arrived before.
                Err(RecvTimeoutError::Timeout) => self.clock.now_ns(),
                Err(RecvTimeoutError::Disconnected) => break,
            };
            self.ask_and_answer()?;
            let now_ns = self.clock.now_ns();
            if now_ns - self.looked_ns >= i64::try_from(LOOK.as_nanos()).unwrap_or(0) {
                self.looked_ns = now_ns;
                self.recorder.flush_due(taken_ns)?;
                progress(self.recorder.summary.rows.values().sum(), self.warn());
            }
            if now_ns - self.compared_ns >= COMPARE_NS {
                self.compared_ns = now_ns;
                self.clock.compare();
            }
        }
        Ok(())
    }

    fn take(&mut self, message: Message, arrival: i64) -> Result<(), FileError> {
        self.queue.bytes.fetch_sub(message.payload.len() + message.key.len(), Ordering::Relaxed);
        self.recorder.take(message, arrival)
    }

    /// Hands over what is to be asked for, and takes what was answered.
    fn ask_and_answer(&mut self) -> Result<(), FileError> {
        while let Some(request) = self.recorder.request() {
            let id = request.id;
            if self.requests.try_send(request).is_err() {
                self.recorder.answer(id, Vec::new())?;
            }
        }
        while let Ok((id, messages)) = self.answers.try_recv() {
            self.recorder.answer(id, messages)?;
        }
        Ok(())
    }

    /// Says what does not get to the disk; messages that were dropped.
    fn warn(&mut self) -> u64 {
        let (dropped, lost) = (self.queue.dropped.load(Ordering::Relaxed), self.recorder.gaps.lost());
        if self.said.is_due("dropped", dropped) {
            tracing::warn!(dropped, "messages were dropped because the disk was behind");
        }
        if self.said.is_due("lost", lost) {
            tracing::warn!(lost, "messages never came, by their sequence numbers");
        }
        for (&cause, &refused) in &self.recorder.summary.refused {
            if self.said.is_due(cause, refused) {
                tracing::warn!(cause, refused, "messages are not recorded");
            }
        }
        dropped
    }

    /// Closes, whatever went wrong so far: what can be written is. If all went well, with what is still on its way.
    fn finish(mut self, ran: Result<(), FileError>) -> Result<Summary, RecordError> {
        let taken = ran.and_then(|()| self.take_rest());
        let dropped = self.queue.dropped.load(Ordering::Relaxed);
        let closed = self.recorder.close();
        taken?;
        Ok(Summary { dropped, ..closed? })
    }

    /// Takes what is left in the queue, and waits for what is missing.
    fn take_rest(&mut self) -> Result<(), FileError> {
        while let Ok((arrival, message)) = self.queue.receiver.try_recv() {
            self.take(message, arrival)?;
            self.ask_and_answer()?;
        }
        self.recorder.end();
        self.ask_and_answer()?;
        let until_ns = self.clock.now_ns().saturating_add(PATIENCE_NS);
        while self.recorder.is_waiting() && self.clock.now_ns() < until_ns {
            if let Ok((id, messages)) = self.answers.recv_timeout(LOOK) {
                self.recorder.answer(id, messages)?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_are_said_at_first_and_whenever_they_have_doubled() {
        let mut said = Said::default();
        let due: Vec<u64> = (0..=20).filter(|count| said.is_due("lost", *count)).collect();
        assert_eq!(due, [1, 2, 4, 8, 16]);
        assert!(said.is_due("malformed", 5) && !said.is_due("malformed", 9) && said.is_due("malformed", 11));
    }
}
