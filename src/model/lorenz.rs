//! Lorenz 63, of which everything, all but one term, or nothing may be known.
//!
//! ```text
//! dx/dt = sigma (y - x) + delta_x     dy/dt = x (rho - z) - y + delta_y     dz/dt = x y - beta z + delta_z
//! ```
//!
//! With [`Known::AllButXz`] the term `-x z` of the second row is missing (gray box); with [`Known::Nothing`] the
//! right-hand sides are the deltas alone (black box).
//!
//! | parameter | default | |
//! |---|---|---|
//! | `sigma` | 10 | Prandtl number |
//! | `rho` | 28 | Rayleigh number over its critical value |
//! | `beta` | 8/3 | geometry |
//! | `delta_x`, `delta_y`, `delta_z` | 0 | what the right-hand sides lack |
//!
//! Lorenz, *Deterministic nonperiodic flow*, J. Atmos. Sci. 20 (1963). Everything is dimensionless.

use super::{Model, ParameterInfo, Quantity};
use crate::named_vector;

named_vector! {
    /// Parameters.
    Parameters,
    /// Position of a parameter in the parameter vector.
    Parameter {
        /// Prandtl number.
        sigma: Sigma,
        /// Rayleigh number over its critical value.
        rho: Rho,
        /// Geometry.
        beta: Beta,
        /// What `dx/dt` lacks.
        delta_x: DeltaX,
        /// What `dy/dt` lacks.
        delta_y: DeltaY,
        /// What `dz/dt` lacks.
        delta_z: DeltaZ,
    }
}

const STATES: &[Quantity] =
    &[Quantity { name: "x", unit: "1" }, Quantity { name: "y", unit: "1" }, Quantity { name: "z", unit: "1" }];

const PARAMETERS: &[ParameterInfo] = &[
    ParameterInfo::positive("sigma", "1", 10.0),
    ParameterInfo::positive("rho", "1", 28.0),
    ParameterInfo::positive("beta", "1", 8.0 / 3.0),
    ParameterInfo::missing("delta_x", "1", 1.0, 1e6),
    ParameterInfo::missing("delta_y", "1", 1.0, 1e6),
    ParameterInfo::missing("delta_z", "1", 1.0, 1e6),
];

/// How much of the equations is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Known {
    /// All three right-hand sides.
    #[default]
    Everything,
    /// All but the term `-x z` of the second.
    AllButXz,
    /// None of them.
    Nothing,
}

/// The Lorenz system.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Lorenz {
    /// How much of the equations is known.
    pub known: Known,
}

impl Lorenz {
    /// 1 for what is known, 0 for what is not: the whole, and the term `-x z`.
    fn knowledge(self) -> (f64, f64) {
        match self.known {
            Known::Everything => (1.0, 1.0),
            Known::AllButXz => (1.0, 0.0),
            Known::Nothing => (0.0, 0.0),
        }
    }
}

impl Model for Lorenz {
    type Lanes = super::lanes::NoLanes;

    fn states(&self) -> &[Quantity] {
        STATES
    }

    fn parameters(&self) -> &[ParameterInfo] {
        PARAMETERS
    }

    fn rhs(&self, _: f64, x: &[f64], theta: &[f64], dx: &mut [f64]) {
        let p = Parameters::from_slice(theta);
        let (all, xz) = self.knowledge();
        let [x, y, z] = [x[0], x[1], x[2]];
        dx[0] = all * p.sigma * (y - x) + p.delta_x;
        dx[1] = all * (x * p.rho - y) - xz * x * z + p.delta_y;
        dx[2] = all * (x * y - p.beta * z) + p.delta_z;
    }

    fn rhs_and_state_jacobian(&self, t_s: f64, x: &[f64], theta: &[f64], dx: &mut [f64], dfdx: &mut [f64]) {
        self.rhs(t_s, x, theta, dx);
        let p = Parameters::from_slice(theta);
        let (all, xz) = self.knowledge();
        let [x, y, z] = [x[0], x[1], x[2]];
        dfdx[..9].copy_from_slice(&[
            -all * p.sigma,
            all * p.sigma,
            0.0,
            all * p.rho - xz * z,
            -all,
            -xz * x,
            all * y,
            all * x,
            -all * p.beta,
        ]);
    }

    fn parameter_jacobian(&self, _: f64, x: &[f64], _: &[f64], which: &[usize], dfdtheta: &mut [f64]) {
        let (all, _) = self.knowledge();
        for (column, &p) in which.iter().enumerate() {
            let is = |parameter: Parameter| p == parameter as usize;
            let rows = if is(Parameter::Sigma) {
                [all * (x[1] - x[0]), 0.0, 0.0]
            } else if is(Parameter::Rho) {
                [0.0, all * x[0], 0.0]
            } else if is(Parameter::Beta) {
                [0.0, 0.0, -all * x[2]]
            } else if is(Parameter::DeltaX) {
                [1.0, 0.0, 0.0]
            } else if is(Parameter::DeltaY) {
                [0.0, 1.0, 0.0]
            } else {
                [0.0, 0.0, 1.0]
            };
            rows.iter().enumerate().for_each(|(i, value)| dfdtheta[i * which.len() + column] = *value);
        }
    }
}
