//! The estimator of one bed: a state machine, `handle(input) -> outputs`.
//!
//! | module | |
//! |---|---|
//! | [`time`] | event time and arrival time, which must not be mixed up |
//! | [`settings`] | everything an estimator is told at the start |
//! | [`window`] | samples in, closed windows out: event time, lateness, gaps, disorder |
//! | [`ensemble`] | the members, one step of all of them, the second look, their clocks, how many take part, what they say together |
//! | [`batch`] | eight members: their features, states and parameters, and one window of work on them |
//! | [`coupling`] | what is free in a window and what the prior is: `independent`, `coupled` |
//! | [`cloud`] | rows over the members as a cloud: mean, covariance, directions |
//! | [`random`] | noise over the members with exact moments |
//! | [`adapt`] | what is learnt about the assumptions: the pace of parameters, the noise of sensors, the fit of the model |
//! | `rivals` | the unscented and the ensemble Kalman filter behind the same interface |
//! | [`signal`] | beat onsets and artefacts, read off a waveform without a model |
//! | [`timing`] | the beat from outside or found in the pressures, against the clock of the members |
//! | [`smoother`] | the members at past times, corrected by what came since |
//! | [`beat`] | clinical figures per beat |
//! | [`alarm`] | limits, judged on the bands |
//! | [`statistics`] | mean, sd by source, quantiles |
//! | [`messages`] | what an estimator can be told, and what it says |
//! | [`estimator`] | the state machine that ties these together |
//!
//! # How the bands come to hold
//!
//! The sampling error of a hundred members is taken out: with exact moments the ensemble *is* the Kalman filter where
//! the model is linear. What is left to go wrong are the assumptions, and each has one that watches it:
//!
//! 1. *How fast a parameter moves* is learnt per parameter by hypotheses side by side ([`adapt::pace`]); when one begins
//!    to move, the windows of the last moments are solved again with the new pace. Where the settings pull a parameter to
//!    a centre, pace and pull are a statement of the user and stay.
//! 2. *How noisy a sensor is* shows in the differences of neighbouring innovations, whatever the model does.
//! 3. *Whether the model fits* shows in innovations that agree with their neighbours, or that come back with every beat
//!    ([`adapt::fit`]). The first adds process noise to what the sensor observes, and some to the other sensors'; the second widens
//!    the model's part of that channel's band by what is missed, phase by phase. Past a limit it is a misfit, which is said.
//! 4. *A single sample that is far off* pulls no harder than one that is just credible (Huber); a sensor that is
//!    disturbed is set aside ([`signal::quality`]) and its channel is forecast meanwhile.
//!
//! Invariants: no clock, socket, thread or log; time, seed and the way to run members side by side are arguments.
//! The same inputs give the same outputs, whatever the number of threads and however the samples are cut into blocks.
//! One failed member never fails a window.
//! Deliberately absent: names of topics, wire formats, wall-clock time.

pub mod adapt;
pub mod alarm;
pub mod batch;
pub mod beat;
pub mod cloud;
pub mod coupling;
pub mod ensemble;
pub mod estimator;
pub mod messages;
pub mod random;
mod rivals;
pub mod settings;
pub mod signal;
pub mod smoother;
pub mod statistics;
pub mod time;
pub mod timing;
pub mod window;
