//! The members, and one step of all of them over one window.

use std::sync::OnceLock;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::coupling::{coupled, coupled_unknowns, independent, independent_unknowns};
use super::settings::{CouplingKind, EstimatorSettings, SettingsError};
use super::statistics::{Explainers, Summary, mean_and_sd, summarise};
use super::time::s_from_ns;
use crate::model::{Model, ParameterInfo};
use crate::xtfc::basis::Basis;
use crate::xtfc::collocation::CollocationSolver;
use crate::xtfc::dense;
use crate::xtfc::features::{FeatureError, RandomFeatures};
use crate::xtfc::problem::{Datum, Prior, Solution, Unknowns, WindowProblem};

/// A share of the prior variance that counts as learnt.
const INFORMED: f64 = 1e-4;

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

/// One Monte Carlo member.
#[derive(Debug, Clone)]
pub struct Member {
    basis: Basis,
    solver: CollocationSolver,
    solution: Solution,
    /// State at the end of the last window, `[n_states]`.
    x: Vec<f64>,
    /// Parameters there, clocks moved on.
    theta: Vec<f64>,
    /// Its perturbed samples of this window.
    data: Vec<Datum>,
    /// Prior root of its own (`independent`).
    root: Vec<f64>,
    /// Whether the last solve gave numbers.
    solved: bool,
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

/// The ensemble of one bed.
#[derive(Debug, Clone)]
pub struct Ensemble<M> {
    model: M,
    settings: EstimatorSettings,
    /// What is estimated, the phase along with the heart rate.
    estimated: Vec<usize>,
    unknowns: Unknowns,
    members: Vec<Member>,
    rng: ChaCha8Rng,
    /// Shared prior root (`coupled`), `[n_u x n_u]`.
    root: Vec<f64>,
    /// Noise of each observation for each member, `[n_observations x n_members]`, in units of its sd.
    noise: Vec<f64>,
    /// Spread of each estimated coordinate at the start.
    initial_sd: Vec<f64>,
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
            CouplingKind::Coupled => coupled_unknowns(&estimated, &transforms),
            CouplingKind::Independent => independent_unknowns(&estimated),
        };
        let mut rng = ChaCha8Rng::seed_from_u64(settings.seed);
        let mut theta = settings.theta.clone();
        model.advance(start_s, &mut theta);

        let (n, m) = (model.n_states(), settings.members);
        let bases = draw_bases(&model, &settings, &mut rng, parallel)?;
        let states = centred_normals(n, m, &mut rng);
        let guesses = centred_normals(estimated.len(), m, &mut rng);
        let members = bases.into_iter().enumerate().map(|(i, basis)| {
            let x = (0..n).map(|s| settings.initial_state[s] + settings.initial_state_sd[s] * states[s * m + i]);
            let mut theta = theta.clone();
            if settings.coupling == CouplingKind::Coupled {
                for (k, (&p, transform)) in estimated.iter().zip(&transforms).enumerate() {
                    let u = transform.forward(theta[p]) + settings.initial_guess_sd * guesses[k * m + i];
                    theta[p] = clamp_to_bounds(&model.parameters()[p], transform.inverse(u)).0;
                }
            }
            Member::new(basis, x.collect(), theta)
        });
        let mut ensemble = Self {
            members: members.collect(),
            model,
            settings,
            estimated,
            unknowns,
            rng,
            root: Vec::new(),
            noise: Vec::new(),
            initial_sd: Vec::new(),
        };
        ensemble.initial_sd = (0..ensemble.estimated.len()).map(|k| ensemble.coordinate_sd(k)).collect();
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

    /// Solves one window for every member; observations are in order of time, then channel.
    pub fn step(&mut self, observations: &[Observation], parallel: &dyn Parallel) -> WindowReport {
        let coupled = self.settings.coupling == CouplingKind::Coupled;
        if coupled {
            self.drift();
        }
        self.draw_noise(observations.len());
        if coupled && !observations.is_empty() {
            self.update_root();
        }
        let before: Vec<f64> = (0..self.estimated.len()).map(|k| self.coordinate_sd(k)).collect();
        self.solve(observations, parallel);
        let mut report = self.account(observations.len());
        if !observations.is_empty() {
            report.informed = (0..self.estimated.len())
                .map(|k| self.coordinate_sd(k).powi(2) < (1.0 - INFORMED) * before[k].powi(2))
                .collect();
        }
        report
    }

