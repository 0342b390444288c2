//! CSV: records of samples in, truth, observations and estimates out.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use super::error::FileError;
use super::whole::Destination;
use crate::edge::config::Config;
use crate::estimate::beat::BeatEstimate;
use crate::estimate::ensemble::ParameterSummary;
use crate::estimate::estimator::Estimate;
use crate::estimate::statistics::Summary;
use crate::estimate::time::EventTime;
use crate::model::Model;
use crate::model::cvsim6::{Cvsim6, Pressures};
use crate::model::discrepancy::Circulation;

/// One row of a record.
#[derive(Debug, Clone, PartialEq)]
pub struct Row {
    /// When.
    pub time: EventTime,
    /// A sample per column of [`RecordReader::states`], where there is one.
    pub values: Vec<Option<f64>>,
}

/// Reads a record row by row: `time_s` and any of the six pressures by name or by monitor label.
pub struct RecordReader {
    path: PathBuf,
    reader: csv::Reader<File>,
    record: csv::StringRecord,
    time_column: usize,
    /// State of each other column, in the order of the file.
    states: Vec<usize>,
    headers: Vec<String>,
    last: Option<EventTime>,
}

impl RecordReader {
    /// Opens a record and checks its header.
    ///
    /// # Errors
    /// When the file cannot be read, is empty, has no `time_s`, or a column that is no pressure.
    pub fn open(path: &Path, config: &Config) -> Result<Self, FileError> {
        let file = File::open(path).map_err(|e| FileError::file(path, &e))?;
        let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).from_reader(file);
        let headers: Vec<String> = reader
            .headers()
            .map_err(|e| FileError::content(path, Some(1), e.to_string(), "a CSV header"))?
            .iter()
            .map(str::to_owned)
            .collect();
        if headers.is_empty() {
            return Err(FileError::content(path, None, "an empty file", "a CSV header with `time_s` and pressures"));
        }
        let Some(time_column) = headers.iter().position(|h| h == "time_s") else {
            let found = format!("columns {}", headers.join(", "));
            return Err(FileError::content(path, Some(1), found, "a column `time_s` [s]"));
        };
        let mut states = Vec::new();
        for header in headers.iter().filter(|h| *h != "time_s") {
            let state = config.state_of_label(header);
            let Some(index) = Pressures::NAMES.iter().position(|name| Some(*name) == state) else {
                let names = Pressures::NAMES.join(", ");
                let expected = format!("a pressure ({names}) or a label of the table [labels]");
                return Err(FileError::content(path, Some(1), format!("column `{header}`"), &expected));
            };
            if states.contains(&index) {
                let found = format!("column `{header}`, a second one for {}", Pressures::NAMES[index]);
                return Err(FileError::content(path, Some(1), found, "one column per pressure"));
            }
            states.push(index);
        }
        if headers.iter().filter(|h| *h == "time_s").count() > 1 {
            return Err(FileError::content(path, Some(1), "two columns `time_s`", "one"));
        }
        if states.is_empty() {
            return Err(FileError::content(path, Some(1), "no column but `time_s`", "at least one pressure"));
        }
        let record = csv::StringRecord::new();
        Ok(Self { path: path.to_owned(), reader, record, time_column, states, headers, last: None })
    }

    /// The state that each value of a row belongs to.
    #[must_use]
    pub fn states(&self) -> &[usize] {
        &self.states
    }

    /// The next row; None at the end.
    ///
    /// # Errors
    /// When a cell is not a number, or time does not increase.
    pub fn next_row(&mut self) -> Result<Option<Row>, FileError> {
        let more = self.reader.read_record(&mut self.record);
        let line = self.record.position().map(csv::Position::line);
        if !more.map_err(|e| {
            FileError::content(
                &self.path,
                e.position().map(csv::Position::line),
                e.to_string(),
                "a row like the header",
            )
        })? {
            if self.last.is_none() {
                return Err(FileError::content(&self.path, None, "no row", "at least one sample"));
            }
            return Ok(None);
        }
        let mut time = None;
        let mut values = Vec::with_capacity(self.states.len());
        for (column, cell) in self.record.iter().enumerate() {
            if column == self.time_column {
                time = Some(EventTime::from_s(self.number(cell, column, line)?));
            } else if cell.is_empty() {
                values.push(None);
            } else {
                values.push(Some(self.number(cell, column, line)?));
            }
        }
        let Some(time) = time else {
            return Err(FileError::content(&self.path, line, "no time", "a number in `time_s`"));
        };
        if let Some(last) = self.last.filter(|last| *last >= time) {
            let found = format!("time_s {} after {}", time.as_s(), last.as_s());
            return Err(FileError::content(&self.path, line, found, "strictly increasing times"));
        }
        self.last = Some(time);
        Ok(Some(Row { time, values }))
    }

    fn number(&self, cell: &str, column: usize, line: Option<u64>) -> Result<f64, FileError> {
        let value = cell.parse::<f64>().ok().filter(|v| column != self.time_column || v.is_finite());
        value.ok_or_else(|| {
            let found = format!("`{cell}` in column `{}`", self.headers.get(column).map_or("", String::as_str));
            let empty =
                if column == self.time_column { "a number" } else { "a number, or nothing for a missing sample" };
            FileError::content(&self.path, line, found, empty)
        })
    }
}

