//! Tables of a recording: which message becomes which rows.
//!
//! | table | from | a row per | |
//! |---|---|---|---|
//! | `samples` | `pressure/*` | sample | of a block without samples one row without a value |
//! | `estimates` | `estimate/state` | time | `NAME_STATISTIC` |
//! | `smoothed` | `estimate/smoothed` | time | the same |
//! | `parameters` | `estimate/parameters` | message | the same: a row beside that of the estimate of its time |
//! | `beats` | `estimate/beat` | heart beat | the same |
//! | `events` | `event`, `note`, `alarm`, `acknowledge`, `beat` | happening | `source` says which; of alarms what changed |
//! | `truth` | `truth` | message | a column per name |
//! | `status` | `status` | message | channels, counters and distances as JSON |
//! | `members` | `estimate/members` | member | only if asked for |
//!
//! Every row begins with `arrival`, unix time in nanoseconds, which no two messages of a recording share: rows of one
//! arrival are one message. What the daemon publishes carries `sequence`, `seed` and `config_hash` (16 hexadecimal
//! digits, since half of all 64-bit numbers are not whole in a float). Event times are integers \[ns\]. Floats keep
//! their bits.

use std::collections::{BTreeMap, BTreeSet};

use serde::Serialize;

use crate::edge::bus::Message;
use crate::edge::files::columnar::{Cell, Field, Kind};
use crate::edge::files::units::Units;
use crate::edge::wire::{
    Acknowledge, Alarms, BEAT_STATISTICS, BeatEstimate, Beats, Event, Header, Members, Note, PARAMETER_STATISTICS,
    ParameterEstimate, PressureBlock, STATE_STATISTICS, StateEstimate, Status, Truth, WireError, decode,
};

/// Most names in a message.
const MAX_NAMES: usize = 1024;

/// Most rows of a message, as many as the daemon accepts in a block.
const MAX_ROWS: usize = 16_384;

/// A table.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[allow(missing_docs)]
pub enum Table {
    Samples,
    Estimates,
    Smoothed,
    Parameters,
    Beats,
    Events,
    Truth,
    Status,
    Members,
}

impl Table {
    /// All of them.
    pub const ALL: [Self; 9] = [
        Self::Samples,
        Self::Estimates,
        Self::Smoothed,
        Self::Parameters,
        Self::Beats,
        Self::Events,
        Self::Truth,
        Self::Status,
        Self::Members,
    ];

    /// Name of its folder.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Samples => "samples",
            Self::Estimates => "estimates",
            Self::Smoothed => "smoothed",
            Self::Parameters => "parameters",
            Self::Beats => "beats",
            Self::Events => "events",
            Self::Truth => "truth",
            Self::Status => "status",
            Self::Members => "members",
        }
    }

    /// Statistics that follow each name; none where there is a column per name.
    fn statistics(self) -> &'static [&'static str] {
        match self {
            Self::Estimates | Self::Smoothed => &STATE_STATISTICS,
            Self::Parameters => &PARAMETER_STATISTICS,
            Self::Beats => &BEAT_STATISTICS,
            _ => &[],
        }
    }
}

/// What a message becomes.
#[derive(Debug, Clone, PartialEq)]
pub struct Entry {
    /// Where it belongs.
    pub table: Table,
    /// Names that the columns are made of, where they differ from message to message.
    pub names: Vec<String>,
    /// Units of these, where the message says so.
    pub units: Vec<String>,
    /// Its rows; none if nothing is new.
    pub rows: Vec<Vec<Cell>>,
}

/// A message that cannot be recorded: why.
pub type Refused = &'static str;

/// What is remembered of a bed from message to message.
#[derive(Debug, Default)]
pub struct BedMemory {
    /// Latest event time \[ns\].
    event_time: Option<i64>,
    /// State of each alarm, and whether somebody has seen it.
    alarms: BTreeMap<String, (String, bool)>,
}

/// Rows of a message that arrived under a topic of a bed.
///
/// # Errors
/// When it is not understood.
pub fn entry(topic: &str, message: &Message, arrival: i64, bed: &mut BedMemory) -> Result<Entry, Refused> {
    let arrival = Cell::Int(arrival);
    let entry = match topic {
        "estimate/state" => states(Table::Estimates, &arrival, read(message)?),
        "estimate/smoothed" => states(Table::Smoothed, &arrival, read(message)?),
        "estimate/parameters" => parameters(arrival, read(message)?),
        "estimate/beat" => beats(arrival, read(message)?),
        "estimate/members" => members(&arrival, read(message)?),
        "truth" => truth(arrival, read(message)?),
        "status" => status(arrival, &read(message)?),
        _ => match topic.strip_prefix("pressure/") {
            Some(channel) => samples(arrival, channel, &read(message)?),
            None => happenings(topic, message, &arrival, bed),
        },
    }?;
    if matches!(entry.table, Table::Estimates | Table::Parameters) {
        bed.event_time = bed.event_time.max(entry.time_ns());
    }
    Ok(entry)
}