    /// Random walk of the parameters and process noise of the states over one window.
    fn drift(&mut self) {
        let drift = &self.settings.drift;
        let root_h = s_from_ns(self.settings.window.length_ns).sqrt();
        let parameters = self.model.parameters();
        for member in &mut self.members {
            for (x, sd) in member.x.iter_mut().zip(&drift.states).filter(|(_, sd)| **sd > 0.0) {
                let e: f64 = StandardNormal.sample(&mut self.rng);
                *x += sd * root_h * e;
            }
            if drift.parameters > 0.0 {
                for &p in &self.estimated {
                    let e: f64 = StandardNormal.sample(&mut self.rng);
                    let transform = parameters[p].transform;
                    let u = transform.forward(member.theta[p]) + drift.parameters * root_h * e;
                    member.theta[p] = clamp_to_bounds(&parameters[p], transform.inverse(u)).0;
                }
            }
        }
    }

    /// Sample covariance of (state, parameter coordinates), inflated, as a root.
    fn update_root(&mut self) {
        let n_u = self.unknowns.len(self.model.n_states());
        let samples: Vec<f64> = self.members.iter().flat_map(|member| self.coordinates(member)).collect();
        coupled::covariance_root(&samples, n_u, &mut self.root);
        let inflation = self.settings.drift.inflation.powf(s_from_ns(self.settings.window.length_ns));
        if inflation > 1.0 {
            self.root.iter_mut().for_each(|r| *r *= inflation.sqrt());
        }
    }

    fn coordinates<'a>(&'a self, member: &'a Member) -> impl Iterator<Item = f64> + 'a {
        let parameters = self.unknowns.parameters.iter().zip(&self.unknowns.transforms);
        member.x.iter().copied().chain(parameters.map(|(&p, transform)| transform.forward(member.theta[p])))
    }

    /// Perturbations of the observations, centred over the members so that the perturbed mean is the observed value.
    fn draw_noise(&mut self, observations: usize) {
        self.noise = centred_normals(observations, self.members.len(), &mut self.rng);
    }

    fn solve(&mut self, observations: &[Observation], parallel: &dyn Parallel) {
        let Self { model, settings, unknowns, members, root, noise, .. } = self;
        let (model, settings, unknowns, root, noise) = (&*model, &*settings, &*unknowns, &*root, &*noise);
        let m = members.len();
        parallel.for_each(members, &|i, member| {
            member.perturb(observations, settings, |k| noise[k * m + i]);
            member.solve(model, settings, unknowns, root);
        });
    }

