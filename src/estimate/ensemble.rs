//! The members, and one step of all of them over one window.

use std::collections::VecDeque;
use std::sync::OnceLock;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::adapt::fit::ChannelFit;
use super::adapt::pace::{Pace, diffusion};
use super::coupling::{coupled, coupled_unknowns, independent_unknowns};
pub use super::member::Member;
use super::random::exact_normals;
use super::rivals::Unscented;
use super::settings::{CouplingKind, EstimatorSettings, SettingsError};
use super::statistics::{Explainers, Summary, mean_and_sd, summarise};
use crate::model::{Cycle, Model, Transform};
use crate::xtfc::basis::Basis;
use crate::xtfc::features::{FeatureError, RandomFeatures};
use crate::xtfc::problem::{Solution, Unknowns};

/// A share of the prior variance that counts as learnt.
const INFORMED: f64 = 1e-4;

/// Longest time between two steps of what wanders \[s\].
const WANDER_S: f64 = 0.02;

/// Spacing of the checkpoints \[s\], and how many are kept.
const CHECKPOINT_S: f64 = 0.1;
const CHECKPOINTS: usize = 4;

/// Draws of a member's features before they are given up.
const MAX_REDRAWS: usize = 100;

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
    /// Members replaced by a draw from the others because theirs did not.
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
    /// Whether the window had data that said something about each estimated parameter.
    pub informed: Vec<bool>,
}

/// The ensemble as it was.
#[derive(Debug, Clone)]
struct Checkpoint {
    /// States and parameters.
    members: Vec<(Vec<f64>, Vec<f64>)>,
    fits: Vec<ChannelFit>,
    wander_due_s: f64,
    elapsed_s: f64,
}

/// The last moments, to be looked at again.
#[derive(Debug, Clone, Default)]
struct Memory {
    /// Each with the windows since the one before it.
    checkpoints: VecDeque<(Checkpoint, Vec<Vec<Observation>>)>,
    since: Vec<Vec<Observation>>,
}

impl Memory {
    fn note(&mut self, observations: &[Observation]) {
        self.since.push(observations.to_vec());
    }

    #[allow(clippy::cast_precision_loss)]
    fn is_due(&self, h: f64) -> bool {
        self.checkpoints.is_empty() || self.since.len() as f64 * h >= CHECKPOINT_S - 1e-9
    }

    fn keep(&mut self, checkpoint: Checkpoint) {
        self.checkpoints.push_back((checkpoint, std::mem::take(&mut self.since)));
        if self.checkpoints.len() > CHECKPOINTS {
            self.checkpoints.pop_front();
        }
    }

    /// The oldest checkpoint and all windows since; forgets everything.
    fn rewind(&mut self) -> Option<(Checkpoint, Vec<Vec<Observation>>)> {
        let (oldest, _) = self.checkpoints.pop_front()?;
        let mut windows: Vec<_> = self.checkpoints.drain(..).flat_map(|(_, windows)| windows).collect();
        windows.append(&mut self.since);
        Some((oldest, windows))
    }
}

/// Samples of a window against what the members expect.
#[derive(Debug, Clone, Default)]
struct Judged {
    /// Noise that each is taken to have \[mmHg\].
    sd: Vec<f64>,
    /// Observed minus expected, in units of the stated noise.
    residuals: Vec<f64>,
    /// The sd that members and noise give it \[mmHg\].
    expected_sd: Vec<f64>,
    /// Observed minus expected in that unit.
    innovations: Vec<f64>,
}

/// The ensemble of one bed.
#[derive(Debug, Clone)]
pub struct Ensemble<M> {
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
    second_look: bool,
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
            _ => coupled_unknowns(&estimated, &transforms),
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
        let adaptation = settings.adaptation;
        let mut ensemble = Self {
            paces: estimated.iter().zip(&centre).map(pace).collect(),
            fits: settings.channels.iter().map(|_| ChannelFit::new(adaptation.noise, adaptation.excess)).collect(),
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
            second_look: false,
        };
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

