//! A damped linear oscillator, of which everything or nothing may be known.
//!
//! ```text
//! dx/dt = y + delta_x          dy/dt = -omega^2 x - 2 zeta omega y + delta_y
//! ```
//!
//! With [`Known::Nothing`] the right-hand sides are the deltas alone: the black box.
//!
//! | parameter | default | unit | |
//! |---|---|---|---|
//! | `omega` | 2 | 1/s | angular frequency |
//! | `zeta` | 0.1 | 1 | damping ratio |
//! | `delta_x`, `delta_y` | 0 | 1/s, 1/s^2 | what the right-hand sides lack |

use super::{Model, ParameterInfo, Quantity};
use crate::named_vector;

named_vector! {
    /// Parameters; units in the table above.
    Parameters,
    /// Position of a parameter in the parameter vector.
    Parameter {
        /// Angular frequency \[1/s\].
        omega: Omega,
        /// Damping ratio.
        zeta: Zeta,
        /// What `dx/dt` lacks.
        delta_x: DeltaX,
        /// What `dy/dt` lacks.
        delta_y: DeltaY,
    }
}

const STATES: &[Quantity] = &[Quantity { name: "x", unit: "1" }, Quantity { name: "y", unit: "1/s" }];

const PARAMETERS: &[ParameterInfo] = &[
    ParameterInfo::positive("omega", "1/s", 2.0),
    ParameterInfo::positive("zeta", "1", 0.1),
    ParameterInfo::missing("delta_x", "1/s", 1.0, 1e6),
    ParameterInfo::missing("delta_y", "1/s^2", 1.0, 1e6),
];

/// How much of the equations is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Known {
    /// Both right-hand sides.
    #[default]
    Everything,
    /// None of them.
    Nothing,
}

/// The oscillator.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Oscillator {
    /// How much of the equations is known.
    pub known: Known,
}

impl Model for Oscillator {
    type Lanes = super::lanes::NoLanes;

    fn states(&self) -> &[Quantity] {
        STATES
    }

    fn parameters(&self) -> &[ParameterInfo] {
        PARAMETERS
    }

    fn rhs(&self, _: f64, x: &[f64], theta: &[f64], dx: &mut [f64]) {
        let Parameters { omega, zeta, delta_x, delta_y } = Parameters::from_slice(theta);
        (dx[0], dx[1]) = match self.known {
            Known::Everything => (x[1] + delta_x, -omega * omega * x[0] - 2.0 * zeta * omega * x[1] + delta_y),
            Known::Nothing => (delta_x, delta_y),
        };
    }

    fn rhs_and_state_jacobian(&self, t_s: f64, x: &[f64], theta: &[f64], dx: &mut [f64], dfdx: &mut [f64]) {
        let Parameters { omega, zeta, .. } = Parameters::from_slice(theta);
        self.rhs(t_s, x, theta, dx);
        dfdx[..4].copy_from_slice(&match self.known {
            Known::Everything => [0.0, 1.0, -omega * omega, -2.0 * zeta * omega],
            Known::Nothing => [0.0; 4],
        });
    }

    fn parameter_jacobian(&self, _: f64, x: &[f64], theta: &[f64], which: &[usize], dfdtheta: &mut [f64]) {
        let Parameters { omega, zeta, .. } = Parameters::from_slice(theta);
        let known = self.known == Known::Everything;
        for (column, &p) in which.iter().enumerate() {
            let (by_x, by_y) = if p == Parameter::DeltaX as usize {
                (1.0, 0.0)
            } else if p == Parameter::DeltaY as usize {
                (0.0, 1.0)
            } else if known && p == Parameter::Omega as usize {
                (0.0, -2.0 * omega * x[0] - 2.0 * zeta * x[1])
            } else if known && p == Parameter::Zeta as usize {
                (0.0, -2.0 * omega * x[1])
            } else {
                (0.0, 0.0)
            };
            (dfdtheta[column], dfdtheta[which.len() + column]) = (by_x, by_y);
        }
    }
}
