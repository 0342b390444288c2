//! The X-TFC solver: one window of one ensemble member.
//!
//! | module | noun of the formula |
//! |---|---|
//! | [`features`] | random features `sigma(w z + b)` and collocation nodes |
//! | [`basis`] | constrained expression, orthonormalised per member |
//! | [`problem`] | unknowns, priors, rows: what is minimised |
//! | [`dense`] | general solver: Gauss-Newton on dense least squares, any shape; the readable reference |
//! | [`collocation`] | the same minimiser when there are as many features as nodes, several times cheaper |
//! | [`sweeps`] | the same without samples, for eight members at once |
//!
//! Invariants: a pure function of the problem; a failed solve is a value with an account of itself.
//! Deliberately absent: ensembles, random draws other than the features, event time, channels.

pub mod basis;
pub mod collocation;
pub mod dense;
pub mod features;
pub(crate) mod lu;
pub mod problem;
pub mod sweeps;
