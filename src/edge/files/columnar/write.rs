//! Rows to a Parquet file.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use parquet::basic::{Compression, Encoding, LogicalType, Repetition, TimeUnit, Type as Physical, ZstdLevel};
use parquet::data_type::{ByteArray, ByteArrayType, DoubleType, Int64Type};
use parquet::errors::ParquetError;
use parquet::file::metadata::KeyValue;
use parquet::file::properties::{EnabledStatistics, WriterProperties};
use parquet::file::writer::{SerializedColumnWriter, SerializedFileWriter};
use parquet::schema::types::{ColumnPath, Type};

use super::{Batch, Cell, Column, Field, Kind, SCHEMA, SCHEMA_KEY, UNITS_KEY, group_rows};
use crate::edge::files::error::FileError;
use crate::edge::files::whole::WholeFile;

/// Level of the compression: more costs time and gains little on numbers.
const ZSTD_LEVEL: i32 = 3;

/// Writes a table row by row; the file has its name when it is finished, and not before.
pub struct Writer {
    path: PathBuf,
    fields: Vec<Field>,
    file: SerializedFileWriter<WholeFile>,
    pending: Batch,
    group_rows: usize,
    rows: u64,
}

impl Writer {
    /// Begins a file with these columns and more metadata than that of every file.
    ///
    /// # Errors
    /// When the file cannot be written, or two columns have one name.
    pub fn create(path: &Path, fields: Vec<Field>, metadata: &[(&str, String)]) -> Result<Self, FileError> {
        if let Some(twice) = fields.iter().enumerate().find(|(i, f)| fields[..*i].iter().any(|g| g.name == f.name)) {
            return Err(FileError::content(path, None, format!("two columns `{}`", twice.1.name), "one of a name"));
        }
        let failed = |e: ParquetError| FileError::file(path, &e);
        let schema = schema(&fields).map_err(failed)?;
        let properties = properties(&fields, metadata).map_err(failed)?;
        let file = SerializedFileWriter::new(WholeFile::create(path)?, schema, Arc::new(properties)).map_err(failed)?;
        let (pending, group_rows) = (Batch::new(&fields), group_rows(fields.len()));
        Ok(Self { path: path.to_owned(), fields, file, pending, group_rows, rows: 0 })
    }

    /// Adds a row: a cell per column, in order.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn row(&mut self, cells: impl IntoIterator<Item = Cell>) -> Result<(), FileError> {
        self.pending.push(cells);
        if self.pending.rows() >= self.group_rows { self.write_group() } else { Ok(()) }
    }

    /// Adds rows of the same columns.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn batch(&mut self, batch: Batch) -> Result<(), FileError> {
        self.pending.append(batch);
        if self.pending.rows() >= self.group_rows { self.write_group() } else { Ok(()) }
    }

    /// Rows so far.
    #[must_use]
    pub fn rows(&self) -> u64 {
        self.rows + self.pending.rows() as u64
    }

    /// Writes what is left and gives the file its name; returns its size \[bytes\].
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn finish(mut self) -> Result<u64, FileError> {
        self.write_group()?;
        let path = self.path;
        // The footer is written on the way.
        self.file.into_inner().map_err(|e| FileError::file(&path, &e))?.finish()
    }

    fn write_group(&mut self) -> Result<(), FileError> {
        if self.pending.rows() == 0 {
            return Ok(());
        }
        for (field, column) in self.fields.iter().zip(self.pending.columns()) {
            if !field.optional && has_missing(column) {
                let found = format!("a missing cell in column `{}`", field.name);
                return Err(FileError::content(&self.path, None, found, "a value in every row"));
            }
        }
        let failed = |e: ParquetError| FileError::file(&self.path, &e);
        let mut group = self.file.next_row_group().map_err(failed)?;
        for (field, column) in self.fields.iter().zip(self.pending.columns()) {
            let Some(mut writer) = group.next_column().map_err(failed)? else { break };
            write_column(&mut writer, field, column).map_err(failed)?;
            writer.close().map_err(failed)?;
        }
        group.close().map_err(failed)?;
        self.rows += self.pending.rows() as u64;
        self.pending.clear();
        Ok(())
    }
}

