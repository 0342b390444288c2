//! From the files of a recording back to the bus: what came in, at the pace at which it came.
//!
//! Blocks of samples, onsets of beats, notes, acknowledgements and truths, of all beds together in the order of arrival.
//! A block has the samples, event times, sequence number and flags that were recorded, bit for bit; its times are told
//! one by one, whichever way they were sent. What the daemon published is not played: it publishes it again.

use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use super::layout::{self, Parts};
use super::tables::Table;
use crate::edge::bus::{Bus, Delivery, Encoding, Message};
use crate::edge::files::columnar::{Batch, Kind, Reader};
use crate::edge::files::error::FileError;
use crate::edge::replay::{ReplayError, wait_until, wait_until_taken};
use crate::edge::wire::{self, Acknowledge, Beats, Note, PressureBlock, SCHEMA, Truth};
use crate::estimate::time::s_from_ns;
use crate::runtime::clock::Clock;

/// Rows of each table and bed that are held at a time.
const BATCH: usize = 1024;

/// A recording on its way.
pub struct Playback {
    streams: Vec<Stream>,
}

impl Playback {
    /// Opens a recording: the beds that are named, or all; keys begin with `prefix`.
    ///
    /// # Errors
    /// When there is none, or a bed is not in it.
    pub fn open(directory: &Path, beds: &[String], prefix: &str) -> Result<Self, FileError> {
        let mut streams = Vec::new();
        for table in [Table::Samples, Table::Events, Table::Truth] {
            for (bed, folder) in layout::beds(directory, table.name())? {
                if beds.is_empty() || beds.contains(&bed) {
                    streams.push(Stream::open(table, format!("{prefix}/{bed}"), bed, &folder)?);
                }
            }
        }
        if let Some(missing) = beds.iter().find(|bed| !streams.iter().any(|s| s.bed == **bed)) {
            return Err(FileError::content(directory, None, format!("no bed `{missing}`"), "a bed of the recording"));
        }
        if streams.is_empty() {
            let expected = "a recording, as `hemostream record` writes it";
            return Err(FileError::content(directory, None, "no bed", expected));
        }
        let mut playback = Self { streams };
        playback.streams.iter_mut().try_for_each(Stream::advance)?;
        Ok(playback)
    }

    /// Names of the beds, in order.
    #[must_use]
    pub fn beds(&self) -> Vec<&str> {
        let mut beds: Vec<&str> = self.streams.iter().map(|s| s.bed.as_str()).collect();
        beds.sort_unstable();
        beds.dedup();
        beds
    }

    /// A bed and a channel of it to look for a listener at, if samples were recorded.
    #[must_use]
    pub fn first_key(&self) -> Option<&str> {
        let heads = self.streams.iter().filter(|s| s.table == Table::Samples);
        heads.filter_map(|s| s.head.as_ref()).map(|(_, message)| message.key.as_str()).next()
    }

    /// The next message, and when it arrived \[unix ns\]; None at the end.
    ///
    /// # Errors
    /// When a file is damaged.
    pub fn next_message(&mut self) -> Result<Option<(i64, Message)>, FileError> {
        let arrival = |stream: &Stream| stream.head.as_ref().map(|(arrival, _)| *arrival);
        let earliest = self.streams.iter_mut().filter(|s| s.head.is_some()).min_by_key(|s| arrival(s));
        let Some(stream) = earliest else { return Ok(None) };
        let head = stream.head.take();
        stream.advance()?;
        Ok(head)
    }
}

/// Messages of one table and bed.
struct Stream {
    table: Table,
    bed: String,
    /// `PREFIX/BED`.
    key: String,
    rows: Rows,
    head: Option<(i64, Message)>,
}

impl Stream {
    fn open(table: Table, key: String, bed: String, folder: &Path) -> Result<Self, FileError> {
        let hours = layout::hours(folder)?.into();
        let rows = Rows { hours, parts: VecDeque::new(), path: folder.to_owned(), open: None, next: 0 };
        Ok(Self { table, bed, key, rows, head: None })
    }

