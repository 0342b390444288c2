//! The members, and one step of all of them over one window.

mod beats;
mod clock;
mod forecast;
mod look;
mod review;
mod setup;
mod summary;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use self::beats::Beats;
use self::clock::Edit;
use self::forecast::Forecaster;
use self::review::Memory;
pub use self::setup::with_companions;
use self::setup::{channel_fit, check, draw_bases};
pub use self::summary::{ParameterSummary, Snapshot};
use super::adapt::fit::ChannelFit;
use super::adapt::pace::{Pace, diffusion};
use super::coupling::{coupled_unknowns, independent_unknowns};
pub use super::member::Member;
use super::random::exact_normals;
use super::rivals::Unscented;
use super::settings::{CouplingKind, EstimatorSettings, SettingsError};
use super::smoother::Smoother;
use super::statistics::mean_and_sd;
use crate::model::{Model, Transform};
use crate::xtfc::problem::{Solution, Unknowns};

/// A share of the prior variance that counts as learnt.
const INFORMED: f64 = 1e-4;

/// Runs a job for every member; the core does not know how. The job sees one member at a time and members do not see
/// each other, so the order does not matter.
pub trait Parallel: Sync {
    /// Calls `job(index, member)` for every member.
    fn for_each(&self, members: &mut [Member], job: &(dyn Fn(usize, &mut Member) + Sync));

    /// Calls `job(index)` for every index below `count`.
    fn for_indices(&self, count: usize, job: &(dyn Fn(usize) + Sync));
}

/// One after the other.
#[derive(Debug, Clone, Copy, Default)]
pub struct Serial;

impl Parallel for Serial {
    fn for_each(&self, members: &mut [Member], job: &(dyn Fn(usize, &mut Member) + Sync)) {
        members.iter_mut().enumerate().for_each(|(i, member)| job(i, member));
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
    /// Parameters put back to their bounds.
    pub clamped: usize,
    /// Sum of the Gauss-Newton iterations over members.
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
    unknowns: Unknowns,
    pub(super) members: Vec<Member>,
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
    /// None where members are solved one by one.
    forecaster: Option<Forecaster<M::Lanes>>,
    beats: Option<Beats>,
}

impl<M: Model> Ensemble<M> {
    /// Draws all members; the clocks of the model are moved to `start_s` of event time.
    ///
    /// # Errors
    /// When the settings do not fit the model.
    pub fn new(
        model: M,
        settings: EstimatorSettings,
        start_s: f64,
        parallel: &dyn Parallel,
    ) -> Result<Self, SettingsError> {
        check(&model, &settings)?;
        let estimated = with_companions(&model, &settings.estimate);
        let transforms: Vec<_> = estimated.iter().map(|&p| model.parameters()[p].transform).collect();
        let unknowns = match settings.coupling {
            CouplingKind::Independent => independent_unknowns(&estimated),
            _ => coupled_unknowns(&model, &estimated, &transforms),
        };
        let mut rng = ChaCha8Rng::seed_from_u64(settings.seed);
        let mut theta = settings.theta.clone();
        model.advance(start_s, &mut theta);

        let (n, m) = (model.n_states(), settings.members);
        let bases = draw_bases(&model, &settings, &mut rng, parallel)?;
        let draws = exact_normals(n + estimated.len(), m, &[], &mut rng);
        let (states, guesses) = draws.split_at(n * m);
        let centre: Vec<f64> = estimated.iter().zip(&transforms).map(|(&p, t)| t.forward(theta[p])).collect();
        let members = bases.into_iter().enumerate().map(|(i, basis)| {
            let x = (0..n).map(|s| settings.initial_state[s] + settings.initial_state_sd[s] * states[s * m + i]);
            let mut theta = theta.clone();
            if settings.coupling.is_bayesian() {
                for (k, &p) in estimated.iter().enumerate() {
                    let belief = &settings.beliefs[p];
                    theta[p] = belief.value(transforms[k], centre[k] + belief.sd * guesses[k * m + i]);
                }
            }
            Member::new(basis, x.collect(), theta)
        });
        let members = members.collect();
        let pace = |(&p, centre): (&usize, &f64)| {
            let belief = &settings.beliefs[p];
            Pace::new(belief.drift, belief.reversion, *centre, belief.sd)
        };
        let mut ensemble = Self {
            paces: estimated.iter().zip(&centre).map(pace).collect(),
            fits: settings.channels.iter().map(|c| channel_fit(&settings, c)).collect(),
            members,
            model,
            settings,
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
            forecaster: None,
            beats: None,
        };
        if ensemble.settings.coupling.is_xtfc() {
            let instructions = ensemble.settings.instructions;
            let forecaster = |lanes| Forecaster::new(lanes, instructions, &ensemble.members);
            ensemble.forecaster = ensemble.model.lanes().map(forecaster);
        }
        ensemble.initial_sd = (0..ensemble.estimated.len()).map(|k| ensemble.coordinate(k).1).collect();
        if ensemble.settings.coupling == CouplingKind::Ukf {
            ensemble.unscented = Some(Unscented::new(&ensemble.rows(), m, &mut ensemble.rng));
        }
        Ok(ensemble)
    }

