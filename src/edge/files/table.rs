//! Tables out, as CSV or as Parquet by the ending of the name: the same columns, the same numbers.

use std::path::Path;

use super::columnar::{Cell, Field, Kind, Writer};
use super::csv::{EventWriter, TableWriter};
use super::error::FileError;
use super::units::Units;
use crate::estimate::time::EventTime;

/// How a table is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TableFormat {
    /// Text.
    Csv,
    /// Columns.
    Parquet,
}

impl TableFormat {
    /// By the ending of a name.
    ///
    /// # Errors
    /// When it is another one.
    pub fn of(path: &Path) -> Result<Self, FileError> {
        let ending = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
        match ending.as_deref() {
            Some("csv") => Ok(Self::Csv),
            Some("parquet") => Ok(Self::Parquet),
            Some(_) => Err(FileError::content(path, None, "another ending", ".csv or .parquet")),
            None => Err(FileError::content(path, None, "no ending", ".csv or .parquet")),
        }
    }
}

/// A table of numbers.
pub enum Table {
    /// As text.
    Csv(TableWriter),
    /// In columns.
    Parquet(Box<Writer>),
}

impl Table {
    /// Begins a table with these columns; only Parquet keeps their units.
    ///
    /// # Errors
    /// When the name has another ending or the file cannot be written.
    pub fn create(path: &Path, header: &[String], units: &Units) -> Result<Self, FileError> {
        match TableFormat::of(path)? {
            TableFormat::Csv => Ok(Self::Csv(TableWriter::create(path, header)?)),
            TableFormat::Parquet => {
                let field = |name: &String| {
                    let field = Field::new(name.clone(), Kind::Float, units.of_column(name));
                    if name == "time_s" { field } else { field.optional() }
                };
                let fields = header.iter().map(field).collect();
                Ok(Self::Parquet(Box::new(Writer::create(path, fields, &[])?)))
            }
        }
    }

    /// Writes a row; NaN becomes a missing cell.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn row(&mut self, values: &[f64]) -> Result<(), FileError> {
        let cell = |value: &f64| if value.is_nan() { Cell::Missing } else { Cell::Float(*value) };
        match self {
            Self::Csv(table) => table.row(values),
            Self::Parquet(table) => table.row(values.iter().map(cell)),
        }
    }

    /// Writes what is left; the file has its name only now.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn finish(self) -> Result<(), FileError> {
        match self {
            Self::Csv(table) => table.finish(),
            Self::Parquet(table) => table.finish().map(|_| ()),
        }
    }
}

/// What happened: `time_s, kind, channel, text`.
pub enum EventTable {
    /// As text.
    Csv(Box<EventWriter>),
    /// In columns.
    Parquet(Box<Writer>),
}

impl EventTable {
    /// Begins a table.
    ///
    /// # Errors
    /// When the name has another ending or the file cannot be written.
    pub fn create(path: &Path) -> Result<Self, FileError> {
        match TableFormat::of(path)? {
            TableFormat::Csv => Ok(Self::Csv(Box::new(EventWriter::create(path)?))),
            TableFormat::Parquet => {
                let text = ["kind", "channel", "text"].map(|name| Field::new(name, Kind::Text, ""));
                let fields = std::iter::once(Field::new("time_s", Kind::Float, "s")).chain(text).collect();
                Ok(Self::Parquet(Box::new(Writer::create(path, fields, &[])?)))
            }
        }
    }

    /// Writes a row.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn row(&mut self, time: EventTime, kind: &str, channel: &str, text: &str) -> Result<(), FileError> {
        match self {
            Self::Csv(table) => table.row(time, kind, channel, text),
            Self::Parquet(table) => {
                let texts = [kind, channel, text].map(Cell::text);
                table.row(std::iter::once(Cell::Float(time.as_s())).chain(texts))
            }
        }
    }

    /// Writes what is left; the file has its name only now.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn finish(self) -> Result<(), FileError> {
        match self {
            Self::Csv(table) => table.finish(),
            Self::Parquet(table) => table.finish().map(|_| ()),
        }
    }
}