fn has_missing(column: &Column) -> bool {
    match column {
        Column::Int(cells) => cells.iter().any(Option::is_none),
        Column::Float(cells) => cells.iter().any(Option::is_none),
        Column::Text(_) => false,
    }
}

fn write_column(writer: &mut SerializedColumnWriter<'_>, field: &Field, column: &Column) -> Result<(), ParquetError> {
    match column {
        Column::Int(cells) => {
            let values: Vec<i64> = cells.iter().copied().flatten().collect();
            writer.typed::<Int64Type>().write_batch(&values, levels(field, cells).as_deref(), None)?;
        }
        Column::Float(cells) => {
            let values: Vec<f64> = cells.iter().copied().flatten().collect();
            writer.typed::<DoubleType>().write_batch(&values, levels(field, cells).as_deref(), None)?;
        }
        Column::Text(cells) => {
            let values: Vec<ByteArray> = cells.iter().map(|text| ByteArray::from(&**text)).collect();
            writer.typed::<ByteArrayType>().write_batch(&values, None, None)?;
        }
    }
    Ok(())
}

/// Which cells are there, as Parquet counts it; None where all must be.
fn levels<T>(field: &Field, cells: &[Option<T>]) -> Option<Vec<i16>> {
    field.optional.then(|| cells.iter().map(|cell| i16::from(cell.is_some())).collect())
}

fn schema(fields: &[Field]) -> Result<Arc<Type>, ParquetError> {
    let column = |field: &Field| {
        let (physical, logical) = match field.kind {
            Kind::Int => (Physical::INT64, None),
            Kind::Unsigned => (Physical::INT64, Some(LogicalType::integer(64, false))),
            Kind::Time => (Physical::INT64, Some(LogicalType::timestamp(true, TimeUnit::NANOS))),
            Kind::Float => (Physical::DOUBLE, None),
            Kind::Text => (Physical::BYTE_ARRAY, Some(LogicalType::String)),
        };
        let optional = field.optional && field.kind != Kind::Text;
        let repetition = if optional { Repetition::OPTIONAL } else { Repetition::REQUIRED };
        let column = Type::primitive_type_builder(&field.name, physical);
        column.with_repetition(repetition).with_logical_type(logical).build().map(Arc::new)
    };
    let columns = fields.iter().map(column).collect::<Result<Vec<_>, _>>()?;
    Ok(Arc::new(Type::group_type_builder("hemostream").with_fields(columns).build()?))
}

/// Numbers that hardly repeat are not worth a dictionary; each kind has the encoding that packs it best.
fn properties(fields: &[Field], metadata: &[(&str, String)]) -> Result<WriterProperties, ParquetError> {
    let units: serde_json::Map<String, serde_json::Value> =
        fields.iter().map(|f| (f.name.clone(), f.unit.clone().into())).collect();
    let own = [(SCHEMA_KEY, SCHEMA.to_owned()), (UNITS_KEY, serde_json::Value::Object(units).to_string())];
    let pairs = own.iter().chain(metadata).map(|(key, value)| KeyValue::new((*key).to_owned(), value.clone()));
    let mut properties = WriterProperties::builder()
        .set_created_by(concat!("hemostream ", env!("CARGO_PKG_VERSION")).to_owned())
        .set_compression(Compression::ZSTD(ZstdLevel::try_new(ZSTD_LEVEL)?))
        .set_statistics_enabled(EnabledStatistics::Chunk)
        .set_offset_index_disabled(true)
        .set_key_value_metadata(Some(pairs.collect()));
    for field in fields {
        let path = ColumnPath::from(field.name.as_str());
        let encoding = match field.kind {
            Kind::Text => continue,
            Kind::Float => Encoding::BYTE_STREAM_SPLIT,
            Kind::Int | Kind::Unsigned | Kind::Time => Encoding::DELTA_BINARY_PACKED,
        };
        properties = properties.set_column_dictionary_enabled(path.clone(), false).set_column_encoding(path, encoding);
    }
    Ok(properties.build())
}
