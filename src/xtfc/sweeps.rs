#![doc = include_str!("sweeps.md")]

use arrayvec::ArrayVec;

use super::basis::Basis;
use super::problem::Unknowns;
use crate::model::Transform;
use crate::model::lanes::{InstructionSet, LaneModel, Lanes, WIDTH};

/// Beyond this, a general solve is cheaper.
pub const MAX_SWEEPS: usize = 20;

/// The same, where there are samples.
pub const MAX_ROUNDS: usize = 14;

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

/// What the members of an ensemble have in common in a window: the equations, all parameters but their own, and, unless
/// these set the clock, what depends on the time only.
#[derive(Clone)]
pub struct Shared<M: LaneModel> {
    model: M,
    fixed: M::Fixed,
    /// Parameters of which members have values of their own.
    own: Vec<usize>,
    /// At these nodes \[s\], and at the end of the window; None where each has its own.
    times_s: Vec<f64>,
    moments: Option<(AtNodes<M::Moment>, M::Moment)>,
    length_s: f64,
}

impl<M: LaneModel> std::fmt::Debug for Shared<M> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Shared").field("model", &self.model).field("own", &self.own).finish_non_exhaustive()
    }
}

impl<M: LaneModel> Shared<M> {
    /// From the parameters of any eight members, `[n_parameters]`, of which they may differ in `own`; None where `model`
    /// has no equations for these, or does not know what their own parameters do.
    #[must_use]
    pub fn new(model: M, theta: &[Lanes], own: &[usize]) -> Option<Self> {
        if !own.iter().all(|&p| model.knows(p)) {
            return None;
        }
        let fixed = model.fixed(theta)?;
        Some(Self { model, fixed, own: own.to_vec(), times_s: Vec::new(), moments: None, length_s: 0.0 })
    }

    /// The equations.
    #[must_use]
    pub fn model(&self) -> &M {
        &self.model
    }

