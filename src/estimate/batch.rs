//! Eight members of the ensemble: where they are, how they went through the last window, and the work of one window on
//! them. Solved side by side where the model has equations for lanes, one by one by the general solver where not.

use super::beat::Curve;
use super::coupling::independent;
use super::ensemble::Observation;
use super::settings::EstimatorSettings;
use crate::model::Model;
use crate::model::lanes::{LaneModel, Lanes, WIDTH};
use crate::model::rk4::{MAX_STEP_S, Rk4};
use crate::xtfc::basis::Basis;
use crate::xtfc::collocation::{CollocationSolver, Guess};
use crate::xtfc::dense;
use crate::xtfc::problem::{Datum, Prior, Solution, Unknowns, WindowProblem};
use crate::xtfc::sweeps::{self, Covariance, Expressions, FitScratch, Freedom, Progress, Samples, Shared, Solutions};

/// Positions in the window whose expressions are remembered: sensors sample evenly, so that few of them come again and
/// again.
const POSITIONS: usize = 16;

/// Windows with more samples are left to the general solver, whose effort grows more slowly with their number.
const MAX_SAMPLES: usize = 32;

/// What all members have in common.
#[derive(Debug)]
pub(super) struct Tools<'a, M: Model> {
    pub model: &'a M,
    /// Equations for lanes; None where members are solved one by one.
    pub shared: Option<&'a Shared<M::Lanes>>,
    pub settings: &'a EstimatorSettings,
    pub unknowns: &'a Unknowns,
    /// Estimated parameters.
    pub estimated: &'a [usize],
    /// Parameters that are not the same for ever: what is estimated, and clocks.
    pub varying: &'a [usize],
    /// At the end of the window.
    pub look: Look,
}

/// Whether members look at where all their quantities are, and what their last look stands for \[s\] if that is not in
/// their curves yet.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Look {
    pub is_due: bool,
    pub last_s: Option<f64>,
}

/// The samples of a window, and what is believed before them.
#[derive(Debug, Clone, Copy)]
pub(super) struct Lesson<'a> {
    pub observations: &'a [Observation],
    /// Noise of each \[mmHg\].
    pub sd: &'a [f64],
    /// Its draws, `[n_observations x n_members]`.
    pub noise: &'a [f64],
    /// Number of members.
    pub members: usize,
    /// None where every member has a prior of its own (`independent`).
    pub shared: Option<SharedPrior<'a>>,
}

/// The prior of `coupled`.
#[derive(Debug, Clone, Copy)]
pub(super) struct SharedPrior<'a> {
    /// Root of the covariance, `[n_u x n_u]`.
    pub root: &'a [f64],
    /// `root root^T`
    pub covariance: &'a [f64],
    /// Inverse covariance of the samples over the members, in units of their noise, `[n_observations x n_observations]`.
    pub precision: &'a [f64],
}

/// How a window went.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Tally {
    pub iterations: usize,
    pub not_converged: usize,
    pub clamped: usize,
    /// Members left to the general solver.
    pub one_by_one: usize,
    /// Sum of squares of the physics residuals \[(mmHg/s)^2\].
    pub squares: f64,
}

/// The constrained (and free) expressions of all members at a position.
#[derive(Debug, Clone, Default)]
struct Position {
    s: u64,
    phi: Vec<Lanes>,
    psi: Vec<Lanes>,
}

