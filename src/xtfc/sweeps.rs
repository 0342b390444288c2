#![doc = include_str!("sweeps.md")]

use super::basis::Basis;
use super::problem::Unknowns;
use crate::model::Transform;
use crate::model::lanes::{InstructionSet, LaneModel, Lanes, WIDTH};

/// Beyond this, a general solve is cheaper.
pub const MAX_SWEEPS: usize = 20;

/// The same, where there are samples.
pub const MAX_ROUNDS: usize = 14;

/// Up to this many nodes there is code with less to clear away.
const FEW: usize = 5;

/// Most nodes of a batch.
const MAX_NODES: usize = 8;

/// Residuals above this many times their limit are taken as they are.
const SMALL: f64 = 1e3;

/// The constrained expressions of a batch of members.
#[derive(Debug, Clone)]
pub struct Expressions {
    /// Node positions \[s\].
    times_s: Vec<f64>,
    /// `phi` at the nodes \[s\], `[n_nodes x n_nodes]`.
    values: Vec<Lanes>,
    /// `phi` at the end \[s\], `[n_nodes]`.
    end: Vec<Lanes>,
    length_s: f64,
}

impl Expressions {
    /// Of up to eight members; None if they cannot be treated alike.
    #[must_use]
    pub fn new(bases: &[Basis]) -> Option<Self> {
        let first = bases.first()?;
        let nodes = first.positions().len();
        let alike = |basis: &Basis| basis.is_nodal() && basis.positions() == first.positions();
        if !(2..=MAX_NODES).contains(&nodes) || bases.len() > WIDTH || !bases.iter().all(alike) {
            return None;
        }
        // An incomplete batch is filled up with its first member.
        let lanes =
            |of: &dyn Fn(&Basis) -> f64| Lanes(std::array::from_fn(|lane| of(bases.get(lane).unwrap_or(first))));
        Some(Self {
            times_s: first.positions().iter().map(|s| s * first.length_s()).collect(),
            values: (0..nodes * nodes).map(|k| lanes(&|basis| basis.values()[k])).collect(),
            end: (0..nodes).map(|k| lanes(&|basis| basis.end()[k])).collect(),
            length_s: first.length_s(),
        })
    }
}

/// Eight members on a window. Reuse it from window to window.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Solutions {
    /// State at the start, `[n_states]`; before the solve, fixed or the prior mean.
    pub start: Vec<Lanes>,
    /// Parameters, `[n_parameters]`; before the solve, fixed or the prior mean.
    pub theta: Vec<Lanes>,
    /// Slopes at the nodes, `[n_states x n_nodes]`.
    pub beta: Vec<Lanes>,
    /// State at the end, `[n_states]`.
    pub end: Vec<Lanes>,
}

/// How a solve went.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Progress {
    /// Sweeps, or rounds of sweeps where there are samples.
    pub sweeps: usize,
    /// Members whose equations hold; the others are left to the general solver.
    pub done: [bool; WIDTH],
    /// Root mean square of the physics residual at the nodes \[mmHg/s\].
    pub physics_rms: Lanes,
}

/// The samples of a window.
#[derive(Debug, Clone, Copy)]
pub struct Samples<'a> {
    /// The state that each observes, `[n_samples]`.
    pub states: &'a [usize],
    /// Weight of each \[1/mmHg\].
    pub weights: &'a [f64],
    /// `phi` at each, `[n_samples x n_nodes]`.
    pub phi: &'a [Lanes],
    /// Each as every member sees it \[mmHg\].
    pub values: &'a [Lanes],
}

#[allow(clippy::inline_always)]
impl<'a> Samples<'a> {
    /// `phi` at a sample, `[n_nodes]`.
    #[inline(always)]
    fn phi(&self, sample: usize) -> &'a [Lanes] {
        let nodes = self.phi.len() / self.states.len();
        &self.phi[sample * nodes..(sample + 1) * nodes]
    }
}

/// Covariance of what is free.
#[derive(Debug, Clone, Copy)]
pub enum Covariance<'a> {
    /// Of all members, `[n_u x n_u]`.
    Shared(&'a [f64]),
    /// Variances of each, `[n_u]`.
    Own(&'a [Lanes]),
}

#[allow(clippy::inline_always)]
impl Covariance<'_> {
    /// `-P gradient`, one row.
    #[inline(always)]
    fn shift(&self, row: usize, gradient: &[Lanes]) -> Lanes {
        match self {
            Self::Shared(covariance) => {
                let mut sum = Lanes::default();
                for (entry, gradient) in covariance[row * gradient.len()..].iter().zip(gradient) {
                    sum = sum - Lanes::splat(*entry) * *gradient;
                }
                sum
            }
            Self::Own(variances) => Lanes::default() - variances[row] * gradient[row],
        }
    }
}

