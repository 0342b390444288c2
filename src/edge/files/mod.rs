//! Files in and out.

pub mod csv;