/// A batch of members.
#[derive(Debug, Clone)]
pub struct Batch {
    first: usize,
    count: usize,
    /// Empty in filters that do not use X-TFC.
    bases: Vec<Basis>,
    /// Largest number of coefficients of a state.
    rank: usize,
    pub(super) expressions: Option<Expressions>,
    /// States at the end of the last window, `[n_states]`.
    pub(super) x: Vec<Lanes>,
    /// Parameters there, clocks moved on, `[n_parameters]`.
    pub(super) theta: Vec<Lanes>,
    /// States and what varies of the parameters, as they were before the last lesson taken at once.
    before: (Vec<Lanes>, Vec<Lanes>),
    /// The last window.
    pub(super) window: Solutions,
    /// What they expect of the samples of this window, `[n_observations]`.
    pub(super) expected: Vec<Lanes>,
    /// The beat under way.
    pub(super) curve: Curve,
    /// Whether the last solve gave numbers.
    pub(super) solved: [bool; WIDTH],
    pub(super) tally: Tally,
    positions: Vec<Position>,
    oldest_position: usize,
    states: Vec<usize>,
    weights: Vec<f64>,
    phi: Vec<Lanes>,
    values: Vec<Lanes>,
    variances: Vec<Lanes>,
    derived: Vec<Lanes>,
    scratch: FitScratch,
    one: One,
    /// Whether the general solver has places for all that it needs.
    has_room: bool,
}

/// A member on its own.
#[derive(Debug, Clone, Default)]
struct One {
    x: Vec<f64>,
    theta: Vec<f64>,
    data: Vec<Datum>,
    root: Vec<f64>,
    beta: Vec<f64>,
    xi: Vec<f64>,
    solver: CollocationSolver,
    solution: Solution,
    rk4: Rk4,
}

impl Batch {
    /// Members from `first` on, with a basis, a state and parameters each; no bases in filters without X-TFC.
    pub(super) fn new(first: usize, bases: Vec<Basis>, xs: &[Vec<f64>], thetas: &[Vec<f64>]) -> Self {
        let lanes = |rows: &[Vec<f64>], k: usize| Lanes(std::array::from_fn(|i| rows.get(i).unwrap_or(&rows[0])[k]));
        let x: Vec<Lanes> = (0..xs[0].len()).map(|s| lanes(xs, s)).collect();
        let theta: Vec<Lanes> = (0..thetas[0].len()).map(|p| lanes(thetas, p)).collect();
        let mut batch = Self {
            first,
            count: xs.len(),
            rank: 0,
            expressions: None,
            bases,
            window: Solutions { start: x.clone(), theta: theta.clone(), beta: Vec::new(), end: x.clone() },
            before: (Vec::new(), Vec::new()),
            x,
            theta,
            expected: Vec::new(),
            curve: Curve::default(),
            solved: [true; WIDTH],
            tally: Tally::default(),
            positions: Vec::new(),
            oldest_position: 0,
            states: Vec::new(),
            weights: Vec::new(),
            phi: Vec::new(),
            values: Vec::new(),
            variances: Vec::new(),
            derived: Vec::new(),
            scratch: FitScratch::default(),
            one: One::default(),
            has_room: false,
        };
        batch.renew();
        batch
    }

    /// After a member has been given other features.
    fn renew(&mut self) {
        self.rank = self.bases.iter().map(Basis::rank).max().unwrap_or(0);
        self.expressions = Expressions::new(&self.bases);
        self.window.beta.resize(self.x.len() * self.rank, Lanes::default());
        self.positions.clear();
        self.oldest_position = 0;
    }

    /// Number of members.
    #[must_use]
    pub fn len(&self) -> usize {
        self.count
    }

    /// Never true.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// Index of its first member in the ensemble.
    #[must_use]
    pub fn first(&self) -> usize {
        self.first
    }

    /// Solves the window as if there were no samples.
    pub(super) fn forecast<M: Model>(&mut self, tools: &Tools<'_, M>) {
        self.tally = Tally::default();
        self.begin(tools);
        let settings = tools.settings;
        let progress = tools.shared.zip(self.expressions.as_ref()).map(|(shared, expressions)| {
            let tolerance = settings.stopping.tolerance_mmhg;
            sweeps::forecast(shared, expressions, tolerance, settings.instructions, &mut self.window)
        });
        self.take(progress, |batch, lane| {
            batch.one.data.clear();
            batch.solve_one(tools, lane, None, false);
        });
    }