    /// How fast an estimated parameter is believed to move now, over what the settings say.
    pub fn pace(&self, k: usize) -> f64 {
        self.paces[k].now() / self.settings.beliefs[self.estimated[k]].drift
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
        self.elapsed_s += h;
        report
    }

    /// One window, and a second look at the last few if a parameter has begun to move in them.
    fn coupled_step(&mut self, observations: &[Observation], h: f64, parallel: &dyn Parallel) -> WindowReport {
        let mut report = self.first_look(observations, h, parallel);
        if self.settings.adaptation.pace {
            let mut moving = false;
            for pace in &mut self.paces {
                moving |= pace.advance(h);
            }
            self.memory.note(observations);
            if moving && let Some((checkpoint, windows)) = self.memory.rewind() {
                self.restore(&checkpoint);
                for window in &windows {
                    self.second_look = true;
                    report = WindowReport { informed: report.informed, ..self.first_look(window, h, parallel) };
                    self.elapsed_s += h;
                }
                self.elapsed_s -= h;
                self.second_look = false;
            }
            if self.memory.is_due(h) {
                self.memory.keep(self.checkpoint());
            }
        }
        report
    }

    fn checkpoint(&self) -> Checkpoint {
        Checkpoint {
            members: self.members.iter().map(|member| (member.x.clone(), member.theta.clone())).collect(),
            fits: self.fits.clone(),
            wander_due_s: self.wander_due_s,
            elapsed_s: self.elapsed_s,
        }
    }

    fn restore(&mut self, checkpoint: &Checkpoint) {
        for (member, (x, theta)) in self.members.iter_mut().zip(&checkpoint.members) {
            member.x.clone_from(x);
            member.theta.clone_from(theta);
        }
        self.fits.clone_from(&checkpoint.fits);
        self.wander_due_s = checkpoint.wander_due_s;
        self.elapsed_s = checkpoint.elapsed_s;
    }

    fn first_look(&mut self, observations: &[Observation], h: f64, parallel: &dyn Parallel) -> WindowReport {
        self.wander_due_s += h;
        // Between samples a little at a time is enough.
        if !observations.is_empty() || self.wander_due_s >= WANDER_S {
            self.wander();
        }
        if observations.is_empty() {
            return self.learn(observations, &[], &[], parallel);
        }
        parallel.for_each(&mut self.members, &|_, member| {
            member.forecast(&self.model, observations, &self.settings, 0.0);
        });
        let rows = self.rows();
        let judged = self.judge(observations);
        let noise = exact_normals(observations.len(), self.members.len(), &rows, &mut self.rng);
        coupled::covariance_root(&rows, self.members.len(), &mut self.root);
        let inflation = self.settings.drift.inflation.powf(h);
        if inflation > 1.0 {
            self.root.iter_mut().for_each(|r| *r *= inflation.sqrt());
        }
        let report = self.learn(observations, &judged.sd, &noise, parallel);
        // Clocks stand at the end of the window by now.
        let clock = self.model.cycle().zip(self.cycles());
        for (j, o) in observations.iter().enumerate() {
            let phase = clock.map(|(cycle, cycles)| {
                let rate = self.members[0].theta[cycle.rate] / 60.0;
                (cycles - (1.0 - o.s) * h * rate).rem_euclid(1.0)
            });
            let (residual, innovation) = (judged.residuals[j], judged.innovations[j]);
            self.fits[o.channel].hear(self.elapsed_s + o.s * h, phase, residual, judged.expected_sd[j], innovation);
        }
        WindowReport { innovations: judged.innovations, ..report }
    }

