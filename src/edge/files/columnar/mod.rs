//! A small columnar table, and the Parquet file that holds it.
//!
//! Columns are named and have a unit; cells are integers, floats (each possibly missing) or text. Floats keep their
//! bits, NaN included; a missing cell is a null. Metadata of the file: `hemostream.schema`, the version of this layout,
//! and `hemostream.units`, a JSON object from column to unit (`""` where there is none). Compressed with zstd; written
//! and read in row groups of bounded size, so that a table may be longer than memory.
//!
//! Deliberately absent: nested columns, decimals, dates, encryption, and arrow.

mod read;
mod write;

use std::sync::Arc;

pub use read::Reader;
pub use write::Writer;

/// Version of the layout of our files.
pub const SCHEMA: &str = "1";
/// Key of [`SCHEMA`] in the metadata of a file.
pub const SCHEMA_KEY: &str = "hemostream.schema";
/// Key of the units in the metadata of a file.
pub const UNITS_KEY: &str = "hemostream.units";

/// What a column holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// Integers.
    Int,
    /// Integers from 0 to 2^64 - 1, as the bits of an `i64`.
    Unsigned,
    /// Unix time \[ns\], UTC.
    Time,
    /// Numbers.
    Float,
    /// Text.
    Text,
}

/// A column without its cells.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Field {
    /// Its name.
    pub name: String,
    /// Unit of its numbers; empty where there is none.
    pub unit: String,
    /// What it holds.
    pub kind: Kind,
    /// Whether a cell may be missing. Text is never missing; it may be empty.
    pub optional: bool,
}

impl Field {
    /// A column in which every cell is there.
    #[must_use]
    pub fn new(name: impl Into<String>, kind: Kind, unit: &str) -> Self {
        Self { name: name.into(), unit: unit.to_owned(), kind, optional: false }
    }

    /// The same column, whose cells may be missing.
    #[must_use]
    pub fn optional(self) -> Self {
        Self { optional: true, ..self }
    }
}

/// One cell.
#[derive(Debug, Clone, PartialEq)]
pub enum Cell {
    /// Nothing.
    Missing,
    /// An integer, or what is stored as one.
    Int(i64),
    /// A number.
    Float(f64),
    /// Text.
    Text(Arc<str>),
}

impl Cell {
    /// The bits of an unsigned number.
    #[must_use]
    pub fn unsigned(value: u64) -> Self {
        Self::Int(value.cast_signed())
    }

    /// Text of its own.
    #[must_use]
    pub fn text(text: &str) -> Self {
        Self::Text(text.into())
    }
}

/// The cells of a column.
#[derive(Debug, Clone, PartialEq)]
pub enum Column {
    /// Of the kinds [`Kind::Int`], [`Kind::Unsigned`], [`Kind::Time`].
    Int(Vec<Option<i64>>),
    /// Of [`Kind::Float`].
    Float(Vec<Option<f64>>),
    /// Of [`Kind::Text`].
    Text(Vec<Arc<str>>),
}

impl Column {
    fn new(kind: Kind) -> Self {
        match kind {
            Kind::Int | Kind::Unsigned | Kind::Time => Self::Int(Vec::new()),
            Kind::Float => Self::Float(Vec::new()),
            Kind::Text => Self::Text(Vec::new()),
        }
    }

    fn len(&self) -> usize {
        match self {
            Self::Int(cells) => cells.len(),
            Self::Float(cells) => cells.len(),
            Self::Text(cells) => cells.len(),
        }
    }

    fn push(&mut self, cell: Cell) {
        match (self, cell) {
            (Self::Int(cells), Cell::Int(value)) => cells.push(Some(value)),
            (Self::Float(cells), Cell::Float(value)) => cells.push(Some(value)),
            (Self::Text(cells), Cell::Text(text)) => cells.push(text),
            (Self::Int(cells), Cell::Missing) => cells.push(None),
            (Self::Float(cells), Cell::Missing) => cells.push(None),
            (column, cell) => {
                debug_assert!(false, "{cell:?} is not what the column holds");
                match column {
                    Self::Int(cells) => cells.push(None),
                    Self::Float(cells) => cells.push(None),
                    Self::Text(cells) => cells.push("".into()),
                }
            }
        }
    }

    fn append(&mut self, other: Self) {
        match (self, other) {
            (Self::Int(cells), Self::Int(more)) => cells.extend(more),
            (Self::Float(cells), Self::Float(more)) => cells.extend(more),
            (Self::Text(cells), Self::Text(more)) => cells.extend(more),
            (column, other) => debug_assert!(false, "{column:?} and {other:?} are of different kinds"),
        }
    }

    fn clear(&mut self) {
        match self {
            Self::Int(cells) => cells.clear(),
            Self::Float(cells) => cells.clear(),
            Self::Text(cells) => cells.clear(),
        }
    }
}

/// Some rows of a table.
#[derive(Debug, Clone, PartialEq)]
pub struct Batch {
    columns: Vec<Column>,
}

impl Batch {
    /// No rows of these columns.
    #[must_use]
    pub fn new(fields: &[Field]) -> Self {
        Self { columns: fields.iter().map(|f| Column::new(f.kind)).collect() }
    }

    /// Its rows.
    #[must_use]
    pub fn rows(&self) -> usize {
        self.columns.first().map_or(0, Column::len)
    }

    /// Its columns.
    #[must_use]
    pub fn columns(&self) -> &[Column] {
        &self.columns
    }

    /// Adds a row: a cell per column, in order.
    pub fn push(&mut self, row: impl IntoIterator<Item = Cell>) {
        let mut cells = row.into_iter();
        for column in &mut self.columns {
            column.push(cells.next().unwrap_or(Cell::Missing));
        }
        debug_assert!(cells.next().is_none(), "a row has as many cells as there are columns");
    }

    /// Adds rows of the same columns.
    pub fn append(&mut self, other: Self) {
        self.columns.iter_mut().zip(other.columns).for_each(|(column, more)| column.append(more));
    }

    /// Forgets its rows.
    pub fn clear(&mut self) {
        self.columns.iter_mut().for_each(Column::clear);
    }

    /// The integer in a row and a column, if there is one.
    #[must_use]
    pub fn int(&self, row: usize, column: usize) -> Option<i64> {
        match self.columns.get(column)? {
            Column::Int(cells) => *cells.get(row)?,
            Column::Float(_) | Column::Text(_) => None,
        }
    }

    /// The number in a row and a column, if there is one.
    #[must_use]
    pub fn float(&self, row: usize, column: usize) -> Option<f64> {
        match self.columns.get(column)? {
            Column::Float(cells) => *cells.get(row)?,
            Column::Int(_) | Column::Text(_) => None,
        }
    }

    /// The text in a row and a column; empty if there is none.
    #[must_use]
    pub fn text(&self, row: usize, column: usize) -> &str {
        match self.columns.get(column) {
            Some(Column::Text(cells)) => cells.get(row).map_or("", |text| text),
            _ => "",
        }
    }
}

/// Most rows of a row group.
const MAX_GROUP_ROWS: usize = 16_384;
/// Fewest, however many columns there are.
const MIN_GROUP_ROWS: usize = 1024;
/// About how many cells of a row group: 16 MiB in memory.
const GROUP_CELLS: usize = 1 << 20;

/// Rows of a row group with so many columns.
#[must_use]
pub fn group_rows(columns: usize) -> usize {
    (GROUP_CELLS / columns.max(1)).clamp(MIN_GROUP_ROWS, MAX_GROUP_ROWS)
}

#[cfg(test)]
mod tests;
