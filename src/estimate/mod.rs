//! The estimator of one bed: a state machine, `handle(input) -> outputs`.
//!
//! | module | |
//! |---|---|
//! | [`time`] | event time and arrival time, which must not be mixed up |
//! | [`settings`] | everything an estimator is told at the start |
//! | [`window`] | samples in, closed windows out: event time, lateness, gaps, disorder |
//! | [`ensemble`] | the members and one step of all of them |
//! | [`coupling`] | what is free in a window and what the prior is: `independent`, `coupled` |
//! | [`statistics`] | mean, sd by source, quantiles |
//! | [`estimator`] | the state machine that ties these together |
//!
//! Invariants: no clock, socket, thread or log; time, seed and the way to run members side by side are arguments.
//! The same inputs give the same outputs, whatever the number of threads and however the samples are cut into blocks.
//! One failed member never fails a window.
//! Deliberately absent: names of topics, wire formats, wall-clock time.

pub mod adapt;
pub mod beat;
pub mod coupling;
pub mod ensemble;
pub mod estimator;
pub mod member;
pub mod random;
mod rivals;
pub mod settings;
pub mod signal;
pub mod smoother;
pub mod statistics;
pub mod time;
pub mod timing;
pub mod window;