    fn begin<M: Model>(&mut self, tools: &Tools<'_, M>) {
        self.window.start.clone_from(&self.x);
        tools.varying.iter().for_each(|&p| self.window.theta[p] = self.theta[p]);
    }

    /// What a kernel has found; the members it has left out are solved by `one`.
    fn take(&mut self, progress: Option<Progress>, mut one: impl FnMut(&mut Self, usize)) {
        let progress = progress.unwrap_or(Progress::NONE);
        for lane in 0..self.count {
            if progress.done[lane] {
                self.solved[lane] = true;
                self.tally.iterations += progress.sweeps;
                self.tally.squares += progress.physics_rms.0[lane].powi(2);
            } else {
                self.tally.one_by_one += 1;
                one(self, lane);
            }
        }
    }

    /// What the window says before any sample is taken in, after [`Batch::forecast`].
    pub(super) fn expect(&mut self, observations: &[Observation], settings: &EstimatorSettings) {
        self.locate(observations, settings);
        self.expected.clear();
        for (&state, phi) in self.states.iter().zip(self.phi.chunks_exact(self.rank)) {
            let beta = &self.window.beta[state * self.rank..][..self.rank];
            let start = self.window.start[state];
            self.expected.push(phi.iter().zip(beta).fold(start, |x, (phi, beta)| x + *phi * *beta));
        }
    }

    /// Which states are observed, and where.
    fn locate(&mut self, observations: &[Observation], settings: &EstimatorSettings) {
        self.phi.clear();
        self.states.clear();
        for observation in observations {
            self.states.push(settings.channels[observation.channel].state);
            let at = self.position(observation.s);
            self.phi.extend_from_slice(&self.positions[at].phi);
        }
    }

    /// Learns from samples, after [`Batch::forecast`] and [`Batch::expect`].
    pub(super) fn fit<M: Model>(&mut self, tools: &Tools<'_, M>, lesson: &Lesson<'_>) {
        self.hear(tools, lesson);
        let progress = self.by_kernel(tools, lesson, false);
        self.conclude(tools, lesson, progress);
    }

    /// [`Batch::forecast`], [`Batch::expect`] and [`Batch::fit`] at once; [`Batch::take_back`] undoes it.
    pub(super) fn forecast_and_fit<M: Model>(&mut self, tools: &Tools<'_, M>, lesson: &Lesson<'_>) {
        let (x, theta) = &mut self.before;
        x.clone_from(&self.x);
        theta.clear();
        theta.extend(tools.varying.iter().map(|p| self.theta[*p]));
        self.begin(tools);
        self.locate(lesson.observations, tools.settings);
        self.hear(tools, lesson);
        self.make_room(tools, lesson);
        let progress = self.by_kernel(tools, lesson, true);
        if progress.is_some() {
            self.conclude(tools, lesson, progress);
        } else {
            self.forecast(tools);
            self.expect(lesson.observations, tools.settings);
            self.fit(tools, lesson);
        }
    }

    /// As it was before a lesson that was taken at once, but for what was looked at.
    pub(super) fn take_back(&mut self, varying: &[usize]) {
        let (x, theta) = &self.before;
        self.x.clone_from(x);
        varying.iter().zip(theta).for_each(|(p, value)| self.theta[*p] = *value);
    }

    /// The samples as every member hears them.
    fn hear<M: Model>(&mut self, tools: &Tools<'_, M>, lesson: &Lesson<'_>) {
        let settings = tools.settings;
        self.weights.clear();
        let weight = |sd: &f64| if settings.coupling.is_bayesian() { 1.0 / sd } else { settings.weights.data };
        self.weights.extend(lesson.sd.iter().map(weight));
        self.values.clear();
        for (k, (observation, sd)) in lesson.observations.iter().zip(lesson.sd).enumerate() {
            let noise = &lesson.noise[k * lesson.members + self.first..][..self.count];
            let value = |lane: usize| observation.value + sd * noise.get(lane).unwrap_or(&noise[0]);
            self.values.push(Lanes(std::array::from_fn(value)));
        }
        self.variances.clear();
        if lesson.shared.is_none() {
            for &p in &tools.unknowns.parameters {
                let root = |theta: f64| independent::prior_sd(theta, &tools.model.parameters()[p], settings);
                self.variances.push(self.theta[p].map(|theta| root(theta).powi(2)));
            }
        }
    }

