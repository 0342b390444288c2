//! What is free in a window, with what prior, and what happens to the members between windows.

pub mod coupled;
pub mod independent;

use crate::model::Transform;
use crate::xtfc::problem::Unknowns;

/// The unknowns of the coupled ensemble: initial state and parameters, each in its own coordinate.
#[must_use]
pub fn coupled_unknowns(parameters: &[usize], transforms: &[Transform]) -> Unknowns {
    Unknowns {
        initial_state: true,
        parameters: parameters.to_vec(),
        transforms: transforms.to_vec(),
        // A factor of two, or one typical size, per Gauss-Newton step: far beyond any sensible update.
        max_steps: vec![std::f64::consts::LN_2; parameters.len()],
    }
}

/// The unknowns of the independent ensemble: parameters only, as the paper has them.
#[must_use]
pub fn independent_unknowns(parameters: &[usize]) -> Unknowns {
    Unknowns {
        initial_state: false,
        parameters: parameters.to_vec(),
        transforms: vec![Transform::Linear { scale: 1.0 }; parameters.len()],
        max_steps: vec![f64::INFINITY; parameters.len()],
    }
}
