//! What is free in a window, with what prior, and what happens to the members between windows.

pub mod coupled;
pub mod independent;

use crate::model::{Model, Transform};
use crate::xtfc::problem::Unknowns;

/// The unknowns of the coupled ensemble: initial state and parameters, each in its own coordinate.
#[must_use]
pub fn coupled_unknowns<M: Model>(model: &M, parameters: &[usize], transforms: &[Transform]) -> Unknowns {
    let phase = model.cycle().map(|cycle| cycle.phase);
    // A trust region. A quarter, or most of a typical size, is far beyond any sensible update; a clock that moves further
    // than this in one step leaves the part of the beat in which its effect was linear.
    let max_step = |(p, transform): (&usize, &Transform)| match transform {
        _ if Some(*p) == phase => 0.02,
        Transform::Log => 0.25,
        Transform::Linear { .. } => std::f64::consts::LN_2,
    };
    Unknowns {
        initial_state: true,
        parameters: parameters.to_vec(),
        transforms: transforms.to_vec(),
        max_steps: parameters.iter().zip(transforms).map(max_step).collect(),
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