    /// All members side by side, with or without the forecast; None where that cannot be done.
    fn by_kernel<M: Model>(&mut self, tools: &Tools<'_, M>, lesson: &Lesson<'_>, forecast: bool) -> Option<Progress> {
        let (shared, expressions) = tools.shared.zip(self.expressions.as_ref())?;
        if lesson.observations.len() > MAX_SAMPLES {
            return None;
        }
        let settings = tools.settings;
        let covariance =
            lesson.shared.map_or(Covariance::Own(&self.variances), |prior| Covariance::Shared(prior.covariance));
        let freedom = Freedom {
            unknowns: tools.unknowns,
            covariance,
            physics_weights: &settings.weights.physics,
            precision: lesson.shared.map(|prior| prior.precision),
        };
        let samples = Samples { states: &self.states, weights: &self.weights, phi: &self.phi, values: &self.values };
        let (tolerance, instructions) = (settings.stopping.tolerance_mmhg, settings.instructions);
        if forecast {
            let places = (&mut self.scratch, &mut self.window, &mut self.expected);
            sweeps::forecast_and_fit(shared, expressions, &samples, &freedom, tolerance, instructions, places)
        } else {
            let places = (&mut self.scratch, &mut self.window);
            Some(sweeps::fit(shared, expressions, &samples, &freedom, tolerance, instructions, places))
        }
    }

    /// Takes what a kernel has found, and solves the rest one by one.
    fn conclude<M: Model>(&mut self, tools: &Tools<'_, M>, lesson: &Lesson<'_>, progress: Option<Progress>) {
        // The account of the forecast is not that of the window.
        self.tally = Tally::default();
        let is_tried = progress.is_some();
        self.take(progress, |batch, lane| {
            batch.tell_one(lane, lesson);
            batch.solve_one(tools, lane, Some(lesson), is_tried);
        });
    }

    /// The samples as one member hears them.
    fn tell_one(&mut self, lane: usize, lesson: &Lesson<'_>) {
        let data = lesson.observations.iter().enumerate().map(|(k, o)| Datum {
            s: o.s,
            state: self.states[k],
            value: self.values[k].0[lane],
            weight: self.weights[k],
        });
        self.one.data.clear();
        self.one.data.extend(data);
    }

    /// Solves one member in vain, with the first lesson: there are places then for all that the general solver needs, and it
    /// does not have to ask for them whenever a member is first left to it.
    fn make_room<M: Model>(&mut self, tools: &Tools<'_, M>, lesson: &Lesson<'_>) {
        if !std::mem::replace(&mut self.has_room, true) {
            self.tell_one(0, lesson);
            self.solve_one(tools, 0, Some(lesson), false);
            self.begin(tools);
        }
    }