impl Entry {
    /// Event time of the last row, where the daemon published it.
    fn time_ns(&self) -> Option<i64> {
        match self.rows.last()?.get(4)? {
            Cell::Int(number) => Some(*number),
            _ => None,
        }
    }
}

fn read<T: serde::de::DeserializeOwned>(message: &Message) -> Result<T, Refused> {
    decode(&message.payload, message.encoding).map_err(|error| match error {
        WireError::TooLong(_) => "oversized",
        WireError::Malformed(_) => "malformed",
        WireError::Schema(_) => "wrong_schema",
    })
}

/// Times of the samples of a block; None if it does not say when they were taken.
fn times(block: &PressureBlock) -> Option<Vec<i64>> {
    let n = block.values.len();
    let explicit = block.period_ns == 0;
    let told = block.offsets_ns.len() == n || (n == 1 && block.offsets_ns.is_empty());
    if block.period_ns < 0 || (explicit && n > 0 && !told) || (!explicit && !block.offsets_ns.is_empty()) {
        return None;
    }
    let offset = |i: usize| match explicit {
        true => Some(block.offsets_ns.get(i).copied().unwrap_or(0)),
        false => block.period_ns.checked_mul(i64::try_from(i).ok()?),
    };
    (0..n).map(|i| block.start_ns.checked_add(offset(i)?)).collect()
}

fn samples(arrival: Cell, channel: &str, block: &PressureBlock) -> Result<Entry, Refused> {
    if block.values.len() > MAX_ROWS {
        return Err("oversized");
    }
    let times = times(block).ok_or("malformed")?;
    let (channel, sequence) = (Cell::text(channel), Cell::unsigned(block.sequence));
    let row = |time: i64, value: Cell| {
        let flags = Cell::Int(i64::from(block.flags));
        vec![arrival.clone(), channel.clone(), sequence.clone(), flags, Cell::Int(time), value]
    };
    let mut rows: Vec<_> = times.iter().zip(&block.values).map(|(t, v)| row(*t, Cell::Float(*v))).collect();
    if rows.is_empty() {
        rows.push(row(block.start_ns, Cell::Missing));
    }
    Ok(Entry { table: Table::Samples, names: Vec::new(), units: Vec::new(), rows })
}

/// `arrival, sequence, seed, config_hash, time_ns`.
fn published(arrival: &Cell, header: &Header, time_ns: i64) -> Vec<Cell> {
    vec![
        arrival.clone(),
        Cell::unsigned(header.sequence),
        Cell::unsigned(header.seed),
        Cell::text(&format!("{:016x}", header.config_hash)),
        Cell::Int(time_ns),
    ]
}

fn floats(values: &[f64]) -> impl Iterator<Item = Cell> + '_ {
    values.iter().map(|value| Cell::Float(*value))
}

/// Refuses what does not fill its columns.
fn check(table: Table, names: &[String], rows: usize, values: usize) -> Result<(), Refused> {
    if names.len() > MAX_NAMES || rows > MAX_ROWS {
        return Err("oversized");
    }
    let expected = rows * names.len() * table.statistics().len().max(1);
    if values == expected { Ok(()) } else { Err("malformed") }
}

fn states(table: Table, arrival: &Cell, message: StateEstimate) -> Result<Entry, Refused> {
    let StateEstimate { header, members, times_ns, since_data_s, names, values } = message;
    check(table, &names, times_ns.len(), values.len())?;
    if since_data_s.len() != times_ns.len() {
        return Err("malformed");
    }
    let width = names.len() * STATE_STATISTICS.len();
    let row = |(i, (time, since)): (usize, (&i64, &f64))| {
        let mut row = published(arrival, &header, *time);
        row.extend([Cell::Int(i64::from(members)), Cell::Float(*since)]);
        row.extend(floats(&values[i * width..(i + 1) * width]));
        row
    };
    let rows = times_ns.iter().zip(&since_data_s).enumerate().map(row).collect();
    Ok(Entry { table, names, units: Vec::new(), rows })
}

fn parameters(arrival: Cell, message: ParameterEstimate) -> Result<Entry, Refused> {
    let ParameterEstimate { header, members, names, values } = message;
    check(Table::Parameters, &names, 1, values.len())?;
    let mut row = published(&arrival, &header, header.time_ns);
    row.push(Cell::Int(i64::from(members)));
    row.extend(floats(&values));
    Ok(Entry { table: Table::Parameters, names, units: Vec::new(), rows: vec![row] })
}

