#![doc = include_str!("discrepancy.md")]

use super::cvsim6::Cvsim6;
use super::{Cycle, Extent, InductancePath, Model, ParameterInfo, Quantity};

/// Most states of a model, discrepancies included.
pub const MAX_STATES: usize = 20;

/// Most parameters of a model.
pub const MAX_PARAMETERS: usize = 64;

/// What is believed of a discrepancy.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Form {
    /// Nothing.
    Free,
    /// The inertia of the blood beside the resistance of the vessel.
    Inertial {
        /// Inductance over resistance \[s\].
        ratio_s: f64,
    },
    /// It changes slowly.
    Tracked,
}

/// A parameter that is a function of time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Discrepancy {
    /// Index of the parameter.
    pub parameter: usize,
    /// What is believed of it.
    pub form: Form,
}

/// Discrepancies that the model does not have.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DiscrepancyError {
    /// An index out of range, or the same one twice.
    #[error("parameter number {0} cannot become a function of time")]
    Parameter(usize),
    /// Inertia of something that is no open vessel.
    #[error("no inertia is known for `{0}`")]
    NoInertia(String),
    /// Too many states or parameters.
    #[error("more than {MAX_STATES} states or {MAX_PARAMETERS} parameters")]
    TooLarge,
}

/// The model of every bed.
pub type Circulation = Discrepant<Cvsim6>;

/// A model some of whose parameters are functions of time; with none of them it is the model itself.
#[derive(Debug, Clone)]
pub struct Discrepant<M> {
    base: M,
    terms: Vec<Term>,
    /// The model's, then one per discrepancy.
    states: Vec<Quantity>,
}

#[derive(Debug, Clone)]
struct Term {
    parameter: usize,
    rate: Rate,
}

#[derive(Debug, Clone)]
enum Rate {
    Free,
    Constant,
    Inertial { path: InductancePath, ratio_s: f64 },
}

impl<M: Model> Discrepant<M> {
    /// The model as it is.
    pub fn none(base: M) -> Self {
        let states = base.states().to_vec();
        Self { base, terms: Vec::new(), states }
    }

    /// The model with discrepancies, in this order after its states.
    ///
    /// # Errors
    /// When the model does not have what they need.
    pub fn new(base: M, discrepancies: &[Discrepancy]) -> Result<Self, DiscrepancyError> {
        let mut all = Self::none(base);
        for discrepancy in discrepancies {
            let p = discrepancy.parameter;
            let repeated = all.terms.iter().any(|term| term.parameter == p);
            let info = all.base.parameters().get(p).filter(|_| !repeated).ok_or(DiscrepancyError::Parameter(p))?;
            let rate = match discrepancy.form {
                Form::Free => Rate::Free,
                Form::Tracked => Rate::Constant,
                Form::Inertial { ratio_s } => {
                    let path = all.base.inductance_path(p);
                    let path = path.ok_or_else(|| DiscrepancyError::NoInertia(info.name.to_owned()))?;
                    Rate::Inertial { path, ratio_s }
                }
            };
            all.states.push(Quantity { name: info.name, unit: info.unit });
            all.terms.push(Term { parameter: p, rate });
        }
        if all.states.len() > MAX_STATES || all.base.parameters().len() > MAX_PARAMETERS {
            return Err(DiscrepancyError::TooLarge);
        }
        Ok(all)
    }

    /// Parameters that are functions of time, in the order of their states.
    pub fn discrepancies(&self) -> impl ExactSizeIterator<Item = usize> + '_ {
        self.terms.iter().map(|term| term.parameter)
    }

    /// Calls `f` with the parameters at a moment, discrepancies filled in from the states.
    fn with_theta<T>(&self, x: &[f64], theta: &[f64], f: impl FnOnce(&[f64]) -> T) -> T {
        let mut now = [0.0; MAX_PARAMETERS];
        let now = &mut now[..theta.len()];
        now.copy_from_slice(theta);
        for (term, delta) in self.terms.iter().zip(&x[self.base.n_states()..]) {
            now[term.parameter] = *delta;
        }
        f(now)
    }

    /// What is believed of the derivatives of the discrepancies.
    fn rates(&self, x: &[f64], theta: &[f64], dx: &mut [f64]) {
        for (term, rate) in self.terms.iter().zip(&mut dx[self.base.n_states()..]) {
            *rate = match &term.rate {
                Rate::Free | Rate::Constant => 0.0,
                Rate::Inertial { path, ratio_s } => (x[path.from] - x[path.to]) / (ratio_s * theta[path.resistance]),
            };
        }
    }

    /// Spreads the `n x n` Jacobian at the front of `dfdx` to rows of the full width.
    fn widen(&self, dfdx: &mut [f64]) {
        let (n, width) = (self.base.n_states(), self.states.len());
        dfdx[n * n..width * width].fill(0.0);
        // From the last row on, so that none is overwritten before it has moved.
        for i in (0..n).rev() {
            dfdx.copy_within(i * n..(i + 1) * n, i * width);
            dfdx[i * width + n..(i + 1) * width].fill(0.0);
        }
    }
}

