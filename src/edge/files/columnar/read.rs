//! Rows from a Parquet file, ours or somebody else's.

use std::collections::BTreeMap;
use std::fs::File;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use parquet::basic::{LogicalType, Repetition, TimeUnit, Type as Physical};
use parquet::column::reader::{ColumnReader, ColumnReaderImpl};
use parquet::data_type::{ByteArray, DataType};
use parquet::errors::ParquetError;
use parquet::file::reader::FileReader;
use parquet::file::serialized_reader::SerializedFileReader;
use parquet::schema::types::{ColumnDescPtr, SchemaDescriptor};

use super::{Batch, Column, Field, Kind, UNITS_KEY};
use crate::edge::files::error::FileError;

/// Most columns of a file: far more than our widest table.
const MAX_COLUMNS: usize = 16_384;

/// Reads a table from its start to its end.
pub struct Reader {
    path: PathBuf,
    file: SerializedFileReader<File>,
    fields: Vec<Field>,
    metadata: BTreeMap<String, String>,
    next_group: usize,
    columns: Vec<ColumnReader>,
    left_in_group: usize,
}

impl Reader {
    /// Opens a file and reads what it says of its columns.
    ///
    /// # Errors
    /// When it cannot be read, is no Parquet, or has a column that is nested or of a kind not supported.
    pub fn open(path: &Path) -> Result<Self, FileError> {
        let file = File::open(path).map_err(|e| FileError::file(path, &e))?;
        let bytes = file.metadata().map_err(|e| FileError::file(path, &e))?.len();
        let file = guarded(|| SerializedFileReader::new(file))
            .and_then(|file| check_places(&file, bytes).map(|()| file))
            .map_err(|e| FileError::content(path, None, format!("no Parquet ({e})"), "a Parquet file"))?;
        let about = file.metadata().file_metadata();
        let pairs = about.key_value_metadata().map(Vec::as_slice).unwrap_or_default();
        let metadata: BTreeMap<String, String> =
            pairs.iter().filter_map(|kv| Some((kv.key.clone(), kv.value.clone()?))).collect();
        let units = metadata.get(UNITS_KEY).and_then(|json| serde_json::from_str(json).ok()).unwrap_or_default();
        let fields = fields(path, about.schema_descr(), &units)?;
        Ok(Self { path: path.to_owned(), file, fields, metadata, next_group: 0, columns: Vec::new(), left_in_group: 0 })
    }

    /// Its columns.
    #[must_use]
    pub fn fields(&self) -> &[Field] {
        &self.fields
    }

    /// Where a column stands.
    #[must_use]
    pub fn column(&self, name: &str) -> Option<usize> {
        self.fields.iter().position(|f| f.name == name)
    }

    /// What the file says of itself under a key.
    #[must_use]
    pub fn metadata(&self, key: &str) -> Option<&str> {
        self.metadata.get(key).map(String::as_str)
    }

    /// All it says of itself.
    #[must_use]
    pub fn all_metadata(&self) -> &BTreeMap<String, String> {
        &self.metadata
    }

    /// Its rows.
    #[must_use]
    pub fn rows(&self) -> u64 {
        u64::try_from(self.file.metadata().file_metadata().num_rows()).unwrap_or(0)
    }

    /// The next rows, at most `max`; None at the end.
    ///
    /// # Errors
    /// When the file is damaged.
    pub fn next_batch(&mut self, max: usize) -> Result<Option<Batch>, FileError> {
        while self.left_in_group == 0 {
            if self.next_group >= self.file.num_row_groups() {
                return Ok(None);
            }
            guarded(|| self.open_group()).map_err(|e| FileError::file(&self.path, &e))?;
        }
        let rows = self.left_in_group.min(max.max(1));
        let mut columns = Vec::with_capacity(self.columns.len());
        for (reader, field) in self.columns.iter_mut().zip(&self.fields) {
            let column = guarded(|| read_column(reader, rows)).map_err(|e| FileError::file(&self.path, &e))?;
            if column.len() != rows {
                let found = format!("{} cells in column `{}`", column.len(), field.name);
                return Err(FileError::content(&self.path, None, found, &format!("{rows}, as the file says")));
            }
            columns.push(column);
        }
        self.left_in_group -= rows;
        Ok(Some(Batch { columns }))
    }

    fn open_group(&mut self) -> Result<(), ParquetError> {
        let group = self.file.get_row_group(self.next_group)?;
        self.next_group += 1;
        self.left_in_group = usize::try_from(group.metadata().num_rows()).unwrap_or(0);
        self.columns = (0..self.fields.len()).map(|i| group.get_column_reader(i)).collect::<Result<_, _>>()?;
        Ok(())
    }
}

/// The crate checks some of what a damaged file says by assertions; one file must not take the program with it.
fn guarded<T>(read: impl FnOnce() -> Result<T, ParquetError>) -> Result<T, ParquetError> {
    let damaged = |_| Err(ParquetError::General("the file is damaged".to_owned()));
    catch_unwind(AssertUnwindSafe(read)).unwrap_or_else(damaged)
}

