//! Live hemodynamics with honest uncertainty.
//!
//! hemostream watches blood pressures arrive and says what the circulation behind them is doing: pressures that no
//! sensor sees, flows, volumes, resistances and compliances, each with a band. Every bed has an ensemble of about a
//! hundred members; every member solves the equations of the circulation ([CVSim-6](model::cvsim6)) window by window
//! with a physics-informed random-feature network ([X-TFC](xtfc)), fitted to the equations and to the samples. The
//! method is that of De Florio, Zou, Schiavazzi and Karniadakis, *Quantification of total uncertainty in the
//! physics-informed reconstruction of CVSim-6 physiology* (2024), as `independent`, and a `coupled` ensemble that goes
//! past it.
//!
//! # The way of a sample
//!
//! ```text
//! zenoh topic -> edge::zenoh -> edge::inlet (wire -> task) -> runtime::service (bed, queue) -> runtime::workers
//!   -> estimate::window (event time: which window, when final) -> estimate::ensemble (all members)
//!   -> xtfc (one member, one window) over model -> estimate::statistics (bands)
//!   -> edge::outlet (wire, last values) -> zenoh topic -> edge::dashboard
//! ```
//!
//! It never walks back.
//!
//! # Layers
//!
//! `model <- xtfc <- estimate <- runtime <- edge <- report <- reproduce, validate`: each knows those before it and nothing
//! of those after it, and the last two nothing of each other. The first three are pure: no clock, no socket, no thread, no log; a test checks it. Each module says what it
//! guarantees and what is deliberately absent.
//!
//! # Where to add what
//!
//! | | |
//! |---|---|
//! | a model | one file in [`model`]; [`model::adding_a_model`] is the recipe |
//! | equations of a model for eight members at once | [`model::lanes::LaneModel`], and [`model::Model::lanes`] |
//! | something that a model may lack | a `delta_...` parameter of it, see [`model::discrepancy`] |
//! | an activation, a distribution, a node placement | [`xtfc::features`], and its name in [`edge::config`] |
//! | another way to couple members | [`estimate::coupling`] |
//! | a sensor name of a monitor | the table `[labels]` of the configuration |
//! | a published quantity | [`model::Model::derived`] if it follows from states and parameters |
//! | a topic | a type in [`edge::wire`], encoded in [`edge::outlet`] |
//! | a command | a file in `src/commands` |
//! | a study of the paper | a file in [`reproduce`], and its line in [`reproduce::STUDIES`] |
//! | a patient to validate with | a file in `config/patients`, and its line in [`validate::patients`] |
//! | something that an estimator may be told wrongly | a variant of [`validate::scenario::Scenario`] |

pub mod benchmarks {
    #![doc = include_str!("benchmarks.md")]
    #![doc = include_str!("benchmarks.svg")]
}
pub mod edge;
pub mod estimate;
pub mod model;
pub mod report;
pub mod reproduce;
pub mod runtime;
pub mod validate;
pub mod xtfc;
