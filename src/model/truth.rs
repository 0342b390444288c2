//! The truth simulator: a model integrated by an adaptive stiff solver, independent of X-TFC.
//!
//! Radau IIA of order 5 with step control (crate `differential-equations`), restarted wherever the right-hand
//! side is not smooth in time: corners of the model and scripted parameter changes.

use differential_equations::linalg::Matrix;
use differential_equations::methods::ImplicitRungeKutta;
use differential_equations::ode::{ODE, OrdinaryNumericalMethod, solve_ode};
use differential_equations::solout::DefaultSolout;

use super::Model;

/// Relative and absolute \[mmHg\] tolerance of the integrator, per step.
pub const TOLERANCE: f64 = 1e-9;

/// Restarts within one call of [`Simulator::advance_to`]; more means that a model reports corners without end.
const MAX_SEGMENTS: usize = 1_000_000;

/// Parameters that take new values at a given time.
#[derive(Debug, Clone, PartialEq)]
pub struct Change {
    /// Time since the start of the simulation \[s\].
    pub at_s: f64,
    /// Index of a parameter and its new value.
    pub assignments: Vec<(usize, f64)>,
}

/// The integrator could not go on.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("the truth simulator failed at {at_s} s: {reason}")]
pub struct SimulationError {
    /// Time since the start of the simulation \[s\].
    pub at_s: f64,
    /// What the integrator said.
    pub reason: String,
}

/// A patient in motion.
#[derive(Debug, Clone)]
pub struct Simulator<M> {
    model: M,
    /// Values now, the clock parameters included.
    theta: Vec<f64>,
    x: Vec<f64>,
    time_s: f64,
    /// Still to come, in order of time.
    script: std::collections::VecDeque<Change>,
}

impl<M: Model> Simulator<M> {
    /// Starts at time 0 from `x0` `[n_states]` with parameters `theta` `[n_parameters]`.
    #[must_use]
    pub fn new(model: M, x0: Vec<f64>, theta: Vec<f64>, mut script: Vec<Change>) -> Self {
        script.sort_by(|a, b| a.at_s.total_cmp(&b.at_s));
        let mut simulator = Self { model, theta, x: x0, time_s: 0.0, script: script.into() };
        simulator.apply_due_changes();
        simulator
    }

    /// Time since the start \[s\].
    #[must_use]
    pub fn time_s(&self) -> f64 {
        self.time_s
    }

    /// States now.
    #[must_use]
    pub fn state(&self) -> &[f64] {
        &self.x
    }

    /// Parameters now.
    #[must_use]
    pub fn parameters(&self) -> &[f64] {
        &self.theta
    }

    /// Derived quantities now, `[n_derived]`.
    #[must_use]
    pub fn derived(&self) -> Vec<f64> {
        let mut out = vec![0.0; self.model.derived().len()];
        self.model.derive(0.0, &self.x, &self.theta, &mut out);
        out
    }

    /// Integrates to `time_s`; does nothing if that is not in the future.
    ///
    /// # Errors
    /// When the integrator gives up (parameters without a bounded solution).
    pub fn advance_to(&mut self, time_s: f64) -> Result<(), SimulationError> {
        for _ in 0..MAX_SEGMENTS {
            if self.time_s >= time_s {
                return Ok(());
            }
            let change = self.script.front().map_or(f64::INFINITY, |c| c.at_s);
            let end = time_s.min(change);
            let corner = self.model.next_corner(0.0, end - self.time_s, &self.theta);
            self.integrate_to(corner.map_or(end, |c| self.time_s + c))?;
            self.apply_due_changes();
        }
        Err(self.failure("too many corners".to_owned()))
    }

    /// Integrates over a stretch without corners.
    fn integrate_to(&mut self, end_s: f64) -> Result<(), SimulationError> {
        let span_s = end_s - self.time_s;
        let system = System { model: &self.model, theta: &self.theta };
        let mut method = ImplicitRungeKutta::radau5()
            .rtol(TOLERANCE)
            .atol(TOLERANCE)
            .h0((1e-4_f64).min(0.5 * span_s))
            .max_steps(1_000_000);
        let solved = solve_with(&mut method, &system, span_s, &self.x);
        let x = solved.map_err(|reason| self.failure(reason))?;
        if !x.iter().all(|v| v.is_finite()) {
            return Err(self.failure("the state is not finite".to_owned()));
        }
        self.x = x;
        self.model.advance(span_s, &mut self.theta);
        self.time_s = end_s;
        Ok(())
    }

    fn apply_due_changes(&mut self) {
        while self.script.front().is_some_and(|c| c.at_s <= self.time_s) {
            for (parameter, value) in self.script.pop_front().into_iter().flat_map(|c| c.assignments) {
                self.theta[parameter] = value;
            }
        }
    }

    fn failure(&self, reason: String) -> SimulationError {
        SimulationError { at_s: self.time_s, reason }
    }
}

fn solve_with<S, N>(method: &mut N, system: &S, span_s: f64, x0: &[f64]) -> Result<Vec<f64>, String>
where
    S: ODE<f64, Vec<f64>>,
    N: OrdinaryNumericalMethod<f64, Vec<f64>> + differential_equations::interpolate::Interpolation<f64, Vec<f64>>,
{
    let solution = solve_ode(method, system, 0.0, span_s, &x0.to_vec(), &mut DefaultSolout::new())
        .map_err(|error| error.to_string())?;
    solution.y.last().cloned().ok_or_else(|| "no step was made".to_owned())
}

/// The model with parameters held, as the integrator wants it.
struct System<'a, M> {
    model: &'a M,
    theta: &'a [f64],
}

impl<M: Model> ODE<f64, Vec<f64>> for System<'_, M> {
    fn diff(&self, t: f64, y: &Vec<f64>, dydt: &mut Vec<f64>) {
        self.model.rhs(t, y, self.theta, dydt);
    }

    fn jacobian(&self, t: f64, y: &Vec<f64>, j: &mut Matrix<f64>) {
        let n = y.len();
        let (mut f, mut dfdx) = (vec![0.0; n], vec![0.0; n * n]);
        self.model.rhs_and_state_jacobian(t, y, self.theta, &mut f, &mut dfdx);
        for row in 0..n {
            for column in 0..n {
                j[(row, column)] = dfdx[row * n + column];
            }
        }
    }
}