/// What samples can move.
#[derive(Debug, Clone, Copy)]
pub struct Freedom<'a> {
    /// Besides the slopes.
    pub unknowns: &'a Unknowns,
    /// Their prior covariance.
    pub covariance: Covariance<'a>,
    /// Weights of the physics rows, per equation \[s/mmHg\].
    pub physics_weights: &'a [f64],
    /// About the inverse covariance of the weighted samples, `[n_samples x n_samples]`; worked out member by member if
    /// there is none. The better, the fewer rounds; the result does not depend on it.
    pub precision: Option<&'a [f64]>,
}

/// Scratch of [`fit`]; reuse it from window to window.
#[derive(Debug, Clone, Default)]
pub struct FitScratch {
    /// Weighted residuals that the dual equations are driven by, and how far they are from those found, `[n_samples]`.
    residuals: Vec<Lanes>,
    off: Vec<Lanes>,
    step: Vec<Lanes>,
    along: Vec<Lanes>,
    /// About the inverse of how `off` answers to `residuals`, `[n_samples x n_samples]`.
    inverse: Vec<Lanes>,
    /// Derivative of the data by what is free, `[n_u]`.
    gradient: Vec<Lanes>,
    /// Derivatives of the weighted samples by what is free and by the errors of the equations.
    answers: Vec<Lanes>,
    mean_theta: Vec<Lanes>,
}

/// A window without samples: sweeps until no equation is off by more than `tolerance_mmhg` over its length. None, with
/// nothing done, where `model` has no equations for these members.
#[must_use]
pub fn forecast<M: LaneModel>(
    model: &M,
    expressions: &Expressions,
    tolerance_mmhg: f64,
    instructions: InstructionSet,
    solutions: &mut Solutions,
) -> Option<Progress> {
    let nodes = expressions.times_s.len();
    solutions.beta.resize(nodes * solutions.start.len(), Lanes::default());
    solutions.end.resize(solutions.start.len(), Lanes::default());
    let limit = tolerance_mmhg / expressions.length_s;
    if nodes <= FEW {
        instructions.run(Forecast::<M, FEW> { model, expressions, limit, solutions })
    } else {
        instructions.run(Forecast::<M, MAX_NODES> { model, expressions, limit, solutions })
    }
}

/// A window with samples, from the solution without them (by [`forecast`]). None, with nothing done, where `model` does
/// not know what is free.
#[must_use]
pub fn fit<M: LaneModel>(
    model: &M,
    expressions: &Expressions,
    samples: &Samples<'_>,
    freedom: &Freedom<'_>,
    tolerance_mmhg: f64,
    instructions: InstructionSet,
    (scratch, solutions): (&mut FitScratch, &mut Solutions),
) -> Option<Progress> {
    if !freedom.unknowns.parameters.iter().all(|&p| model.knows(p)) {
        return None;
    }
    if expressions.times_s.len() <= FEW {
        instructions.run(Fit::<M, FEW> { model, expressions, samples, freedom, tolerance_mmhg, scratch, solutions })
    } else {
        instructions.run(Fit::<M, MAX_NODES> {
            model,
            expressions,
            samples,
            freedom,
            tolerance_mmhg,
            scratch,
            solutions,
        })
    }
}

/// Something at every node. Lent, not owned, by what is made of it: these are too large to be moved about.
type AtNodes<T, const N: usize> = [T; N];

/// The equations of a model at the nodes of a window.
struct Equations<'a, M: LaneModel, const N: usize> {
    fixed: M::Fixed,
    moments: &'a mut AtNodes<M::Moment, N>,
    /// Kept where derivatives by parameters are needed.
    instants: Option<&'a mut AtNodes<M::Instant, N>>,
    expressions: &'a Expressions,
}

/// The path of the members: slopes and states at the nodes.
struct Path<'a, M: LaneModel, const N: usize> {
    start: M::State,
    slopes: &'a mut AtNodes<M::State, N>,
}

/// The derivatives where the equations were evaluated last, and relaxations that fit them well enough.
struct Tangents<'a, M: LaneModel, const N: usize> {
    tangents: &'a mut AtNodes<M::Tangent, N>,
    relaxations: &'a mut AtNodes<M::Relaxation, N>,
}

