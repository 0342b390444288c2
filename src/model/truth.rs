//! The truth simulator: a model integrated by an adaptive stiff solver, independent of X-TFC.
//!
//! Variable-order backward differentiation with step control (crate `diffsol`), restarted wherever the right-hand
//! side is not smooth in time: corners of the model and scripted parameter changes. Kinks that depend on the state
//! (valves) are found by the step control.

use diffsol::{NalgebraLU, NalgebraMat, OdeBuilder, OdeSolverMethod, OdeSolverStopReason, VectorCommon};

use std::collections::VecDeque;

use super::Model;

/// Relative and absolute \[mmHg\] tolerance of the integrator, per step.
const TOLERANCE: f64 = 1e-10;

/// Longest stretch integrated at once \[s\]; models without corners need an end.
const MAX_SEGMENT_S: f64 = 1.0;

/// Steps within one segment; more means that the tolerance cannot be met.
const MAX_STEPS: usize = 1_000_000;

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
    /// Integrated already, from a corner to the next.
    segment: Segment,
    /// Still to come, in order of time.
    script: VecDeque<Change>,
}

/// A stretch without corners: the steps of the integrator and what they started from.
#[derive(Debug, Clone)]
struct Segment {
    start_s: f64,
    end_s: f64,
    /// At the start.
    theta: Vec<f64>,
    /// In order of time; never empty.
    steps: Vec<Step>,
}

/// State and derivative at the end of a step; time since the start of the segment.
#[derive(Debug, Clone)]
struct Step {
    t: f64,
    x: Vec<f64>,
    dx: Vec<f64>,
}

impl Segment {
    /// The state `t` after the start, by cubic Hermite interpolation between steps.
    fn state(&self, t: f64) -> Vec<f64> {
        let after = self.steps.partition_point(|step| step.t < t).clamp(1, self.steps.len().max(2) - 1);
        let (Some(a), Some(b)) = (self.steps.get(after - 1), self.steps.get(after)) else {
            return self.steps[0].x.clone();
        };
        let h = b.t - a.t;
        let s = (t - a.t) / h;
        let (from, to) = ((1.0 + 2.0 * s) * (1.0 - s) * (1.0 - s), s * s * (3.0 - 2.0 * s));
        let (slope_from, slope_to) = (h * s * (1.0 - s) * (1.0 - s), h * s * s * (s - 1.0));
        (0..a.x.len()).map(|i| from * a.x[i] + to * b.x[i] + slope_from * a.dx[i] + slope_to * b.dx[i]).collect()
    }
}

impl<M: Model> Simulator<M> {
    /// Starts at time 0 from `x0` `[n_states]` with parameters `theta` `[n_parameters]`.
    #[must_use]
    pub fn new(model: M, x0: Vec<f64>, theta: Vec<f64>, mut script: Vec<Change>) -> Self {
        script.sort_by(|a, b| a.at_s.total_cmp(&b.at_s));
        let start = Step { t: 0.0, x: x0.clone(), dx: vec![0.0; x0.len()] };
        let segment = Segment { start_s: 0.0, end_s: 0.0, theta: theta.clone(), steps: vec![start] };
        let mut simulator = Self { model, theta, x: x0, time_s: 0.0, segment, script: script.into() };
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

    /// Gives a parameter a new value from now on.
    pub fn assign(&mut self, parameter: usize, value: f64) {
        self.theta[parameter] = value;
        // What was integrated ahead is no longer true.
        let now = Step { t: 0.0, x: self.x.clone(), dx: vec![0.0; self.x.len()] };
        self.segment =
            Segment { start_s: self.time_s, end_s: self.time_s, theta: self.theta.clone(), steps: vec![now] };
    }

    /// Integrates to `time_s`; does nothing if that is not in the future.
    ///
    /// # Errors
    /// When the integrator gives up (parameters without a bounded solution).
    pub fn advance_to(&mut self, time_s: f64) -> Result<(), SimulationError> {
        if time_s <= self.time_s {
            return Ok(());
        }
        while time_s >= self.segment.end_s {
            self.move_to(self.segment.end_s);
            self.apply_due_changes();
            self.segment = self.integrate()?;
        }
        self.move_to(time_s);
        Ok(())
    }

    /// Moves within the segment.
    fn move_to(&mut self, time_s: f64) {
        let t = time_s - self.segment.start_s;
        self.x = self.segment.state(t);
        self.theta.clone_from(&self.segment.theta);
        self.model.advance(t, &mut self.theta);
        self.time_s = time_s;
    }

    /// Integrates from now to the next corner or change.
    fn integrate(&self) -> Result<Segment, SimulationError> {
        let change = self.script.front().map_or(f64::INFINITY, |c| c.at_s - self.time_s);
        let limit = MAX_SEGMENT_S.min(change);
        let span_s = self.model.next_corner(0.0, limit, &self.theta).unwrap_or(limit);
        let steps =
            self.solve(span_s).map_err(|reason| SimulationError { at_s: self.time_s, reason: reason.to_string() })?;
        if !steps.iter().all(|step| step.x.iter().all(|v| v.is_finite())) {
            return Err(SimulationError { at_s: self.time_s, reason: "the state is not finite".to_owned() });
        }
        let theta = self.theta.clone();
        Ok(Segment { start_s: self.time_s, end_s: self.time_s + span_s, theta, steps })
    }

    fn solve(&self, span_s: f64) -> Result<Vec<Step>, diffsol::error::DiffsolError> {
        let n = self.x.len();
        let (model, theta, x0) = (&self.model, &self.theta, &self.x);
        let problem = OdeBuilder::<NalgebraMat<f64>>::new()
            .rhs_implicit(
                |x, _, t, dx| model.rhs(t, x, theta, dx),
                |x, _, t, v, jv| {
                    let (mut f, mut dfdx) = (vec![0.0; n], vec![0.0; n * n]);
                    model.rhs_and_state_jacobian(t, x, theta, &mut f, &mut dfdx);
                    for (row, out) in dfdx.chunks_exact(n).zip(jv.iter_mut()) {
                        *out = row.iter().zip(v).map(|(a, b)| a * b).sum();
                    }
                },
            )
            .init(|_, _, x| x.copy_from_slice(x0), n)
            .rtol(TOLERANCE)
            .atol([TOLERANCE])
            .h0(1e-5_f64.min(span_s))
            .build()?;
        let mut solver = problem.bdf::<NalgebraLU<f64>>()?;
        solver.set_stop_time(span_s)?;
        let record = |t: f64, x: &[f64]| {
            let mut dx = vec![0.0; n];
            model.rhs(t, x, theta, &mut dx);
            Step { t, x: x.to_vec(), dx }
        };
        let mut steps = vec![record(0.0, x0)];
        for _ in 0..MAX_STEPS {
            let reason = solver.step()?;
            let state = solver.state();
            steps.push(record(state.t, state.y.inner().as_slice()));
            if matches!(reason, OdeSolverStopReason::TstopReached) {
                break;
            }
        }
        Ok(steps)
    }

    fn apply_due_changes(&mut self) {
        while self.script.front().is_some_and(|c| c.at_s <= self.time_s) {
            for (parameter, value) in self.script.pop_front().into_iter().flat_map(|c| c.assignments) {
                self.theta[parameter] = value;
            }
        }
    }
}
