//! All integration tests, one binary: linking zenoh once is enough.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::float_cmp, missing_docs, unreachable_pub)]

mod model;
mod support;
mod xtfc;