    /// Makes the next message; rows that are none are passed over.
    fn advance(&mut self) -> Result<(), FileError> {
        while self.head.is_none() {
            let Some(arrival) = self.rows.arrival()? else { return Ok(()) };
            let message = match self.table {
                Table::Samples => Some(self.block(arrival)?),
                Table::Truth => Some(self.truth()?),
                _ => self.happening(arrival)?,
            };
            self.head = message.map(|message| (arrival, message));
        }
        Ok(())
    }

    fn message<T: serde::Serialize>(&self, topic: &str, message: &T) -> Result<Message, FileError> {
        let payload = wire::encode(message).map_err(|e| FileError::file(&self.rows.path, &e))?;
        Ok(Message { key: format!("{}/{topic}", self.key), encoding: Encoding::Bincode, payload })
    }

    /// All rows of an arrival are one block.
    fn block(&mut self, arrival: i64) -> Result<Message, FileError> {
        let (channel, start_ns) = (self.rows.text("channel")?.to_owned(), self.rows.int("time_ns")?);
        let sequence = self.rows.int("sequence")?.cast_unsigned();
        let flags = u32::try_from(self.rows.int("flags")?).unwrap_or(0);
        let (mut offsets_ns, mut values) = (Vec::new(), Vec::new());
        while self.rows.arrival()? == Some(arrival) {
            if let Some(value) = self.rows.float("value")? {
                let Some(offset) = self.rows.int("time_ns")?.checked_sub(start_ns) else {
                    let expected = "times that are less than 292 years apart";
                    return Err(FileError::content(&self.rows.path, None, "a block of samples", expected));
                };
                offsets_ns.push(offset);
                values.push(value);
            }
            self.rows.next += 1;
        }
        let block = PressureBlock { schema: SCHEMA, sequence, flags, start_ns, period_ns: 0, offsets_ns, values };
        self.message(&format!("pressure/{channel}"), &block)
    }

    fn truth(&mut self) -> Result<Message, FileError> {
        let time_ns = self.rows.int("time_ns")?;
        let (mut names, mut values) = (Vec::new(), Vec::new());
        for (name, value) in self.rows.floats() {
            names.push(name.to_owned());
            values.push(value);
        }
        self.rows.next += 1;
        self.message("truth", &Truth { schema: SCHEMA, time_ns, names, values })
    }

    /// A message that somebody sent to the bed; None for what the daemon said.
    fn happening(&mut self, arrival: i64) -> Result<Option<Message>, FileError> {
        let rows = &self.rows;
        let text = |name: &str| rows.text(name).map(str::to_owned);
        let message = match rows.text("source")? {
            "note" => {
                let (time_ns, author, text) = (rows.int("time_ns")?, text("author")?, text("text")?);
                Some(self.message("note", &Note { schema: SCHEMA, time_ns, author, text })?)
            }
            "acknowledge" => {
                let (alarm, author) = (text("name")?, text("author")?);
                Some(self.message("acknowledge", &Acknowledge { schema: SCHEMA, alarm, author })?)
            }
            "beat" => return self.onsets(arrival).map(Some),
            _ => None,
        };
        self.rows.next += 1;
        Ok(message)
    }

    fn onsets(&mut self, arrival: i64) -> Result<Message, FileError> {
        let mut onsets_ns = Vec::new();
        while self.rows.arrival()? == Some(arrival) {
            onsets_ns.push(self.rows.int("time_ns")?);
            self.rows.next += 1;
        }
        self.message("beat", &Beats { schema: SCHEMA, onsets_ns })
    }
}

/// Rows of one table and bed, over all parts of all hours.
struct Rows {
    hours: VecDeque<PathBuf>,
    parts: VecDeque<PathBuf>,
    /// The file that is read.
    path: PathBuf,
    open: Option<(Reader, Batch)>,
    next: usize,
}

