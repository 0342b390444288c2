//! Files in and out.

pub mod columnar;
pub mod convert;
pub mod csv;
pub mod error;
pub mod grid;
pub mod parquet;
pub mod record;
pub mod table;
pub mod units;
pub mod wfdb;
pub mod wfdb_write;
pub mod whole;