    /// The model.
    pub fn model(&self) -> &M {
        &self.model
    }

    /// What is estimated, as indices into the model's parameters; the beat phase comes along with the heart rate.
    pub fn estimated(&self) -> &[usize] {
        &self.estimated
    }

    /// Number of members.
    pub fn len(&self) -> usize {
        self.members.len()
    }

    /// Never true of a constructed ensemble.
    pub fn is_empty(&self) -> bool {
        self.members.is_empty()
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
            CouplingKind::Independent => {
                let sd: Vec<f64> =
                    observations.iter().map(|o| self.settings.channels[o.channel].noise_sd_mmhg).collect();
                let noise = exact_normals(observations.len(), self.members.len(), &[], &mut self.rng);
                self.learn(observations, &sd, &noise, parallel)
            }
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

    /// One window of X-TFC for every member, with what it says of the parameters.
    fn learn(
        &mut self,
        observations: &[Observation],
        sd: &[f64],
        noise: &[f64],
        parallel: &dyn Parallel,
    ) -> WindowReport {
        if observations.is_empty() {
            self.forecast(parallel);
            return self.account(0);
        }
        let before = self.coordinates();
        let Self { model, settings, unknowns, members, root, .. } = self;
        let (model, settings, unknowns, root) = (&*model, &*settings, &*unknowns, &*root);
        let m = members.len();
        parallel.for_each(members, &|i, member| {
            member.perturb(observations, settings, sd, |k| noise[k * m + i]);
            member.solve(model, settings, unknowns, root);
        });
        let mut report = self.account(observations.len());
        report.informed = self.compare(&before);
        report
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
        let m = self.members.len();
        let draws = exact_normals(states.len() + parameters.len(), m, &self.rows(), &mut self.rng);
        for (row, &(state, sd)) in draws.chunks_exact(m).zip(&states) {
            self.members.iter_mut().zip(row).for_each(|(member, e)| member.x[state] += sd * e);
        }
        for (row, &(k, keep, sd)) in draws.chunks_exact(m).skip(states.len()).zip(&parameters) {
            let (p, transform, centre) = (self.estimated[k], self.transforms[k], self.centre[k]);
            let belief = &self.settings.beliefs[p];
            for (member, e) in self.members.iter_mut().zip(row) {
                let u = centre + keep * (transform.forward(member.theta[p]) - centre) + sd * e;
                member.theta[p] = belief.value(transform, u);
            }
        }
    }

    /// States and parameter coordinates of the members now, `[n_u x n_members]`.
    pub(super) fn rows(&self) -> Vec<f64> {
        self.rows_of(&self.members)
    }

    pub(super) fn rows_of(&self, members: &[Member]) -> Vec<f64> {
        let n = self.model.n_states();
        let states = (0..n).flat_map(|s| members.iter().map(move |member| member.x[s]));
        let parameters = self.estimated.iter().zip(&self.transforms);
        states
            .chain(parameters.flat_map(|(&p, t)| members.iter().map(move |member| t.forward(member.theta[p]))))
            .collect()
    }

    /// Mean and standard deviation of every estimated coordinate.
    pub(super) fn coordinates(&self) -> Vec<(f64, f64)> {
        (0..self.estimated.len()).map(|k| self.coordinate(k)).collect()
    }

    /// Moves the members on, mends those without numbers, and sums up.
    fn account(&mut self, observations: usize) -> WindowReport {
        let mut report =
            WindowReport { solved: self.members.iter().filter(|m| m.solved).count(), ..Default::default() };
        let h = self.settings.window.length_s();
        let mut squares = 0.0;
        for member in &mut self.members {
            let h = if self.clock_waits { 0.0 } else { h };
            if !member.solved {
                self.model.advance(h, &mut member.theta);
                continue;
            }
            let account = member.solution.account;
            report.iterations += account.iterations;
            report.not_converged += usize::from(!account.converged);
            squares += account.physics_rms * account.physics_rms;
            member.x.clone_from(&member.solution.end);
            member.theta.clone_from(&member.solution.theta);
            for &p in &self.estimated {
                let (low, high) = self.settings.beliefs[p].bounds;
                let inside = member.theta[p].clamp(low, high);
                report.clamped += usize::from(inside.to_bits() != member.theta[p].to_bits());
                member.theta[p] = inside;
            }
            self.model.advance(h, &mut member.theta);
        }
        #[allow(clippy::cast_precision_loss)]
        if report.solved > 0 {
            report.physics_rms = (squares / report.solved as f64).sqrt();
        }
        // `coupled` has compared the samples with what it expected before it solved.
        if self.settings.coupling == CouplingKind::Independent {
            report.innovations = self.innovations(observations);
        }
        report.replaced = self.replace_failed();
        report
    }

    /// Normalised innovation per observation, from the members' own account of them.
    #[allow(clippy::cast_precision_loss)]
    fn innovations(&self, observations: usize) -> Vec<f64> {
        let told: Vec<&Solution> = self
            .members
            .iter()
            .filter(|member| member.solved && member.solution.innovations.len() == observations)
            .map(|member| &member.solution)
            .collect();
        let count = told.len() as f64;
        (0..observations)
            .map(|j| {
                let residual: f64 = told.iter().map(|s| s.innovations[j].0).sum::<f64>() / count;
                let variance: f64 = told.iter().map(|s| s.innovations[j].1).sum::<f64>() / count;
                residual / variance.sqrt()
            })
            .collect()
    }

    /// Gives a failed member the place of a living one, and its features.
    fn replace_failed(&mut self) -> usize {
        let living: Vec<usize> = (0..self.members.len()).filter(|&i| self.members[i].solved).collect();
        if living.len() == self.members.len() || living.is_empty() {
            return 0;
        }
        let mut replaced = 0;
        for i in 0..self.members.len() {
            if self.members[i].solved {
                continue;
            }
            // Deterministic and different from failure to failure: walk through the living.
            let donor = self.members[living[(i + replaced) % living.len()]].clone();
            let member = &mut self.members[i];
            member.x = donor.x;
            member.theta = donor.theta;
            member.solution.clone_from(&donor.solution);
            // Coefficients belong to the donor's basis.
            member.basis = donor.basis;
            member.solved = true;
            replaced += 1;
        }
        if let Some(forecaster) = &mut self.forecaster {
            forecaster.renew(&self.members);
        }
        replaced
    }

    /// Mean and standard deviation over the members of an estimated coordinate.
    fn coordinate(&self, k: usize) -> (f64, f64) {
        let (p, transform) = (self.estimated[k], self.transforms[k]);
        let values: Vec<f64> = self.members.iter().map(|member| transform.forward(member.theta[p])).collect();
        mean_and_sd(&values)
    }

    /// All parameters of a member at the end of the last window.
    pub fn theta_of(&self, member: usize) -> &[f64] {
        &self.members[member].theta
    }
}
