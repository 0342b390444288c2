//! A record of pressures in a Parquet file: `time_s` (or `time_ns`, integers) and any of the six pressures by name or by
//! monitor label, as in a CSV. A null or a NaN is a missing sample.

use std::path::{Path, PathBuf};

use super::columnar::{Batch, Field, Kind, Reader};
use super::csv::Row;
use super::error::FileError;
use crate::edge::config::Config;
use crate::estimate::time::EventTime;
use crate::model::cvsim6::Pressures;

/// Rows held at a time.
const BATCH: usize = 4096;

/// Reads a record row by row.
pub struct ParquetRows {
    path: PathBuf,
    reader: Reader,
    time_column: usize,
    /// Column and state of each pressure.
    columns: Vec<(usize, Kind)>,
    states: Vec<usize>,
    batch: Option<Batch>,
    next: usize,
    rows: u64,
    last: Option<EventTime>,
}

impl ParquetRows {
    /// Opens a record and checks its columns.
    ///
    /// # Errors
    /// When the file cannot be read, has no time, or a column that is no pressure.
    pub fn open(path: &Path, config: &Config) -> Result<Self, FileError> {
        let reader = Reader::open(path)?;
        let (mut time_column, mut columns, mut states) = (None, Vec::new(), Vec::new());
        for (index, field) in reader.fields().iter().enumerate() {
            if is_time(path, field)? {
                if time_column.replace(index).is_some() {
                    return Err(FileError::content(path, None, "two columns of time", "`time_s` or `time_ns`"));
                }
                continue;
            }
            let state = state(path, field, config)?;
            if states.contains(&state) {
                let found = format!("column `{}`, a second one for {}", field.name, Pressures::NAMES[state]);
                return Err(FileError::content(path, None, found, "one column per pressure"));
            }
            columns.push((index, field.kind));
            states.push(state);
        }
        let Some(time_column) = time_column else {
            let names: Vec<&str> = reader.fields().iter().map(|f| f.name.as_str()).collect();
            let found = format!("columns {}", names.join(", "));
            return Err(FileError::content(path, None, found, "a column `time_s` [s] or `time_ns` [ns]"));
        };
        if states.is_empty() {
            return Err(FileError::content(path, None, "no column but the time", "at least one pressure"));
        }
        let path = path.to_owned();
        Ok(Self { path, reader, time_column, columns, states, batch: None, next: 0, rows: 0, last: None })
    }

    /// The state that each value of a row belongs to.
    #[must_use]
    pub fn states(&self) -> &[usize] {
        &self.states
    }

    /// The next row; None at the end.
    ///
    /// # Errors
    /// When the file is damaged, or time is missing or does not increase.
    pub fn next_row(&mut self) -> Result<Option<Row>, FileError> {
        while self.batch.as_ref().is_none_or(|batch| self.next >= batch.rows()) {
            self.next = 0;
            self.batch = self.reader.next_batch(BATCH)?;
            if self.batch.is_none() {
                if self.last.is_none() {
                    return Err(FileError::content(&self.path, None, "no row", "at least one sample"));
                }
                return Ok(None);
            }
        }
        let Some(batch) = &self.batch else { return Ok(None) };
        let row = self.next;
        self.next += 1;
        self.rows += 1;
        let time = batch.int(row, self.time_column).map(EventTime);
        let time = time.or_else(|| batch.float(row, self.time_column).filter(|t| t.is_finite()).map(EventTime::from_s));
        let Some(time) = time else {
            return Err(FileError::content(
                &self.path,
                None,
                format!("no time in row {}", self.rows),
                "a time in every row",
            ));
        };
        if let Some(last) = self.last.filter(|last| *last >= time) {
            let found = format!("time {} s after {} s in row {}", time.as_s(), last.as_s(), self.rows);
            return Err(FileError::content(&self.path, None, found, "strictly increasing times"));
        }
        self.last = Some(time);
        let values = self.columns.iter().map(|(column, kind)| number(batch, row, *column, *kind)).collect();
        Ok(Some(Row { time, values }))
    }
}

fn is_time(path: &Path, field: &Field) -> Result<bool, FileError> {
    let fits = match field.name.as_str() {
        "time_s" => field.kind == Kind::Float,
        "time_ns" => matches!(field.kind, Kind::Int | Kind::Time),
        _ => return Ok(false),
    };
    if fits {
        return Ok(true);
    }
    let found = format!("column `{}` of another type", field.name);
    Err(FileError::content(path, None, found, "`time_s` in floats or `time_ns` in integers"))
}

fn state(path: &Path, field: &Field, config: &Config) -> Result<usize, FileError> {
    let name = config.state_of_label(&field.name);
    let state = Pressures::NAMES.iter().position(|known| Some(*known) == name);
    let is_number = matches!(field.kind, Kind::Float | Kind::Int);
    state.filter(|_| is_number).ok_or_else(|| {
        let names = Pressures::NAMES.join(", ");
        let expected = format!("numbers of a pressure ({names}) or of a label of the table [labels]");
        FileError::content(path, None, format!("column `{}`", field.name), &expected)
    })
}

#[allow(clippy::cast_precision_loss)]
fn number(batch: &Batch, row: usize, column: usize, kind: Kind) -> Option<f64> {
    match kind {
        Kind::Int => batch.int(row, column).map(|value| value as f64),
        _ => batch.float(row, column).filter(|value| !value.is_nan()),
    }
}