    /// One member by the general solver, from where the kernel gave up if it `is_tried`; a forecast without a lesson.
    fn solve_one<M: Model>(&mut self, tools: &Tools<'_, M>, lane: usize, lesson: Option<&Lesson<'_>>, is_tried: bool) {
        let nothing_free = Unknowns::default();
        let Some(basis) = self.bases.get(lane) else { return };
        let One { x, theta, data, root, beta, xi, solver, solution, .. } = &mut self.one;
        read(&self.x, lane, x);
        read(&self.theta, lane, theta);
        let (unknowns, prior) = match lesson {
            // Without samples the prior is its own minimiser: a forecast.
            None => (&nothing_free, Prior::NONE),
            Some(lesson) => {
                let root = lesson.shared.map_or_else(
                    || {
                        let infos = tools.model.parameters();
                        independent::prior_root(theta, infos, &tools.unknowns.parameters, tools.settings, root);
                        &root[..]
                    },
                    |prior| prior.root,
                );
                (tools.unknowns, Prior { root, n_xi: tools.unknowns.len(x.len()) })
            }
        };
        let problem = WindowProblem {
            model: tools.model,
            basis,
            start: x,
            theta,
            unknowns,
            prior,
            data,
            physics_weights: &tools.settings.weights.physics,
            stopping: tools.settings.stopping,
        };
        if basis.is_nodal() {
            let off = data.iter().zip(&self.expected).map(|(d, expected)| d.weight * (expected.0[lane] - d.value));
            let below = off.map(|off| off * off).sum();
            // There is a place for it from the first solve on, whether or not that one needed it.
            read(&self.window.beta, lane, beta);
            xi.resize(tools.unknowns.len(x.len()), 0.0);
            let guess = is_tried.then(|| {
                self.scratch.xi(lane, prior.root, prior.n_xi, xi);
                Guess { beta, xi, below }
            });
            solver.solve_from(&problem, guess, solution);
        } else {
            dense::solve(&problem, solution);
        }
        self.solved[lane] = solution.is_finite();
        if !self.solved[lane] {
            self.stay(lane);
            return;
        }
        self.tally.iterations += solution.account.iterations;
        self.tally.not_converged += usize::from(!solution.account.converged);
        self.tally.squares += solution.account.physics_rms.powi(2);
        write(&mut self.window.start, lane, &solution.start);
        write(&mut self.window.theta, lane, &solution.theta);
        write(&mut self.window.end, lane, &solution.end);
        let (rank, own) = (self.rank, basis.rank());
        for (state, beta) in solution.beta.chunks_exact(own).enumerate() {
            write(&mut self.window.beta[state * rank..][..own], lane, beta);
            self.window.beta[state * rank + own..(state + 1) * rank].iter_mut().for_each(|b| b.0[lane] = 0.0);
        }
    }

    /// Takes the state and parameters at the start for the whole window, so that nothing without a number is read
    /// from it where no other member can stand in.
    fn stay(&mut self, lane: usize) {
        self.window.beta.iter_mut().for_each(|beta| beta.0[lane] = 0.0);
        copy(&self.x, lane, &mut self.window.start, lane);
        copy(&self.x, lane, &mut self.window.end, lane);
        copy(&self.theta, lane, &mut self.window.theta, lane);
    }

    /// Goes to the end of the window; clocks move on by `h`.
    pub(super) fn move_on<M: Model>(&mut self, tools: &Tools<'_, M>, h: f64) {
        self.x.clone_from(&self.window.end);
        tools.varying.iter().for_each(|&p| self.theta[p] = self.window.theta[p]);
        for &p in tools.estimated {
            let (low, high) = tools.settings.beliefs[p].bounds;
            for value in &mut self.theta[p].0[..self.count] {
                let inside = value.clamp(low, high);
                self.tally.clamped += usize::from(inside.to_bits() != value.to_bits());
                *value = inside;
            }
        }
        self.fill_up();
        advance(tools, h, &mut self.theta);
        if tools.look.is_due {
            self.look(tools);
        }
    }

    /// Looks at where all quantities are at the end of the window.
    pub(super) fn look<M: Model>(&mut self, tools: &Tools<'_, M>) {
        if let Some(dt_s) = tools.look.last_s {
            self.curve.take_in(dt_s, tools.settings.instructions);
        }
        let mut derived = std::mem::take(&mut self.derived);
        derived.resize(tools.model.derived().len(), Lanes::default());
        self.derive_at(tools, tools.settings.window.length_s(), &self.x, &mut derived);
        self.curve.look(&self.x, &derived);
        self.derived = derived;
    }

    /// As if the last window had been spent where the members are now.
    pub(super) fn stand_still(&mut self) {
        self.window.start.clone_from(&self.x);
        self.window.end.clone_from(&self.x);
        self.window.theta.clone_from(&self.theta);
        self.window.beta.fill(Lanes::default());
    }