impl Rows {
    /// Arrival of the row that is next; None at the end.
    fn arrival(&mut self) -> Result<Option<i64>, FileError> {
        while self.open.as_ref().is_none_or(|(_, batch)| self.next >= batch.rows()) {
            self.next = 0;
            if let Some((reader, batch)) = &mut self.open {
                match reader.next_batch(BATCH)? {
                    Some(more) => *batch = more,
                    None => self.open = None,
                }
            } else if let Some(path) = self.parts.pop_front() {
                let reader = Reader::open(&path)?;
                let none = Batch::new(reader.fields());
                (self.path, self.open) = (path, Some((reader, none)));
            } else if let Some(hour) = self.hours.pop_front() {
                self.parts = Parts::of(&hour)?.live.into_iter().map(|part| part.path).collect();
            } else {
                return Ok(None);
            }
        }
        self.int("arrival").map(Some)
    }

    fn cell<T>(&self, name: &str, get: impl Fn(&Batch, usize) -> Option<T>) -> Result<T, FileError> {
        let cell = self.open.as_ref().and_then(|(reader, batch)| get(batch, reader.column(name)?));
        cell.ok_or_else(|| {
            let found = format!("no `{name}`");
            FileError::content(&self.path, None, found, "a file of a recording, as `hemostream record` writes it")
        })
    }

    fn int(&self, name: &str) -> Result<i64, FileError> {
        self.cell(name, |batch, column| batch.int(self.next, column))
    }

    fn float(&self, name: &str) -> Result<Option<f64>, FileError> {
        self.cell(name, |batch, column| Some(batch.float(self.next, column)))
    }

    fn text(&self, name: &str) -> Result<&str, FileError> {
        let cell = self.open.as_ref().and_then(|(reader, batch)| {
            let column = reader.column(name)?;
            (reader.fields()[column].kind == Kind::Text).then(|| batch.text(self.next, column))
        });
        cell.map_or_else(|| self.cell(name, |_, _| None), Ok)
    }

    /// All numbers of the row, by column.
    fn floats(&self) -> impl Iterator<Item = (&str, f64)> {
        let open = self.open.iter();
        open.flat_map(move |(reader, batch)| {
            let fields = reader.fields().iter().enumerate();
            fields.filter_map(move |(column, f)| Some((f.name.as_str(), batch.float(self.next, column)?)))
        })
    }
}

/// How a playback went.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Played {
    /// Messages published.
    pub messages: u64,
    /// Time between the arrivals of the first and the last \[s\].
    pub seconds: f64,
}

/// Plays a recording until it ends, `seconds` are over or `stop` is set; times between messages are those between their
/// arrivals, divided by `speed`. `progress` is told how it goes.
///
/// # Errors
/// When a file is damaged or the bus is closed.
pub fn play(
    bus: &dyn Bus,
    playback: &mut Playback,
    speed: f64,
    seconds: Option<f64>,
    stop: &AtomicBool,
    progress: &mut dyn FnMut(Played),
) -> Result<Played, ReplayError> {
    let clock = Clock::start();
    let asked = playback.first_key().map(str::to_owned);
    let (mut played, mut first) = (Played::default(), None);
    while let Some((arrival, message)) = playback.next_message()? {
        let since = s_from_ns(arrival.saturating_sub(*first.get_or_insert(arrival)));
        if seconds.is_some_and(|limit| since > limit) {
            break;
        }
        wait_until(&clock, since / speed, stop);
        if stop.load(Ordering::Relaxed) {
            break;
        }
        let is_block = message.key.contains("/pressure/");
        bus.publish(message, if is_block { Delivery::Samples } else { Delivery::Events })?;
        played = Played { messages: played.messages + 1, seconds: since.max(played.seconds) };
        progress(played);
    }
    if let Some(key) = asked {
        wait_until_taken(bus, &key);
    }
    Ok(played)
}
