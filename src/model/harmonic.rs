//! The harmonic example of the paper, and of this project: what it takes to add a model, in one file.
//!
//! ```text
//! linear       dx/dt = cos(k t) / k + delta          x = x(0) + sin(k t) / k^2     (delta = 0)
//! growing      dx/dt = x cos(k t) / k + delta        x = x(0) exp(sin(k t) / k^2)  (delta = 0)
//! ```
//!
//! | parameter | default | unit | |
//! |---|---|---|---|
//! | `k` | 1 | 1/s | angular frequency, and the inverse of the amplitude |
//! | `delta` | 0 | 1/s | what the right-hand side lacks |
//! | `time` | 0 | s | time at the start of the window, the clock parameter |
//!
//! De Florio, Zou, Schiavazzi and Karniadakis (2024), the section on the benchmark ODE. If the growing law is the truth
//! and the linear law the model, what the model lacks is `delta = (x - 1) cos(k t) / k`.

use super::{Model, ParameterInfo, Quantity, Transform};
use crate::named_vector;

named_vector! {
    /// Parameters; units in the table above.
    Parameters,
    /// Position of a parameter in the parameter vector.
    Parameter {
        /// Angular frequency \[1/s\].
        k: K,
        /// What the right-hand side lacks \[1/s\].
        delta: Delta,
        /// Time at the start of the window \[s\].
        time: Time,
    }
}

const STATES: &[Quantity] = &[Quantity { name: "x", unit: "1" }];

const PARAMETERS: &[ParameterInfo] = &[
    ParameterInfo {
        name: "k",
        unit: "1/s",
        default: 1.0,
        bounds: (1e-2, 1e2),
        transform: Transform::Log,
        estimable: true,
    },
    ParameterInfo::missing("delta", "1/s", 1.0, 1e6),
    ParameterInfo {
        name: "time",
        unit: "s",
        default: 0.0,
        bounds: (-1e9, 1e9),
        transform: Transform::Linear { scale: 1.0 },
        estimable: false,
    },
];

/// Which right-hand side.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Law {
    /// `cos(k t) / k`
    #[default]
    Linear,
    /// `x cos(k t) / k`
    Growing,
}

/// The harmonic example.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Harmonic {
    /// Which right-hand side.
    pub law: Law,
}

impl Harmonic {
    /// The exact solution with `delta = 0`.
    #[must_use]
    pub fn exact(self, t_s: f64, x0: f64, k: f64) -> f64 {
        let integral = (k * t_s).sin() / (k * k);
        match self.law {
            Law::Linear => x0 + integral,
            Law::Growing => x0 * integral.exp(),
        }
    }

    /// The factor of the cosine, and its derivative by `x`.
    fn amplitude(self, x: f64) -> (f64, f64) {
        match self.law {
            Law::Linear => (1.0, 0.0),
            Law::Growing => (x, 1.0),
        }
    }
}

impl Model for Harmonic {
    type Lanes = super::lanes::NoLanes;

    fn states(&self) -> &[Quantity] {
        STATES
    }

    fn parameters(&self) -> &[ParameterInfo] {
        PARAMETERS
    }

    fn rhs(&self, t_s: f64, x: &[f64], theta: &[f64], dx: &mut [f64]) {
        let Parameters { k, delta, time } = Parameters::from_slice(theta);
        dx[0] = self.amplitude(x[0]).0 * (k * (time + t_s)).cos() / k + delta;
    }

    fn rhs_and_state_jacobian(&self, t_s: f64, x: &[f64], theta: &[f64], dx: &mut [f64], dfdx: &mut [f64]) {
        let Parameters { k, delta, time } = Parameters::from_slice(theta);
        let (amplitude, by_x) = self.amplitude(x[0]);
        let cosine = (k * (time + t_s)).cos();
        dx[0] = amplitude * cosine / k + delta;
        dfdx[0] = by_x * cosine / k;
    }

    fn parameter_jacobian(&self, t_s: f64, x: &[f64], theta: &[f64], which: &[usize], dfdtheta: &mut [f64]) {
        let Parameters { k, time, .. } = Parameters::from_slice(theta);
        let (t, amplitude) = (time + t_s, self.amplitude(x[0]).0);
        let (sine, cosine) = (k * t).sin_cos();
        for (column, &p) in dfdtheta.iter_mut().zip(which) {
            *column = if p == Parameter::K as usize {
                -amplitude * (t * sine / k + cosine / (k * k))
            } else if p == Parameter::Delta as usize {
                1.0
            } else {
                -amplitude * sine
            };
        }
    }

    fn advance(&self, dt_s: f64, theta: &mut [f64]) {
        theta[Parameter::Time as usize] += dt_s;
    }
}