    /// Another window begins: parameters that all have alike, `moved`, are now those in `theta`.
    pub fn begin(&mut self, theta: &[Lanes], moved: &[usize], expressions: &Expressions, instructions: InstructionSet) {
        for &p in moved.iter().filter(|p| !self.own.contains(p)) {
            self.model.change(&mut self.fixed, theta, p);
        }
        if self.own.iter().any(|&p| M::is_timed(p)) {
            return;
        }
        self.times_s.clone_from(&expressions.times_s);
        self.length_s = expressions.length_s;
        self.moments = Some(instructions.run(Moments::<M> {
            fixed: &self.fixed,
            times_s: &self.times_s,
            length_s: self.length_s,
        }));
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

impl Solutions {
    fn make_room(&mut self, expressions: &Expressions) {
        self.beta.resize(expressions.times_s.len() * self.start.len(), Lanes::default());
        self.end.resize(self.start.len(), Lanes::default());
    }
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

impl Progress {
    /// Nothing was done.
    pub const NONE: Self = Self { sweeps: 0, done: [false; WIDTH], physics_rms: Lanes([0.0; WIDTH]) };
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

    /// One of them.
    #[inline(always)]
    fn only(&self, sample: usize) -> Self {
        let one = sample..sample + 1;
        Self {
            states: &self.states[one.clone()],
            weights: &self.weights[one.clone()],
            phi: self.phi(sample),
            values: &self.values[one],
        }
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
    /// About the inverse covariance of the weighted samples, `[n_samples x n_samples]`; if there is none, it is worked out
    /// member by member where samples have to do with each other. The better, the fewer rounds; the result does not depend
    /// on it.
    pub precision: Option<&'a [f64]>,
}

/// Scratch of [`fit`]; reuse it from window to window.
#[derive(Debug, Clone, Default)]
pub struct FitScratch {
    /// Weighted residuals that the dual equations are driven by, and how far they are from those found, `[n_samples]`.
    residuals: Vec<Lanes>,
    /// `weight * residual`
    pulls: Vec<Lanes>,
    off: Vec<Lanes>,
    step: Vec<Lanes>,
    along: Vec<Lanes>,
    /// About the inverse of how `off` answers to `residuals`, `[n_samples x n_samples]`.
    inverse: Vec<Lanes>,
    /// Derivative of the data by what is free, `[n_u]`.
    gradient: Vec<Lanes>,
    /// Derivatives of the weighted samples by what is free and by the errors of the equations.
    answers: Vec<Lanes>,
    /// Prior mean of what is free of the parameters, `[n_parameters_free]`.
    mean_theta: Vec<Lanes>,
}

/// A window without samples: sweeps until no equation is off by more than `tolerance_mmhg` over its length.
#[must_use]
pub fn forecast<M: LaneModel>(
    shared: &Shared<M>,
    expressions: &Expressions,
    tolerance_mmhg: f64,
    instructions: InstructionSet,
    solutions: &mut Solutions,
) -> Progress {
    solutions.make_room(expressions);
    let limit = tolerance_mmhg / expressions.length_s;
    instructions.run(Forecast { shared, expressions, limit, solutions })
}

/// A window with samples, from the solution without them (by [`forecast`]). What is free is among the members' own
/// parameters.
#[must_use]
pub fn fit<M: LaneModel>(
    shared: &Shared<M>,
    expressions: &Expressions,
    samples: &Samples<'_>,
    freedom: &Freedom<'_>,
    tolerance_mmhg: f64,
    instructions: InstructionSet,
    (scratch, solutions): (&mut FitScratch, &mut Solutions),
) -> Progress {
    let job = Fit { shared, expressions, samples, freedom, tolerance_mmhg, expected: None, scratch, solutions };
    // It has somewhere to begin.
    instructions.run(job).unwrap_or(Progress::NONE)
}

/// [`forecast`] and [`fit`] at once, which is less work than one after the other; `expected` is what the forecast says of
/// the samples, `[n_samples]`. None where that does not get done for all members: nothing has been changed then.
#[must_use]
pub fn forecast_and_fit<M: LaneModel>(
    shared: &Shared<M>,
    expressions: &Expressions,
    samples: &Samples<'_>,
    freedom: &Freedom<'_>,
    tolerance_mmhg: f64,
    instructions: InstructionSet,
    (scratch, solutions, expected): (&mut FitScratch, &mut Solutions, &mut Vec<Lanes>),
) -> Option<Progress> {
    solutions.make_room(expressions);
    let expected = Some(expected);
    instructions.run(Fit { shared, expressions, samples, freedom, tolerance_mmhg, expected, scratch, solutions })
}

/// Derived quantities of the states `x` at `t_s` after the start of the window, `[n_derived]`.
pub fn derive<M: LaneModel>(
    shared: &Shared<M>,
    t_s: f64,
    instructions: InstructionSet,
    (x, theta): (&[Lanes], &[Lanes]),
    out: &mut [Lanes],
) {
    instructions.run(Derive { shared, t_s, x, theta, out });
}

#[allow(clippy::inline_always)]
impl<M: LaneModel> Shared<M> {
    /// With what these members have of their own.
    #[inline(always)]
    fn fixed_of(&self, theta: &[Lanes]) -> M::Fixed {
        let mut fixed = self.fixed;
        for &p in &self.own {
            self.model.change(&mut fixed, theta, p);
        }
        fixed
    }

    #[inline(always)]
    fn moment_of(&self, fixed: &M::Fixed, t_s: f64) -> M::Moment {
        match &self.moments {
            Some((_, end)) if t_s.to_bits() == self.length_s.to_bits() => *end,
            _ => M::moment(fixed, &M::instant(fixed, t_s)),
        }
    }
}

/// Something at every node, written once it is known: clearing these first would take a tenth of a forecast. Lent, not
/// owned, by what is made of them: they are too large to be moved about.
type AtNodes<T> = ArrayVec<T, MAX_NODES>;

/// The equations of a model at the nodes of a window.
struct Equations<'a, M: LaneModel> {
    fixed: M::Fixed,
    moments: &'a mut AtNodes<M::Moment>,
    /// Kept where derivatives by parameters are needed.
    instants: Option<&'a mut AtNodes<M::Instant>>,
    expressions: &'a Expressions,
}

/// The path of the members: slopes and states at the nodes.
struct Path<'a, M: LaneModel> {
    start: M::State,
    slopes: &'a mut AtNodes<M::State>,
}

/// The derivatives where the equations were evaluated last, and relaxations that fit them well enough.
struct Tangents<'a, M: LaneModel> {
    tangents: &'a mut AtNodes<M::Tangent>,
    relaxations: &'a mut AtNodes<M::Relaxation>,
}

/// The dual path: `g = (I - df/dx phi)^-T b`, and `(df/dx)^T g`.
struct Dual<'a, M: LaneModel> {
    g: &'a mut AtNodes<M::State>,
    pulled: &'a mut AtNodes<M::State>,
    /// `b`: what the samples pull at, as it is felt at the nodes.
    drive: &'a mut AtNodes<M::State>,
    /// The slopes that the equations are to give: those of the path without the errors `e = -g / w^2` that this stands for.
    held: &'a mut AtNodes<M::State>,
}

