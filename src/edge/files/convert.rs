//! From one format of records to another.
//!
//! A record is read twice: once to see whether all of it can be read, how long it is and between which limits its
//! values lie, and once to write it. What is written has its name when it is whole.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::columnar::{Cell, Field, Kind, Writer};
use super::csv::{Row, TableWriter};
use super::error::FileError;
use super::grid::{Grid, GridError, OnGrid};
use super::record::Record;
use super::table::TableFormat;
use super::wfdb;
use super::wfdb_write::{self, SignalRange, WfdbWriter};
use crate::edge::config::Config;
use crate::estimate::time::EventTime;
use crate::model::cvsim6::Pressures;

/// How to convert.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ConvertOptions {
    /// What states are called in what is written; their own names where nothing is said.
    pub labels: BTreeMap<String, String>,
    /// Put samples on a grid of this rate; None to keep their times.
    pub rate_hz: Option<f64>,
}

/// What was written.
#[derive(Debug, Clone, PartialEq)]
pub struct Converted {
    /// Rows.
    pub rows: u64,
    /// Samples that are there.
    pub samples: u64,
    /// Columns, as they are called.
    pub columns: Vec<String>,
    /// Time from the first row to the last \[s\].
    pub seconds: f64,
}

/// Called with the rows done and, once it is known, how many there are to do.
pub type Progress<'a> = &'a mut dyn FnMut(u64, Option<u64>);

/// Rows between two calls of [`Progress`].
const PROGRESS_ROWS: u64 = 4096;

/// Converts a record; the formats are those of the names: `.csv`, `.parquet`, and `.hea` or no ending for WFDB.
///
/// # Errors
/// When the record cannot be read, does not fit the other format, or that cannot be written.
pub fn convert(
    input: &Path,
    output: &Path,
    config: &Config,
    options: &ConvertOptions,
    progress: Progress<'_>,
) -> Result<Converted, FileError> {
    let target = Target::of(output)?;
    let files = target.files(output);
    refuse_same(input, output, &files)?;
    if let [header, samples] = files.as_slice() {
        refuse_foreign(header, samples)?;
    }
    let survey = Survey::of(input, config, progress)?;
    let names = names(input, &survey.states, options)?;
    let grid = match (options.rate_hz, target) {
        (Some(rate_hz), _) => Some(Grid { start: survey.first, rate_hz }),
        (None, Target::Wfdb) => Some(survey.grid(input)?),
        (None, Target::Table(_)) => None,
    };
    let mut on_grid = grid.map(|grid| OnGrid::new(grid, names.len(), options.rate_hz.is_none()));
    let mut sink = Sink::create(output, target, &survey, &names, grid)?;
    let (mut done, mut counted) = (0_u64, Converted { rows: 0, samples: 0, columns: names, seconds: survey.seconds() });
    let mut emit = |row: Row| -> Result<(), NotPlaced> {
        counted.rows += 1;
        counted.samples += row.values.iter().flatten().count() as u64;
        sink.row(&row).map_err(NotPlaced::File)
    };
    let explain = |error: NotPlaced| error.explained(input);
    let mut reader = Record::open(input, config)?;
    while let Some(row) = reader.next_row()? {
        match &mut on_grid {
            Some(on_grid) => on_grid.take(&row, &mut emit).map_err(explain)?,
            None => emit(row).map_err(explain)?,
        }
        done += 1;
        if done.is_multiple_of(PROGRESS_ROWS) {
            progress(done, Some(survey.rows));
        }
    }
    on_grid.map_or(Ok(()), |on_grid| on_grid.finish(&mut emit)).map_err(explain)?;
    sink.finish()?;
    Ok(counted)
}

/// A row that was not written.
enum NotPlaced {
    Grid(GridError),
    File(FileError),
}

impl From<GridError> for NotPlaced {
    fn from(error: GridError) -> Self {
        Self::Grid(error)
    }
}