impl<M: Model> Model for Discrepant<M> {
    type Lanes = M::Lanes;

    fn lanes(&self) -> Option<Self::Lanes> {
        // With something that it lacks it has more states than the equations for lanes.
        if self.terms.is_empty() { self.base.lanes() } else { None }
    }

    fn states(&self) -> &[Quantity] {
        &self.states
    }

    fn parameters(&self) -> &[ParameterInfo] {
        self.base.parameters()
    }

    fn derived(&self) -> &[Quantity] {
        self.base.derived()
    }

    fn rhs(&self, t_s: f64, x: &[f64], theta: &[f64], dx: &mut [f64]) {
        if self.terms.is_empty() {
            return self.base.rhs(t_s, x, theta, dx);
        }
        let n = self.base.n_states();
        self.with_theta(x, theta, |theta| self.base.rhs(t_s, &x[..n], theta, &mut dx[..n]));
        self.rates(x, theta, dx);
    }

    fn rhs_and_state_jacobian(&self, t_s: f64, x: &[f64], theta: &[f64], dx: &mut [f64], dfdx: &mut [f64]) {
        if self.terms.is_empty() {
            return self.base.rhs_and_state_jacobian(t_s, x, theta, dx, dfdx);
        }
        let (n, width) = (self.base.n_states(), self.states.len());
        self.with_theta(x, theta, |theta| {
            self.base.rhs_and_state_jacobian(t_s, &x[..n], theta, &mut dx[..n], &mut dfdx[..n * n]);
            self.widen(dfdx);
            let mut column = [0.0; MAX_STATES];
            for (k, term) in self.terms.iter().enumerate() {
                self.base.parameter_jacobian(t_s, &x[..n], theta, &[term.parameter], &mut column[..n]);
                for (i, value) in column[..n].iter().enumerate() {
                    dfdx[i * width + n + k] = *value;
                }
            }
        });
        self.rates(x, theta, dx);
        for (k, term) in self.terms.iter().enumerate() {
            if let Rate::Inertial { path, ratio_s } = &term.rate {
                let conductance = 1.0 / (ratio_s * theta[path.resistance]);
                dfdx[(n + k) * width + path.from] = conductance;
                dfdx[(n + k) * width + path.to] = -conductance;
            }
        }
    }

    fn parameter_jacobian(&self, t_s: f64, x: &[f64], theta: &[f64], which: &[usize], dfdtheta: &mut [f64]) {
        if self.terms.is_empty() {
            return self.base.parameter_jacobian(t_s, x, theta, which, dfdtheta);
        }
        let n = self.base.n_states();
        self.with_theta(x, theta, |theta| self.base.parameter_jacobian(t_s, &x[..n], theta, which, dfdtheta));
        for (column, &p) in which.iter().enumerate() {
            // The states have taken the place of these parameters.
            if self.terms.iter().any(|term| term.parameter == p) {
                (0..n).for_each(|i| dfdtheta[i * which.len() + column] = 0.0);
            }
            for (k, term) in self.terms.iter().enumerate() {
                dfdtheta[(n + k) * which.len() + column] = match &term.rate {
                    Rate::Inertial { path, ratio_s } if path.resistance == p => {
                        -(x[path.from] - x[path.to]) / (ratio_s * theta[p] * theta[p])
                    }
                    _ => 0.0,
                };
            }
        }
    }

    fn derive(&self, t_s: f64, x: &[f64], theta: &[f64], out: &mut [f64]) {
        let n = self.base.n_states();
        self.with_theta(x, theta, |theta| self.base.derive(t_s, &x[..n], theta, out));
    }

    fn is_free(&self, state: usize) -> bool {
        let own = state.checked_sub(self.base.n_states());
        own.map_or_else(|| self.base.is_free(state), |k| matches!(self.terms[k].rate, Rate::Free))
    }

    fn n_discrepancies(&self) -> usize {
        self.terms.len()
    }

    fn inductance_path(&self, parameter: usize) -> Option<InductancePath> {
        self.base.inductance_path(parameter)
    }

    fn advance(&self, dt_s: f64, theta: &mut [f64]) {
        self.base.advance(dt_s, theta);
    }

    fn set_clock(&self, phase: f64, x: &mut [f64], theta: &mut [f64]) {
        self.base.set_clock(phase, &mut x[..self.base.n_states()], theta);
    }

    fn cycle(&self) -> Option<Cycle> {
        self.base.cycle()
    }

    fn clinical(&self) -> &[Quantity] {
        self.base.clinical()
    }

    fn read_cycle(&self, duration_s: f64, theta: &[f64], states: &[Extent], derived: &[Extent], out: &mut [f64]) {
        self.base.read_cycle(duration_s, theta, &states[..self.base.n_states()], derived, out);
    }

    fn next_corner(&self, t_s: f64, until_s: f64, theta: &[f64]) -> Option<f64> {
        self.base.next_corner(t_s, until_s, theta)
    }
}