fn beats(arrival: Cell, message: BeatEstimate) -> Result<Entry, Refused> {
    let BeatEstimate { header, members, end_ns, names, units, values } = message;
    check(Table::Beats, &names, 1, values.len())?;
    if units.len() != names.len() {
        return Err("malformed");
    }
    let mut row = published(&arrival, &header, header.time_ns);
    row.extend([Cell::Int(end_ns), Cell::Int(i64::from(members))]);
    row.extend(floats(&values));
    Ok(Entry { table: Table::Beats, names, units, rows: vec![row] })
}

fn members(arrival: &Cell, message: Members) -> Result<Entry, Refused> {
    let Members { header, names, values } = message;
    let width = names.len().max(1);
    check(Table::Members, &names, values.len() / width, values.len())?;
    let row = |(member, values): (i64, &[f64])| {
        let mut row = published(arrival, &header, header.time_ns);
        row.push(Cell::Int(member));
        row.extend(floats(values));
        row
    };
    let rows = (0..).zip(values.chunks_exact(width)).map(row).collect();
    Ok(Entry { table: Table::Members, names, units: Vec::new(), rows })
}

fn truth(arrival: Cell, message: Truth) -> Result<Entry, Refused> {
    let Truth { time_ns, names, values, .. } = message;
    check(Table::Truth, &names, 1, values.len())?;
    let row = [arrival, Cell::Int(time_ns)].into_iter().chain(floats(&values)).collect();
    Ok(Entry { table: Table::Truth, names, units: Vec::new(), rows: vec![row] })
}

fn json(value: &impl Serialize) -> Cell {
    Cell::text(&serde_json::to_string(value).unwrap_or_default())
}

fn status(arrival: Cell, s: &Status) -> Result<Entry, Refused> {
    let mut row = published(&arrival, &s.header, s.header.time_ns);
    row.extend([s.members_alive, s.members].map(|n| Cell::Int(i64::from(n))));
    row.extend([s.windows, s.windows_without_data].map(Cell::unsigned));
    row.extend([s.lag_p50_ms, s.lag_p99_ms, s.lag_max_ms, s.solve_ms, s.iterations].map(Cell::Float));
    row.extend([Cell::unsigned(s.not_converged), Cell::Int(i64::from(s.queue_depth))]);
    let by_name: BTreeMap<&str, u64> = s.counters.iter().map(|(name, n)| (name.as_str(), *n)).collect();
    let distances: BTreeMap<&str, f64> = s.disagreement.iter().map(|(name, d)| (name.as_str(), *d)).collect();
    row.extend([json(&s.channels), json(&by_name), json(&distances)]);
    Ok(Entry { table: Table::Status, names: Vec::new(), units: Vec::new(), rows: vec![row] })
}

/// One row of `events`.
#[derive(Default)]
struct Happening<'a> {
    kind: &'a str,
    channel: &'a str,
    name: &'a str,
    author: &'a str,
    text: &'a str,
    time_ns: i64,
    header: Option<&'a Header>,
    detail: String,
}

impl Happening<'_> {
    fn row(&self, arrival: &Cell, source: &str) -> Vec<Cell> {
        let texts = [source, self.kind, self.channel, self.name, self.author, self.text].map(Cell::text);
        let number = |of: fn(&Header) -> u64| self.header.map_or(Cell::Missing, |h| Cell::unsigned(of(h)));
        let hash = self.header.map_or_else(String::new, |h| format!("{:016x}", h.config_hash));
        let mut row = vec![arrival.clone()];
        row.extend(texts);
        row.extend([Cell::Int(self.time_ns), number(|h| h.sequence), number(|h| h.seed)]);
        row.extend([Cell::text(&hash), Cell::text(&self.detail)]);
        row
    }
}

fn happenings(topic: &str, message: &Message, arrival: &Cell, bed: &mut BedMemory) -> Result<Entry, Refused> {
    let rows = match topic {
        "event" => {
            let Event { header, kind, channel, text } = read(message)?;
            let (time_ns, header) = (header.time_ns, Some(&header));
            let (kind, channel, text) = (kind.as_str(), channel.as_str(), text.as_str());
            vec![Happening { kind, channel, text, time_ns, header, ..Happening::default() }.row(arrival, topic)]
        }
        "note" => {
            let Note { time_ns, author, text, .. } = read(message)?;
            let (author, text) = (author.as_str(), text.as_str());
            vec![Happening { kind: topic, author, text, time_ns, ..Happening::default() }.row(arrival, topic)]
        }
        "acknowledge" => {
            let Acknowledge { alarm, author, .. } = read(message)?;
            let (name, author) = (alarm.as_str(), author.as_str());
            // It has no event time of its own; the latest one is what its author had before their eyes.
            let time_ns = bed.event_time.unwrap_or(0);
            vec![Happening { kind: topic, name, author, time_ns, ..Happening::default() }.row(arrival, topic)]
        }
        "beat" => {
            let Beats { onsets_ns, .. } = read(message)?;
            if onsets_ns.len() > MAX_ROWS {
                return Err("oversized");
            }
            let onset = |time_ns: &i64| {
                Happening { kind: "beat_onset", time_ns: *time_ns, ..Happening::default() }.row(arrival, topic)
            };
            onsets_ns.iter().map(onset).collect()
        }
        "alarm" => alarms(arrival, &read(message)?, bed)?,
        _ => return Err("unknown_topic"),
    };
    Ok(Entry { table: Table::Events, names: Vec::new(), units: Vec::new(), rows })
}