    /// Moves the members on, mends those without numbers, and sums up.
    fn account(&mut self, observations: usize) -> WindowReport {
        let mut report =
            WindowReport { solved: self.members.iter().filter(|m| m.solved).count(), ..Default::default() };
        let h = s_from_ns(self.settings.window.length_ns);
        let parameters = self.model.parameters();
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
                let (value, clamped) = clamp_to_bounds(&parameters[p], member.theta[p]);
                member.theta[p] = value;
                report.clamped += usize::from(clamped);
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

    /// Standard deviation over the members of an estimated coordinate.
    fn coordinate_sd(&self, k: usize) -> f64 {
        let p = self.estimated[k];
        let transform = self.model.parameters()[p].transform;
        let values: Vec<f64> = self.members.iter().map(|member| transform.forward(member.theta[p])).collect();
        mean_and_sd(&values).1
    }

    /// States and derived quantities of all members at position `s` of the last window, `[n_quantities x n_members]`,
    /// states first.
    pub fn snapshot<'a>(&self, s: f64, scratch: &'a mut Snapshot) -> &'a mut [f64] {
        let (n, m) = (self.model.n_states(), self.members.len());
        let n_q = n + self.model.derived().len();
        scratch.values.resize(n_q * m, 0.0);
        scratch.row.resize(n_q, 0.0);
        let t = s * s_from_ns(self.settings.window.length_ns);
        for (i, member) in self.members.iter().enumerate() {
            scratch.phi.resize(member.basis.rank(), 0.0);
            let (x, derived) = scratch.row.split_at_mut(n);
            member.solution.state_at(&self.model, &member.basis, s, &mut scratch.phi, x);
            self.model.derive(t, x, &member.solution.theta, derived);
            for (q, value) in scratch.row.iter().enumerate() {
                scratch.values[q * m + i] = *value;
            }
        }
        &mut scratch.values
    }

    /// One summary per quantity of [`Ensemble::snapshot`].
    pub fn summarise_at(&self, s: f64, scratch: &mut Snapshot) -> Vec<Summary> {
        let (n, m) = (self.model.n_states(), self.members.len());
        let values = self.snapshot(s, scratch);
        let explainers = Explainers::new(&values[(n - self.model.n_discrepancies()) * m..n * m], m);
        let noise = |q: usize| self.settings.aleatoric_sd_mmhg.get(q).copied().unwrap_or(0.0);
        let summary = |(q, row): (usize, &mut [f64])| {
            let share = explainers.share_of(row);
            summarise(row, noise(q), share)
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
            let share = self.coordinate_sd(k) / self.initial_sd[k];
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

impl Member {
    fn new(basis: Basis, x: Vec<f64>, theta: Vec<f64>) -> Self {
        let solution = Solution {
            beta: vec![0.0; x.len() * basis.rank()],
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
            solved: true,
        }
    }

    /// The member's own noisy copy of the observations.
    fn perturb(&mut self, observations: &[Observation], settings: &EstimatorSettings, noise: impl Fn(usize) -> f64) {
        self.data.clear();
        self.data.extend(observations.iter().enumerate().map(|(k, o)| {
            let channel = &settings.channels[o.channel];
            let weight = match settings.coupling {
                CouplingKind::Coupled => 1.0 / channel.noise_sd_mmhg,
                CouplingKind::Independent => settings.weights.data,
            };
            let value = o.value + channel.noise_sd_mmhg * noise(k);
            Datum { s: o.s, state: channel.state, value, weight }
        }));
    }

    fn solve<M: Model>(&mut self, model: &M, settings: &EstimatorSettings, unknowns: &Unknowns, shared_root: &[f64]) {
        let nothing_free = Unknowns::default();
        // Without samples the prior is its own minimiser: a forecast.
        let (unknowns, prior) = if self.data.is_empty() {
            (&nothing_free, Prior::NONE)
        } else {
            let root = match settings.coupling {
                CouplingKind::Coupled => shared_root,
                CouplingKind::Independent => {
                    let weight = settings.weights.parameter;
                    let infos = model.parameters();
                    independent::prior_root(&self.theta, infos, &unknowns.parameters, weight, &mut self.root);
                    &self.root
                }
            };
            (unknowns, Prior { root, n_xi: unknowns.len(self.x.len()) })
        };
        let problem = WindowProblem {
            model,
            basis: &self.basis,
            start: &self.x,
            theta: &self.theta,
            unknowns,
            prior,
            data: &self.data,
            physics_weights: &settings.weights.physics,
            stopping: settings.stopping,
        };
        if self.basis.is_nodal() {
            self.solver.solve(&problem, &mut self.solution);
        } else {
            dense::solve(&problem, &mut self.solution);
        }
        self.solved = self.solution.is_finite();
        if !self.solved {
            self.stay();
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

fn check<M: Model>(model: &M, settings: &EstimatorSettings) -> Result<(), SettingsError> {
    let length = |what, found, expected| {
        if found == expected { Ok(()) } else { Err(SettingsError::Length { what, found, expected }) }
    };
    let n = model.n_states();
    length("theta", settings.theta.len(), model.parameters().len())?;
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
    let rate = model.parameter_index("heart_rate");
    if let (Some(rate), Some(phase)) = (rate, model.parameter_index("beat_phase"))
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
) -> Result<Vec<Basis>, SettingsError> {
    let length_s = s_from_ns(settings.window.length_ns);
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
    slots.into_iter().map(|slot| Ok(slot.into_inner().map_or_else(&mut again, Ok)?)).collect()
}

/// `rows x columns` standard normals, row-major; every row is centred, its variance kept at 1.
#[allow(clippy::cast_precision_loss)]
fn centred_normals(rows: usize, columns: usize, rng: &mut ChaCha8Rng) -> Vec<f64> {
    let mut values: Vec<f64> = (0..rows * columns).map(|_| StandardNormal.sample(rng)).collect();
    let n = columns as f64;
    for row in values.chunks_exact_mut(columns.max(1)) {
        let mean = row.iter().sum::<f64>() / n;
        row.iter_mut().for_each(|v| *v = (*v - mean) * (n / (n - 1.0)).sqrt());
    }
    values
}

fn clamp_to_bounds(info: &ParameterInfo, value: f64) -> (f64, bool) {
    let (low, high) = info.bounds;
    let inside = value.clamp(low, high);
    (inside, inside.to_bits() != value.to_bits())
}