/// The dual path: `g = (I - df/dx phi)^-T b`, and `(df/dx)^T g`.
struct Dual<'a, M: LaneModel, const N: usize> {
    g: &'a mut AtNodes<M::State, N>,
    pulled: &'a mut AtNodes<M::State, N>,
}

#[allow(clippy::inline_always)]
impl<'a, M: LaneModel, const N: usize> Equations<'a, M, N> {
    #[inline(always)]
    fn new(
        model: &M,
        expressions: &'a Expressions,
        theta: &[Lanes],
        moments: &'a mut AtNodes<M::Moment, N>,
        instants: Option<&'a mut AtNodes<M::Instant, N>>,
    ) -> Option<Self> {
        let mut equations = Self { fixed: model.fixed(theta)?, moments, instants, expressions };
        equations.set_moments();
        Some(equations)
    }

    #[inline(always)]
    fn nodes(&self) -> usize {
        self.expressions.times_s.len().min(N)
    }

    /// `phi` at a node, `[n_nodes]`.
    #[inline(always)]
    fn phi(&self, node: usize) -> &'a [Lanes] {
        &self.expressions.values[node * self.nodes()..(node + 1) * self.nodes()]
    }

    #[inline(always)]
    fn set_moments(&mut self) {
        for (node, (moment, t_s)) in self.moments.iter_mut().zip(&self.expressions.times_s).enumerate() {
            let instant = M::instant(&self.fixed, *t_s);
            *moment = M::moment(&self.fixed, &instant);
            if let Some(instants) = &mut self.instants {
                instants[node] = instant;
            }
        }
    }

    /// Derivatives at the start of the window, for all nodes.
    #[inline(always)]
    fn look_ahead(&self, tangent: M::Tangent, at: &mut Tangents<'_, M, N>) {
        for node in 0..self.nodes() {
            at.tangents[node] = tangent;
            at.relaxations[node] = M::relaxation(&self.fixed, &self.moments[node], &tangent, self.phi(node)[node]);
        }
    }

    /// Solves each node in turn, with the newest slopes of the others; returns the largest residual met on the way, and
    /// leaves the states there.
    #[inline(always)]
    fn sweep(
        &self,
        path: &mut Path<'_, M, N>,
        at: &mut Tangents<'_, M, N>,
        errors: Option<&AtNodes<M::State, N>>,
        mut states: Option<&mut AtNodes<M::State, N>>,
    ) -> Lanes {
        let mut largest = Lanes::splat(0.0);
        for node in 0..self.nodes() {
            let phi = self.phi(node);
            let x = path.at(phi);
            let (mut residual, tangent) = M::linearise(&self.fixed, &self.moments[node], &x);
            for (r, k) in residual.as_mut().iter_mut().zip(path.slopes[node].as_ref()) {
                *r = *r - *k;
            }
            if let Some(errors) = errors {
                add::<M>(&mut residual, &errors[node]);
            }
            for r in residual.as_ref() {
                largest = r.abs().larger(largest);
            }
            // The relaxation of the last visit: one that is exact would have to be waited for.
            let step = M::relax(&at.relaxations[node], &residual, false);
            add::<M>(&mut path.slopes[node], &step);
            if !M::is_alike(&tangent, &at.tangents[node]) {
                at.relaxations[node] = M::relaxation(&self.fixed, &self.moments[node], &tangent, phi[node]);
                at.tangents[node] = tangent;
            }
            if let Some(states) = &mut states {
                states[node] = x;
            }
        }
        largest
    }

    /// The same for the dual equations, which run backwards.
    #[inline(always)]
    fn sweep_dual(&self, at: &Tangents<'_, M, N>, drive: &AtNodes<M::State, N>, dual: &mut Dual<'_, M, N>) -> Lanes {
        let mut largest = Lanes::splat(0.0);
        for node in (0..self.nodes()).rev() {
            let mut residual = drive[node];
            let column = self.expressions.values[node..].iter().step_by(self.nodes());
            for (phi, pulled) in column.zip(dual.pulled.iter()) {
                for (r, pulled) in residual.as_mut().iter_mut().zip(pulled.as_ref()) {
                    *r = *r + *phi * *pulled;
                }
            }
            for (r, g) in residual.as_mut().iter_mut().zip(dual.g[node].as_ref()) {
                *r = *r - *g;
            }
            for r in residual.as_ref() {
                largest = r.abs().larger(largest);
            }
            let step = M::relax(&at.relaxations[node], &residual, true);
            add::<M>(&mut dual.g[node], &step);
            dual.pulled[node] = M::pull(&self.fixed, &self.moments[node], &at.tangents[node], &dual.g[node]);
        }
        largest
    }
}