#[allow(clippy::inline_always)]
impl<'a, M: LaneModel> Equations<'a, M> {
    #[inline(always)]
    fn new(
        shared: &Shared<M>,
        expressions: &'a Expressions,
        theta: &[Lanes],
        moments: &'a mut AtNodes<M::Moment>,
        instants: Option<&'a mut AtNodes<M::Instant>>,
    ) -> Self {
        let mut equations = Self { fixed: shared.fixed_of(theta), moments, instants, expressions };
        match &shared.moments {
            Some((moments, _)) if shared.times_s == expressions.times_s => equations.moments.clone_from(moments),
            _ => equations.set_moments(),
        }
        equations
    }

    #[inline(always)]
    fn nodes(&self) -> usize {
        self.expressions.times_s.len()
    }

    /// `phi` at a node, `[n_nodes]`.
    #[inline(always)]
    fn phi(&self, node: usize) -> &'a [Lanes] {
        &self.expressions.values[node * self.nodes()..(node + 1) * self.nodes()]
    }

    #[inline(always)]
    fn set_moments(&mut self) {
        self.moments.clear();
        if let Some(instants) = &mut self.instants {
            instants.clear();
        }
        for t_s in &self.expressions.times_s {
            let instant = M::instant(&self.fixed, *t_s);
            self.moments.push(M::moment(&self.fixed, &instant));
            if let Some(instants) = &mut self.instants {
                instants.push(instant);
            }
        }
    }

    /// Derivatives at the start of the window, for all nodes.
    #[inline(always)]
    fn look_ahead(&self, tangent: M::Tangent, at: &mut Tangents<'_, M>) {
        for (node, moment) in self.moments.iter().enumerate() {
            at.tangents.push(tangent);
            let mut relaxation = M::Relaxation::default();
            M::relaxation(&self.fixed, moment, &tangent, self.phi(node)[node], &mut relaxation);
            at.relaxations.push(relaxation);
        }
    }

    /// Solves each node in turn, with the newest slopes of the others; returns the largest residual met on the way, and
    /// leaves the states there.
    #[inline(always)]
    fn sweep(
        &self,
        path: &mut Path<'_, M>,
        at: &mut Tangents<'_, M>,
        held: Option<&AtNodes<M::State>>,
        mut states: Option<&mut AtNodes<M::State>>,
    ) -> Lanes {
        let mut largest = Lanes::splat(0.0);
        for node in 0..self.nodes() {
            let phi = self.phi(node);
            let x = path.at(phi);
            let (mut residual, tangent) = M::linearise(&self.fixed, &self.moments[node], &x);
            let against = held.map_or(&path.slopes[node], |held| &held[node]);
            for (r, k) in residual.as_mut().iter_mut().zip(against.as_ref()) {
                *r = *r - *k;
            }
            for r in residual.as_ref() {
                largest = r.abs().larger(largest);
            }
            // The relaxation of the last visit: one that is exact would have to be waited for.
            let step = M::relax(&at.relaxations[node], &residual, false);
            add::<M>(&mut path.slopes[node], &step);
            if !M::is_alike(&tangent, &at.tangents[node]) {
                M::relaxation(&self.fixed, &self.moments[node], &tangent, phi[node], &mut at.relaxations[node]);
                at.tangents[node] = tangent;
            }
            if let Some(states) = &mut states {
                states[node] = x;
            }
        }
        largest
    }

    /// Sweeps until nothing is left of the residuals but what is within `limit`; the `states` at the nodes by then.
    #[inline(always)]
    fn settle(
        &self,
        path: &mut Path<'_, M>,
        at: &mut Tangents<'_, M>,
        limit: f64,
        mut states: Option<&mut AtNodes<M::State>>,
    ) -> (Left, usize) {
        let (mut left, mut sweeps) = (Left::START, 0);
        while sweeps < MAX_SWEEPS {
            sweeps += 1;
            left.after(self.sweep(path, at, None, states.as_deref_mut()), Lanes::splat(limit));
            if left.of_limit.all_within(1.0) {
                break;
            }
        }
        (left, sweeps)
    }

    /// The same for the dual equations, which run backwards; the largest residual.
    #[inline(always)]
    fn sweep_dual(&self, at: &Tangents<'_, M>, dual: &mut Dual<'_, M>) -> Lanes {
        let mut largest = Lanes::splat(0.0);
        for node in (0..self.nodes()).rev() {
            let mut residual = dual.drive[node];
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
impl<M: LaneModel> Dual<'_, M> {
    /// Where nothing pulls.
    #[inline(always)]
    fn rest(&mut self, nodes: usize) {
        for at_nodes in [&mut *self.g, &mut *self.pulled, &mut *self.drive, &mut *self.held] {
            rest::<M>(at_nodes, nodes);
        }
    }

    /// From the slopes of the path, and `-1 / w^2`.
    #[inline(always)]
    fn hold(&mut self, slopes: &AtNodes<M::State>, factors: &M::State) {
        for ((held, slopes), g) in self.held.iter_mut().zip(slopes).zip(self.g.iter()) {
            let errors = g.as_ref().iter().zip(factors.as_ref());
            for ((held, slope), (g, factor)) in held.as_mut().iter_mut().zip(slopes.as_ref()).zip(errors) {
                *held = *slope - *g * *factor;
            }
        }
    }

    /// Sum of the squares of the errors.
    #[inline(always)]
    fn squares(&self, factors: &M::State) -> Lanes {
        let mut squares = Lanes::default();
        for g in self.g.iter() {
            for (g, factor) in g.as_ref().iter().zip(factors.as_ref()) {
                let error = *g * *factor;
                squares = squares + error * error;
            }
        }
        squares
    }

    /// From what the samples pull at; the largest of it.
    #[inline(always)]
    fn drive_by(&mut self, samples: &Samples<'_>, pulls: &[Lanes]) -> Lanes {
        let mut size = Lanes::splat(0.0);
        for drive in self.drive.iter_mut() {
            *drive = M::State::default();
        }
        for (j, (observed, pull)) in samples.states.iter().zip(pulls).enumerate() {
            for (drive, phi) in self.drive.iter_mut().zip(samples.phi(j)) {
                let entry = &mut drive.as_mut()[*observed];
                *entry = *entry + *pull * *phi;
            }
        }
        for drive in &*self.drive {
            for entry in drive.as_ref() {
                size = entry.abs().larger(size);
            }
        }
        size
    }
}

#[allow(clippy::inline_always)]
impl<'a, M: LaneModel> Path<'a, M> {
    /// Slopes constant over the window; the derivative at its start.
    #[inline(always)]
    fn straight(
        equations: &Equations<'_, M>,
        start: &[Lanes],
        slopes: &'a mut AtNodes<M::State>,
    ) -> (Self, M::Tangent) {
        let start = state::<M>(start);
        let (slope, tangent) = M::linearise(&equations.fixed, &equations.moments[0], &start);
        for _ in 0..equations.nodes() {
            slopes.push(slope);
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
    fn write(&self, equations: &Equations<'_, M>, solutions: &mut Solutions) {
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
fn rest<M: LaneModel>(at_nodes: &mut AtNodes<M::State>, nodes: usize) {
    at_nodes.clear();
    for _ in 0..nodes {
        at_nodes.push(M::State::default());
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
    for (done, none) in done.iter_mut().zip(nothing_of(end).0) {
        *done &= !none.is_nan();
    }
}

#[allow(clippy::inline_always)]
#[inline(always)]
fn are_numbers(values: &[Lanes]) -> bool {
    nothing_of(values).all_within(0.0)
}

/// Zero, or no number where one of these is none or infinite.
#[allow(clippy::inline_always)]
#[inline(always)]
fn nothing_of(values: &[Lanes]) -> Lanes {
    let mut none = Lanes::splat(0.0);
    for x in values {
        none = none + *x * Lanes::splat(0.0);
    }
    none
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

struct Moments<'a, M: LaneModel> {
    fixed: &'a M::Fixed,
    times_s: &'a [f64],
    length_s: f64,
}

#[allow(clippy::inline_always)]
impl<M: LaneModel> pulp::NullaryFnOnce for Moments<'_, M> {
    type Output = (AtNodes<M::Moment>, M::Moment);

    #[inline(always)]
    fn call(self) -> Self::Output {
        let mut moments = AtNodes::new();
        for t_s in self.times_s {
            moments.push(M::moment(self.fixed, &M::instant(self.fixed, *t_s)));
        }
        (moments, M::moment(self.fixed, &M::instant(self.fixed, self.length_s)))
    }
}

struct Derive<'a, M: LaneModel> {
    shared: &'a Shared<M>,
    t_s: f64,
    x: &'a [Lanes],
    theta: &'a [Lanes],
    out: &'a mut [Lanes],
}

#[allow(clippy::inline_always)]
impl<M: LaneModel> pulp::NullaryFnOnce for Derive<'_, M> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let Self { shared, t_s, x, theta, out } = self;
        let fixed = shared.fixed_of(theta);
        let moment = shared.moment_of(&fixed, t_s);
        M::derive((&fixed, &moment), &state::<M>(x), theta, out);
    }
}

struct Forecast<'a, M: LaneModel> {
    shared: &'a Shared<M>,
    expressions: &'a Expressions,
    limit: f64,
    solutions: &'a mut Solutions,
}

#[allow(clippy::inline_always)]
impl<M: LaneModel> pulp::NullaryFnOnce for Forecast<'_, M> {
    type Output = Progress;

    #[inline(always)]
    fn call(self) -> Progress {
        let Self { shared, expressions, limit, solutions } = self;
        let (mut moments, mut slopes) = (AtNodes::new(), AtNodes::new());
        let equations = Equations::<M>::new(shared, expressions, &solutions.theta, &mut moments, None);
        let (mut path, tangent) = Path::straight(&equations, &solutions.start, &mut slopes);
        let (mut tangents, mut relaxations) = (AtNodes::new(), AtNodes::new());
        let mut at = Tangents::<M> { tangents: &mut tangents, relaxations: &mut relaxations };
        equations.look_ahead(tangent, &mut at);
        let (left, sweeps) = equations.settle(&mut path, &mut at, limit, None);
        path.write(&equations, solutions);
        let physics_rms = left.of_limit * Lanes::splat(limit);
        let mut done = left.of_limit.0.map(|share| share <= 1.0);
        refuse_what_is_no_number(&solutions.end, &mut done);
        Progress { sweeps, done, physics_rms }
    }
}

