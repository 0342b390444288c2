#![doc = include_str!("collocation.md")]

use super::lu::{factorise, solve, solve_spd, solve_transposed};
use super::problem::{Account, Point, Solution, WindowProblem, dot, resize, sample_rows};
use crate::model::Model;

/// Halvings of a step that makes things worse.
const MAX_HALVINGS: usize = 8;

/// Relative growth of the objective that is rounding.
const ROUNDING: f64 = 1e-13;

/// A step leads nowhere if, shortened, it makes the objective smaller by less than this share of what the full one promised,
/// and that would have been worth having. Where more than so many did, and between them it got smaller by no more than
/// that is worth, the objective has a corner, and the iteration stays at it.
const LEAST_KEPT: f64 = 0.1;

const MAX_STALLS: usize = 4;

/// What is worth having, in shares of the objective.
const PROGRESS: f64 = 0.01;

/// Scratch of the solver; reuse it from window to window.
#[derive(Debug, Clone, Default)]
pub struct CollocationSolver {
    point: Point,
    trial: Point,
    /// `df/dx` at the nodes, `[n_nodes x n_states x n_states]`.
    jacobians: Vec<f64>,
    /// `df/dtheta` at a node, `[n_states x n_free]`.
    by_parameter: Vec<f64>,
    blocks: Blocks,
    /// `phi` at the samples, `[n_data x rank]`.
    phi: Vec<f64>,
    /// `B`, `[n_states x n_nodes x n_xi]`.
    by_xi: Vec<f64>,
    /// `G`, `[n_data x n_states x n_nodes]`.
    adjoint: Vec<f64>,
    /// `H`, `[n_data x n_xi]`.
    sensitivity: Vec<f64>,
    /// `C`, `[n_data x n_data]`.
    covariance: Vec<f64>,
    /// `r`, then `rho`.
    rho: Vec<f64>,
    step_beta: Vec<f64>,
    step_xi: Vec<f64>,
    /// Physics residual after a full step.
    predicted: Vec<f64>,
    /// Whether the step was shortened to its limits.
    limited: bool,
    /// Objective where a step led nowhere, infinite before that, and how often it did since it was that small.
    stuck_at: f64,
    stalls: usize,
}

/// Where to begin.
#[derive(Debug, Clone, Copy)]
pub struct Guess<'a> {
    /// Slopes at the nodes, `[n_states x n_nodes]`.
    pub beta: &'a [f64],
    /// `[n_xi]`
    pub xi: &'a [f64],
    /// Objective above which it is not worth having: that of the solution without samples.
    pub below: f64,
}

/// What came of a step.
enum Step {
    /// The linearisation was not right yet.
    On,
    /// It was.
    Converged,
    /// No share of the step leads on.
    Corner,
}

impl CollocationSolver {
    /// Minimises; `problem.basis` must be nodal ([`super::basis::Basis::is_nodal`]).
    pub fn solve<M: Model>(&mut self, problem: &WindowProblem<'_, M>, out: &mut Solution) {
        self.solve_from(problem, None, out);
    }

    /// The same from a guess, if that is worth having; else from constant slopes and the prior mean.
    pub fn solve_from<M: Model>(
        &mut self,
        problem: &WindowProblem<'_, M>,
        guess: Option<Guess<'_>>,
        out: &mut Solution,
    ) {
        debug_assert!(problem.basis.is_nodal(), "the square solver needs a nodal basis");
        sample_rows(problem, &mut self.phi);
        self.point.reset(problem);
        self.point.place(problem);
        evaluate(&mut self.point, problem, &self.phi);
        if let Some(Guess { beta, xi, below }) = guess {
            self.trial.clone_from(&self.point);
            self.trial.beta.copy_from_slice(beta);
            self.trial.xi.copy_from_slice(xi);
            self.trial.place(problem);
            evaluate(&mut self.trial, problem, &self.phi);
            if self.trial.objective(problem) < below {
                std::mem::swap(&mut self.point, &mut self.trial);
            }
        }

        let mut account = Account::default();
        (self.stuck_at, self.stalls) = (f64::INFINITY, 0);
        while account.iterations < problem.stopping.max_iterations {
            account.iterations += 1;
            self.linearise(problem);
            account.condition = self.blocks.assemble_and_factorise(problem, &self.jacobians);
            if !account.condition.is_finite() {
                break;
            }
            self.full_step(problem);
            match self.take_step(problem) {
                Step::On => {}
                Step::Converged => {
                    account.converged = true;
                    break;
                }
                Step::Corner => break,
            }
        }
        self.point.finish(problem, account, out);
    }