/// Refuses columns that are said to be elsewhere than in the file.
fn check_places(file: &SerializedFileReader<File>, bytes: u64) -> Result<(), ParquetError> {
    for column in file.metadata().row_groups().iter().flat_map(|group| group.columns()) {
        let start = column.dictionary_page_offset().unwrap_or(column.data_page_offset());
        let ends = start.checked_add(column.compressed_size()).and_then(|end| u64::try_from(end).ok());
        let sound = start >= 0 && column.data_page_offset() >= 0 && column.compressed_size() >= 0;
        if !sound || column.num_values() < 0 || ends.is_none_or(|end| end > bytes) {
            return Err(ParquetError::General("a column beyond the file".to_owned()));
        }
    }
    Ok(())
}

fn fields(path: &Path, schema: &SchemaDescriptor, units: &BTreeMap<String, String>) -> Result<Vec<Field>, FileError> {
    if schema.num_columns() > MAX_COLUMNS {
        let found = format!("{} columns", schema.num_columns());
        return Err(FileError::content(path, None, found, &format!("at most {MAX_COLUMNS}")));
    }
    let field = |column: &ColumnDescPtr| {
        let name = column.path().string();
        let fail = |found: &str| {
            let found = format!("column `{name}`, which is {found}");
            FileError::content(path, None, found, "a flat column of integers, floats or text")
        };
        if column.path().parts().len() != 1 || column.max_rep_level() > 0 {
            return Err(fail("nested"));
        }
        let unit = units.get(&name).map_or("", String::as_str);
        let kind = kind(column).ok_or_else(|| fail(&format!("of type {}", column.physical_type())))?;
        let optional = column.self_type().get_basic_info().repetition() == Repetition::OPTIONAL;
        // Missing text is read as empty.
        Ok(Field { optional: optional && kind != Kind::Text, ..Field::new(name.clone(), kind, unit) })
    };
    schema.columns().iter().map(field).collect()
}

/// What a column holds; None if it is nothing that we read. Times of another resolution than ours would be taken for ours.
fn kind(column: &ColumnDescPtr) -> Option<Kind> {
    match (column.physical_type(), column.logical_type_ref()) {
        (Physical::INT64, Some(LogicalType::Timestamp(time))) => (time.unit == TimeUnit::NANOS).then_some(Kind::Time),
        (Physical::INT64, Some(LogicalType::Integer(int))) if !int.is_signed => Some(Kind::Unsigned),
        (Physical::INT64 | Physical::INT32, None | Some(LogicalType::Integer(_))) => Some(Kind::Int),
        (Physical::DOUBLE | Physical::FLOAT, None) => Some(Kind::Float),
        (Physical::BYTE_ARRAY, None | Some(LogicalType::String | LogicalType::Json | LogicalType::Enum)) => {
            Some(Kind::Text)
        }
        _ => None,
    }
}

fn read_column(reader: &mut ColumnReader, rows: usize) -> Result<Column, ParquetError> {
    match reader {
        ColumnReader::Int64ColumnReader(reader) => Ok(Column::Int(cells(reader, rows)?)),
        ColumnReader::Int32ColumnReader(reader) => {
            Ok(Column::Int(cells(reader, rows)?.into_iter().map(|cell| cell.map(i64::from)).collect()))
        }
        ColumnReader::DoubleColumnReader(reader) => Ok(Column::Float(cells(reader, rows)?)),
        ColumnReader::FloatColumnReader(reader) => {
            Ok(Column::Float(cells(reader, rows)?.into_iter().map(|cell| cell.map(f64::from)).collect()))
        }
        ColumnReader::ByteArrayColumnReader(reader) => Ok(Column::Text(texts(cells(reader, rows)?)?)),
        _ => Err(ParquetError::General("a column of another type than the file says".to_owned())),
    }
}

/// The next cells of a column.
fn cells<T: DataType>(reader: &mut ColumnReaderImpl<T>, rows: usize) -> Result<Vec<Option<T::T>>, ParquetError> {
    let (mut levels, mut values) = (Vec::new(), Vec::new());
    let (records, found, _) = reader.read_records(rows, Some(&mut levels), None, &mut values)?;
    if levels.is_empty() {
        return Ok(values.into_iter().map(Some).collect());
    }
    let mut values = values.into_iter().take(found);
    Ok(levels.into_iter().take(records).map(|level| if level > 0 { values.next() } else { None }).collect())
}

/// Text, which repeats: neighbours that are the same share their bytes.
fn texts(cells: Vec<Option<ByteArray>>) -> Result<Vec<Arc<str>>, ParquetError> {
    let mut texts: Vec<Arc<str>> = Vec::with_capacity(cells.len());
    for cell in &cells {
        let text = cell.as_ref().map_or(Ok(""), ByteArray::as_utf8)?;
        match texts.last() {
            Some(last) if **last == *text => texts.push(Arc::clone(last)),
            _ => texts.push(text.into()),
        }
    }
    Ok(texts)
}