/// Alarms that are not what they were.
fn alarms(arrival: &Cell, message: &Alarms, bed: &mut BedMemory) -> Result<Vec<Vec<Cell>>, Refused> {
    if message.alarms.len() > MAX_NAMES {
        return Err("oversized");
    }
    let mut rows = Vec::new();
    let mut now = BTreeMap::new();
    for alarm in &message.alarms {
        let state = (alarm.state.clone(), alarm.acknowledged);
        if bed.alarms.get(&alarm.name) != Some(&state) {
            let happening = Happening {
                kind: &alarm.state,
                channel: &alarm.quantity,
                name: &alarm.name,
                text: &alarm.text,
                time_ns: message.header.time_ns,
                header: Some(&message.header),
                detail: serde_json::to_string(alarm).unwrap_or_default(),
                ..Happening::default()
            };
            rows.push(happening.row(arrival, "alarm"));
        }
        now.insert(alarm.name.clone(), state);
    }
    bed.alarms = now;
    Ok(rows)
}

/// Columns of a table for these names.
///
/// # Errors
/// When the names do not make distinct columns.
pub fn fields(entry: &Entry, units: &Units) -> Result<Vec<Field>, Refused> {
    let mut fields = fixed(entry.table);
    for (i, name) in entry.names.iter().enumerate() {
        if name.is_empty() || name.chars().any(char::is_control) {
            return Err("malformed");
        }
        let told = entry.units.get(i).map(String::as_str);
        match entry.table.statistics() {
            [] => fields.push(Field::new(name.clone(), Kind::Float, told.unwrap_or(units.of_column(name)))),
            statistics => fields.extend(statistics.iter().map(|statistic| {
                let column = format!("{name}_{statistic}");
                let unit = told.unwrap_or(units.of_column(&column)).to_owned();
                Field { unit, ..Field::new(column, Kind::Float, "") }
            })),
        }
    }
    let distinct: BTreeSet<&str> = fields.iter().map(|f| f.name.as_str()).collect();
    if distinct.len() == fields.len() { Ok(fields) } else { Err("malformed") }
}

/// Columns that a table always has, before those of the names.
fn fixed(table: Table) -> Vec<Field> {
    let arrival = Field::new("arrival", Kind::Time, "ns");
    let text = |name: &str| Field::new(name, Kind::Text, "");
    let (int, unsigned) =
        (|name: &str| Field::new(name, Kind::Int, ""), |name: &str| Field::new(name, Kind::Unsigned, ""));
    let time = |name: &str| Field::new(name, Kind::Int, "ns");
    let float = |name: &str, unit: &str| Field::new(name, Kind::Float, unit);
    let published =
        || vec![arrival.clone(), unsigned("sequence"), unsigned("seed"), text("config_hash"), time("time_ns")];
    let with = |more: Vec<Field>| published().into_iter().chain(more).collect();
    match table {
        Table::Samples => {
            let value = float("value", "mmHg").optional();
            vec![arrival, text("channel"), unsigned("sequence"), int("flags"), time("time_ns"), value]
        }
        Table::Estimates | Table::Smoothed => with(vec![int("members"), float("since_data_s", "s")]),
        Table::Parameters => with(vec![int("members")]),
        Table::Beats => with(vec![time("end_ns"), int("members")]),
        Table::Members => with(vec![int("member")]),
        Table::Truth => vec![arrival, time("time_ns")],
        Table::Events => {
            let mut fields = vec![arrival];
            fields.extend(["source", "kind", "channel", "name", "author", "text"].map(text));
            fields.extend([time("time_ns"), unsigned("sequence").optional(), unsigned("seed").optional()]);
            fields.extend(["config_hash", "detail"].map(text));
            fields
        }
        Table::Status => with(vec![
            int("members_alive"),
            int("members"),
            unsigned("windows"),
            unsigned("windows_without_data"),
            float("lag_p50_ms", "ms"),
            float("lag_p99_ms", "ms"),
            float("lag_max_ms", "ms"),
            float("solve_ms", "ms"),
            float("iterations", ""),
            unsigned("not_converged"),
            int("queue_depth"),
            text("channels"),
            text("counters"),
            text("disagreement"),
        ]),
    }
}