struct Fit<'a, M: LaneModel> {
    shared: &'a Shared<M>,
    expressions: &'a Expressions,
    samples: &'a Samples<'a>,
    freedom: &'a Freedom<'a>,
    tolerance_mmhg: f64,
    /// Begins with the forecast, if there is a place for what it says of the samples.
    expected: Option<&'a mut Vec<Lanes>>,
    scratch: &'a mut FitScratch,
    solutions: &'a mut Solutions,
}

#[allow(clippy::inline_always)]
impl<M: LaneModel> pulp::NullaryFnOnce for Fit<'_, M> {
    type Output = Option<Progress>;

    #[inline(always)]
    fn call(self) -> Option<Progress> {
        let Self { shared, expressions, samples, freedom, tolerance_mmhg, expected, scratch, solutions } = self;
        let (mut moments, mut instants) = (AtNodes::new(), AtNodes::new());
        let timed = freedom.unknowns.parameters.iter().any(|&p| M::is_timed(p));
        let kept = timed.then_some(&mut instants);
        let model = &shared.model;
        let mut equations = Equations::<M>::new(shared, expressions, &solutions.theta, &mut moments, kept);
        let nodes = equations.nodes();
        let limit = tolerance_mmhg / expressions.length_s;
        let mean = state::<M>(&solutions.start);
        let (mut slopes, mut states) = (AtNodes::new(), AtNodes::new());
        rest::<M>(&mut states, nodes);
        let (mut tangents, mut relaxations) = (AtNodes::new(), AtNodes::new());
        let mut at = Tangents::<M> { tangents: &mut tangents, relaxations: &mut relaxations };
        let mut path = if let Some(expected) = expected {
            let (mut path, tangent) = Path::straight(&equations, &solutions.start, &mut slopes);
            equations.look_ahead(tangent, &mut at);
            let (left, _) = equations.settle(&mut path, &mut at, limit, Some(&mut states));
            let end = path.at(&expressions.end);
            if !left.of_limit.all_within(1.0) || !are_numbers(end.as_ref()) {
                return None;
            }
            expected.clear();
            for (j, &observed) in samples.states.iter().enumerate() {
                expected.push(path.state_at(observed, samples.phi(j)));
            }
            path
        } else {
            for node in 0..nodes {
                let mut slope = M::State::default();
                for (slope, beta) in slope.as_mut().iter_mut().zip(solutions.beta.chunks_exact(nodes)) {
                    *slope = beta[node];
                }
                slopes.push(slope);
            }
            let mut path = Path::<M> { start: mean, slopes: &mut slopes };
            // Derivatives where the members are; the residual is that of the forecast.
            let (_, tangent) = M::linearise(&equations.fixed, &equations.moments[0], &path.start);
            equations.look_ahead(tangent, &mut at);
            equations.sweep(&mut path, &mut at, None, Some(&mut states));
            path
        };

        scratch.begin(samples, freedom, &path, &solutions.theta);
        let (mut g, mut pulled, mut drive, mut held) = (AtNodes::new(), AtNodes::new(), AtNodes::new(), AtNodes::new());
        let mut dual = Dual::<M> { g: &mut g, pulled: &mut pulled, drive: &mut drive, held: &mut held };
        dual.rest(nodes);
        scratch.advance();
        let mut progress = Progress::NONE;
        let (mut of_dual, mut most_of_dual) = (M::State::default(), 0.0_f64);
        for (factor, weight) in of_dual.as_mut().iter_mut().zip(freedom.physics_weights) {
            *factor = Lanes::splat(-1.0 / (weight * weight));
            most_of_dual = most_of_dual.max(1.0 / (weight * weight));
        }
        let limit = Lanes::splat(limit);
        let (mut left, mut dual_left) = (Left::START, Left::START);
        while progress.sweeps < MAX_ROUNDS {
            progress.sweeps += 1;
            // What the samples pull at, and how that feels at the nodes.
            for (pull, (weight, residual)) in
                scratch.pulls.iter_mut().zip(samples.weights.iter().zip(&scratch.residuals))
            {
                *pull = Lanes::splat(*weight) * *residual;
            }
            let size = dual.drive_by(samples, &scratch.pulls);
            let dual_residual = equations.sweep_dual(&at, &mut dual);

            // States at the start and parameters follow from that, and the path that belongs to them.
            let (within, moved) =
                scratch.place(model, &mut equations, samples, freedom, (&dual, &states), (mean, &mut path), solutions);
            // What is left of the dual path, relative to what drives it, is left of what it has moved. Where nothing pulls,
            // nothing is left.
            let moved = (size * Lanes::splat(most_of_dual * expressions.length_s)).larger(moved);
            let share = Lanes::splat(tolerance_mmhg) / moved.larger(Lanes::splat(tolerance_mmhg));
            dual_left.after(dual_residual, (size * share).larger(Lanes::splat(f64::MIN_POSITIVE)));
            dual.hold(path.slopes, &of_dual);
            let residual = equations.sweep(&mut path, &mut at, Some(&*dual.held), Some(&mut states));

            // What it makes of the samples.
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
            if progress.sweeps == 1 && freedom.precision.is_none() && !scratch.is_nearly_right() {
                scratch.guess(model, &equations, samples, freedom, (&mut dual, &at), &states, &solutions.theta);
                dual.rest(nodes);
                scratch.advance();
            } else {
                scratch.improve();
            }
        }
        #[allow(clippy::cast_precision_loss)]
        let count = (nodes * solutions.start.len()) as f64;
        progress.physics_rms = (dual.squares(&of_dual) / Lanes::splat(count)).sqrt();
        path.write(&equations, solutions);
        refuse_what_is_no_number(&solutions.end, &mut progress.done);
        Some(progress)
    }
}

