//! The members, and one step of all of them over one window.

mod beats;
mod clock;
mod look;
mod review;
mod setup;
mod size;
mod summary;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use self::beats::Beats;
use self::clock::Edit;
use self::review::Memory;
pub use self::setup::with_companions;
use self::setup::{channel_fit, check, draw_bases, varying};
pub use self::summary::{ParameterSummary, Snapshot};
use super::adapt::fit::ChannelFit;
use super::adapt::pace::{Pace, diffusion};
pub use super::batch::Batch;
use super::batch::{Lesson, SharedPrior, Tools, gather, read};
use super::coupling::{coupled_unknowns, independent_unknowns};
use super::random::exact_normals;
use super::rivals::Unscented;
use super::settings::{CouplingKind, EstimatorSettings, SettingsError};
use super::smoother::Smoother;
use super::statistics::mean_and_sd;
use crate::model::lanes::{Lanes, WIDTH};
use crate::model::{Model, Transform};
use crate::xtfc::problem::Unknowns;

/// A share of the prior variance that counts as learnt.
const INFORMED: f64 = 1e-4;

/// Runs a job for every batch of members; the core does not know how. The job sees one batch at a time and members do not
/// see each other, so the order does not matter.
pub trait Parallel: Sync {
    /// Calls `job(batch)` for every batch.
    fn for_each(&self, batches: &mut [Batch], job: &(dyn Fn(&mut Batch) + Sync));

    /// Calls `job(index)` for every index below `count`.
    fn for_indices(&self, count: usize, job: &(dyn Fn(usize) + Sync));
}

/// One after the other.
#[derive(Debug, Clone, Copy, Default)]
pub struct Serial;

impl Parallel for Serial {
    fn for_each(&self, batches: &mut [Batch], job: &(dyn Fn(&mut Batch) + Sync)) {
        batches.iter_mut().for_each(job);
    }

    fn for_indices(&self, count: usize, job: &(dyn Fn(usize) + Sync)) {
        (0..count).for_each(job);
    }
}

/// A sample within a window, not yet perturbed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Observation {
    /// Position in the window, in `[0, 1]`.
    pub s: f64,
    /// Index of the channel.
    pub channel: usize,
    /// \[mmHg\]
    pub value: f64,
}

/// How a window went, over all members.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct WindowReport {
    /// Members whose solve gave numbers.
    pub solved: usize,
    /// Members replaced by copies of others because theirs did not.
    pub replaced: usize,
    /// Members whose iteration did not converge (but gave numbers).
    pub not_converged: usize,
    /// Members that the kernels left to the general solver, or all where there are no kernels.
    pub one_by_one: usize,
    /// Parameters put back to their bounds.
    pub clamped: usize,
    /// Sum of the sweeps and Gauss-Newton iterations over members.
    pub iterations: usize,
    /// Root mean square over members of the physics residual \[mmHg/s\].
    pub physics_rms: f64,
    /// Normalised innovation of each observation: (observed - forecast) over the sd that members and noise give it.
    pub innovations: Vec<f64>,
    /// What the members expected of each observation, on average \[mmHg\].
    pub expected: Vec<f64>,
    /// Estimated parameters, by their position among them, that have begun to move.
    pub moving: Vec<usize>,
    /// Whether the window had data that said something about each estimated parameter.
    pub informed: Vec<bool>,
}

/// The ensemble of one bed.
#[derive(Debug, Clone)]
pub struct Ensemble<M: Model> {
    pub(super) model: M,
    pub(super) settings: EstimatorSettings,
    /// What is estimated, the phase along with the heart rate.
    pub(super) estimated: Vec<usize>,
    pub(super) transforms: Vec<Transform>,
    /// What is estimated, and what the model's clocks move.
    varying: Vec<usize>,
    unknowns: Unknowns,
    pub(super) batches: Vec<Batch>,
    /// Batches that take no part for the time being, in their order.
    resting: Vec<Batch>,
    /// Equations for eight members at once; None where members are solved one by one.
    lanes: Option<M::Lanes>,
    pub(super) rng: ChaCha8Rng,
    /// Shared prior root (`coupled`), `[n_u x n_u]`.
    root: Vec<f64>,
    /// Coordinate that each estimated parameter is pulled back to.
    pub(super) centre: Vec<f64>,
    /// Spread of each estimated coordinate at the start.
    initial_sd: Vec<f64>,
    /// How fast each estimated parameter moves.
    paces: Vec<Pace>,
    /// How each channel fits.
    fits: Vec<ChannelFit>,
    /// Event time since the start \[s\], and since parameters and states last wandered.
    elapsed_s: f64,
    wander_due_s: f64,
    pub(super) unscented: Option<Unscented>,
    memory: Memory,
    /// First window that is being solved again.
    second_look: Option<u64>,
    hears_again: bool,
    smoother: Smoother,
    /// Windows solved.
    window: u64,
    listening: bool,
    held: bool,
    clock_waits: bool,
    /// In order of time: those to come, and those of the last moments.
    edits: Vec<Edit>,
    applied: Vec<Edit>,
    beats: Option<Beats>,
}