    /// `df/dx` at the nodes, and `B` where there are samples to steer by.
    fn linearise<M: Model>(&mut self, problem: &WindowProblem<'_, M>) {
        let n = problem.start.len();
        let positions = problem.basis.positions();
        let h = problem.basis.length_s();
        self.jacobians.resize(positions.len() * n * n, 0.0);
        for (node, s) in positions.iter().enumerate() {
            let x = &self.point.x[node * n..(node + 1) * n];
            let f = &mut self.point.f[node * n..(node + 1) * n];
            let jacobian = &mut self.jacobians[node * n * n..(node + 1) * n * n];
            problem.model.rhs_and_state_jacobian(s * h, x, &self.point.theta, f, jacobian);
        }
        if !problem.data.is_empty() && problem.prior.n_xi > 0 {
            self.linearise_in_xi(problem);
        }
    }

    /// `B = dF/dxi = -(df/dx dx_k/dxi + df/dtheta dtheta/dxi)`.
    fn linearise_in_xi<M: Model>(&mut self, problem: &WindowProblem<'_, M>) {
        let (n, n_xi) = (problem.start.len(), problem.prior.n_xi);
        let positions = problem.basis.positions();
        let unknowns = problem.unknowns;
        let free = unknowns.parameters.len();
        let first_parameter = if unknowns.initial_state { n } else { 0 };
        resize(&mut self.by_xi, n * positions.len() * n_xi);
        self.by_parameter.resize(n * free, 0.0);
        for (node, s) in positions.iter().enumerate() {
            let x = &self.point.x[node * n..(node + 1) * n];
            let t = s * problem.basis.length_s();
            problem.model.parameter_jacobian(t, x, &self.point.theta, &unknowns.parameters, &mut self.by_parameter);
            for i in 0..n {
                let row = &mut self.by_xi[(i * positions.len() + node) * n_xi..][..n_xi];
                let mut add = |factor: f64, root_row: usize| {
                    if factor.to_bits() << 1 != 0 {
                        let root = &problem.prior.root[root_row * n_xi..(root_row + 1) * n_xi];
                        row.iter_mut().zip(root).for_each(|(b, r)| *b -= factor * r);
                    }
                };
                if unknowns.initial_state {
                    let starting = (0..n).filter(|j| !problem.model.is_free(*j));
                    starting.for_each(|j| add(self.jacobians[(node * n + i) * n + j], j));
                }
                for (k, (&p, transform)) in unknowns.parameters.iter().zip(&unknowns.transforms).enumerate() {
                    let slope = transform.slope(self.point.theta[p]);
                    add(self.by_parameter[i * free + k] * slope, first_parameter + k);
                }
            }
        }
    }

    /// The Gauss-Newton step into `step_beta`, `step_xi`, and the physics residual it predicts.
    fn full_step<M: Model>(&mut self, problem: &WindowProblem<'_, M>) {
        self.limited = false;
        resize(&mut self.step_xi, problem.prior.n_xi);
        resize(&mut self.predicted, self.point.physics.len());
        self.rho.clear();
        if !problem.data.is_empty() {
            self.solve_in_sample_space(problem);
        }
        // A dbeta = e - F - B dxi
        self.step_beta.clear();
        self.step_beta.extend(self.predicted.iter().zip(&self.point.physics).map(|(e, f)| e - f));
        if !problem.data.is_empty() && problem.prior.n_xi > 0 {
            for (b, row) in self.step_beta.iter_mut().zip(self.by_xi.chunks_exact(problem.prior.n_xi)) {
                *b -= dot(row, &self.step_xi);
            }
        }
        self.blocks.solve(&mut self.step_beta, false);
    }