/// `B^T g`: what the dual path says of the state at the start and the parameters, `[n_u]`.
#[allow(clippy::inline_always)]
#[inline(always)]
fn pull_back<M: LaneModel>(
    model: &M,
    equations: &Equations<'_, M>,
    freedom: &Freedom<'_>,
    (dual, states): (&Dual<'_, M>, &AtNodes<M::State>),
    theta: &[Lanes],
    out: &mut [Lanes],
) {
    let unknowns = freedom.unknowns;
    let mut first = 0;
    if unknowns.initial_state {
        let mut sum = M::State::default();
        for pulled in &*dual.pulled {
            add::<M>(&mut sum, pulled);
        }
        first = sum.as_ref().len();
        out[..first].copy_from_slice(sum.as_ref());
    }
    for (k, (&p, transform)) in unknowns.parameters.iter().zip(&unknowns.transforms).enumerate() {
        let timed = M::is_timed(p);
        let mut sum = Lanes::default();
        for (node, (x, g)) in states.iter().zip(dual.g.iter()).enumerate() {
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

/// Of one: what a change of a parameter does to pressures of a hundred mmHg, sooner or later.
const PER_CENT: f64 = 100.0;

/// What a first step may leave for samples to be taken as being on their own.
const NEARLY: f64 = 0.1;

/// Sweeps through the dual equations that are good enough for a guess.
const GUESS_SWEEPS: usize = 2;

impl FitScratch {
    /// Where the last fit left the whitened unknowns of a member, from the root of its prior covariance,
    /// `[n_u x n_xi]`, row-major: `xi = -root^T gradient`.
    pub fn xi(&self, lane: usize, root: &[f64], n_xi: usize, out: &mut Vec<f64>) {
        out.clear();
        out.resize(n_xi, 0.0);
        for (gradient, row) in self.gradient.iter().zip(root.chunks_exact(n_xi)) {
            out.iter_mut().zip(row).for_each(|(xi, root)| *xi -= root * gradient.0[lane]);
        }
    }
}

#[allow(clippy::inline_always)]
impl FitScratch {
    /// Works out the inverse covariance of the weighted samples, `S = 1 + H P H^T + G G^T / w^2`.
    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    fn guess<M: LaneModel>(
        &mut self,
        model: &M,
        equations: &Equations<'_, M>,
        samples: &Samples<'_>,
        freedom: &Freedom<'_>,
        (dual, at): (&mut Dual<'_, M>, &Tangents<'_, M>),
        states: &AtNodes<M::State>,
        theta: &[Lanes],
    ) {
        let (m, n_u, nodes) = (samples.states.len(), self.gradient.len(), equations.nodes());
        let n = states[0].as_ref().len();
        let mut answers = std::mem::take(&mut self.answers);
        for (j, answer) in answers.chunks_exact_mut(n_u + nodes * n).enumerate() {
            let observed = samples.states[j];
            let weight = Lanes::splat(samples.weights[j]);
            dual.rest(nodes);
            dual.drive_by(&samples.only(j), &[weight]);
            for _ in 0..GUESS_SWEEPS {
                equations.sweep_dual(at, dual);
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
    fn begin<M: LaneModel>(
        &mut self,
        samples: &Samples<'_>,
        freedom: &Freedom<'_>,
        path: &Path<'_, M>,
        theta: &[Lanes],
    ) {
        let m = samples.states.len();
        self.mean_theta.clear();
        self.mean_theta.extend(freedom.unknowns.parameters.iter().map(|&p| theta[p]));
        for rows in [&mut self.residuals, &mut self.pulls, &mut self.off, &mut self.step, &mut self.along] {
            rows.clear();
            rows.resize(m, Lanes::default());
        }
        self.gradient.clear();
        self.gradient.resize(freedom.unknowns.len(path.start.as_ref().len()), Lanes::default());
        self.inverse.clear();
        self.inverse.resize(m * m, Lanes::default());
        if freedom.precision.is_none() {
            // A place for a guess, whether or not one will be needed.
            let (n_u, n) = (self.gradient.len(), path.start.as_ref().len());
            self.answers.resize(m * (n_u + path.slopes.len() * n), Lanes::default());
        }
        match freedom.precision {
            Some(precision) => {
                for (entry, precision) in self.inverse.iter_mut().zip(precision) {
                    *entry = Lanes::splat(*precision);
                }
            }
            // Samples that are less certain than what is expected of them: nearly so.
            None => (0..m).for_each(|j| self.inverse[j * m + j] = Lanes::splat(1.0)),
        }
        for (j, &observed) in samples.states.iter().enumerate() {
            let expected = path.state_at(observed, samples.phi(j));
            self.off[j] = Lanes::splat(samples.weights[j]) * (expected - samples.values[j]);
        }
    }

    /// Whether the first step has left little of what it was to do away with. It was as long as that, if the samples were
    /// taken to be on their own.
    #[inline(always)]
    fn is_nearly_right(&self) -> bool {
        let (mut left, mut whole) = (Lanes::splat(0.0), Lanes::splat(0.0));
        for (off, step) in self.off.iter().zip(&self.step) {
            left = off.abs().larger(left);
            whole = step.abs().larger(whole);
        }
        (left - whole * Lanes::splat(NEARLY)).all_within(0.0)
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
    /// where no coordinate moved further than its limit; and how far the state has moved \[mmHg\], with a per cent of a
    /// parameter for one.
    #[allow(clippy::too_many_arguments)]
    #[inline(always)]
    fn place<M: LaneModel>(
        &mut self,
        model: &M,
        equations: &mut Equations<'_, M>,
        samples: &Samples<'_>,
        freedom: &Freedom<'_>,
        (dual, states): (&Dual<'_, M>, &AtNodes<M::State>),
        (mean, path): (M::State, &mut Path<'_, M>),
        solutions: &mut Solutions,
    ) -> (Lanes, Lanes) {
        let unknowns = freedom.unknowns;
        let n = if unknowns.initial_state { path.start.as_ref().len() } else { 0 };
        let mut gradient = std::mem::take(&mut self.gradient);
        pull_back(model, equations, freedom, (dual, states), &solutions.theta, &mut gradient);
        if unknowns.initial_state {
            for (&observed, pull) in samples.states.iter().zip(&self.pulls) {
                gradient[observed] = gradient[observed] + *pull;
            }
        }
        self.gradient = gradient;
        let (mut within, mut moved) = (Lanes::splat(1.0), Lanes::splat(0.0));
        for (i, start) in path.start.as_mut()[..n].iter_mut().enumerate() {
            let shift = freedom.covariance.shift(i, &self.gradient);
            *start = mean.as_ref()[i] + shift;
            moved = shift.abs().larger(moved);
        }
        for (k, (&p, transform)) in unknowns.parameters.iter().zip(&unknowns.transforms).enumerate() {
            let shift = freedom.covariance.shift(n + k, &self.gradient);
            within = (Lanes::splat(unknowns.max_steps[k]) - shift.abs()).choose(within, Lanes::default());
            moved = (shift.abs() * Lanes::splat(PER_CENT)).larger(moved);
            solutions.theta[p] = match transform {
                Transform::Log => self.mean_theta[k] * shift.exp(),
                Transform::Linear { scale } => self.mean_theta[k] + shift * Lanes::splat(*scale),
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
        (within, moved)
    }
}
