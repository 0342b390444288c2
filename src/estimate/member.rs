//! One Monte Carlo member: its state, its parameters, its random features and its solve of a window.

use super::coupling::independent;
use super::ensemble::Observation;
use super::settings::{CouplingKind, EstimatorSettings};
use crate::model::Model;
use crate::model::rk4::{MAX_STEP_S, Rk4};
use crate::xtfc::basis::Basis;
use crate::xtfc::collocation::CollocationSolver;
use crate::xtfc::dense;
use crate::xtfc::problem::{Datum, Prior, Solution, Unknowns, WindowProblem};

/// A member of the ensemble.
#[derive(Debug, Clone)]
pub struct Member {
    /// None in filters that do not use X-TFC.
    pub(super) basis: Option<Basis>,
    solver: CollocationSolver,
    pub(super) solution: Solution,
    /// State at the end of the last window, `[n_states]`.
    pub(super) x: Vec<f64>,
    /// Parameters there, clocks moved on.
    pub(super) theta: Vec<f64>,
    /// Its perturbed samples of this window.
    data: Vec<Datum>,
    /// Prior root of its own (`independent`).
    root: Vec<f64>,
    /// What it expects of the samples of this window, `[n_observations]`.
    pub(super) expected: Vec<f64>,
    rk4: Rk4,
    /// Whether the last solve gave numbers.
    pub(super) solved: bool,
}

/// What members expect of the samples of a window, `[n_observations x n_members]`.
pub(super) fn expectations(members: &[Member], observations: usize) -> Vec<f64> {
    (0..observations).flat_map(|j| members.iter().map(move |member| member.expected[j])).collect()
}

impl Member {
    pub(super) fn new(basis: Option<Basis>, x: Vec<f64>, theta: Vec<f64>) -> Self {
        let solution = Solution {
            beta: vec![0.0; x.len() * basis.as_ref().map_or(0, Basis::rank)],
            start: x.clone(),
            end: x.clone(),
            theta: theta.clone(),
            ..Solution::default()
        };
        Self {
            basis,
            solver: CollocationSolver::default(),
            solution,
            x,
            theta,
            data: Vec::new(),
            root: Vec::new(),
            expected: Vec::new(),
            rk4: Rk4::default(),
            solved: true,
        }
    }

    /// Looks ahead: what it expects of the samples if nothing is learnt from them. Returns the state at the end.
    pub(super) fn forecast<M: Model>(
        &mut self,
        model: &M,
        observations: &[Observation],
        settings: &EstimatorSettings,
        until_s: f64,
    ) -> Vec<f64> {
        let h = settings.window.length_s();
        let (mut x, mut t) = (self.x.clone(), 0.0);
        self.expected.clear();
        for observation in observations {
            let at = observation.s * h;
            self.rk4.advance(model, (t, at), MAX_STEP_S, &self.theta, &mut x);
            t = at;
            self.expected.push(x[settings.channels[observation.channel].state]);
        }
        self.rk4.advance(model, (t, until_s), MAX_STEP_S, &self.theta, &mut x);
        x
    }

    /// The member's own noisy copy of the observations; `sd` is the noise of each, `noise` its draw.
    pub(super) fn perturb(
        &mut self,
        observations: &[Observation],
        settings: &EstimatorSettings,
        sd: &[f64],
        noise: impl Fn(usize) -> f64,
    ) {
        self.data.clear();
        self.data.extend(observations.iter().zip(sd).enumerate().map(|(k, (o, sd))| {
            let weight = if settings.coupling.is_bayesian() { 1.0 / sd } else { settings.weights.data };
            Datum { s: o.s, state: settings.channels[o.channel].state, value: o.value + sd * noise(k), weight }
        }));
    }

    pub(super) fn solve<M: Model>(
        &mut self,
        model: &M,
        settings: &EstimatorSettings,
        unknowns: &Unknowns,
        shared_root: &[f64],
    ) {
        let nothing_free = Unknowns::default();
        let Some(basis) = &self.basis else { return };
        // Without samples the prior is its own minimiser: a forecast.
        let (unknowns, prior) = if self.data.is_empty() {
            (&nothing_free, Prior::NONE)
        } else {
            let root = match settings.coupling {
                CouplingKind::Independent => {
                    let weight = settings.weights.parameter;
                    let infos = model.parameters();
                    independent::prior_root(&self.theta, infos, &unknowns.parameters, weight, &mut self.root);
                    &self.root
                }
                _ => shared_root,
            };
            (unknowns, Prior { root, n_xi: unknowns.len(self.x.len()) })
        };
        let problem = WindowProblem {
            model,
            basis,
            start: &self.x,
            theta: &self.theta,
            unknowns,
            prior,
            data: &self.data,
            physics_weights: &settings.weights.physics,
            stopping: settings.stopping,
        };
        if basis.is_nodal() {
            self.solver.solve(&problem, &mut self.solution);
        } else {
            dense::solve(&problem, &mut self.solution);
        }
        self.solved = self.solution.is_finite();
        if !self.solved {
            self.stay();
        }
    }

    /// A window that nothing is learnt from, by the general solver.
    pub(super) fn solve_without_samples<M: Model>(
        &mut self,
        model: &M,
        settings: &EstimatorSettings,
        unknowns: &Unknowns,
    ) {
        self.data.clear();
        self.solve(model, settings, unknowns, &[]);
    }

    /// Where it was at the start of the window and is at its end, in a filter that has no network between them.
    pub(super) fn go<M: Model>(&mut self, model: &M, h: f64, end: &[f64]) {
        std::mem::swap(&mut self.solution.start, &mut self.x);
        self.x.clear();
        self.x.extend_from_slice(end);
        self.solution.end.clear();
        self.solution.end.extend_from_slice(end);
        self.solution.theta.clone_from(&self.theta);
        model.advance(-h, &mut self.solution.theta);
    }

    /// State at position `s` of the window.
    pub(super) fn state_at<M: Model>(&self, model: &M, s: f64, phi: &mut Vec<f64>, out: &mut [f64]) {
        if s >= 1.0 {
            out.copy_from_slice(&self.solution.end);
        } else if let Some(basis) = &self.basis {
            phi.resize(basis.rank(), 0.0);
            self.solution.state_at(model, basis, s, phi, out);
        } else {
            let ends = self.solution.start.iter().zip(&self.solution.end);
            out.iter_mut().zip(ends).for_each(|(o, (a, b))| *o = a + s * (b - a));
        }
    }

    /// Takes the state and parameters at the start for the whole window, so that nothing without a number is read
    /// from it where no other member can stand in.
    fn stay(&mut self) {
        self.solution.beta.fill(0.0);
        self.solution.start.clone_from(&self.x);
        self.solution.end.clone_from(&self.x);
        self.solution.theta.clone_from(&self.theta);
    }
}
