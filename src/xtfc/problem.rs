//! What is minimised on one window of one member.
//!
//! Unknowns are the coefficients `beta` `[n_states x rank]` and `xi` `[n_xi]`, which moves what else is free: the
//! initial state (if free) and the estimated coordinates of the parameters, stacked as `u = mean + root xi`.
//!
//! ```text
//! minimise   sum over nodes, equations   (w_i (dx_i/dt - f_i(t, x, theta)))^2      physics
//!          + sum over samples            (w_j (x_j(t_j) - y_j))^2                  data
//!          + |xi|^2                                                                prior
//! ```
//!
//! For a state of which nothing is known ([`Model::is_free`]) the physics row is `w_i (x_i - f_i)`, and its network
//! stands for its values without continuity.
//!
//! Writing the prior through a root of its covariance (`covariance = root root^T`) serves both couplings, and a
//! singular covariance as well: directions without spread simply cannot move.

use crate::model::{Model, Transform};

/// One sample inside the window.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Datum {
    /// Position in the window, in `[0, 1]`.
    pub s: f64,
    /// The state it observes; not a free one.
    pub state: usize,
    /// Observed value \[mmHg\].
    pub value: f64,
    /// Weight `w_j` \[1/mmHg\]: the reciprocal of the noise sd, or the paper's `lambda_2`.
    pub weight: f64,
}

/// What is free besides `beta`.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Unknowns {
    /// Whether the state at the start of the window is free; otherwise it is the end of the previous window.
    pub initial_state: bool,
    /// Free parameters, as indices into `theta`.
    pub parameters: Vec<usize>,
    /// The coordinate each is solved in.
    pub transforms: Vec<Transform>,
    /// Largest change of each coordinate in one Gauss-Newton step.
    pub max_steps: Vec<f64>,
}

impl Unknowns {
    /// Number of entries of `u`.
    #[must_use]
    pub fn len(&self, n_states: usize) -> usize {
        self.parameters.len() + if self.initial_state { n_states } else { 0 }
    }

    /// Whether nothing is free but `beta`.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        !self.initial_state && self.parameters.is_empty()
    }
}

/// Gaussian prior of `u`.
#[derive(Debug, Clone, Copy)]
pub struct Prior<'a> {
    /// Root of the covariance, `[n_u x n_xi]`, row-major; the mean is the problem's start.
    pub root: &'a [f64],
    /// Number of columns of the root.
    pub n_xi: usize,
}

impl Prior<'_> {
    /// Nothing but `beta` is free.
    pub const NONE: Prior<'static> = Prior { root: &[], n_xi: 0 };
}

/// When to stop.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stopping {
    /// Largest number of Gauss-Newton iterations.
    pub max_iterations: usize,
    /// Largest error of the pressures left by the linearisation \[mmHg\].
    pub tolerance_mmhg: f64,
}

impl Default for Stopping {
    fn default() -> Self {
        Self { max_iterations: 20, tolerance_mmhg: 1e-9 }
    }
}

/// One window of one member.
#[derive(Debug, Clone, Copy)]
pub struct WindowProblem<'a, M> {
    /// The equations.
    pub model: &'a M,
    /// The constrained expression of this member.
    pub basis: &'a super::basis::Basis,
    /// State at the start of the window, `[n_states]`: fixed, or the prior mean.
    pub start: &'a [f64],
    /// Parameters, `[n_parameters]`: fixed, or the prior mean.
    pub theta: &'a [f64],
    /// What is free.
    pub unknowns: &'a Unknowns,
    /// Prior of what is free.
    pub prior: Prior<'a>,
    /// Samples.
    pub data: &'a [Datum],
    /// Weight of the physics rows \[s/mmHg\], per equation `[n_states]`: the paper's `lambda_1`.
    pub physics_weights: &'a [f64],
    /// When to stop.
    pub stopping: Stopping,
}

impl<'a, M: Model> WindowProblem<'a, M> {
    /// What stands left of the equals sign in the equation of a state, at the nodes, `[n_nodes x rank]`: the derivative,
    /// or the value of a free function.
    pub(super) fn left_hand_side(&self, state: usize) -> &'a [f64] {
        if self.model.is_free(state) { self.basis.free_values() } else { self.basis.rates() }
    }

    /// How a state depends on its coefficients at the nodes, `[n_nodes x rank]`.
    pub(super) fn expression(&self, state: usize) -> &'a [f64] {
        if self.model.is_free(state) { self.basis.free_values() } else { self.basis.values() }
    }
}

