//! The members, and one step of all of them over one window.

mod beats;
mod clock;
mod look;
mod review;
mod rows;
mod setup;
mod size;
mod summary;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use self::beats::Beats;
use self::clock::Edit;
use self::look::Scratch;
use self::review::Memory;
pub use self::setup::with_companions;
use self::setup::{channel_fit, check, draw_bases, varying};
pub use self::summary::{ParameterSummary, Snapshot};
use super::adapt::fit::ChannelFit;
use super::adapt::pace::{Pace, diffusion};
pub use super::batch::Batch;
use super::batch::{Lesson, SharedPrior, read};
use super::coupling::{coupled_unknowns, independent_unknowns};
use super::random::Normals;
use super::rivals::Unscented;
use super::settings::{CouplingKind, EstimatorSettings, SettingsError};
use super::smoother::Smoother;
use crate::model::lanes::{Lanes, WIDTH};
use crate::model::{Model, Transform};
use crate::xtfc::problem::Unknowns;
use crate::xtfc::sweeps::Shared;

/// A share of the prior variance that counts as learnt.
const INFORMED: f64 = 1e-4;

/// Runs a job for every batch of members; the core does not know how. The job sees one batch at a time and members do not
/// see each other, so the order does not matter.
pub trait Parallel: Sync {
    /// Calls `job(batch)` for every batch.
    fn for_each(&self, batches: &mut [Batch], job: &(dyn Fn(&mut Batch) + Sync)) {
        self.for_each_beside(batches, job, &mut || {});
    }

    /// The same, and `beside` once.
    fn for_each_beside(
        &self,
        batches: &mut [Batch],
        job: &(dyn Fn(&mut Batch) + Sync),
        beside: &mut (dyn FnMut() + Send),
    );

    /// Calls `job(index)` for every index below `count`.
    fn for_indices(&self, count: usize, job: &(dyn Fn(usize) + Sync));

    /// Does both.
    fn both(&self, one: &mut (dyn FnMut() + Send), other: &mut (dyn FnMut() + Send));
}

/// One after the other.
#[derive(Debug, Clone, Copy, Default)]
pub struct Serial;

impl Parallel for Serial {
    fn for_each_beside(
        &self,
        batches: &mut [Batch],
        job: &(dyn Fn(&mut Batch) + Sync),
        beside: &mut (dyn FnMut() + Send),
    ) {
        batches.iter_mut().for_each(job);
        beside();
    }

    fn for_indices(&self, count: usize, job: &(dyn Fn(usize) + Sync)) {
        (0..count).for_each(job);
    }

    fn both(&self, one: &mut (dyn FnMut() + Send), other: &mut (dyn FnMut() + Send)) {
        one();
        other();
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
#[derive(Debug, Clone, Copy, PartialEq, Default)]
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
}

/// What a window said about samples and parameters.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Findings {
    /// Normalised innovation of each observation: (observed - forecast) over the sd that members and noise give it.
    pub innovations: Vec<f64>,
    /// What the members expected of each observation, on average \[mmHg\].
    pub expected: Vec<f64>,
    /// Estimated parameters, by their position among them, that have begun to move.
    pub moving: Vec<usize>,
    /// Whether the window had data that said something about each estimated parameter; empty without data.
    pub informed: Vec<bool>,
}

impl Findings {
    fn clear(&mut self) {
        self.innovations.clear();
        self.expected.clear();
        self.moving.clear();
        self.informed.clear();
    }
}