impl<M: Model> Ensemble<M> {
    /// Draws all members, at event time 0; see [`Ensemble::starting_at`].
    ///
    /// # Errors
    /// When the settings do not fit the model.
    pub fn new(model: M, settings: EstimatorSettings, parallel: &dyn Parallel) -> Result<Self, SettingsError> {
        check(&model, &settings)?;
        let estimated = with_companions(&model, &settings.estimate);
        let transforms: Vec<_> = estimated.iter().map(|&p| model.parameters()[p].transform).collect();
        let unknowns = match settings.coupling {
            CouplingKind::Independent => independent_unknowns(&estimated),
            _ => coupled_unknowns(&model, &estimated, &transforms),
        };
        let varying = varying(&model, &estimated, &settings.theta);
        let mut rng = ChaCha8Rng::seed_from_u64(settings.seed);
        let theta = settings.theta.clone();
        let (n, m) = (model.n_states(), settings.members);
        let bases = draw_bases(&model, &settings, &mut rng, parallel)?;
        let draws = exact_normals(n + estimated.len(), m, &[], &mut rng, settings.instructions);
        let (states, guesses) = draws.split_at(n * m);
        let centre: Vec<f64> = estimated.iter().zip(&transforms).map(|(&p, t)| t.forward(theta[p])).collect();
        let state = |i: usize| {
            let x = (0..n).map(|s| settings.initial_state[s] + settings.initial_state_sd[s] * states[s * m + i]);
            x.collect::<Vec<f64>>()
        };
        let parameters = |i: usize| {
            let mut theta = theta.clone();
            if settings.coupling.is_bayesian() {
                for (k, &p) in estimated.iter().enumerate() {
                    let belief = &settings.beliefs[p];
                    theta[p] = belief.value(transforms[k], centre[k] + belief.sd * guesses[k * m + i]);
                }
            }
            theta
        };
        let mut bases = bases.into_iter();
        let batch = |first: usize| {
            let members = first..(first + WIDTH).min(m);
            let bases = bases.by_ref().take(members.len()).collect();
            let (xs, thetas): (Vec<_>, Vec<_>) = members.map(|i| (state(i), parameters(i))).unzip();
            Batch::new(first, bases, &xs, &thetas)
        };
        let batches = (0..m).step_by(WIDTH).map(batch).collect();
        let pace = |(&p, centre): (&usize, &f64)| {
            let belief = &settings.beliefs[p];
            Pace::new(belief.drift, belief.reversion, *centre, belief.sd)
        };
        let mut ensemble = Self {
            paces: estimated.iter().zip(&centre).map(pace).collect(),
            fits: settings.channels.iter().map(|c| channel_fit(&settings, c)).collect(),
            batches,
            resting: Vec::new(),
            lanes: model.lanes().filter(|_| settings.coupling.is_xtfc()),
            model,
            settings,
            varying,
            estimated,
            transforms,
            unknowns,
            rng,
            root: Vec::new(),
            centre,
            initial_sd: Vec::new(),
            elapsed_s: 0.0,
            wander_due_s: 0.0,
            unscented: None,
            memory: Memory::default(),
            second_look: None,
            hears_again: false,
            smoother: Smoother::default(),
            window: 0,
            listening: true,
            held: false,
            clock_waits: false,
            edits: Vec::new(),
            applied: Vec::new(),
            beats: None,
        };
        ensemble.initial_sd = (0..ensemble.estimated.len()).map(|k| ensemble.coordinate(k).1).collect();
        if ensemble.settings.coupling == CouplingKind::Ukf {
            ensemble.unscented =
                Some(Unscented::new(&ensemble.rows(), m, &mut ensemble.rng, ensemble.settings.instructions));
        }
        Ok(ensemble)
    }