impl NotPlaced {
    fn explained(self, input: &Path) -> FileError {
        match self {
            Self::File(error) => error,
            Self::Grid(error @ GridError::Irregular { .. }) => {
                let expected = "rows at a constant rate, which WFDB demands, or --rate-hz to put them on a grid";
                FileError::content(input, None, error.to_string(), expected)
            }
            Self::Grid(error @ GridError::TooLong(_)) => {
                FileError::content(input, None, error.to_string(), "a shorter record or a lower rate")
            }
        }
    }
}

/// Writing over what is being read would lose it.
fn refuse_same(input: &Path, output: &Path, files: &[PathBuf]) -> Result<(), FileError> {
    let read = Record::files(input)?;
    if files.iter().any(|file| read.iter().any(|other| is_same(file, other))) {
        return Err(FileError::content(output, None, "the record that is read", "another file to write to"));
    }
    Ok(())
}

/// Whether two names are of one file that is there.
fn is_same(a: &Path, b: &Path) -> bool {
    matches!((a.canonicalize(), b.canonicalize()), (Ok(a), Ok(b)) if a == b)
}

/// A file of samples is replaced together with the header that names it; without that it is somebody else's.
fn refuse_foreign(header: &Path, samples: &Path) -> Result<(), FileError> {
    if !samples.exists() {
        return Ok(());
    }
    let named = header.exists().then(|| wfdb::Record::open(header)).and_then(Result::ok);
    if named.is_some_and(|record| record.files().iter().any(|file| is_same(file, samples))) {
        return Ok(());
    }
    let header = header.display();
    let expected = format!("no such file, or one that {header} names; remove what an interrupted conversion left");
    Err(FileError::content(samples, None, "a file that no header names", &expected))
}

/// How what is written is called, column by column.
fn names(input: &Path, states: &[usize], options: &ConvertOptions) -> Result<Vec<String>, FileError> {
    if let Some(state) = options.labels.keys().find(|state| !states.iter().any(|s| Pressures::NAMES[*s] == **state)) {
        return Err(FileError::content(input, None, format!("no {state} to label"), "a pressure of the record"));
    }
    let name = |state: &usize| {
        let own = Pressures::NAMES[*state];
        options.labels.get(own).cloned().unwrap_or_else(|| own.to_owned())
    };
    let names: Vec<String> = states.iter().map(name).collect();
    match names.iter().enumerate().find(|(i, name)| names[..*i].contains(name)) {
        Some((_, twice)) => Err(FileError::content(input, None, format!("two columns `{twice}`"), "distinct labels")),
        None => Ok(names),
    }
}

/// What the first reading tells.
struct Survey {
    states: Vec<usize>,
    rows: u64,
    first: EventTime,
    last: EventTime,
    ranges: Vec<Option<(f64, f64)>>,
}

impl Survey {
    fn of(input: &Path, config: &Config, progress: Progress<'_>) -> Result<Self, FileError> {
        let mut reader = Record::open(input, config)?;
        let states = reader.states().to_vec();
        let mut survey =
            Self { ranges: vec![None; states.len()], states, rows: 0, first: EventTime(0), last: EventTime(0) };
        while let Some(row) = reader.next_row()? {
            if survey.rows == 0 {
                survey.first = row.time;
            }
            survey.last = row.time;
            survey.rows += 1;
            for (column, value) in row.values.iter().enumerate() {
                let Some(value) = value.filter(|value| !value.is_nan()) else { continue };
                if value.is_infinite() {
                    let name = Pressures::NAMES[survey.states[column]];
                    let found = format!("{name} of {value} at {} s", row.time.as_s());
                    return Err(FileError::content(input, None, found, "a number, or nothing for a missing sample"));
                }
                let (low, high) = survey.ranges[column].unwrap_or((value, value));
                survey.ranges[column] = Some((low.min(value), high.max(value)));
            }
            if survey.rows.is_multiple_of(PROGRESS_ROWS) {
                progress(survey.rows, None);
            }
        }
        if survey.rows == 0 {
            return Err(FileError::content(input, None, "no row", "at least one sample"));
        }
        Ok(survey)
    }