#[allow(clippy::inline_always)]
impl<'a, M: LaneModel, const N: usize> Path<'a, M, N> {
    /// Slopes constant over the window; the derivative at its start.
    #[inline(always)]
    fn straight(
        equations: &Equations<'_, M, N>,
        start: &[Lanes],
        slopes: &'a mut AtNodes<M::State, N>,
    ) -> (Self, M::Tangent) {
        let start = state::<M>(start);
        let (slope, tangent) = M::linearise(&equations.fixed, &equations.moments[0], &start);
        for slopes in &mut slopes[..equations.nodes()] {
            *slopes = slope;
        }
        (Self { start, slopes }, tangent)
    }

    /// `x + sum phi_j slope_j`
    #[inline(always)]
    fn at(&self, phi: &[Lanes]) -> M::State {
        let mut x = self.start;
        for (phi, slope) in phi.iter().zip(self.slopes.iter()) {
            for (x, slope) in x.as_mut().iter_mut().zip(slope.as_ref()) {
                *x = *x + *phi * *slope;
            }
        }
        x
    }

    /// One state of [`Path::at`].
    #[inline(always)]
    fn state_at(&self, state: usize, phi: &[Lanes]) -> Lanes {
        let mut x = self.start.as_ref()[state];
        for (phi, slope) in phi.iter().zip(self.slopes.iter()) {
            x = x + *phi * slope.as_ref()[state];
        }
        x
    }

    #[inline(always)]
    fn write(&self, equations: &Equations<'_, M, N>, solutions: &mut Solutions) {
        solutions.start.copy_from_slice(self.start.as_ref());
        solutions.end.copy_from_slice(self.at(&equations.expressions.end).as_ref());
        for (i, beta) in solutions.beta.chunks_exact_mut(equations.nodes()).enumerate() {
            for (beta, slopes) in beta.iter_mut().zip(self.slopes.iter()) {
                *beta = slopes.as_ref()[i];
            }
        }
    }
}

#[allow(clippy::inline_always)]
#[inline(always)]
fn state<M: LaneModel>(values: &[Lanes]) -> M::State {
    let mut state = M::State::default();
    state.as_mut().copy_from_slice(values);
    state
}

#[allow(clippy::inline_always)]
#[inline(always)]
fn add<M: LaneModel>(to: &mut M::State, what: &M::State) {
    for (to, what) in to.as_mut().iter_mut().zip(what.as_ref()) {
        *to = *to + *what;
    }
}

#[allow(clippy::inline_always)]
#[inline(always)]
fn dot(a: &[Lanes], b: &[Lanes]) -> Lanes {
    let mut sum = Lanes::default();
    for (a, b) in a.iter().zip(b) {
        sum = sum + *a * *b;
    }
    sum
}

/// Largest values pass over what is no number.
#[allow(clippy::inline_always)]
#[inline(always)]
fn refuse_what_is_no_number(end: &[Lanes], done: &mut [bool; WIDTH]) {
    let mut none = Lanes::splat(0.0);
    for x in end {
        none = none + *x * Lanes::splat(0.0);
    }
    for (done, none) in done.iter_mut().zip(none.0) {
        *done &= !none.is_nan();
    }
}

/// What a sweep has left of residuals that were measured in the course of it: with `theta` the factor by which they shrank
/// since the sweep before, at most `theta / (1 - theta)` of them, as in stiff solvers (Hairer and Wanner 1996, IV.8).
struct Left {
    before: Lanes,
    /// In units of the limit.
    of_limit: Lanes,
}

#[allow(clippy::inline_always)]
impl Left {
    const START: Self = Self { before: Lanes::splat(0.0), of_limit: Lanes::splat(f64::INFINITY) };

    #[inline(always)]
    fn after(&mut self, residual: Lanes, limit: Lanes) {
        let shrunk = self.before - residual;
        let estimate = residual * residual / shrunk;
        // Not before they are small, and shrink quickly: where a valve closes, they may come back.
        let quick = shrunk - Lanes::splat(0.7) * self.before;
        let small = Lanes::splat(SMALL) * limit - residual;
        let left = quick.choose(small.choose(estimate, residual), residual);
        self.of_limit = left / limit;
        self.before = residual;
    }
}

