//! The general solver: Gauss-Newton on one dense least-squares problem, for any number of features, nodes, states,
//! parameters and samples. The readable reference that faster paths are tested against.
//!
//! Rows as in [`problem`](super::problem); columns are `beta` `[n_states x rank]`, then `xi`. Every step is solved
//! by column-pivoted QR, and by the pseudo-inverse (singular values) where columns are dependent, which gives the
//! shortest of the minimising steps.

use faer::linalg::solvers::SolveLstsqCore;
use faer::{Conj, Mat};

use super::collocation::limit_step;
use super::problem::{Account, Point, Solution, WindowProblem, dot, sample_rows};
use crate::model::Model;

/// Diagonal entries of R below this share of the largest count as dependent columns.
const RANK_TOLERANCE: f64 = 1e-12;

/// Halvings of a step that makes things worse.
const MAX_HALVINGS: usize = 8;

/// Relative change of the objective that counts as none.
const NO_GAIN: f64 = 1e-12;

/// Minimises the problem.
pub fn solve<M: Model>(problem: &WindowProblem<'_, M>, out: &mut Solution) {
    let mut phi = Vec::new();
    sample_rows(problem, &mut phi);
    let mut point = Point::default();
    point.reset(problem);
    point.place(problem);
    evaluate(&mut point, problem, &phi);

    let mut account = Account::default();
    while account.iterations < problem.stopping.max_iterations && !account.converged {
        account.iterations += 1;
        let (jacobian, residual) = rows(&point, problem, &phi);
        let (mut step, condition) = least_squares(&jacobian, &residual);
        account.condition = condition;
        if !step.iter().all(|v| v.is_finite()) {
            break;
        }
        let n_beta = point.beta.len();
        let limited = limit_step(problem, &mut step[n_beta..]);
        let next = take_step(&point, problem, &phi, &step);
        // At a kink (a valve at rest) no step gets small, but none gains anything either.
        let (before, after) = (point.objective(problem), next.objective(problem));
        let no_gain = (before - after).abs() <= NO_GAIN * before;
        account.converged = !limited && (step_is_small(problem, &step, n_beta) || no_gain);
        point = next;
    }
    point.finish(problem, account, out);
}

fn evaluate<M: Model>(point: &mut Point, problem: &WindowProblem<'_, M>, phi: &[f64]) {
    point.evaluate_states(problem, phi);
    point.evaluate_rhs(problem);
    point.evaluate_physics(problem);
}

/// Jacobian `[n_rows x n_unknowns]` and residual `[n_rows]`, weighted.
fn rows<M: Model>(point: &Point, problem: &WindowProblem<'_, M>, phi: &[f64]) -> (Mat<f64>, Vec<f64>) {
    let (n, rank, n_xi) = (problem.start.len(), problem.basis.rank(), problem.prior.n_xi);
    let nodes = problem.basis.positions().len();
    let n_beta = n * rank;
    let n_physics = n * nodes;
    let n_rows = n_physics + problem.data.len() + n_xi;
    let mut a = Mat::zeros(n_rows, n_beta + n_xi);
    let mut b = vec![0.0; n_rows];

    let (mut f, mut dfdx) = (vec![0.0; n], vec![0.0; n * n]);
    for (node, s) in problem.basis.positions().iter().enumerate() {
        let t = s * problem.basis.length_s();
        let x = &point.x[node * n..(node + 1) * n];
        problem.model.rhs_and_state_jacobian(t, x, &point.theta, &mut f, &mut dfdx);
        let by_xi = rhs_by_xi(point, problem, t, x, &dfdx);
        for i in 0..n {
            let (row, w) = (i * nodes + node, problem.physics_weights[i]);
            for k in 0..rank {
                a[(row, i * rank + k)] += w * problem.left_hand_side(i)[node * rank + k];
                for j in 0..n {
                    a[(row, j * rank + k)] -= w * dfdx[i * n + j] * problem.expression(j)[node * rank + k];
                }
            }
            for k in 0..n_xi {
                a[(row, n_beta + k)] -= w * by_xi[i * n_xi + k];
            }
            b[row] = w * point.physics[row];
        }
    }
    for (j, datum) in problem.data.iter().enumerate() {
        let row = n_physics + j;
        for k in 0..rank {
            a[(row, datum.state * rank + k)] = datum.weight * phi[j * rank + k];
        }
        if problem.unknowns.initial_state {
            for k in 0..n_xi {
                a[(row, n_beta + k)] = datum.weight * problem.prior.root[datum.state * n_xi + k];
            }
        }
        b[row] = point.data[j];
    }
    for k in 0..n_xi {
        let row = n_physics + problem.data.len() + k;
        a[(row, n_beta + k)] = 1.0;
        b[row] = point.xi[k];
    }
    (a, b)
}

