//! The members, and one step of all of them over one window.

use std::collections::VecDeque;
use std::sync::OnceLock;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::adapt::fit::ChannelFit;
use super::adapt::pace::{Pace, diffusion};
use super::coupling::{coupled, coupled_unknowns, independent_unknowns};
pub use super::member::Member;
use super::member::expectations;
use super::random::exact_normals;
use super::rivals::Unscented;
use super::settings::{ChannelSettings, CouplingKind, EstimatorSettings, SettingsError};
use super::smoother::{Correction, Remembered, Smoother};
use super::statistics::{Explainers, Summary, mean_and_sd, summarise};
use super::time::EventTime;
use super::timing::{ClockEdit, TimingSource, WAITING_PHASE};
use crate::model::{Cycle, Model, Transform};
use crate::xtfc::basis::Basis;
use crate::xtfc::features::{FeatureError, RandomFeatures};
use crate::xtfc::problem::{Solution, Unknowns};

/// A share of the prior variance that counts as learnt.
const INFORMED: f64 = 1e-4;

/// A parameter is identifiable when data have halved the sd it started with.
const IDENTIFIABLE: f64 = 0.75;

/// Longest time between two steps of what wanders \[s\].
const WANDER_S: f64 = 0.02;

/// Spacing of the checkpoints \[s\], and how many are kept.
const CHECKPOINT_S: f64 = 0.1;
const CHECKPOINTS: usize = 8;

/// How far a second look goes back when a parameter has begun to move \[s\].
const LOOK_BACK_S: f64 = 0.4;

/// Longest time over which a clock that could not be corrected in time is set forth \[s\].
const MAX_CLOCK_S: f64 = 2.0;

/// Spread of heart rate (relative) and phase (beats) after an onset has set them.
const RATE_SD: f64 = 0.03;
const PHASE_SD: f64 = 0.01;

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
    /// What the members expected of each observation, on average \[mmHg\].
    pub expected: Vec<f64>,
    /// Estimated parameters, by their position among them, that have begun to move.
    pub moving: Vec<usize>,
    /// Whether the window had data that said something about each estimated parameter.
    pub informed: Vec<bool>,
}

/// The ensemble as it was.
#[derive(Debug, Clone)]
struct Checkpoint {
    /// States and parameters.
    members: Vec<(Vec<f64>, Vec<f64>)>,
    fits: Vec<ChannelFit>,
    paces: Vec<Pace>,
    wander_due_s: f64,
    elapsed_s: f64,
    window: u64,
    clock_waits: bool,
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

    /// The last checkpoint before `from_s`, or the oldest, and all windows since, which are forgotten.
    fn rewind(&mut self, from_s: f64) -> Option<(Checkpoint, Vec<Vec<Observation>>)> {
        let before = self.checkpoints.iter().rposition(|(checkpoint, _)| checkpoint.elapsed_s <= from_s).unwrap_or(0);
        let (checkpoint, _) = self.checkpoints.get(before)?.clone();
        let mut windows: Vec<_> = self.checkpoints.drain(before + 1..).flat_map(|(_, windows)| windows).collect();
        windows.append(&mut self.since);
        Some((checkpoint, windows))
    }
}