    /// `rho`, hence `dxi` (limited) and `e`.
    fn solve_in_sample_space<M: Model>(&mut self, problem: &WindowProblem<'_, M>) {
        let (n, n_xi, m) = (problem.start.len(), problem.prior.n_xi, problem.data.len());
        let nodes = problem.basis.positions().len();
        let size = n * nodes;
        resize(&mut self.adjoint, m * size);
        resize(&mut self.sensitivity, m * n_xi);
        resize(&mut self.rho, m);
        resize(&mut self.covariance, m * m);
        for (j, datum) in problem.data.iter().enumerate() {
            let g = &mut self.adjoint[j * size..(j + 1) * size];
            let phi = &self.phi[j * nodes..(j + 1) * nodes];
            g[datum.state * nodes..][..nodes].iter_mut().zip(phi).for_each(|(g, phi)| *g = datum.weight * phi);
            self.blocks.solve(g, true);

            let h = &mut self.sensitivity[j * n_xi..(j + 1) * n_xi];
            if problem.unknowns.initial_state {
                let root = &problem.prior.root[datum.state * n_xi..][..n_xi];
                h.iter_mut().zip(root).for_each(|(h, root)| *h = datum.weight * root);
            }
            if n_xi > 0 {
                for (g, row) in g.iter().zip(self.by_xi.chunks_exact(n_xi)) {
                    h.iter_mut().zip(row).for_each(|(h, b)| *h -= g * b);
                }
            }
            self.rho[j] = self.point.data[j] - dot(g, &self.point.physics) - dot(h, &self.point.xi);
        }
        for j in 0..m {
            for k in 0..=j {
                let h = dot(&self.sensitivity[j * n_xi..][..n_xi], &self.sensitivity[k * n_xi..][..n_xi]);
                let g = self.adjoint[j * size..][..size].chunks_exact(nodes);
                let rows = g.zip(self.adjoint[k * size..][..size].chunks_exact(nodes)).zip(problem.physics_weights);
                let physics: f64 = rows.map(|((a, b), w)| dot(a, b) / (w * w)).sum();
                let value = h + physics + if j == k { 1.0 } else { 0.0 };
                (self.covariance[j * m + k], self.covariance[k * m + j]) = (value, value);
            }
        }
        // Definite by construction: identity plus Gram matrices. Only overflow can break it.
        if !solve_spd(&mut self.covariance, m, &mut self.rho) {
            self.rho.fill(f64::NAN);
        }
        for (j, rho) in self.rho.iter().enumerate() {
            let h = &self.sensitivity[j * n_xi..][..n_xi];
            self.step_xi.iter_mut().zip(h).for_each(|(s, h)| *s -= h * rho);
            let g = &self.adjoint[j * size..][..size];
            for (i, (e, g)) in self.predicted.iter_mut().zip(g).enumerate() {
                let w = problem.physics_weights[i / nodes];
                *e -= g * rho / (w * w);
            }
        }
        self.step_xi.iter_mut().zip(&self.point.xi).for_each(|(s, xi)| *s -= xi);
        self.limited = limit_step(problem, &mut self.step_xi);
    }