    /// Lanes beyond the last member are like the first.
    pub(super) fn fill_up(&mut self) {
        if self.count == WIDTH {
            return;
        }
        for lanes in self.x.iter_mut().chain(&mut self.theta) {
            let first = lanes.0[0];
            lanes.0[self.count..].fill(first);
        }
    }

    /// Looks ahead with a Runge-Kutta scheme, to the end of a window of `h`; what is expected of the samples on the way.
    pub(super) fn look_ahead<M: Model>(&mut self, tools: &Tools<'_, M>, observations: &[Observation], h: f64) {
        self.begin(tools);
        self.expected.clear();
        self.expected.resize(observations.len(), Lanes::default());
        let One { x, theta, rk4, .. } = &mut self.one;
        for lane in 0..self.count {
            read(&self.x, lane, x);
            read(&self.theta, lane, theta);
            let mut t = 0.0;
            for (observation, expected) in observations.iter().zip(&mut self.expected) {
                rk4.advance(tools.model, (t, observation.s * h), MAX_STEP_S, theta, x);
                t = observation.s * h;
                expected.0[lane] = x[tools.settings.channels[observation.channel].state];
            }
            rk4.advance(tools.model, (t, h), MAX_STEP_S, theta, x);
            write(&mut self.window.end, lane, x);
        }
        self.x.clone_from(&self.window.end);
        self.fill_up();
        advance(tools, h, &mut self.theta);
    }

    /// The end of a window of `h` is where the members are now; the parameters at its start follow from that.
    pub(super) fn start_from_end<M: Model>(&mut self, tools: &Tools<'_, M>, h: f64) {
        self.window.end.clone_from(&self.x);
        self.window.theta.clone_from(&self.theta);
        advance(tools, -h, &mut self.window.theta);
    }

    /// Where `s` is among the positions, remembered from now on.
    fn position(&mut self, s: f64) -> usize {
        if let Some(known) = self.positions.iter().position(|position| position.s == s.to_bits()) {
            return known;
        }
        let at = if self.positions.len() < POSITIONS {
            self.positions.push(Position::default());
            self.positions.len() - 1
        } else {
            self.oldest_position = (self.oldest_position + 1) % POSITIONS;
            self.oldest_position
        };
        let mut position = std::mem::take(&mut self.positions[at]);
        self.express(s, &mut position);
        self.positions[at] = position;
        at
    }

    fn express(&self, s: f64, position: &mut Position) {
        position.s = s.to_bits();
        for rows in [&mut position.phi, &mut position.psi] {
            rows.clear();
            rows.resize(self.rank, Lanes::default());
        }
        let mut row = vec![0.0; self.rank];
        for lane in 0..WIDTH {
            let Some(basis) = self.bases.get(lane).or(self.bases.first()) else { return };
            let row = &mut row[..basis.rank()];
            basis.values_at(s, row);
            write(&mut position.phi[..row.len()], lane, row);
            basis.free_values_at(s, row);
            write(&mut position.psi[..row.len()], lane, row);
        }
    }

    /// States at position `s` of the window, `[n_states]`.
    pub(super) fn states_at<M: Model>(&self, model: &M, s: f64, out: &mut Vec<Lanes>) {
        out.clear();
        if s >= 1.0 {
            out.extend_from_slice(&self.x);
            return;
        }
        if self.bases.is_empty() {
            let ends = self.window.start.iter().zip(&self.window.end);
            out.extend(ends.map(|(a, b)| *a + Lanes::splat(s) * (*b - *a)));
            return;
        }
        let mut own = Position::default();
        let known = self.positions.iter().find(|position| position.s == s.to_bits());
        let position = known.unwrap_or_else(|| {
            self.express(s, &mut own);
            &own
        });
        for (state, beta) in self.window.beta.chunks_exact(self.rank).enumerate() {
            let sum = |from: Lanes, rows: &[Lanes]| rows.iter().zip(beta).fold(from, |x, (r, b)| x + *r * *b);
            out.push(if model.is_free(state) {
                sum(Lanes::default(), &position.psi)
            } else {
                sum(self.window.start[state], &position.phi)
            });
        }
    }