/// Writes rows of numbers under a header. Numbers are written so that they read back exactly. The file has its name
/// when it is finished, and not before.
pub struct TableWriter {
    path: PathBuf,
    writer: BufWriter<Destination>,
    columns: usize,
    line: String,
}

impl TableWriter {
    /// Begins the file and writes the header.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn create(path: &Path, header: &[String]) -> Result<Self, FileError> {
        let writer = BufWriter::new(Destination::create(path)?);
        let mut table = Self { path: path.to_owned(), writer, columns: header.len(), line: header.join(",") };
        table.write_line()?;
        Ok(table)
    }

    /// Writes a row; NaN becomes an empty cell.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn row(&mut self, values: &[f64]) -> Result<(), FileError> {
        debug_assert_eq!(values.len(), self.columns, "a row has as many cells as the header");
        self.line.clear();
        let mut digits = zmij::Buffer::new();
        for (i, value) in values.iter().enumerate() {
            if i > 0 {
                self.line.push(',');
            }
            if !value.is_nan() {
                let text = digits.format(*value);
                self.line.push_str(text.strip_suffix(".0").unwrap_or(text));
            }
        }
        self.write_line()
    }

    fn write_line(&mut self) -> Result<(), FileError> {
        self.line.push('\n');
        self.writer.write_all(self.line.as_bytes()).map_err(|e| FileError::file(&self.path, &e))
    }

    /// Writes what is buffered and gives the file its name.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn finish(self) -> Result<(), FileError> {
        self.writer.into_inner().map_err(|e| FileError::file(&self.path, &e))?.finish()
    }
}

/// Writes what happened, row by row: `time_s, kind, channel, text`. The file has its name when it is finished, and not
/// before.
pub struct EventWriter {
    path: PathBuf,
    writer: csv::Writer<Destination>,
}

impl EventWriter {
    /// Begins the file and writes the header.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn create(path: &Path) -> Result<Self, FileError> {
        let mut writer = csv::Writer::from_writer(Destination::create(path)?);
        writer.write_record(["time_s", "kind", "channel", "text"]).map_err(|e| FileError::file(path, &e))?;
        Ok(Self { path: path.to_owned(), writer })
    }

    /// Writes a row.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn row(&mut self, time: EventTime, kind: &str, channel: &str, text: &str) -> Result<(), FileError> {
        let time = time.as_s().to_string();
        self.writer.write_record([time.as_str(), kind, channel, text]).map_err(|e| FileError::file(&self.path, &e))
    }

    /// Writes what is buffered and gives the file its name.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn finish(self) -> Result<(), FileError> {
        self.writer.into_inner().map_err(|e| FileError::file(&self.path, &e))?.finish()
    }
}

/// Header of an estimate file: `time_s`, seven statistics per quantity, four per parameter.
#[must_use]
pub fn estimate_header(model: &Circulation, estimated: &[usize]) -> Vec<String> {
    let quantities = model.states().iter().chain(model.derived()).flat_map(|q| {
        ["mean", "sd", "q05", "q95", "epistemic_sd", "aleatoric_sd", "model_sd"].map(|s| format!("{}_{s}", q.name))
    });
    let name = |p: &usize| model.parameters()[*p].name;
    let parameters = estimated.iter().flat_map(|p| ["mean", "sd", "q05", "q95"].map(|s| format!("{}_{s}", name(p))));
    std::iter::once("time_s".to_owned()).chain(quantities).chain(parameters).collect()
}

/// A row of an estimate file.
#[must_use]
pub fn estimate_row(estimate: &Estimate) -> Vec<f64> {
    let quantity = |s: &Summary| [s.mean, s.sd, s.q05, s.q95, s.epistemic_sd, s.aleatoric_sd, s.model_sd];
    let parameter = |(p, _): &(ParameterSummary, i64)| {
        let s = &p.summary;
        [s.mean, s.sd, s.q05, s.q95]
    };
    std::iter::once(estimate.time.as_s())
        .chain(estimate.quantities.iter().flat_map(quantity))
        .chain(estimate.parameters.iter().flat_map(parameter))
        .collect()
}

/// Header of a table of beats: onset, end, four statistics per clinical quantity.
#[must_use]
pub fn beat_header(model: &Circulation) -> Vec<String> {
    let statistics = |name: &'static str| ["mean", "sd", "q05", "q95"].map(|s| format!("{name}_{s}"));
    let quantities = model.clinical().iter().flat_map(|q| statistics(q.name));
    ["time_s", "end_s"].into_iter().map(str::to_owned).chain(quantities).collect()
}

/// A row of a table of beats.
#[must_use]
pub fn beat_row(beat: &BeatEstimate) -> Vec<f64> {
    let quantities = beat.values.iter().flat_map(|s| [s.mean, s.sd, s.q05, s.q95]);
    [beat.start.as_s(), beat.end.as_s()].into_iter().chain(quantities).collect()
}

/// Header of a truth file: `time_s`, pressures, flows, volumes, and the parameters that change.
#[must_use]
pub fn truth_header(model: Cvsim6, changing: &[usize]) -> Vec<String> {
    let quantities = model.states().iter().chain(model.derived()).map(|q| q.name);
    let parameters = changing.iter().map(|&p| model.parameters()[p].name);
    std::iter::once("time_s").chain(quantities).chain(parameters).map(str::to_owned).collect()
}