    /// The same members, with the clocks of the model moved to `start_s` of event time. What they have in common is drawn
    /// once for all beds.
    #[must_use]
    pub fn starting_at(&self, start_s: f64) -> Self {
        let mut ensemble = self.clone();
        let mut theta = self.settings.theta.clone();
        self.model.advance(start_s, &mut theta);
        let moved = |p: usize| theta[p] - self.settings.theta[p];
        for batch in &mut ensemble.batches {
            // All alike: by its own rate, a member would be anywhere by then.
            self.varying.iter().for_each(|&p| batch.theta[p] = batch.theta[p] + Lanes::splat(moved(p)));
            batch.stand_still();
        }
        for (k, &p) in self.estimated.iter().enumerate().filter(|(_, p)| moved(**p).abs() > 0.0) {
            let belief = &self.settings.beliefs[p];
            ensemble.centre[k] = self.transforms[k].forward(theta[p]);
            ensemble.paces[k] = Pace::new(belief.drift, belief.reversion, ensemble.centre[k], belief.sd);
        }
        ensemble
    }

    /// The model.
    pub fn model(&self) -> &M {
        &self.model
    }

    /// What is estimated, as indices into the model's parameters; the beat phase comes along with the heart rate.
    pub fn estimated(&self) -> &[usize] {
        &self.estimated
    }

    /// Number of members that take part.
    pub fn len(&self) -> usize {
        self.batches.last().map_or(0, |batch| batch.first() + batch.len())
    }

    /// Never true of a constructed ensemble.
    pub fn is_empty(&self) -> bool {
        self.batches.is_empty()
    }

    /// How a channel fits.
    pub fn fit(&self, channel: usize) -> &ChannelFit {
        &self.fits[channel]
    }

    /// Solves one window for every member; observations are in order of time, then channel.
    pub fn step(&mut self, observations: &[Observation], parallel: &dyn Parallel) -> WindowReport {
        let h = self.settings.window.length_s();
        let report = match self.settings.coupling {
            CouplingKind::Coupled => self.coupled_step(observations, h, parallel),
            CouplingKind::Independent => self.independent_step(observations, parallel),
            CouplingKind::Enkf => self.enkf_step(observations, h, parallel),
            CouplingKind::Ukf => self.ukf_step(observations, h),
        };
        if self.settings.coupling != CouplingKind::Coupled {
            self.end_window(h);
        }
        report
    }

    /// What follows every window, whatever solved it.
    fn end_window(&mut self, h: f64) {
        self.elapsed_s += h;
        self.window += 1;
        self.follow();
    }

    /// Whether parameters stay as they are, but for the phase of the clock.
    pub fn hold_parameters(&mut self, hold: bool) {
        self.held = hold;
    }

    /// Whether samples are learnt from; otherwise they are only compared with what is expected.
    pub fn listen(&mut self, listening: bool) {
        self.listening = listening;
    }

    /// Whether the window said something about each estimated parameter; tells the paces what it said.
    pub(super) fn compare(&mut self, before: &[(f64, f64)]) -> Vec<bool> {
        let after = self.coordinates();
        let pairs = before.iter().zip(&after);
        // What is looked at again was heard before.
        let listening =
            if self.held || (self.second_look.is_some() && !self.hears_again) { 0 } else { self.paces.len() };
        for (pace, ((mean, sd), (new_mean, new_sd))) in self.paces.iter_mut().take(listening).zip(pairs.clone()) {
            pace.hear((*mean, *new_mean), (sd * sd, new_sd * new_sd));
        }
        pairs.map(|((_, sd), (_, new))| new * new < (1.0 - INFORMED) * sd * sd).collect()
    }

    /// Random walk of the parameters, with a pull to where they started, and process noise of the states, for the time
    /// since the last.
    fn wander(&mut self) {
        let dt = std::mem::take(&mut self.wander_due_s);
        self.wander_for(dt);
    }

