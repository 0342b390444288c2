//! The edge: everything that touches the outside — topics, bytes, files, configuration.
//!
//! Invariants: types that cross a wire or a disk live in [`wire`], carry a schema version, and are converted by
//! hand from the core's types. Units are converted here and nowhere else.
//! Deliberately absent: mathematics.

pub mod bus;
pub mod wire;