    /// One window of X-TFC for every member, with what it says of the parameters.
    fn learn(
        &mut self,
        observations: &[Observation],
        sd: &[f64],
        noise: &[f64],
        parallel: &dyn Parallel,
    ) -> WindowReport {
        let before = self.coordinates();
        let Self { model, settings, unknowns, members, root, .. } = self;
        let (model, settings, unknowns, root) = (&*model, &*settings, &*unknowns, &*root);
        let m = members.len();
        parallel.for_each(members, &|i, member| {
            member.perturb(observations, settings, sd, |k| noise[k * m + i]);
            member.solve(model, settings, unknowns, root);
        });
        let mut report = self.account(observations.len());
        if !observations.is_empty() {
            report.informed = self.compare(&before);
        }
        report
    }

    /// Whether the window said something about each estimated parameter; tells the paces what it said.
    pub(super) fn compare(&mut self, before: &[(f64, f64)]) -> Vec<bool> {
        let after = self.coordinates();
        let pairs = before.iter().zip(&after);
        // What is looked at again was heard before.
        let listening = if self.second_look { 0 } else { self.paces.len() };
        for (pace, ((mean, sd), (new_mean, new_sd))) in self.paces.iter_mut().take(listening).zip(pairs.clone()) {
            pace.hear((*mean, *new_mean), (sd * sd, new_sd * new_sd));
        }
        pairs.map(|((_, sd), (_, new))| new * new < (1.0 - INFORMED) * sd * sd).collect()
    }

    /// What the members expect of the samples, and how far off each sample is.
    #[allow(clippy::cast_precision_loss)]
    fn judge(&self, observations: &[Observation]) -> Judged {
        let mut judged = Judged::default();
        for (j, o) in observations.iter().enumerate() {
            let expected: Vec<f64> = self.members.iter().map(|member| member.expected[j]).collect();
            let (mean, spread) = mean_and_sd(&expected);
            let stated = self.settings.channels[o.channel].noise_sd_mmhg;
            let noise = stated * self.fits[o.channel].noise_factor();
            let expected_sd = (spread * spread + noise * noise).sqrt();
            let innovation = (o.value - mean) / expected_sd;
            // A heavy tail (Huber): what is far off may be an artefact and pulls no more than what is just credible.
            let far = innovation.abs() / self.settings.adaptation.outlier_sd;
            judged.sd.push(if far > 1.0 { noise * far.sqrt() } else { noise });
            judged.residuals.push((o.value - mean) / stated);
            judged.expected_sd.push(expected_sd);
            judged.innovations.push(innovation);
        }
        judged
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
            .map(|(s, sd)| (s, sd * own(s).map_or(largest, |c| excess[c]) * dt.sqrt()))
            .filter(|(_, sd)| *sd > 0.0)
            .collect();
        let adaptive = self.settings.adaptation.pace && self.settings.coupling == CouplingKind::Coupled;
        let parameters: Vec<(usize, f64, f64)> = self
            .estimated
            .iter()
            .enumerate()
            .map(|(k, &p)| {
                let belief = &self.settings.beliefs[p];
                let pace = if adaptive { self.paces[k].now() } else { belief.drift };
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
        report.innovations = self.innovations(observations);
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

    /// Gives a failed member the place of a living one, with the spread of the living around it.
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
        replaced
    }

    /// Mean and standard deviation over the members of an estimated coordinate.
    fn coordinate(&self, k: usize) -> (f64, f64) {
        let (p, transform) = (self.estimated[k], self.transforms[k]);
        let values: Vec<f64> = self.members.iter().map(|member| transform.forward(member.theta[p])).collect();
        mean_and_sd(&values)
    }

    /// States and derived quantities of all members at position `s` of the last window, `[n_quantities x n_members]`,
    /// states first.
    pub fn snapshot<'a>(&self, s: f64, scratch: &'a mut Snapshot) -> &'a mut [f64] {
        let (n, m) = (self.model.n_states(), self.members.len());
        let n_q = n + self.model.derived().len();
        scratch.values.resize(n_q * m, 0.0);
        scratch.row.resize(n_q, 0.0);
        let t = s * self.settings.window.length_s();
        for (i, member) in self.members.iter().enumerate() {
            let (x, derived) = scratch.row.split_at_mut(n);
            member.state_at(&self.model, s, &mut scratch.phi, x);
            self.model.derive(t, x, &member.solution.theta, derived);
            for (q, value) in scratch.row.iter().enumerate() {
                scratch.values[q * m + i] = *value;
            }
        }
        &mut scratch.values
    }

