//! `independent`: the paper's MC X-TFC.
//!
//! Every member has its own features, its own perturbed initial pressures and its own noisy copy of the data, and
//! knows nothing of the others. The state at the start of a window is the end of the previous one. One window says
//! nearly nothing about a parameter, so a row `w_theta (theta - theta_prev) / theta_prev` ties each to its previous
//! value; as a prior root that is `|theta_prev| / w_theta`. Parameters of either sign are tied in units of their
//! typical size.

use crate::estimate::settings::EstimatorSettings;
use crate::model::{ParameterInfo, Transform};

/// How far a parameter may move in a window, as the sd of a prior.
#[must_use]
pub fn prior_sd(theta: f64, info: &ParameterInfo, settings: &EstimatorSettings) -> f64 {
    let size = match info.transform {
        Transform::Log => theta.abs(),
        Transform::Linear { scale } => scale,
    };
    size / settings.weights.parameter
}

/// The diagonal prior root of one member, `[n_parameters x n_parameters]`, row-major, into `root`.
pub fn prior_root(
    theta: &[f64],
    infos: &[ParameterInfo],
    parameters: &[usize],
    settings: &EstimatorSettings,
    root: &mut Vec<f64>,
) {
    let n = parameters.len();
    root.clear();
    root.resize(n * n, 0.0);
    for (k, &p) in parameters.iter().enumerate() {
        root[k * n + k] = prior_sd(theta[p], &infos[p], settings);
    }
}