    pub(super) fn wander_for(&mut self, dt: f64) {
        let drift = &self.settings.drift;
        let excess: Vec<f64> = self.fits.iter().map(ChannelFit::excess).collect();
        let largest = excess.iter().copied().fold(1.0, f64::max);
        let own = |state: usize| self.settings.channels.iter().position(|c| c.state == state);
        let states: Vec<(usize, f64)> = drift
            .states
            .iter()
            .enumerate()
            .map(|(s, sd)| {
                // A model that misses something in one place is off, if less so, in others as well: a sensor says how
                // far. What no sensor shows is not made worse on that account.
                let extra = own(s).map_or(*sd, |c| sd * excess[c].max(largest.sqrt()));
                (s, extra * dt.sqrt())
            })
            .filter(|(_, sd)| *sd > 0.0)
            .collect();
        let adaptive = self.settings.adaptation.pace && self.settings.coupling == CouplingKind::Coupled;
        let parameters: Vec<(usize, f64, f64)> = self
            .estimated
            .iter()
            .enumerate()
            .map(|(k, &p)| {
                let belief = &self.settings.beliefs[p];
                let learnt = adaptive && self.learns_pace(k);
                let pace = if learnt { self.paces[k].now() } else { belief.drift };
                (k, (-belief.reversion * dt).exp(), pace * diffusion(belief.reversion, dt).sqrt())
            })
            .filter(|(_, keep, sd)| *sd > 0.0 || *keep < 1.0)
            .collect();
        let m = self.len();
        let draws = self.draw(states.len() + parameters.len(), &self.rows());
        for (row, &(state, sd)) in draws.chunks_exact(m).zip(&states) {
            self.add_to_state(state, sd, row);
        }
        for (row, &(k, keep, sd)) in draws.chunks_exact(m).skip(states.len()).zip(&parameters) {
            let (p, transform, centre) = (self.estimated[k], self.transforms[k], self.centre[k]);
            let belief = &self.settings.beliefs[p];
            for batch in &mut self.batches {
                let draws = &row[batch.first()..][..batch.len()];
                let u = coordinates(batch.theta[p], transform);
                for (lane, e) in draws.iter().enumerate() {
                    let u = centre + keep * (u.0[lane] - centre) + sd * e;
                    batch.theta[p].0[lane] = belief.value(transform, u);
                }
                batch.fill_up();
            }
        }
    }

    /// Sets states and parameter coordinates of the batches from `first` on, `[n_u x their members]`.
    pub(super) fn place_from(&mut self, first: usize, rows: &[f64]) {
        let Self { batches, estimated, transforms, settings, model, .. } = self;
        let (n, batches) = (model.n_states(), &mut batches[first..]);
        let offset = batches.first().map_or(0, Batch::first);
        let members: usize = batches.iter().map(Batch::len).sum();
        for batch in batches {
            let (at, count) = (batch.first() - offset, batch.len());
            let own = |row: usize| &rows[row * members + at..][..count];
            for s in 0..n {
                batch.x[s].0[..count].copy_from_slice(own(s));
            }
            for (k, &p) in estimated.iter().enumerate() {
                for (value, u) in batch.theta[p].0.iter_mut().zip(own(n + k)) {
                    *value = settings.beliefs[p].value(transforms[k], *u);
                }
            }
            batch.fill_up();
        }
    }

    /// Standard normals over the members, see `random`.
    pub(super) fn draw(&mut self, rows: usize, against: &[f64]) -> Vec<f64> {
        let members = self.len();
        exact_normals(rows, members, against, &mut self.rng, self.settings.instructions)
    }

    /// Adds `sd` times the draws of the members to a state.
    fn add_to_state(&mut self, state: usize, sd: f64, draws: &[f64]) {
        for batch in &mut self.batches {
            let draws = &draws[batch.first()..][..batch.len()];
            batch.x[state].0.iter_mut().zip(draws).for_each(|(x, e)| *x += sd * e);
            batch.fill_up();
        }
    }

    /// States and parameter coordinates of the members now, `[n_u x n_members]`.
    pub(super) fn rows(&self) -> Vec<f64> {
        self.rows_of(&self.batches)
    }

    pub(super) fn rows_of(&self, batches: &[Batch]) -> Vec<f64> {
        let mut rows = Vec::with_capacity((self.model.n_states() + self.estimated.len()) * batches.len() * WIDTH);
        for state in 0..self.model.n_states() {
            gather(batches, &mut rows, |batch| batch.x[state]);
        }
        for (&p, transform) in self.estimated.iter().zip(&self.transforms) {
            gather(batches, &mut rows, |batch| coordinates(batch.theta[p], *transform));
        }
        rows
    }

    /// Mean and standard deviation of every estimated coordinate.
    pub(super) fn coordinates(&self) -> Vec<(f64, f64)> {
        (0..self.estimated.len()).map(|k| self.coordinate(k)).collect()
    }