/// Samples of a window against what the members expect.
#[derive(Debug, Clone, Default)]
struct Judged {
    /// Mean of what the members expect \[mmHg\].
    expected: Vec<f64>,
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
    /// First window that is being solved again.
    second_look: Option<u64>,
    hears_again: bool,
    smoother: Smoother,
    /// Windows solved.
    window: u64,
    listening: bool,
    held: bool,
    clock_waits: bool,
    /// When on the clock of `elapsed_s`, and what; in order of time.
    edits: Vec<(f64, ClockEdit)>,
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
            self.elapsed_s += h;
            self.window += 1;
        }
        report
    }

    /// One window, and a second look at the last few if a parameter has begun to move in them.
    fn coupled_step(&mut self, observations: &[Observation], h: f64, parallel: &dyn Parallel) -> WindowReport {
        let mut report = self.look(observations, h, parallel);
        if self.settings.adaptation.pace && self.listening {
            let learnt: Vec<bool> = (0..self.estimated.len()).map(|k| self.learns_pace(k)).collect();
            for (k, pace) in self.paces.iter_mut().enumerate() {
                if pace.advance(h) && learnt[k] {
                    report.moving.push(k);
                }
            }
            if !report.moving.is_empty() {
                self.look_again(self.elapsed_s - LOOK_BACK_S, false, parallel);
            }
        }
        report
    }

    /// Whether the pace of an estimated parameter is learnt. Where a pull to a centre is believed in, pace and pull are a
    /// statement about how far it gets, to be left as it is. The phase of the clock moves by itself, which is no pace of
    /// its own, and its rate is heard of once in a beat only: what is larger than their drift is left to those who listen
    /// for beats.
    fn learns_pace(&self, k: usize) -> bool {
        let p = self.estimated[k];
        let is_clock = self.model.cycle().is_some_and(|cycle| cycle.phase == p || cycle.rate == p);
        !is_clock && self.settings.beliefs[p].reversion <= 0.0
    }

    /// One window, remembered.
    fn look(&mut self, observations: &[Observation], h: f64, parallel: &dyn Parallel) -> WindowReport {
        let report = self.first_look(observations, h, parallel);
        self.elapsed_s += h;
        self.window += 1;
        // Nothing else is ever looked at again.
        if self.settings.adaptation.pace || self.settings.live.timing != TimingSource::Clock {
            self.memory.note(observations);
            if self.memory.is_due(h) {
                self.memory.keep(self.checkpoint());
            }
        }
        report
    }

    /// Solves the windows since `from_s` (on the clock of `elapsed_s`) again, as far back as they are remembered.
    /// With `doubt`, what was learnt of the paces in them is forgotten and learnt anew.
    fn look_again(&mut self, from_s: f64, doubt: bool, parallel: &dyn Parallel) {
        // A parameter that seems to move may turn out to be a beat that came early, so the first impression is kept.
        let before = (!doubt).then(|| self.memory.clone());
        let Some((checkpoint, windows)) = self.memory.rewind(from_s) else { return };
        let h = self.settings.window.length_s();
        self.restore(&checkpoint);
        if doubt {
            self.paces.clone_from(&checkpoint.paces);
        }
        self.second_look = Some(self.window);
        self.hears_again = doubt;
        for window in &windows {
            self.look(window, h, parallel);
            if doubt && self.settings.adaptation.pace && self.listening {
                self.paces.iter_mut().for_each(|pace| _ = pace.advance(h));
            }
            let last = self.window - 1;
            let mut smoother = std::mem::take(&mut self.smoother);
            smoother.in_window(last).for_each(|moment| self.fill(moment));
            self.smoother = smoother;
        }
        if let Some(before) = before {
            self.memory = before;
        }
        self.second_look = None;
        self.hears_again = false;
    }

    /// Sets the clocks of the members; `now_s` is the event time at the end of the last window.
    pub fn edit_clocks(&mut self, edits: &[ClockEdit], now_s: f64, parallel: &dyn Parallel) {
        let ago = |edit: &ClockEdit| match *edit {
            ClockEdit::Beat { at_s, .. } => now_s - at_s,
            ClockEdit::Wait { from_s } => now_s - from_s,
            ClockEdit::GoOn => 0.0,
        };
        self.edits = edits.iter().map(|edit| (self.elapsed_s - ago(edit), *edit)).collect();
        if let Some((earliest, _)) = self.edits.first() {
            // Before the clock went wrong, parameters had no reason to move: their paces start again from there, too.
            self.look_again(*earliest, true, parallel);
        }
        // What lies in the present, or could not be remembered.
        let h = self.settings.window.length_s();
        self.apply_edits(f64::INFINITY, self.elapsed_s - h);
        if !self.listening {
            self.spread_anew();
        }
    }

    /// Gives the states the spread that they started with: they have run by a wrong clock.
    fn spread_anew(&mut self) {
        let (n, m) = (self.model.n_states(), self.members.len());
        let draws = exact_normals(n, m, &self.rows(), &mut self.rng);
        for (s, row) in draws.chunks_exact(m).enumerate() {
            let sd = self.settings.initial_state_sd[s];
            self.members.iter_mut().zip(row).for_each(|(member, e)| member.x[s] += sd * e);
        }
    }

    /// Applies what falls before `until_s`; clocks stand at `start_s`.
    fn apply_edits(&mut self, until_s: f64, start_s: f64) {
        while let Some((at_s, edit)) = self.edits.first().copied().filter(|(at_s, _)| *at_s < until_s) {
            self.edits.remove(0);
            match edit {
                ClockEdit::Beat { rate, .. } => self.begin_beat(at_s.max(start_s - MAX_CLOCK_S) - start_s, rate),
                ClockEdit::Wait { .. } => {
                    self.clock_waits = true;
                    self.shift_clocks(|beats| beats.round() - 1.0 + WAITING_PHASE);
                }
                ClockEdit::GoOn => self.clock_waits = false,
            }
        }
    }

    /// A beat begins `ahead_s` from where the clocks stand.
    fn begin_beat(&mut self, ahead_s: f64, rate: Option<f64>) {
        let Some(cycle) = self.model.cycle() else { return };
        self.clock_waits = false;
        let m = self.members.len();
        let known = !self.estimated.contains(&cycle.rate);
        let draws = exact_normals(2, m, &self.rows(), &mut self.rng);
        if let Some(rate) = rate {
            let (low, high) = self.settings.beliefs[cycle.rate].bounds;
            for (member, e) in self.members.iter_mut().zip(&draws[..m]) {
                let sd = if known { 0.0 } else { RATE_SD };
                member.theta[cycle.rate] = (rate * (sd * e).exp()).clamp(low, high);
            }
        }
        let per_s = self.rate_hz().unwrap_or(0.0);
        let beats = self.cycles().unwrap_or(0.0);
        let target = (beats + ahead_s * per_s).round() - ahead_s * per_s;
        for (member, e) in self.members.iter_mut().zip(&draws[m..]) {
            // A new rhythm leaves nothing of what the members thought of the old one.
            let own = if rate.is_some() { 0.0 } else { member.theta[cycle.phase] - beats };
            let phase = target + own + if known { 0.0 } else { PHASE_SD * e };
            self.model.set_clock(phase, &mut member.x, &mut member.theta);
        }
    }

    /// Moves all clocks alike, their mean to where `to` says.
    fn shift_clocks(&mut self, to: impl Fn(f64) -> f64) {
        let (Some(cycle), Some(beats)) = (self.model.cycle(), self.cycles()) else { return };
        let shift = to(beats) - beats;
        for member in &mut self.members {
            let phase = member.theta[cycle.phase] + shift;
            self.model.set_clock(phase, &mut member.x, &mut member.theta);
        }
    }

    /// Whether parameters stay as they are, but for the phase of the clock.
    pub fn hold_parameters(&mut self, hold: bool) {
        self.held = hold;
    }

    /// Whether samples are learnt from; otherwise they are only compared with what is expected.
    pub fn listen(&mut self, listening: bool) {
        self.listening = listening;
    }

    /// Mean rate of the cycles \[1/s\].
    #[allow(clippy::cast_precision_loss)]
    pub fn rate_hz(&self) -> Option<f64> {
        let rate = self.model.cycle()?.rate;
        Some(self.members.iter().map(|member| member.theta[rate]).sum::<f64>() / self.members.len() as f64 / 60.0)
    }

    /// Keeps the members at position `s` of the last window, to be corrected by what comes.
    pub fn remember(&mut self, time: EventTime, s: f64) {
        let mut moment = Remembered { time, window: self.window - 1, s, rows: Vec::new(), theta: Vec::new() };
        self.fill(&mut moment);
        self.smoother.remember(moment);
    }

    /// The members at a moment of the last window.
    fn fill(&self, moment: &mut Remembered) {
        let (n, m) = (self.model.n_states(), self.members.len());
        moment.rows.clear();
        moment.rows.resize((n + self.estimated.len()) * m, 0.0);
        let mut x = vec![0.0; n];
        let mut phi = Vec::new();
        let ahead_s = moment.s * self.settings.window.length_s();
        for (i, member) in self.members.iter().enumerate() {
            member.state_at(&self.model, moment.s, &mut phi, &mut x);
            x.iter().enumerate().for_each(|(s, x)| moment.rows[s * m + i] = *x);
            let mut theta = member.solution.theta.clone();
            self.model.advance(ahead_s, &mut theta);
            for (k, &p) in self.estimated.iter().enumerate() {
                moment.rows[(n + k) * m + i] = self.transforms[k].forward(theta[p]);
            }
            if i == 0 {
                moment.theta = theta;
            }
        }
    }

    /// The oldest remembered moment that is not after `until`: its time, a summary per quantity and per parameter.
    pub fn smoothed(&mut self, until: EventTime) -> Option<(EventTime, Vec<Summary>, Vec<ParameterSummary>)> {
        let moment = self.smoother.release(until)?;
        let (n, m) = (self.model.n_states(), self.members.len());
        let n_d = self.model.derived().len();
        let mut values = vec![0.0; (n + n_d) * m];
        let mut parameters = vec![0.0; self.estimated.len() * m];
        let (mut x, mut derived, mut theta) = (vec![0.0; n], vec![0.0; n_d], moment.theta.clone());
        for i in 0..m {
            x.iter_mut().enumerate().for_each(|(s, x)| *x = moment.rows[s * m + i]);
            for (k, &p) in self.estimated.iter().enumerate() {
                theta[p] = self.settings.beliefs[p].value(self.transforms[k], moment.rows[(n + k) * m + i]);
                parameters[k * m + i] = theta[p];
            }
            self.model.derive(0.0, &x, &theta, &mut derived);
            x.iter().chain(&derived).enumerate().for_each(|(q, value)| values[q * m + i] = *value);
        }
        let summaries = parameters.chunks_exact_mut(m).enumerate().map(|(k, row)| {
            let coordinates: Vec<f64> = row.iter().map(|v| self.transforms[k].forward(*v)).collect();
            self.parameter_summary(k, row, mean_and_sd(&coordinates).1)
        });
        let summaries = summaries.collect();
        Some((moment.time, self.summarise(&mut values), summaries))
    }

    fn checkpoint(&self) -> Checkpoint {
        Checkpoint {
            members: self.members.iter().map(|member| (member.x.clone(), member.theta.clone())).collect(),
            fits: self.fits.clone(),
            paces: self.paces.clone(),
            wander_due_s: self.wander_due_s,
            elapsed_s: self.elapsed_s,
            window: self.window,
            clock_waits: self.clock_waits,
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
        self.window = checkpoint.window;
        self.clock_waits = checkpoint.clock_waits;
    }

    fn first_look(&mut self, observations: &[Observation], h: f64, parallel: &dyn Parallel) -> WindowReport {
        self.apply_edits(self.elapsed_s + h, self.elapsed_s);
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
        let judged = self.judge(observations);
        if !self.listening {
            let report = self.learn(&[], &[], &[], parallel);
            return WindowReport { innovations: judged.innovations, expected: judged.expected, ..report };
        }
        let rows = self.rows();
        let noise = exact_normals(observations.len(), self.members.len(), &rows, &mut self.rng);
        coupled::covariance_root(&rows, self.members.len(), &mut self.root);
        let inflation = self.settings.drift.inflation.powf(h);
        if inflation > 1.0 {
            self.root.iter_mut().for_each(|r| *r *= inflation.sqrt());
        }
        if self.held {
            self.fix_parameters();
        }
        if self.settings.live.smoothing_lag_ns > 0 {
            self.correct_the_past(observations, &judged.sd, &noise);
        }
        let report = self.learn(observations, &judged.sd, &noise, parallel);
        // Clocks stand at the end of the window by now.
        let clock = self.model.cycle().zip(self.cycles());
        for (j, o) in observations.iter().enumerate().filter(|_| !self.held) {
            let phase = clock.map(|(cycle, cycles)| {
                let rate = self.members[0].theta[cycle.rate] / 60.0;
                (cycles - (1.0 - o.s) * h * rate).rem_euclid(1.0)
            });
            let (residual, innovation) = (judged.residuals[j], judged.innovations[j]);
            self.fits[o.channel].hear(self.elapsed_s + o.s * h, phase, residual, judged.expected_sd[j], innovation);
        }
        WindowReport { innovations: judged.innovations, expected: judged.expected, ..report }
    }

    /// Takes the parameters out of what a window can move, but for the phase of the clock.
    fn fix_parameters(&mut self) {
        let (n, n_u) = (self.model.n_states(), self.unknowns.len(self.model.n_states()));
        let phase = self.model.cycle().map(|cycle| cycle.phase);
        for (k, _) in self.estimated.iter().enumerate().filter(|(_, p)| Some(**p) != phase) {
            self.root[(n + k) * n_u..(n + k + 1) * n_u].fill(0.0);
        }
    }

    fn correct_the_past(&mut self, observations: &[Observation], sd: &[f64], noise: &[f64]) {
        let m = self.members.len();
        let expected = expectations(&self.members, sd.len());
        let off: Vec<f64> = expected
            .iter()
            .zip(noise)
            .enumerate()
            .map(|(k, (expected, e))| observations[k / m].value + sd[k / m] * e - expected)
            .collect();
        if let Some(correction) = Correction::new(&expected, &off, sd, m) {
            // What is looked at again has corrected the times before it already.
            self.smoother.correct(&correction, self.second_look.unwrap_or(0));
        }
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
        let listening =
            if self.held || (self.second_look.is_some() && !self.hears_again) { 0 } else { self.paces.len() };
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
            judged.expected.push(mean);
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
        self.summarise(self.snapshot(s, scratch))
    }

    /// One summary per row of `values` `[n_quantities x n_members]`, states first.
    fn summarise(&self, values: &mut [f64]) -> Vec<Summary> {
        let (n, m) = (self.model.n_states(), self.members.len());
        let explainers = Explainers::new(&values[(n - self.model.n_discrepancies()) * m..n * m], m);
        let noise = |q: usize| self.settings.aleatoric_sd_mmhg.get(q).copied().unwrap_or(0.0);
        let phase = self.cycles().map(|cycles| cycles.rem_euclid(1.0));
        let systematic = |q: usize| {
            let own = self.settings.channels.iter().position(|c| c.state == q);
            own.map_or(0.0, |channel| self.fits[channel].systematic_sd(phase))
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
            self.parameter_summary(k, &mut values, self.coordinate(k).1)
        };
        self.estimated.iter().enumerate().map(summary).collect()
    }

    fn parameter_summary(&self, k: usize, values: &mut [f64], coordinate_sd: f64) -> ParameterSummary {
        let share = coordinate_sd / self.initial_sd[k];
        ParameterSummary {
            parameter: self.estimated[k],
            summary: summarise(values, 0.0, 0.0),
            identifiability: if share.is_finite() { (1.0 - share * share).clamp(0.0, 1.0) } else { 0.0 },
        }
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

impl ParameterSummary {
    /// Whether the data say so much about it that its value is theirs rather than that of the settings.
    #[must_use]
    pub fn is_identifiable(&self) -> bool {
        self.identifiability >= IDENTIFIABLE
    }
}

/// Scratch of [`Ensemble::summarise_at`].
#[derive(Debug, Clone, Default)]
pub struct Snapshot {
    values: Vec<f64>,
    row: Vec<f64>,
    phi: Vec<f64>,
}

fn channel_fit(settings: &EstimatorSettings, channel: &ChannelSettings) -> ChannelFit {
    let stated = settings.drift.states[channel.state];
    let most = if stated > 0.0 { settings.adaptation.excess / stated } else { 1.0 };
    ChannelFit::new(settings.adaptation.noise, most)
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
