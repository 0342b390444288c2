//! All integration tests, one binary: linking zenoh once is enough.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::float_cmp, missing_docs, unreachable_pub)]

mod config;
mod model;
mod support;
mod twin;
mod xtfc;