    /// All parameters of a member at the end of the last window.
    pub fn theta_of(&self, member: usize) -> &[f64] {
        &self.members[member].theta
    }

    /// Cycles counted at the end of the last window, by the mean clock of the members; None in models without cycles.
    #[allow(clippy::cast_precision_loss)]
    pub fn cycles(&self) -> Option<f64> {
        let phase = self.model.cycle()?.phase;
        Some(self.members.iter().map(|member| member.theta[phase]).sum::<f64>() / self.members.len() as f64)
    }

    /// One summary per quantity of [`Ensemble::snapshot`].
    pub fn summarise_at(&self, s: f64, scratch: &mut Snapshot) -> Vec<Summary> {
        let (n, m) = (self.model.n_states(), self.members.len());
        let values = self.snapshot(s, scratch);
        let explainers = Explainers::new(&values[(n - self.model.n_discrepancies()) * m..n * m], m);
        let noise = |q: usize| self.settings.aleatoric_sd_mmhg.get(q).copied().unwrap_or(0.0);
        let systematic = |q: usize| {
            let own = self.settings.channels.iter().position(|c| c.state == q);
            own.map_or(0.0, |channel| self.fits[channel].systematic_sd())
        };
        let summary = |(q, row): (usize, &mut [f64])| {
            let share = explainers.share_of(row);
            summarise(row, noise(q), share).widened(systematic(q))
        };
        values.chunks_exact_mut(m).enumerate().map(summary).collect()
    }

    /// A parameter of every member at the end of the last window.
    pub fn parameter_of_members(&self, parameter: usize) -> impl ExactSizeIterator<Item = f64> + '_ {
        self.members.iter().map(move |member| member.theta[parameter])
    }

    /// The estimated parameters at the end of the last window.
    pub fn summarise_parameters(&self) -> Vec<ParameterSummary> {
        let summary = |(k, &p): (usize, &usize)| {
            let mut values: Vec<f64> = self.members.iter().map(|member| member.theta[p]).collect();
            let share = self.coordinate(k).1 / self.initial_sd[k];
            ParameterSummary {
                parameter: p,
                summary: summarise(&mut values, 0.0, 0.0),
                identifiability: if share.is_finite() { (1.0 - share * share).clamp(0.0, 1.0) } else { 0.0 },
            }
        };
        self.estimated.iter().enumerate().map(summary).collect()
    }

    /// States and estimated parameters of every member at the end of the last window,
    /// `[n_members x (n_states + n_estimated)]`.
    pub fn members_at_end(&self) -> Vec<f64> {
        let row = |member: &Member| -> Vec<f64> {
            member.x.iter().copied().chain(self.estimated.iter().map(|&p| member.theta[p])).collect()
        };
        self.members.iter().flat_map(row).collect()
    }
}

/// An estimated parameter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ParameterSummary {
    /// Index into the model's parameters.
    pub parameter: usize,
    /// Its distribution.
    pub summary: Summary,
    /// Share of the starting variance (of its coordinate) that data have removed: 0 nothing, 1 all.
    pub identifiability: f64,
}

/// Scratch of [`Ensemble::summarise_at`].
#[derive(Debug, Clone, Default)]
pub struct Snapshot {
    values: Vec<f64>,
    row: Vec<f64>,
    phi: Vec<f64>,
}