    /// Derived quantities of the states `x` at `t_s` after the start of the window, `[n_derived]`.
    pub(super) fn derive_at<M: Model>(&self, tools: &Tools<'_, M>, t_s: f64, x: &[Lanes], out: &mut [Lanes]) {
        if let Some(shared) = tools.shared {
            sweeps::derive(shared, t_s, tools.settings.instructions, (x, &self.window.theta), out);
            return;
        }
        let (mut one, mut theta, mut derived) = (Vec::new(), Vec::new(), vec![0.0; out.len()]);
        for lane in 0..WIDTH {
            read(x, lane, &mut one);
            read(&self.window.theta, lane, &mut theta);
            tools.model.derive(t_s, &one, &theta, &mut derived);
            write(out, lane, &derived);
        }
    }

    /// Parameters at `t_s` after the start of the window, `[n_parameters]`.
    pub(super) fn parameters_at<M: Model>(&self, tools: &Tools<'_, M>, t_s: f64) -> Vec<Lanes> {
        let mut theta = self.window.theta.clone();
        advance(tools, t_s, &mut theta);
        theta
    }

    /// Takes the place of another member, and its features.
    pub(super) fn replace(&mut self, lane: usize, (donor, of): (&Self, usize)) {
        copy(&donor.x, of, &mut self.x, lane);
        copy(&donor.theta, of, &mut self.theta, lane);
        copy(&donor.window.start, of, &mut self.window.start, lane);
        copy(&donor.window.theta, of, &mut self.window.theta, lane);
        copy(&donor.window.end, of, &mut self.window.end, lane);
        self.curve.replace(lane, (&donor.curve, of));
        if let (Some(own), Some(basis)) = (self.bases.get_mut(lane), donor.bases.get(of)) {
            // Coefficients belong to the donor's basis.
            own.clone_from(basis);
            self.renew();
            for state in 0..self.x.len() {
                let rank = donor.rank.min(self.rank);
                let from = &donor.window.beta[state * donor.rank..][..rank];
                let to = &mut self.window.beta[state * self.rank..][..rank];
                copy(from, of, to, lane);
            }
        }
        self.fill_up();
        self.solved[lane] = true;
    }
}

/// Moves clocks on.
fn advance<M: Model>(tools: &Tools<'_, M>, dt_s: f64, theta: &mut [Lanes]) {
    if let Some(shared) = tools.shared {
        shared.model().advance(dt_s, theta);
        return;
    }
    let mut one = Vec::new();
    for lane in 0..WIDTH {
        read(theta, lane, &mut one);
        tools.model.advance(dt_s, &mut one);
        write(theta, lane, &one);
    }
}

/// One member of a batch.
pub(super) fn read(lanes: &[Lanes], lane: usize, out: &mut Vec<f64>) {
    out.clear();
    out.extend(lanes.iter().map(|lanes| lanes.0[lane]));
}

/// One member of a batch.
pub(super) fn write(lanes: &mut [Lanes], lane: usize, values: &[f64]) {
    lanes.iter_mut().zip(values).for_each(|(lanes, value)| lanes.0[lane] = *value);
}

fn copy(from: &[Lanes], of: usize, to: &mut [Lanes], lane: usize) {
    to.iter_mut().zip(from).for_each(|(to, from)| to.0[lane] = from.0[of]);
}

/// What members expect of the samples of a window, `[n_observations x n_members]`, into `out`.
pub(super) fn read_expectations(batches: &[Batch], observations: usize, out: &mut Vec<f64>) {
    out.clear();
    for j in 0..observations {
        batches.iter().for_each(|batch| out.extend_from_slice(&batch.expected[j].0[..batch.count]));
    }
}