struct Forecast<'a, M, const N: usize> {
    model: &'a M,
    expressions: &'a Expressions,
    limit: f64,
    solutions: &'a mut Solutions,
}

#[allow(clippy::inline_always)]
impl<M: LaneModel, const N: usize> pulp::NullaryFnOnce for Forecast<'_, M, N> {
    type Output = Option<Progress>;

    #[inline(always)]
    fn call(self) -> Self::Output {
        let Self { model, expressions, limit, solutions } = self;
        let (mut moments, mut slopes) = ([M::Moment::default(); N], [M::State::default(); N]);
        let equations = Equations::<M, N>::new(model, expressions, &solutions.theta, &mut moments, None)?;
        let (mut path, tangent) = Path::straight(&equations, &solutions.start, &mut slopes);
        let (mut tangents, mut relaxations) = ([M::Tangent::default(); N], [M::Relaxation::default(); N]);
        let mut at = Tangents::<M, N> { tangents: &mut tangents, relaxations: &mut relaxations };
        equations.look_ahead(tangent, &mut at);
        let (mut left, mut sweeps) = (Left::START, 0);
        while sweeps < MAX_SWEEPS {
            sweeps += 1;
            left.after(equations.sweep(&mut path, &mut at, None, None), Lanes::splat(limit));
            if left.of_limit.all_within(1.0) {
                break;
            }
        }
        path.write(&equations, solutions);
        let physics_rms = left.of_limit * Lanes::splat(limit);
        let mut done = left.of_limit.0.map(|share| share <= 1.0);
        refuse_what_is_no_number(&solutions.end, &mut done);
        Some(Progress { sweeps, done, physics_rms })
    }
}

struct Fit<'a, M, const N: usize> {
    model: &'a M,
    expressions: &'a Expressions,
    samples: &'a Samples<'a>,
    freedom: &'a Freedom<'a>,
    tolerance_mmhg: f64,
    scratch: &'a mut FitScratch,
    solutions: &'a mut Solutions,
}