fn check<M: Model>(model: &M, settings: &EstimatorSettings) -> Result<(), SettingsError> {
    let length = |what, found, expected| {
        if found == expected { Ok(()) } else { Err(SettingsError::Length { what, found, expected }) }
    };
    let n = model.n_states();
    length("theta", settings.theta.len(), model.parameters().len())?;
    length("beliefs", settings.beliefs.len(), model.parameters().len())?;
    length("initial_state", settings.initial_state.len(), n)?;
    length("initial_state_sd", settings.initial_state_sd.len(), n)?;
    length("weights.physics", settings.weights.physics.len(), n)?;
    length("aleatoric_sd", settings.aleatoric_sd_mmhg.len(), n)?;
    length("drift.states", settings.drift.states.len(), n)?;
    if settings.members < 2 {
        return Err(SettingsError::Members(settings.members));
    }
    for (what, value) in [
        ("the window length", settings.window.length_ns),
        ("the publishing period", settings.publish_period_ns),
        ("the forecast limit", settings.window.forecast_limit_ns),
    ] {
        if value <= 0 {
            return Err(SettingsError::NotPositive(what));
        }
    }
    if !settings.channels.iter().all(|c| c.noise_sd_mmhg > 0.0) {
        return Err(SettingsError::NotPositive("the noise of every channel"));
    }
    if !settings.weights.physics.iter().all(|w| *w > 0.0) {
        return Err(SettingsError::NotPositive("the weight of every equation"));
    }
    let observable = |state: usize| state < n - model.n_discrepancies() && !model.is_free(state);
    if let Some(channel) = settings.channels.iter().find(|c| !observable(c.state)) {
        return Err(SettingsError::State(channel.state));
    }
    let estimable = |&p: &usize| model.parameters().get(p).is_some_and(|info| info.estimable);
    match settings.estimate.iter().find(|p| !estimable(p)) {
        Some(&p) => Err(SettingsError::Parameter(p)),
        None => Ok(()),
    }
}

/// What is estimated: a rate cannot be learnt without the clock it drives, so the beat phase comes along with the
/// heart rate.
pub fn with_companions<M: Model>(model: &M, estimate: &[usize]) -> Vec<usize> {
    let mut all = estimate.to_vec();
    if let Some(Cycle { rate, phase }) = model.cycle()
        && all.contains(&rate)
        && !all.contains(&phase)
    {
        all.push(phase);
    }
    all
}

fn draw_bases<M: Model>(
    model: &M,
    settings: &EstimatorSettings,
    rng: &mut ChaCha8Rng,
    parallel: &dyn Parallel,
) -> Result<Vec<Option<Basis>>, SettingsError> {
    if !settings.coupling.is_xtfc() {
        return Ok(vec![None; settings.members]);
    }
    let length_s = settings.window.length_s();
    let free = (0..model.n_states()).any(|state| model.is_free(state));
    let draws = (0..settings.members).map(|_| RandomFeatures::draw(settings.features, rng));
    let features = draws.collect::<Result<Vec<_>, _>>()?;
    let basis = |features: &RandomFeatures| {
        let basis = Basis::new(features.clone(), length_s);
        if free { basis.and_then(Basis::with_free) } else { basis }
    };
    let slots: Vec<OnceLock<Basis>> = features.iter().map(|_| OnceLock::new()).collect();
    parallel.for_indices(features.len(), &|i| {
        if let Ok(basis) = basis(&features[i]) {
            // Every index comes once, so that the slot is empty.
            let _ = slots[i].set(basis);
        }
    });
    // Wide distributions now and then draw features that are all saturated: draw again, in the order of the members.
    let mut again = || {
        let mut draws = (0..MAX_REDRAWS).map(|_| basis(&RandomFeatures::draw(settings.features, rng)?));
        draws.find(Result::is_ok).unwrap_or(Err(FeatureError::Degenerate))
    };
    slots.into_iter().map(|slot| Ok(Some(slot.into_inner().map_or_else(&mut again, Ok)?))).collect()
}
