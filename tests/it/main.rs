//! All integration tests, one binary: linking zenoh once is enough.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::float_cmp, clippy::cast_possible_wrap)]
#![allow(clippy::print_stdout, clippy::print_stderr)]
#![allow(missing_docs, unreachable_pub)]

mod alarm;
mod allocations;
mod bedside_alarms;
mod cli;
mod config;
mod discrepancy;
mod files;
mod kalman;
mod lanes;
mod live;
mod model;
mod overload;
mod recording;
mod reproduce;
mod service;
mod stream;
mod support;
mod surprise;
mod tidy;
mod twin;
mod validate;
mod web;
mod window;
mod xtfc;