    /// Moves along the step, shortened while the objective grows.
    fn take_step<M: Model>(&mut self, problem: &WindowProblem<'_, M>) -> Step {
        let before = self.point.objective(problem);
        let (mut share, mut better) = (1.0, false);
        for _ in 0..=MAX_HALVINGS {
            self.trial.clone_from(&self.point);
            self.trial.beta.iter_mut().zip(&self.step_beta).for_each(|(x, s)| *x += share * s);
            self.trial.xi.iter_mut().zip(&self.step_xi).for_each(|(x, s)| *x += share * s);
            self.trial.place(problem);
            evaluate(&mut self.trial, problem, &self.phi);
            // Growth by rounding is none: near the minimiser, halved steps would never get there.
            better = self.trial.objective(problem) <= before * (1.0 + ROUNDING) || self.agrees(problem, share);
            if better {
                break;
            }
            share *= 0.5;
        }
        // The far side of a corner may lead on, so that such a step is taken; and another, if it did.
        let promised = before - self.promised(problem);
        let kept = before - self.trial.objective(problem);
        if share < 0.75 && promised > PROGRESS * before && kept < LEAST_KEPT * promised {
            if before <= (1.0 - PROGRESS) * self.stuck_at {
                (self.stuck_at, self.stalls) = (before, 0);
            }
            self.stalls += 1;
            if self.stalls > MAX_STALLS {
                if better {
                    std::mem::swap(&mut self.point, &mut self.trial);
                }
                return Step::Corner;
            }
        }
        // A limited step is no minimiser, however well it was predicted.
        let converged = !self.limited && share > 0.75 && self.agrees(problem, share);
        std::mem::swap(&mut self.point, &mut self.trial);
        if converged { Step::Converged } else { Step::On }
    }

    /// The objective after a full step, if the equations were as linear as they look.
    fn promised<M: Model>(&self, problem: &WindowProblem<'_, M>) -> f64 {
        let nodes = problem.basis.positions().len();
        let rows = self.predicted.chunks_exact(nodes).zip(problem.physics_weights);
        let physics: f64 = rows.map(|(row, w)| w * w * dot(row, row)).sum();
        let xi: f64 = self.point.xi.iter().zip(&self.step_xi).map(|(xi, step)| (xi + step).powi(2)).sum();
        physics + dot(&self.rho, &self.rho) + xi
    }

    /// Whether the residuals of the trial are what the linearisation said.
    fn agrees<M: Model>(&self, problem: &WindowProblem<'_, M>, share: f64) -> bool {
        let tolerance = problem.stopping.tolerance_mmhg;
        let h = problem.basis.length_s();
        let physics = self.trial.physics.iter().zip(&self.point.physics).zip(&self.predicted);
        let nodes = problem.basis.positions().len();
        let physics_agrees = physics
            .map(|((now, before), e)| h * (now - (1.0 - share) * before - share * e))
            .all(|error| error.abs() <= tolerance);
        let data_agrees = || {
            problem.data.iter().enumerate().all(|(j, datum)| {
                let phi = &self.phi[j * nodes..(j + 1) * nodes];
                let mut change = dot(phi, &self.step_beta[datum.state * nodes..][..nodes]);
                if problem.unknowns.initial_state {
                    change += dot(
                        &problem.prior.root[datum.state * problem.prior.n_xi..][..problem.prior.n_xi],
                        &self.step_xi,
                    );
                }
                let error = self.trial.data[j] - self.point.data[j] - share * datum.weight * change;
                error.abs() <= tolerance * datum.weight
            })
        };
        physics_agrees && data_agrees()
    }
}

fn evaluate<M: Model>(point: &mut Point, problem: &WindowProblem<'_, M>, phi: &[f64]) {
    point.evaluate_states(problem, phi);
    point.evaluate_rhs(problem);
    point.evaluate_physics(problem);
}

/// Shortens the step in `xi` so that no coordinate moves by more than its limit; true if it had to.
pub(super) fn limit_step<M>(problem: &WindowProblem<'_, M>, step_xi: &mut [f64]) -> bool {
    let unknowns = problem.unknowns;
    let first = if unknowns.initial_state { problem.start.len() } else { 0 };
    let mut share = 1.0_f64;
    for (k, limit) in unknowns.max_steps.iter().enumerate() {
        let root = &problem.prior.root[(first + k) * step_xi.len()..][..step_xi.len()];
        let move_ = dot(root, step_xi).abs();
        if move_ > *limit {
            share = share.min(limit / move_);
        }
    }
    if share < 1.0 {
        step_xi.iter_mut().for_each(|s| *s *= share);
    }
    share < 1.0
}

