//! Files in and out.

pub mod csv;
pub mod record;
pub mod wfdb;
