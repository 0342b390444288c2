//! The edge: everything that touches the outside — topics, bytes, files, configuration.
//!
//! Invariants: types that cross a wire or a disk live in [`wire`], carry a schema version, and are converted by
//! hand from the core's types. Units are converted here and nowhere else.
//! Deliberately absent: mathematics.

pub mod bus;
pub mod config;
pub mod dashboard;
pub mod files;
pub mod inlet;
pub mod operator;
pub mod outlet;
pub mod recent;
pub mod recording;
pub mod replay;
pub mod scoreboard;
pub mod settings;
pub mod synthetic;
pub mod wire;
pub mod zenoh;
