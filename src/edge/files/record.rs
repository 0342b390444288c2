//! A record of pressures, whatever the format: rows in order of time.

use std::path::{Path, PathBuf};

use super::csv::{RecordReader, Row};
use super::error::FileError;
use super::parquet::ParquetRows;
use super::wfdb;
use crate::edge::config::Config;
use crate::estimate::time::EventTime;
use crate::model::cvsim6::Pressures;

/// A record, open at its start.
pub enum Record {
    /// Rows of a CSV file.
    Csv(Box<RecordReader>),
    /// Rows of a Parquet file.
    Parquet(Box<ParquetRows>),
    /// Signals of a WFDB record.
    Wfdb(WfdbRows),
}

impl Record {
    /// Opens a record: WFDB if the path is that of a header, with or without its ending; Parquet if it ends in
    /// `.parquet`; otherwise CSV.
    ///
    /// # Errors
    /// When it cannot be read or holds no pressure.
    pub fn open(path: &Path, config: &Config) -> Result<Self, FileError> {
        if is_wfdb(path) {
            Ok(Self::Wfdb(WfdbRows::open(path, config)?))
        } else if path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("parquet")) {
            Ok(Self::Parquet(Box::new(ParquetRows::open(path, config)?)))
        } else {
            Ok(Self::Csv(Box::new(RecordReader::open(path, config)?)))
        }
    }

    /// Files that a record is read from.
    ///
    /// # Errors
    /// When a header that names some cannot be read.
    pub fn files(path: &Path) -> Result<Vec<PathBuf>, FileError> {
        if is_wfdb(path) {
            Ok(wfdb::Record::open(path)?.files().into_iter().collect())
        } else {
            Ok(vec![path.to_owned()])
        }
    }

    /// The state that each value of a row belongs to.
    #[must_use]
    pub fn states(&self) -> &[usize] {
        match self {
            Self::Csv(reader) => reader.states(),
            Self::Parquet(rows) => rows.states(),
            Self::Wfdb(rows) => &rows.states,
        }
    }

    /// The next row; None at the end.
    ///
    /// # Errors
    /// When it cannot be read on.
    pub fn next_row(&mut self) -> Result<Option<Row>, FileError> {
        match self {
            Self::Csv(reader) => Ok(reader.next_row()?),
            Self::Parquet(rows) => rows.next_row(),
            Self::Wfdb(rows) => Ok(rows.next_row()),
        }
    }
}

fn is_wfdb(path: &Path) -> bool {
    let is_header = path.extension().is_some_and(|ending| ending == "hea");
    is_header || (!path.exists() && path.with_added_extension("hea").exists())
}

/// The pressures of a WFDB record, side by side; each has its own rate.
pub struct WfdbRows {
    states: Vec<usize>,
    signals: Vec<Samples>,
    /// Event time of the first frame \[ns\].
    start_ns: i64,
}

struct Samples {
    rate_hz: f64,
    /// \[mmHg\]; NaN where missing.
    values: Vec<f64>,
    next: usize,
}

impl Samples {
    #[allow(clippy::cast_precision_loss)]
    fn next_time(&self) -> Option<EventTime> {
        (self.next < self.values.len()).then(|| EventTime::from_s(self.next as f64 / self.rate_hz))
    }
}

impl WfdbRows {
    fn open(path: &Path, config: &Config) -> Result<Self, FileError> {
        let record = wfdb::Record::open(path)?;
        let (mut states, mut signals) = (Vec::new(), Vec::new());
        for (index, signal) in record.signals.iter().enumerate() {
            let state = config.state_of_label(&signal.name);
            let state = state.and_then(|name| Pressures::NAMES.iter().position(|known| *known == name));
            let Some(state) = state else { continue };
            if !signal.units.eq_ignore_ascii_case("mmHg") {
                let (name, found) = (Pressures::NAMES[state], &signal.units);
                tracing::warn!("{}: a signal of {name} in {found}, expected mmHg, is ignored", signal.name);
                continue;
            }
            if states.contains(&state) {
                tracing::warn!("{}: another signal of {} is ignored", signal.name, Pressures::NAMES[state]);
                continue;
            }
            states.push(state);
            signals.push(Samples { rate_hz: signal.rate_hz, values: record.samples(index)?, next: 0 });
        }
        if states.is_empty() {
            let names: Vec<String> = record.signals.iter().map(|s| format!("{} [{}]", s.name, s.units)).collect();
            let found = format!("the signals {}", names.join(", "));
            let expected = "a pressure in mmHg under a label of the table [labels]";
            return Err(FileError::content(path, None, found, expected));
        }
        Ok(Self { states, signals, start_ns: record.start_ns })
    }

    fn next_row(&mut self) -> Option<Row> {
        let time = self.signals.iter().filter_map(Samples::next_time).min()?;
        let values = self.signals.iter_mut().map(|signal| {
            if signal.next_time() != Some(time) {
                return None;
            }
            signal.next += 1;
            Some(signal.values[signal.next - 1]).filter(|value| !value.is_nan())
        });
        Some(Row { time: time.plus_ns(self.start_ns), values: values.collect() })
    }
}
