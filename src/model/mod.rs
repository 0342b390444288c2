//! What the solver knows of a physiological model, and the models themselves.
//!
//! A [`Model`] is a system of ordinary differential equations `dx/dt = f(t, x, theta)` with named states,
//! named parameters and quantities derived from both. The X-TFC solver, the ensemble and the truth simulator
//! are generic over it and know nothing of hemodynamics.
//!
//! Invariants: pure functions of their arguments; units mmHg, mL, s; exact Jacobians (no finite differences).
//! Deliberately absent: absolute time, noise, files, configuration, logging.
//!
//! [`adding_a_model`] is the recipe for another one.

pub mod capacitance;
pub mod cvsim6;
pub mod discrepancy;
pub mod harmonic;
pub mod lanes;
pub mod lorenz;
pub mod oscillator;
pub mod rk4;
pub mod truth;

pub mod adding_a_model {
    #![doc = include_str!("adding_a_model.md")]
    #![doc = "```rust,ignore"]
    #![doc = include_str!("harmonic.rs")]
    #![doc = "```"]
}

/// Declares a struct of `f64` fields together with its names, its order and its vector form.
///
/// The one declaration is the only place where the order is written down: `NAMES`, `LEN`,
/// `from_slice` and `write_to` follow from it, and so does the index enum used to address Jacobian entries.
#[macro_export]
macro_rules! named_vector {
    ($(#[$meta:meta])* $name:ident, $(#[$index_meta:meta])* $index:ident {
        $($(#[$field_meta:meta])* $field:ident : $variant:ident),+ $(,)?
    }) => {
        $(#[$meta])*
        #[derive(Debug, Clone, Copy, PartialEq)]
        pub struct $name { $($(#[$field_meta])* pub $field: f64),+ }

        $(#[$index_meta])*
        #[derive(Debug, Clone, Copy, PartialEq, Eq)]
        pub enum $index { $($(#[$field_meta])* $variant),+ }

        impl $name {
            /// Names of the entries, in the order of the vector form.
            pub const NAMES: &'static [&'static str] = &[$(stringify!($field)),+];
            /// Number of entries.
            pub const LEN: usize = Self::NAMES.len();

            /// Reads the vector form; `values` has at least `LEN` entries.
            #[must_use]
            pub fn from_slice(values: &[f64]) -> Self {
                Self { $($field: values[$index::$variant as usize]),+ }
            }

            /// Writes the vector form into the first `LEN` entries of `out`.
            pub fn write_to(&self, out: &mut [f64]) {
                $(out[$index::$variant as usize] = self.$field;)+
            }

            /// The vector form.
            #[must_use]
            pub fn to_vec(&self) -> Vec<f64> {
                let mut out = vec![0.0; Self::LEN];
                self.write_to(&mut out);
                out
            }
        }
    };
}

/// A named quantity and its unit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Quantity {
    /// Name in configuration, topics and files.
    pub name: &'static str,
    /// Unit, for people (`mmHg`, `mL/s`, ...).
    pub unit: &'static str,
}

/// How a parameter is mapped to the unbounded coordinate in which it is estimated.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Transform {
    /// Positive parameters: `u = ln theta`.
    Log,
    /// Parameters of either sign, measured in units of a typical size: `u = theta / scale`.
    Linear {
        /// The typical size.
        scale: f64,
    },
}

impl Transform {
    /// The estimated coordinate of a value.
    #[must_use]
    pub fn forward(self, theta: f64) -> f64 {
        match self {
            Self::Log => theta.ln(),
            Self::Linear { scale } => theta / scale,
        }
    }

    /// The value at an estimated coordinate.
    #[must_use]
    pub fn inverse(self, u: f64) -> f64 {
        match self {
            Self::Log => u.exp(),
            Self::Linear { scale } => u * scale,
        }
    }

    /// `d theta / d u` at the value `theta`.
    #[must_use]
    pub fn slope(self, theta: f64) -> f64 {
        match self {
            Self::Log => theta,
            Self::Linear { scale } => scale,
        }
    }
}

/// What the estimator and the configuration need to know of a parameter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ParameterInfo {
    /// Name in configuration, topics and files.
    pub name: &'static str,
    /// Unit, for people.
    pub unit: &'static str,
    /// Default value in the unit above.
    pub default: f64,
    /// Smallest and largest value accepted from a user and reachable by an estimate.
    pub bounds: (f64, f64),
    /// Coordinate in which it is estimated.
    pub transform: Transform,
    /// Whether the right-hand side depends on it, so that pressures can say something about it.
    pub estimable: bool,
}

impl ParameterInfo {
    /// A positive number of which nothing more is known, estimated by its logarithm.
    #[must_use]
    pub const fn positive(name: &'static str, unit: &'static str, default: f64) -> Self {
        Self { name, unit, default, bounds: (1e-6, 1e6), transform: Transform::Log, estimable: true }
    }

    /// What an equation lacks: 0 unless something is, typically of size `scale`, up to `limit` either way.
    #[must_use]
    pub const fn missing(name: &'static str, unit: &'static str, scale: f64, limit: f64) -> Self {
        let transform = Transform::Linear { scale };
        Self { name, unit, default: 0.0, bounds: (-limit, limit), transform, estimable: true }
    }
}

/// A vessel along which a pressure difference accelerates blood.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct InductancePath {
    /// The state upstream.
    pub from: usize,
    /// The state downstream.
    pub to: usize,
    /// The parameter that is the vessel's resistance.
    pub resistance: usize,
}

/// Parameters that make a model periodic: a rate cannot be learnt without the clock it drives.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Cycle {
    /// The parameter that is the rate \[1/min\].
    pub rate: usize,
    /// The clock parameter that counts cycles; one begins at every integer.
    pub phase: usize,
}

/// What a quantity did during a cycle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Extent {
    /// Smallest value.
    pub min: f64,
    /// Largest value.
    pub max: f64,
    /// Mean over time.
    pub mean: f64,
    /// Value at the end minus value at the start.
    pub change: f64,
}

/// A system of ordinary differential equations with exact first derivatives.
///
/// Time `t` is measured from the start of the current window. Whatever must survive from window to window
/// (the phase of the heart beat, absolute time) is a *clock parameter*: an entry of `theta` that
/// [`Model::advance`] moves on.
pub trait Model: Clone + Send + Sync + 'static {
    /// Its equations for eight members at once; [`lanes::NoLanes`] if there are none.
    type Lanes: lanes::LaneModel;

    /// The states, in order.
    fn states(&self) -> &[Quantity];

    /// The parameters, in order.
    fn parameters(&self) -> &[ParameterInfo];

    /// Quantities that follow from states and parameters, in order; none unless said otherwise.
    fn derived(&self) -> &[Quantity] {
        &[]
    }

    /// `dx = f(t, x, theta)`; `x`, `dx`: `[n_states]`, `theta`: `[n_parameters]`.
    fn rhs(&self, t_s: f64, x: &[f64], theta: &[f64], dx: &mut [f64]);

    /// `f` and `df/dx` (row-major `[n_states x n_states]`, overwritten).
    fn rhs_and_state_jacobian(&self, t_s: f64, x: &[f64], theta: &[f64], dx: &mut [f64], dfdx: &mut [f64]);

    /// Columns `df/dtheta_p` for the parameters in `which`
    /// (row-major `[n_states x which.len()]`, overwritten), derivatives by the parameter itself,
    /// not by its estimated coordinate.
    fn parameter_jacobian(&self, t_s: f64, x: &[f64], theta: &[f64], which: &[usize], dfdtheta: &mut [f64]);

    /// Derived quantities; `out`: `[n_derived]`.
    fn derive(&self, t_s: f64, x: &[f64], theta: &[f64], out: &mut [f64]) {
        let _ = (t_s, x, theta, out);
    }

    /// Moves the clock parameters on by `dt_s`; none unless said otherwise.
    fn advance(&self, dt_s: f64, theta: &mut [f64]) {
        let _ = (dt_s, theta);
    }

    /// Sets the clock parameter to `phase` and keeps what does not jump with it (volumes, where states are pressures).
    fn set_clock(&self, phase: f64, x: &mut [f64], theta: &mut [f64]) {
        let _ = x;
        if let Some(cycle) = self.cycle() {
            theta[cycle.phase] = phase;
        }
    }

    /// The equations for eight members at once; without them, members are solved one by one.
    fn lanes(&self) -> Option<Self::Lanes> {
        None
    }

    /// What makes it periodic, if anything does.
    fn cycle(&self) -> Option<Cycle> {
        None
    }

    /// What clinicians read off a cycle, in order; nothing unless said otherwise.
    fn clinical(&self) -> &[Quantity] {
        &[]
    }

    /// Clinical quantities of a cycle of `duration_s`; `states`: `[n_states]`, `derived`: `[n_derived]`, `out`:
    /// `[n_clinical]`.
    fn read_cycle(&self, duration_s: f64, theta: &[f64], states: &[Extent], derived: &[Extent], out: &mut [f64]) {
        let _ = (duration_s, theta, states, derived, out);
    }

    /// The first time in `(t_s, until_s)` at which `f` is not smooth in `t`, if any.
    ///
    /// Integrators restart there. Kinks that depend on the state (valves) are not reported.
    fn next_corner(&self, t_s: f64, until_s: f64, theta: &[f64]) -> Option<f64> {
        let _ = (t_s, until_s, theta);
        None
    }

    /// Whether a state is a function of time of which nothing is known: no equation, no continuity. `f` is then not
    /// its derivative but its value, as far as anything is believed of it.
    fn is_free(&self, state: usize) -> bool {
        let _ = state;
        false
    }

    /// How many of the states, the last ones, are discrepancies: what the equations lack, not what the body has.
    fn n_discrepancies(&self) -> usize {
        0
    }

    /// Where the flow that a parameter adds to runs, if inertia can be ascribed to it.
    fn inductance_path(&self, parameter: usize) -> Option<InductancePath> {
        let _ = parameter;
        None
    }

    /// Number of states.
    fn n_states(&self) -> usize {
        self.states().len()
    }

    /// Index of a parameter by name.
    fn parameter_index(&self, name: &str) -> Option<usize> {
        self.parameters().iter().position(|p| p.name == name)
    }

    /// Default values of all parameters.
    fn default_parameters(&self) -> Vec<f64> {
        self.parameters().iter().map(|p| p.default).collect()
    }
}