/// How a row of the members wanders: it is pulled to a centre, and spreads.
#[derive(Debug, Clone, Copy)]
struct Walk {
    row: usize,
    centre: f64,
    /// Share of the distance from the centre that is left.
    keep: f64,
    sd: f64,
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
    shared: Option<Shared<M::Lanes>>,
    pub(super) normals: Normals,
    pub(super) findings: Findings,
    scratch: Scratch,
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
    /// Whether a sample of the last window with samples was further off than noise explains.
    is_surprised: bool,
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
        let (mut normals, mut draws) = (Normals::new(rng, settings.instructions), Vec::new());
        normals.draw(n + estimated.len(), m, None, &mut draws);
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
        // Members differ in what is estimated only.
        let alike: Vec<Lanes> = theta.iter().map(|value| Lanes::splat(*value)).collect();
        let lanes = model.lanes().filter(|_| settings.coupling.is_xtfc());
        let shared = lanes.and_then(|lanes| Shared::new(lanes, &alike, &estimated));
        let mut ensemble = Self {
            paces: estimated.iter().zip(&centre).map(pace).collect(),
            fits: settings.channels.iter().map(|c| channel_fit(&settings, c)).collect(),
            batches,
            resting: Vec::new(),
            shared,
            model,
            settings,
            varying,
            estimated,
            transforms,
            unknowns,
            normals,
            findings: Findings::default(),
            scratch: Scratch::default(),
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
            is_surprised: false,
            held: false,
            clock_waits: false,
            edits: Vec::new(),
            applied: Vec::new(),
            beats: None,
        };
        ensemble.initial_sd = (0..ensemble.estimated.len()).map(|k| ensemble.coordinate(k).1).collect();
        if ensemble.settings.coupling == CouplingKind::Ukf {
            ensemble.unscented = Some(Unscented::new(&ensemble.cloud(), &mut ensemble.normals));
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

    /// What the last window said.
    pub fn findings(&self) -> &Findings {
        &self.findings
    }

    /// Solves one window for every member; observations are in order of time, then channel.
    pub fn step(&mut self, observations: &[Observation], parallel: &dyn Parallel) -> WindowReport {
        let h = self.settings.window.length_s();
        self.findings.clear();
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

    /// Finds out whether the window said something about each estimated parameter, whose coordinates were `before`; tells
    /// the paces what it said.
    pub(super) fn compare(&mut self, before: &[(f64, f64)]) {
        // What is looked at again was heard before.
        let listening = !(self.held || (self.second_look.is_some() && !self.hears_again));
        for (k, (mean, sd)) in before.iter().enumerate() {
            let (new_mean, new_sd) = self.coordinate(k);
            if listening {
                self.paces[k].hear((*mean, new_mean), (sd * sd, new_sd * new_sd));
            }
            self.findings.informed.push(new_sd * new_sd < (1.0 - INFORMED) * sd * sd);
        }
    }

    /// Random walk of the parameters, with a pull to where they started, and process noise of the states, for the time
    /// since the last.
    fn wander(&mut self) {
        let dt = std::mem::take(&mut self.wander_due_s);
        self.wander_for(dt);
    }

    pub(super) fn wander_for(&mut self, dt: f64) {
        let mut scratch = std::mem::take(&mut self.scratch);
        let Scratch { walks, rows, cloud, draws, .. } = &mut scratch;
        self.plan_walks(dt, walks);
        self.read_rows(rows);
        let m = self.len();
        cloud.set(rows, m, self.settings.instructions);
        self.normals.draw(walks.len(), m, Some(cloud), draws);
        for (walk, draws) in walks.iter().zip(draws.chunks_exact(m)) {
            let row = &mut rows[walk.row * m..][..m];
            for (value, e) in row.iter_mut().zip(draws) {
                *value = walk.centre + walk.keep * (*value - walk.centre) + walk.sd * e;
            }
            self.place_row(0, walk.row, row);
        }
        self.scratch = scratch;
    }

    /// What wanders, and how far in `dt`.
    fn plan_walks(&self, dt: f64, walks: &mut Vec<Walk>) {
        walks.clear();
        let largest = self.fits.iter().map(ChannelFit::excess).fold(1.0, f64::max);
        for (row, sd) in self.settings.drift.states.iter().enumerate() {
            // A model that misses something in one place is off, if less so, in others as well: a sensor says how
            // far. What no sensor shows is not made worse on that account.
            let own = self.settings.channels.iter().position(|c| c.state == row);
            let extra = own.map_or(1.0, |c| self.fits[c].excess().max(largest.sqrt()));
            walks.push(Walk { row, centre: 0.0, keep: 1.0, sd: sd * extra * dt.sqrt() });
        }
        let adaptive = self.settings.adaptation.pace && self.settings.coupling == CouplingKind::Coupled;
        for (k, &p) in self.estimated.iter().enumerate() {
            let belief = &self.settings.beliefs[p];
            let learnt = adaptive && self.learns_pace(k);
            let pace = if learnt { self.paces[k].now() } else { belief.drift };
            walks.push(Walk {
                row: self.model.n_states() + k,
                centre: self.centre[k],
                keep: (-belief.reversion * dt).exp(),
                sd: pace * diffusion(belief.reversion, dt).sqrt(),
            });
        }
        walks.retain(|walk| walk.sd > 0.0 || walk.keep < 1.0);
    }

    /// Every member through the window as if there were no samples, and what that says of them.
    fn look_forward(&mut self, observations: &[Observation], parallel: &dyn Parallel) {
        self.begin_window();
        self.each(parallel, |tools, batch| {
            batch.forecast(tools);
            batch.expect(observations, tools.settings);
        });
    }

    /// A window that nothing is learnt from.
    fn forecast(&mut self, parallel: &dyn Parallel) -> WindowReport {
        let h = self.clock_step_s();
        self.begin_window();
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
        self.each_and_draw_ahead(parallel, |tools, batch| {
            batch.fit(tools, &lesson);
            batch.move_on(tools, h);
        });
        let report = self.account();
        self.compare(before);
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

    /// All parameters of a member at the end of the last window.
    pub fn theta_of(&self, member: usize) -> Vec<f64> {
        let mut theta = Vec::new();
        read(&self.batches[member / WIDTH].theta, member % WIDTH, &mut theta);
        theta
    }
}