#[allow(clippy::inline_always)]
impl<M: LaneModel, const N: usize> pulp::NullaryFnOnce for Fit<'_, M, N> {
    type Output = Option<Progress>;

    #[inline(always)]
    fn call(self) -> Self::Output {
        let Self { model, expressions, samples, freedom, tolerance_mmhg, scratch, solutions } = self;
        let (mut moments, mut slopes) = ([M::Moment::default(); N], [M::State::default(); N]);
        let mut instants = [M::Instant::default(); N];
        let mut equations =
            Equations::<M, N>::new(model, expressions, &solutions.theta, &mut moments, Some(&mut instants))?;
        let nodes = equations.nodes();
        let mean = state::<M>(&solutions.start);
        let mut path = Path::<M, N> { start: mean, slopes: &mut slopes };
        for (i, beta) in solutions.beta.chunks_exact(nodes).enumerate() {
            for (beta, slopes) in beta.iter().zip(path.slopes.iter_mut()) {
                slopes.as_mut()[i] = *beta;
            }
        }
        // Derivatives where the members are; the residual is that of the forecast.
        let (mut tangents, mut relaxations) = ([M::Tangent::default(); N], [M::Relaxation::default(); N]);
        let mut at = Tangents::<M, N> { tangents: &mut tangents, relaxations: &mut relaxations };
        let (_, tangent) = M::linearise(&equations.fixed, &equations.moments[0], &path.start);
        equations.look_ahead(tangent, &mut at);
        let mut states = [M::State::default(); N];
        equations.sweep(&mut path, &mut at, None, Some(&mut states));

        scratch.begin(samples, freedom, &path, &solutions.theta);
        let (mut g, mut pulled) = ([M::State::default(); N], [M::State::default(); N]);
        let mut dual = Dual::<M, N> { g: &mut g, pulled: &mut pulled };
        let (mut drive, mut errors) = ([M::State::default(); N], [M::State::default(); N]);
        if freedom.precision.is_none() {
            let (work, known) = ((&mut dual, &mut drive), (&at, &states));
            scratch.guess(model, &equations, samples, freedom, work, known, &solutions.theta);
        }
        scratch.advance();
        let mut progress = Progress { sweeps: 0, done: [false; WIDTH], physics_rms: Lanes::default() };
        let mut of_dual = M::State::default();
        for (factor, weight) in of_dual.as_mut().iter_mut().zip(freedom.physics_weights) {
            *factor = Lanes::splat(-1.0 / (weight * weight));
        }
        let limit = Lanes::splat(tolerance_mmhg / expressions.length_s);
        let (mut left, mut dual_left) = (Left::START, Left::START);
        while progress.sweeps < MAX_ROUNDS {
            progress.sweeps += 1;
            // What the samples pull at, and how that feels at the nodes.
            drive[..nodes].fill(M::State::default());
            let mut size = Lanes::default();
            for (j, &observed) in samples.states.iter().enumerate() {
                let pull = Lanes::splat(samples.weights[j]) * scratch.residuals[j];
                for (drive, phi) in drive[..nodes].iter_mut().zip(samples.phi(j)) {
                    let entry = &mut drive.as_mut()[observed];
                    *entry = *entry + pull * *phi;
                    size = entry.abs().larger(size);
                }
            }
            let dual_residual = equations.sweep_dual(&at, &drive, &mut dual);
            // Relative to what drives it: corrections are of the order of a mmHg. Where nothing pulls, nothing is left.
            let least = Lanes::splat(f64::MIN_POSITIVE);
            dual_left.after(dual_residual, (size * Lanes::splat(tolerance_mmhg)).larger(least));

            // Errors of the equations, states at the start and parameters follow from that.
            for (error, g) in errors[..nodes].iter_mut().zip(dual.g.iter()) {
                for ((error, g), factor) in error.as_mut().iter_mut().zip(g.as_ref()).zip(of_dual.as_ref()) {
                    *error = *g * *factor;
                }
            }
            let within =
                scratch.place(model, &mut equations, samples, freedom, (&dual, &states), (mean, &mut path), solutions);

            // The path that belongs to them, and what it makes of the samples.
            let residual = equations.sweep(&mut path, &mut at, Some(&errors), Some(&mut states));
            let mut off = Lanes::default();
            for (j, &observed) in samples.states.iter().enumerate() {
                let weight = Lanes::splat(samples.weights[j]);
                let found = weight * (path.state_at(observed, samples.phi(j)) - samples.values[j]);
                scratch.off[j] = found - scratch.residuals[j];
                off = (scratch.off[j].abs() / weight).larger(off);
            }
            left.after(residual, limit);
            let most = (off / Lanes::splat(tolerance_mmhg)).larger(left.of_limit).larger(dual_left.of_limit);
            for (lane, done) in progress.done.iter_mut().enumerate() {
                *done = within.0[lane] > 0.0 && most.0[lane] <= 1.0;
            }
            if progress.done.iter().all(|done| *done) {
                break;
            }
            scratch.improve();
        }
        let mut squares = Lanes::default();
        for error in &errors[..nodes] {
            squares = squares + dot(error.as_ref(), error.as_ref());
        }
        #[allow(clippy::cast_precision_loss)]
        let count = (nodes * solutions.start.len()) as f64;
        progress.physics_rms = (squares / Lanes::splat(count)).sqrt();
        path.write(&equations, solutions);
        refuse_what_is_no_number(&solutions.end, &mut progress.done);
        Some(progress)
    }
}