    /// One batch after the other or side by side.
    pub(super) fn each(&mut self, parallel: &dyn Parallel, job: impl Fn(&Tools<'_, M>, &mut Batch) + Sync) {
        let Self { model, lanes, settings, unknowns, estimated, varying, batches, .. } = self;
        let tools = Tools { model, lanes: lanes.as_ref(), settings, unknowns, estimated, varying };
        parallel.for_each(batches, &|batch| job(&tools, batch));
    }

    /// Every member through the window as if there were no samples, and what that says of them.
    fn look_forward(&mut self, observations: &[Observation], parallel: &dyn Parallel) {
        self.each(parallel, |tools, batch| {
            batch.forecast(tools);
            batch.expect(observations, tools.settings);
        });
    }

    /// A window that nothing is learnt from.
    fn forecast(&mut self, parallel: &dyn Parallel) -> WindowReport {
        let h = self.clock_step_s();
        self.each(parallel, |tools, batch| {
            batch.forecast(tools);
            batch.move_on(tools, h);
        });
        self.account()
    }

    /// To the end of a window that was looked through already.
    fn go_on(&mut self, parallel: &dyn Parallel) -> WindowReport {
        let h = self.clock_step_s();
        self.each(parallel, |tools, batch| batch.move_on(tools, h));
        self.account()
    }

    /// Learns from the samples, after a look forward; `before` are the coordinates of what is estimated.
    fn learn(
        &mut self,
        observations: &[Observation],
        (sd, noise): (&[f64], &[f64]),
        (shared, before): (Option<SharedPrior<'_>>, &[(f64, f64)]),
        parallel: &dyn Parallel,
    ) -> WindowReport {
        let h = self.clock_step_s();
        let lesson = Lesson { observations, sd, noise, members: self.len(), shared };
        self.each(parallel, |tools, batch| {
            batch.fit(tools, &lesson);
            batch.move_on(tools, h);
        });
        let mut report = self.account();
        report.informed = self.compare(before);
        report
    }

    /// What clocks move on by in a window.
    fn clock_step_s(&self) -> f64 {
        if self.clock_waits { 0.0 } else { self.settings.window.length_s() }
    }

    /// Mends the members without numbers, and sums up.
    fn account(&mut self) -> WindowReport {
        let mut report = WindowReport::default();
        let mut squares = 0.0;
        for batch in &self.batches {
            let tally = batch.tally;
            report.solved += batch.solved[..batch.len()].iter().filter(|solved| **solved).count();
            report.iterations += tally.iterations;
            report.not_converged += tally.not_converged;
            report.clamped += tally.clamped;
            report.one_by_one += tally.one_by_one;
            squares += tally.squares;
        }
        #[allow(clippy::cast_precision_loss)]
        if report.solved > 0 {
            report.physics_rms = (squares / report.solved as f64).sqrt();
        }
        report.replaced = self.replace_failed(report.solved);
        report
    }

    /// Gives a failed member the place of a living one, and its features.
    fn replace_failed(&mut self, solved: usize) -> usize {
        if solved == self.len() || solved == 0 {
            return 0;
        }
        let is_living = |i: &usize| self.batches[i / WIDTH].solved[i % WIDTH];
        let (living, failed): (Vec<usize>, Vec<usize>) = (0..self.len()).partition(is_living);
        for (replaced, &i) in failed.iter().enumerate() {
            // Deterministic and different from failure to failure: walk through the living.
            let donor = living[(i + replaced) % living.len()];
            let copy = self.batches[donor / WIDTH].clone();
            self.batches[i / WIDTH].replace(i % WIDTH, (&copy, donor % WIDTH));
        }
        failed.len()
    }

    /// Mean and standard deviation over the members of an estimated coordinate.
    fn coordinate(&self, k: usize) -> (f64, f64) {
        let mut values = Vec::with_capacity(self.len());
        let (p, transform) = (self.estimated[k], self.transforms[k]);
        gather(&self.batches, &mut values, |batch| coordinates(batch.theta[p], transform));
        mean_and_sd(&values)
    }

    /// All parameters of a member at the end of the last window.
    pub fn theta_of(&self, member: usize) -> Vec<f64> {
        let mut theta = Vec::new();
        read(&self.batches[member / WIDTH].theta, member % WIDTH, &mut theta);
        theta
    }
}

/// The coordinates of parameters.
fn coordinates(theta: Lanes, transform: Transform) -> Lanes {
    match transform {
        Transform::Log => theta.ln(),
        Transform::Linear { scale } => theta / Lanes::splat(scale),
    }
}