/// How a solve went.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Account {
    /// Factorisations made.
    pub iterations: usize,
    /// Root mean square of the physics residual at the nodes \[mmHg/s\].
    pub physics_rms: f64,
    /// Root mean square of the weighted data residuals; 0 without data.
    pub data_rms: f64,
    /// Condition of the last linear system, estimated from its pivots.
    pub condition: f64,
    /// Whether the linearisation agreed with the equations at the end.
    pub converged: bool,
}

/// The minimiser. Vectors are reused from window to window.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Solution {
    /// Coefficients, `[n_states x rank]`, row-major.
    pub beta: Vec<f64>,
    /// State at the start of the window, `[n_states]`.
    pub start: Vec<f64>,
    /// State at the end of the window, `[n_states]`.
    pub end: Vec<f64>,
    /// Parameters at the start of the window, `[n_parameters]`.
    pub theta: Vec<f64>,
    /// How it went.
    pub account: Account,
}

impl Solution {
    /// State at position `s` of the window into `out` `[n_states]`; `phi` is scratch `[rank]`.
    pub fn state_at<M: Model>(&self, model: &M, basis: &super::basis::Basis, s: f64, phi: &mut [f64], out: &mut [f64]) {
        basis.values_at(s, phi);
        for ((o, start), beta) in out.iter_mut().zip(&self.start).zip(self.beta.chunks_exact(phi.len())) {
            *o = start + dot(phi, beta);
        }
        if (0..out.len()).any(|i| model.is_free(i)) {
            basis.free_values_at(s, phi);
            for (i, beta) in self.beta.chunks_exact(phi.len()).enumerate().filter(|(i, _)| model.is_free(*i)) {
                out[i] = dot(phi, beta);
            }
        }
    }

    /// Whether every number is finite.
    #[must_use]
    pub fn is_finite(&self) -> bool {
        self.end.iter().chain(&self.beta).chain(&self.theta).all(|v| v.is_finite())
    }
}

pub(super) fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// A point in the space of unknowns, and the residuals there. Shared by the solvers.
#[derive(Debug, Default)]
pub(super) struct Point {
    pub beta: Vec<f64>,
    pub xi: Vec<f64>,
    pub start: Vec<f64>,
    pub theta: Vec<f64>,
    /// States at the nodes, `[n_nodes x n_states]`.
    pub x: Vec<f64>,
    /// `f` at the nodes, `[n_nodes x n_states]`.
    pub f: Vec<f64>,
    /// Physics residual `dx/dt - f`, unweighted, `[n_states x n_nodes]`.
    pub physics: Vec<f64>,
    /// Weighted data residual, `[n_data]`.
    pub data: Vec<f64>,
}

impl Clone for Point {
    fn clone(&self) -> Self {
        let mut clone = Self::default();
        clone.clone_from(self);
        clone
    }

    /// Into the vectors that are there.
    fn clone_from(&mut self, other: &Self) {
        let Self { beta, xi, start, theta, x, f, physics, data } = other;
        self.beta.clone_from(beta);
        self.xi.clone_from(xi);
        self.start.clone_from(start);
        self.theta.clone_from(theta);
        self.x.clone_from(x);
        self.f.clone_from(f);
        self.physics.clone_from(physics);
        self.data.clone_from(data);
    }
}

impl Point {
    /// The start of the iteration: slopes constant over the window, everything else at its prior mean.
    pub(super) fn reset<M: Model>(&mut self, problem: &WindowProblem<'_, M>) {
        let (n, rank) = (problem.start.len(), problem.basis.rank());
        let nodes = problem.basis.positions().len();
        resize(&mut self.beta, n * rank);
        resize(&mut self.xi, problem.prior.n_xi);
        resize(&mut self.x, nodes * n);
        resize(&mut self.f, nodes * n);
        resize(&mut self.physics, nodes * n);
        resize(&mut self.data, problem.data.len());
        self.start.clear();
        self.start.extend_from_slice(problem.start);
        self.theta.clear();
        self.theta.extend_from_slice(problem.theta);
        if problem.basis.is_nodal() {
            problem.model.rhs(0.0, &self.start, &self.theta, &mut self.f[..n]);
            for (i, (row, f)) in self.beta.chunks_exact_mut(rank).zip(&self.f[..n]).enumerate() {
                row.fill(if problem.model.is_free(i) { problem.start[i] } else { *f });
            }
        }
    }

    /// Sets `start` and `theta` from `xi`.
    pub(super) fn place<M: Model>(&mut self, problem: &WindowProblem<'_, M>) {
        let n = problem.start.len();
        let unknowns = problem.unknowns;
        let shift = |row: usize, xi: &[f64]| dot(&problem.prior.root[row * xi.len()..(row + 1) * xi.len()], xi);
        let mut row = 0;
        if unknowns.initial_state {
            for (i, value) in self.start.iter_mut().enumerate() {
                *value = problem.start[i] + shift(i, &self.xi);
            }
            row = n;
        }
        for (i, (&p, transform)) in unknowns.parameters.iter().zip(&unknowns.transforms).enumerate() {
            let u = transform.forward(problem.theta[p]) + shift(row + i, &self.xi);
            self.theta[p] = transform.inverse(u);
        }
    }

