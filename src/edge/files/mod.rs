//! Files in and out.

pub mod csv;
pub mod error;
pub mod record;
pub mod wfdb;