/// `A`, block by block of states that the model couples somewhere in the window.
#[derive(Debug, Clone, Default)]
struct Blocks {
    n_nodes: usize,
    /// Block of each state.
    block_of: Vec<usize>,
    /// States, block by block, ascending in each; and where each block ends among them.
    states: Vec<usize>,
    ends: Vec<usize>,
    /// The matrices of the blocks, one behind the other in a place that is large enough for a single one; and how their rows
    /// were exchanged.
    a: Vec<f64>,
    pivots: Vec<usize>,
    scratch: Vec<f64>,
}

impl Blocks {
    /// Builds `A = I - df/dx phi` (`psi = I` in place of `phi` for free functions) and factorises; returns the worst pivot ratio.
    fn assemble_and_factorise<M: Model>(&mut self, problem: &WindowProblem<'_, M>, jacobians: &[f64]) -> f64 {
        let n = problem.start.len();
        let nodes = problem.basis.positions().len();
        self.n_nodes = nodes;
        self.partition(n, jacobians);
        self.a.resize((n * nodes).pow(2), 0.0);
        self.pivots.resize(n * nodes, 0);
        self.scratch.reserve(n * nodes);
        let mut worst = 1.0_f64;
        let (mut first, mut at) = (0, 0);
        for &end in &self.ends {
            let states = &self.states[first..end];
            let size = states.len() * nodes;
            let a = &mut self.a[at..at + size * size];
            for (bi, &i) in states.iter().enumerate() {
                for (bj, &j) in states.iter().enumerate() {
                    let phi = problem.expression(j);
                    for node in 0..nodes {
                        let slope = jacobians[(node * n + i) * n + j];
                        let row = &mut a[(bi * nodes + node) * size + bj * nodes..][..nodes];
                        row.iter_mut().zip(&phi[node * nodes..]).for_each(|(a, phi)| *a = -slope * phi);
                        if bi == bj {
                            row[node] += 1.0;
                        }
                    }
                }
            }
            worst = worst.max(factorise(a, &mut self.pivots[first * nodes..end * nodes]));
            (first, at) = (end, at + size * size);
        }
        worst
    }

    /// Finds the blocks: states are joined where any node couples them.
    fn partition(&mut self, n: usize, jacobians: &[f64]) {
        self.block_of.clear();
        self.block_of.extend(0..n);
        for jacobian in jacobians.chunks_exact(n * n) {
            for (entry, value) in jacobian.iter().enumerate() {
                let (a, b) = (self.block_of[entry / n], self.block_of[entry % n]);
                if a != b && value.to_bits() << 1 != 0 {
                    let (keep, merge) = (a.min(b), a.max(b));
                    self.block_of.iter_mut().filter(|block| **block == merge).for_each(|block| *block = keep);
                }
            }
        }
        self.states.clear();
        self.ends.clear();
        // However many blocks there will be.
        self.ends.reserve(n);
        for block in 0..n {
            let before = self.states.len();
            self.states.extend((0..n).filter(|&i| self.block_of[i] == block));
            if self.states.len() > before {
                self.ends.push(self.states.len());
            }
        }
    }

    /// Solves `A x = b` (or with the transpose) in place; `b` is `[n_states x n_nodes]`.
    fn solve(&mut self, b: &mut [f64], transposed: bool) {
        let nodes = self.n_nodes;
        let (mut first, mut at) = (0, 0);
        for &end in &self.ends {
            let states = &self.states[first..end];
            let (a, pivots) = (&self.a[at..], &self.pivots[first * nodes..end * nodes]);
            (first, at) = (end, at + pivots.len().pow(2));
            // Right-hand sides often touch one block only.
            let touched = |i: &usize| b[i * nodes..(i + 1) * nodes].iter().any(|v| v.to_bits() << 1 != 0);
            if !states.iter().any(touched) {
                continue;
            }
            self.scratch.clear();
            states.iter().for_each(|i| self.scratch.extend_from_slice(&b[i * nodes..(i + 1) * nodes]));
            if transposed {
                solve_transposed(a, pivots, &mut self.scratch);
            } else {
                solve(a, pivots, &mut self.scratch);
            }
            for (i, x) in states.iter().zip(self.scratch.chunks_exact(nodes)) {
                b[i * nodes..(i + 1) * nodes].copy_from_slice(x);
            }
        }
    }
}