    fn seconds(&self) -> f64 {
        self.last.as_s() - self.first.as_s()
    }

    fn grid(&self, input: &Path) -> Result<Grid, FileError> {
        Grid::through(self.first, self.last, self.rows)
            .ok_or_else(|| FileError::content(input, None, "one row, which has no rate", "more rows, or --rate-hz"))
    }
}

/// What is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Target {
    Table(TableFormat),
    Wfdb,
}

impl Target {
    fn of(path: &Path) -> Result<Self, FileError> {
        match path.extension() {
            None => Ok(Self::Wfdb),
            Some(ending) if ending == "hea" => Ok(Self::Wfdb),
            Some(_) => match TableFormat::of(path) {
                Ok(format) => Ok(Self::Table(format)),
                Err(_) => Err(FileError::content(
                    path,
                    None,
                    "another ending",
                    ".csv, .parquet, or .hea or no ending for WFDB",
                )),
            },
        }
    }

    /// What is written: a table, or a header and its file of samples.
    fn files(self, output: &Path) -> Vec<PathBuf> {
        match self {
            Self::Table(_) => vec![output.to_owned()],
            Self::Wfdb => wfdb_write::files(output).to_vec(),
        }
    }
}

enum Sink {
    Csv(TableWriter),
    Parquet(Box<Writer>),
    Wfdb(Box<WfdbWriter>),
}

impl Sink {
    fn create(
        output: &Path,
        target: Target,
        survey: &Survey,
        names: &[String],
        grid: Option<Grid>,
    ) -> Result<Self, FileError> {
        let header = || std::iter::once("time_s".to_owned()).chain(names.iter().cloned()).collect::<Vec<_>>();
        match (target, grid) {
            (Target::Table(TableFormat::Csv), _) => Ok(Self::Csv(TableWriter::create(output, &header())?)),
            (Target::Table(TableFormat::Parquet), _) => {
                let pressures = names.iter().map(|name| Field::new(name.clone(), Kind::Float, "mmHg").optional());
                let fields = std::iter::once(Field::new("time_s", Kind::Float, "s")).chain(pressures).collect();
                Ok(Self::Parquet(Box::new(Writer::create(output, fields, &[])?)))
            }
            (Target::Wfdb, Some(grid)) => {
                let signal = |(label, range): (&String, &Option<(f64, f64)>)| SignalRange {
                    label: label.clone(),
                    range: *range,
                };
                let signals: Vec<SignalRange> = names.iter().zip(&survey.ranges).map(signal).collect();
                Ok(Self::Wfdb(Box::new(WfdbWriter::create(output, &signals, grid)?)))
            }
            (Target::Wfdb, None) => Err(FileError::content(output, None, "no rate", "a constant rate")),
        }
    }

    /// NaN in the record is a missing sample.
    fn row(&mut self, row: &Row) -> Result<(), FileError> {
        let values = row.values.iter().map(|value| value.filter(|value| !value.is_nan()));
        match self {
            Self::Csv(table) => {
                let values = values.map(|value| value.unwrap_or(f64::NAN));
                table.row(&std::iter::once(row.time.as_s()).chain(values).collect::<Vec<_>>())
            }
            Self::Parquet(table) => {
                let cells = values.map(|value| value.map_or(Cell::Missing, Cell::Float));
                table.row(std::iter::once(Cell::Float(row.time.as_s())).chain(cells))
            }
            Self::Wfdb(record) => record.frame(&values.collect::<Vec<_>>()),
        }
    }

    fn finish(self) -> Result<(), FileError> {
        match self {
            Self::Csv(table) => table.finish(),
            Self::Parquet(table) => table.finish().map(|_| ()),
            Self::Wfdb(record) => record.finish(),
        }
    }
}