/// `df/dxi` at a node, `[n_states x n_xi]`, through the initial state and the parameters.
fn rhs_by_xi<M: Model>(point: &Point, problem: &WindowProblem<'_, M>, t: f64, x: &[f64], dfdx: &[f64]) -> Vec<f64> {
    let (n, n_xi) = (x.len(), problem.prior.n_xi);
    let unknowns = problem.unknowns;
    let free = unknowns.parameters.len();
    let mut dfdtheta = vec![0.0; n * free];
    problem.model.parameter_jacobian(t, x, &point.theta, &unknowns.parameters, &mut dfdtheta);
    let first = if unknowns.initial_state { n } else { 0 };
    let root = |row: usize, k: usize| problem.prior.root[row * n_xi + k];
    let mut out = vec![0.0; n * n_xi];
    for i in 0..n {
        for k in 0..n_xi {
            let mut by_state = 0.0;
            if unknowns.initial_state {
                let starting = (0..n).filter(|j| !problem.model.is_free(*j));
                by_state = starting.map(|j| dfdx[i * n + j] * root(j, k)).sum();
            }
            let by_parameter: f64 = (0..free)
                .map(|p| {
                    let slope = unknowns.transforms[p].slope(point.theta[unknowns.parameters[p]]);
                    dfdtheta[i * free + p] * slope * root(first + p, k)
                })
                .sum();
            out[i * n_xi + k] = by_state + by_parameter;
        }
    }
    out
}

/// Keeps the linear algebra on the thread that asks for it: members are solved in parallel, one of them is too small to
/// share out, and how it is shared out must not change a digit.
pub(super) fn one_thread() {
    faer::set_global_parallelism(faer::Par::Seq);
}

/// The step that minimises `|a step + b|`, and the condition estimate.
///
/// Public so that the tests can hold it against a plain singular value decomposition.
#[must_use]
pub fn least_squares(a: &Mat<f64>, b: &[f64]) -> (Vec<f64>, f64) {
    one_thread();
    let columns = a.ncols();
    if a.nrows() >= columns {
        let qr = a.col_piv_qr();
        let diagonal: Vec<f64> = (0..columns).map(|i| qr.R()[(i, i)].abs()).collect();
        let largest = diagonal.iter().copied().fold(0.0, f64::max);
        let smallest = diagonal.iter().copied().fold(f64::INFINITY, f64::min);
        if smallest > RANK_TOLERANCE * largest {
            let mut rhs = Mat::from_fn(a.nrows(), 1, |i, _| -b[i]);
            qr.solve_lstsq_in_place_with_conj(Conj::No, rhs.as_mut());
            return ((0..columns).map(|i| rhs[(i, 0)]).collect(), largest / smallest);
        }
    }
    shortest_least_squares(a, b)
}

/// The same through the singular value decomposition, which also serves dependent columns.
#[must_use]
pub fn shortest_least_squares(a: &Mat<f64>, b: &[f64]) -> (Vec<f64>, f64) {
    one_thread();
    let Ok(svd) = a.thin_svd() else {
        return (vec![f64::NAN; a.ncols()], f64::INFINITY);
    };
    let sigma: Vec<f64> = svd.S().column_vector().iter().copied().collect();
    let largest = sigma.first().copied().unwrap_or(0.0);
    let (u, v) = (svd.U(), svd.V());
    let mut step = vec![0.0; a.ncols()];
    let mut smallest = largest;
    for (k, &s) in sigma.iter().enumerate().filter(|(_, s)| **s > RANK_TOLERANCE * largest) {
        smallest = s;
        let projection: f64 = (0..a.nrows()).map(|i| u[(i, k)] * b[i]).sum();
        step.iter_mut().enumerate().for_each(|(i, x)| *x -= v[(i, k)] * projection / s);
    }
    (step, largest / smallest)
}

/// The next point: along the step, shortened while the objective grows.
fn take_step<M: Model>(point: &Point, problem: &WindowProblem<'_, M>, phi: &[f64], step: &[f64]) -> Point {
    let before = point.objective(problem);
    let (step_beta, step_xi) = step.split_at(point.beta.len());
    let at = |share: f64| {
        let mut next = point.clone();
        next.beta.iter_mut().zip(step_beta).for_each(|(x, s)| *x += share * s);
        next.xi.iter_mut().zip(step_xi).for_each(|(x, s)| *x += share * s);
        next.place(problem);
        evaluate(&mut next, problem, phi);
        next
    };
    let mut share = 1.0;
    let mut next = at(share);
    for _ in 0..MAX_HALVINGS {
        if next.objective(problem) <= before * (1.0 + 1e-12) {
            break;
        }
        share *= 0.5;
        next = at(share);
    }
    next
}

/// Whether the step moves no state and no coordinate by more than the tolerance.
fn step_is_small<M: Model>(problem: &WindowProblem<'_, M>, step: &[f64], n_beta: usize) -> bool {
    let tolerance = problem.stopping.tolerance_mmhg;
    let rank = problem.basis.rank();
    let end = |i: usize| if problem.model.is_free(i) { problem.basis.free_end() } else { problem.basis.end() };
    let states = step[..n_beta].chunks_exact(rank).enumerate().map(|(i, beta)| dot(end(i), beta).abs());
    states.fold(0.0, f64::max) <= tolerance && step[n_beta..].iter().all(|s| s.abs() <= tolerance)
}