/// `B^T g`: what the dual path says of the state at the start and the parameters, `[n_u]`.
#[allow(clippy::inline_always)]
#[inline(always)]
fn pull_back<M: LaneModel, const N: usize>(
    model: &M,
    equations: &Equations<'_, M, N>,
    freedom: &Freedom<'_>,
    (dual, states): (&Dual<'_, M, N>, &AtNodes<M::State, N>),
    theta: &[Lanes],
    out: &mut [Lanes],
) {
    let unknowns = freedom.unknowns;
    let mut first = 0;
    if unknowns.initial_state {
        let mut sum = M::State::default();
        for pulled in &dual.pulled[..equations.nodes()] {
            add::<M>(&mut sum, pulled);
        }
        first = sum.as_ref().len();
        out[..first].copy_from_slice(sum.as_ref());
    }
    for (k, (&p, transform)) in unknowns.parameters.iter().zip(&unknowns.transforms).enumerate() {
        let timed = M::is_timed(p);
        let mut sum = Lanes::default();
        for (node, (x, g)) in states[..equations.nodes()].iter().zip(dual.g.iter()).enumerate() {
            let mut by = None;
            if let Some(instants) = equations.instants.as_ref().filter(|_| timed) {
                let at = (equations.expressions.times_s[node], &instants[node]);
                by = Some(model.moment_by(&equations.fixed, at, theta, p));
            }
            sum = sum + M::push(&equations.fixed, (&equations.moments[node], by.as_ref()), x, g, p);
        }
        out[first + k] = match transform {
            Transform::Log => sum * theta[p],
            Transform::Linear { scale } => sum * Lanes::splat(*scale),
        };
    }
}

/// Sweeps through the dual equations that are good enough for a guess.
const GUESS_SWEEPS: usize = 2;

#[allow(clippy::inline_always)]
impl FitScratch {
    /// Works out the inverse covariance of the weighted samples, `S = 1 + H P H^T + G G^T / w^2`.
    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    fn guess<M: LaneModel, const N: usize>(
        &mut self,
        model: &M,
        equations: &Equations<'_, M, N>,
        samples: &Samples<'_>,
        freedom: &Freedom<'_>,
        (dual, drive): (&mut Dual<'_, M, N>, &mut AtNodes<M::State, N>),
        (at, states): (&Tangents<'_, M, N>, &AtNodes<M::State, N>),
        theta: &[Lanes],
    ) {
        let (m, n_u, nodes) = (samples.states.len(), self.gradient.len(), equations.nodes());
        let n = drive[0].as_ref().len();
        self.answers.clear();
        self.answers.resize(m * (n_u + nodes * n), Lanes::default());
        let mut answers = std::mem::take(&mut self.answers);
        for (j, answer) in answers.chunks_exact_mut(n_u + nodes * n).enumerate() {
            let observed = samples.states[j];
            let weight = Lanes::splat(samples.weights[j]);
            drive[..nodes].fill(M::State::default());
            dual.g[..nodes].fill(M::State::default());
            dual.pulled[..nodes].fill(M::State::default());
            for (drive, phi) in drive[..nodes].iter_mut().zip(samples.phi(j)) {
                drive.as_mut()[observed] = weight * *phi;
            }
            for _ in 0..GUESS_SWEEPS {
                equations.sweep_dual(at, drive, dual);
            }
            let (of_u, of_errors) = answer.split_at_mut(n_u);
            pull_back(model, equations, freedom, (dual, states), theta, of_u);
            if freedom.unknowns.initial_state {
                of_u[observed] = of_u[observed] + weight;
            }
            for (out, g) in of_errors.chunks_exact_mut(n).zip(dual.g.iter()) {
                for ((out, g), weight) in out.iter_mut().zip(g.as_ref()).zip(freedom.physics_weights) {
                    *out = *g * Lanes::splat(1.0 / weight);
                }
            }
        }
        for (j, row) in answers.chunks_exact(n_u + nodes * n).enumerate() {
            for i in 0..n_u {
                self.gradient[i] = Lanes::default() - freedom.covariance.shift(i, &row[..n_u]);
            }
            for (k, other) in answers.chunks_exact(n_u + nodes * n).enumerate() {
                let own = if j == k { Lanes::splat(1.0) } else { Lanes::default() };
                self.inverse[j * m + k] = own + dot(&self.gradient, &other[..n_u]) + dot(&row[n_u..], &other[n_u..]);
            }
        }
        self.answers = answers;
        self.invert(m);
        dual.g[..nodes].fill(M::State::default());
        dual.pulled[..nodes].fill(M::State::default());
    }

    /// Gauss-Jordan in place; the matrix is the identity plus a Gram matrix, so that pivots are 1 or more.
    #[inline(always)]
    fn invert(&mut self, m: usize) {
        for k in 0..m {
            let pivot = Lanes::splat(1.0) / self.inverse[k * m + k];
            self.inverse[k * m + k] = Lanes::splat(1.0);
            for entry in &mut self.inverse[k * m..(k + 1) * m] {
                *entry = *entry * pivot;
            }
            for i in 0..m {
                if i == k {
                    continue;
                }
                let factor = self.inverse[i * m + k];
                self.inverse[i * m + k] = Lanes::default();
                for j in 0..m {
                    self.inverse[i * m + j] = self.inverse[i * m + j] - factor * self.inverse[k * m + j];
                }
            }
        }
    }

    /// Where the members are without the samples.
    #[inline(always)]
    fn begin<M: LaneModel, const N: usize>(
        &mut self,
        samples: &Samples<'_>,
        freedom: &Freedom<'_>,
        path: &Path<'_, M, N>,
        theta: &[Lanes],
    ) {
        let m = samples.states.len();
        self.mean_theta.clear();
        self.mean_theta.extend_from_slice(theta);
        for rows in [&mut self.residuals, &mut self.off, &mut self.step, &mut self.along] {
            rows.clear();
            rows.resize(m, Lanes::default());
        }
        self.gradient.clear();
        self.gradient.resize(freedom.unknowns.len(path.start.as_ref().len()), Lanes::default());
        self.inverse.clear();
        self.inverse.resize(m * m, Lanes::default());
        for (entry, precision) in self.inverse.iter_mut().zip(freedom.precision.into_iter().flatten()) {
            *entry = Lanes::splat(*precision);
        }
        for (j, &observed) in samples.states.iter().enumerate() {
            let expected = path.state_at(observed, samples.phi(j));
            self.off[j] = Lanes::splat(samples.weights[j]) * (expected - samples.values[j]);
        }
    }

    /// `step = inverse off`, taken.
    #[inline(always)]
    fn advance(&mut self) {
        let m = self.off.len();
        for (j, row) in self.inverse.chunks_exact(m).enumerate() {
            let step = dot(row, &self.off);
            self.step[j] = step;
            self.residuals[j] = self.residuals[j] + step;
        }
    }

    /// Learns from what the last step did how residuals answer (Broyden), and takes the next.
    #[inline(always)]
    fn improve(&mut self) {
        let m = self.off.len();
        // left = inverse off: what the step has missed. along = step^T inverse.
        let mut gain = Lanes::default();
        self.along.fill(Lanes::default());
        for (j, row) in self.inverse.chunks_exact(m).enumerate() {
            let left = dot(row, &self.off);
            gain = gain + self.step[j] * (self.step[j] - left);
            for (along, entry) in self.along.iter_mut().zip(row) {
                *along = *along + self.step[j] * *entry;
            }
        }
        let square = dot(&self.step, &self.step);
        // Where the step went nowhere or the wrong way, nothing is learnt of it.
        let sensible = gain - square * Lanes::splat(0.1);
        let factor = sensible.choose(Lanes::splat(1.0) / gain, Lanes::default());
        // Each row of the inverse needs `left` of the old one.
        for row in self.inverse.chunks_exact_mut(m) {
            let share = dot(row, &self.off) * factor;
            for (entry, along) in row.iter_mut().zip(&self.along) {
                *entry = *entry + share * *along;
            }
        }
        self.advance();
    }

    /// Moves the state at the start and the parameters to where the dual path says, and the equations with them. Positive
    /// where no coordinate moved further than its limit.
    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    fn place<M: LaneModel, const N: usize>(
        &mut self,
        model: &M,
        equations: &mut Equations<'_, M, N>,
        samples: &Samples<'_>,
        freedom: &Freedom<'_>,
        (dual, states): (&Dual<'_, M, N>, &AtNodes<M::State, N>),
        (mean, path): (M::State, &mut Path<'_, M, N>),
        solutions: &mut Solutions,
    ) -> Lanes {
        let unknowns = freedom.unknowns;
        let n = if unknowns.initial_state { path.start.as_ref().len() } else { 0 };
        let mut gradient = std::mem::take(&mut self.gradient);
        pull_back(model, equations, freedom, (dual, states), &solutions.theta, &mut gradient);
        if unknowns.initial_state {
            for (j, &observed) in samples.states.iter().enumerate() {
                let pull = Lanes::splat(samples.weights[j]) * self.residuals[j];
                gradient[observed] = gradient[observed] + pull;
            }
        }
        self.gradient = gradient;
        for (i, start) in path.start.as_mut()[..n].iter_mut().enumerate() {
            *start = mean.as_ref()[i] + freedom.covariance.shift(i, &self.gradient);
        }
        let mut within = Lanes::splat(1.0);
        for (k, (&p, transform)) in unknowns.parameters.iter().zip(&unknowns.transforms).enumerate() {
            let shift = freedom.covariance.shift(n + k, &self.gradient);
            within = (Lanes::splat(unknowns.max_steps[k]) - shift.abs()).choose(within, Lanes::default());
            solutions.theta[p] = match transform {
                Transform::Log => self.mean_theta[p] * shift.exp(),
                Transform::Linear { scale } => self.mean_theta[p] + shift * Lanes::splat(*scale),
            };
        }
        let mut timed = false;
        for &p in &unknowns.parameters {
            model.change(&mut equations.fixed, &solutions.theta, p);
            timed |= M::is_timed(p);
        }
        if timed {
            equations.set_moments();
        }
        within
    }
}