    /// States at the nodes, and the data residual.
    pub(super) fn evaluate_states<M: Model>(&mut self, problem: &WindowProblem<'_, M>, phi: &[f64]) {
        let (n, rank) = (self.start.len(), problem.basis.rank());
        for (node, x) in self.x.chunks_exact_mut(n).enumerate() {
            let here = node * rank..(node + 1) * rank;
            for (i, x) in x.iter_mut().enumerate() {
                let beta = &self.beta[i * rank..(i + 1) * rank];
                *x = if problem.model.is_free(i) {
                    dot(&problem.basis.free_values()[here.clone()], beta)
                } else {
                    self.start[i] + dot(&problem.basis.values()[here.clone()], beta)
                };
            }
        }
        for ((residual, datum), phi) in self.data.iter_mut().zip(problem.data).zip(phi.chunks_exact(rank)) {
            let i = datum.state;
            let x = self.start[i] + dot(phi, &self.beta[i * rank..(i + 1) * rank]);
            *residual = datum.weight * (x - datum.value);
        }
    }

    /// The physics residual from `beta` and `f`.
    pub(super) fn evaluate_physics<M: Model>(&mut self, problem: &WindowProblem<'_, M>) {
        let (n, rank) = (self.start.len(), problem.basis.rank());
        let nodes = problem.basis.positions().len();
        for i in 0..n {
            let beta = &self.beta[i * rank..(i + 1) * rank];
            let rows = problem.left_hand_side(i);
            for node in 0..nodes {
                let left = if problem.basis.is_nodal() { beta[node] } else { dot(&rows[node * rank..][..rank], beta) };
                self.physics[i * nodes + node] = left - self.f[node * n + i];
            }
        }
    }

    /// Evaluates `f` at the nodes (without Jacobian).
    pub(super) fn evaluate_rhs<M: Model>(&mut self, problem: &WindowProblem<'_, M>) {
        let n = self.start.len();
        let h = problem.basis.length_s();
        for (node, s) in problem.basis.positions().iter().enumerate() {
            let range = node * n..(node + 1) * n;
            problem.model.rhs(s * h, &self.x[range.clone()], &self.theta, &mut self.f[range]);
        }
    }

    /// The objective.
    pub(super) fn objective<M: Model>(&self, problem: &WindowProblem<'_, M>) -> f64 {
        let nodes = problem.basis.positions().len();
        let rows = self.physics.chunks_exact(nodes).zip(problem.physics_weights);
        let physics: f64 = rows.map(|(row, w)| w * w * dot(row, row)).sum();
        physics + dot(&self.data, &self.data) + dot(&self.xi, &self.xi)
    }

    /// Copies the minimiser out.
    pub(super) fn finish<M: Model>(&self, problem: &WindowProblem<'_, M>, account: Account, out: &mut Solution) {
        let rank = problem.basis.rank();
        out.beta.clone_from(&self.beta);
        out.start.clone_from(&self.start);
        out.theta.clone_from(&self.theta);
        out.end.clear();
        for (i, (beta, start)) in self.beta.chunks_exact(rank).zip(&self.start).enumerate() {
            out.end.push(if problem.model.is_free(i) {
                dot(problem.basis.free_end(), beta)
            } else {
                start + dot(problem.basis.end(), beta)
            });
        }
        out.account = Account { physics_rms: rms(&self.physics), data_rms: rms(&self.data), ..account };
    }
}

pub(super) fn resize(v: &mut Vec<f64>, len: usize) {
    v.clear();
    v.resize(len, 0.0);
}

#[allow(clippy::cast_precision_loss)]
fn rms(v: &[f64]) -> f64 {
    if v.is_empty() { 0.0 } else { (dot(v, v) / v.len() as f64).sqrt() }
}

/// `phi` at the samples, `[n_data x rank]`.
pub(super) fn sample_rows<M>(problem: &WindowProblem<'_, M>, phi: &mut Vec<f64>) {
    let rank = problem.basis.rank();
    resize(phi, problem.data.len() * rank);
    for (j, datum) in problem.data.iter().enumerate() {
        let (done, rest) = phi.split_at_mut(j * rank);
        // Channels sampled together share their row.
        if j > 0 && problem.data[j - 1].s.to_bits() == datum.s.to_bits() {
            rest[..rank].copy_from_slice(&done[(j - 1) * rank..]);
        } else {
            problem.basis.values_at(datum.s, &mut rest[..rank]);
        }
    }
}
