//! Kernels over eight members against the general solver, on every instruction set.

use hemostream::estimate::coupling::coupled::square;
use hemostream::estimate::coupling::{coupled_unknowns, independent_unknowns};
use hemostream::estimate::ensemble::Serial;
use hemostream::estimate::estimator::{Estimator, Input, Output};
use hemostream::estimate::settings::{CouplingKind, EstimatorSettings};
use hemostream::estimate::time::{ArrivalTime, EventTime};
use hemostream::estimate::window::RawSample;
use hemostream::model::Model;
use hemostream::model::cvsim6::{Cvsim6, Parameter, State};
use hemostream::model::lanes::{InstructionSet, Lanes, WIDTH};
use hemostream::model::truth::Simulator;
use hemostream::xtfc::basis::Basis;
use hemostream::xtfc::collocation::CollocationSolver;
use hemostream::xtfc::features::{FeatureSpec, RandomFeatures};
use hemostream::xtfc::problem::{Datum, Prior, Solution, Stopping, Unknowns, WindowProblem};
use hemostream::xtfc::sweeps::{
    Covariance, Expressions, FitScratch, Freedom, Samples, Shared, Solutions, derive, fit, forecast, forecast_and_fit,
};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

const WEIGHTS: [f64; 6] = [1.0; 6];

fn bases(count: usize, spec: FeatureSpec, length_s: f64) -> Vec<Basis> {
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let draws = std::iter::repeat_with(|| Basis::new(RandomFeatures::draw(spec, &mut rng).unwrap(), length_s).unwrap());
    draws.filter(Basis::is_nodal).take(count).collect()
}

fn available() -> Vec<InstructionSet> {
    InstructionSet::ALL.into_iter().filter(|set| set.is_available()).collect()
}

/// Members around a patient at `phase_s` of a beat, each with its own pressures and resistances; every second call with its
/// own clock.
fn members(phase_s: f64, own_clocks: bool) -> (Vec<Vec<f64>>, Vec<Vec<f64>>) {
    let model = Cvsim6::default();
    let theta = model.default_parameters();
    let mut patient = Simulator::new(model, Cvsim6::initial_pressures(&theta).unwrap(), theta, vec![]);
    patient.advance_to(phase_s).unwrap();
    let wobble = |k: usize| 1.0 + 0.04 * (1.7 * k as f64 + 11.0 * phase_s).sin();
    (0..WIDTH)
        .map(|lane| {
            let x = patient.state().iter().enumerate().map(|(s, p)| p * wobble(s + 7 * lane)).collect();
            let mut theta = patient.parameters().to_vec();
            for p in [Parameter::RPv, Parameter::RA, Parameter::CA, Parameter::CLSys] {
                theta[p as usize] *= wobble(3 * lane + p as usize).powi(5);
            }
            if own_clocks {
                theta[Parameter::BeatPhase as usize] += 0.003 * lane as f64;
                theta[Parameter::HeartRate as usize] += 0.2 * lane as f64;
            }
            (x, theta)
        })
        .unzip()
}

fn in_lanes(rows: &[Vec<f64>]) -> Vec<Lanes> {
    (0..rows[0].len()).map(|k| Lanes(std::array::from_fn(|lane| rows[lane][k]))).collect()
}

/// Eight members on a window, as the general solver sees each of them.
struct Case {
    xs: Vec<Vec<f64>>,
    thetas: Vec<Vec<f64>>,
}

impl Case {
    fn at(step: u32) -> Self {
        let (xs, thetas) = members(0.85 + 0.007 * f64::from(step), step % 2 == 1);
        Self { xs, thetas }
    }

    fn solutions(&self) -> Solutions {
        Solutions { start: in_lanes(&self.xs), theta: in_lanes(&self.thetas), ..Solutions::default() }
    }

    fn problem<'a>(&'a self, model: &'a Cvsim6, basis: &'a Basis, lane: usize) -> WindowProblem<'a, Cvsim6> {
        WindowProblem {
            model,
            basis,
            start: &self.xs[lane],
            theta: &self.thetas[lane],
            unknowns: NOTHING_FREE,
            prior: Prior::NONE,
            data: &[],
            physics_weights: &WEIGHTS,
            // Never reached: more iterations than it would take, and the minimiser is known much better than to 1e-9.
            stopping: Stopping { max_iterations: 20, tolerance_mmhg: 0.0 },
        }
    }
}

static NOTHING_FREE: &Unknowns =
    &Unknowns { initial_state: false, parameters: Vec::new(), transforms: Vec::new(), max_steps: Vec::new() };

/// Members that may differ in everything.
fn all_their_own(model: Cvsim6) -> Shared<Cvsim6> {
    let theta: Vec<Lanes> = model.default_parameters().into_iter().map(Lanes::splat).collect();
    let own: Vec<usize> = (0..Parameter::DeltaQLi as usize).collect();
    Shared::new(model, &theta, &own).unwrap()
}

fn close(found: &[Lanes], lane: usize, expected: &[f64], tolerance: f64, what: &str) {
    for (k, (found, expected)) in found.iter().zip(expected).enumerate() {
        let found = found.0[lane];
        assert!((found - expected).abs() <= tolerance * expected.abs().max(1.0), "{what} {k}: {found} {expected}");
    }
}

/// Through a whole beat, valves and all, at the lengths of windows in use: the sweeps end where the general solver does.
#[test]
fn sweeps_find_what_the_general_solver_finds_on_every_instruction_set() {
    let model = Cvsim6::default();
    let shared = all_their_own(model);
    for (length_s, least) in [(0.0005, 1.0), (0.001, 1.0), (0.002, 1.0), (0.004, 0.99), (0.005, 0.99), (0.01, 0.9)] {
        let bases = bases(WIDTH, FeatureSpec::default(), length_s);
        let expressions = Expressions::new(&bases).unwrap();
        let (mut solver, mut general) = (CollocationSolver::default(), Solution::default());
        let (mut solved, mut all) = (0_u32, 0_u32);
        for step in 0..120 {
            let case = Case::at(step);
            let run = |set: InstructionSet| {
                let mut solutions = case.solutions();
                let progress = forecast(&shared, &expressions, 1e-10, set, &mut solutions);
                (solutions, progress)
            };
            let (swept, progress) = run(InstructionSet::Portable);
            for set in available() {
                assert_eq!(run(set).0, swept, "every instruction set rounds alike");
            }
            for (lane, basis) in bases.iter().enumerate() {
                all += 1;
                if !progress.done[lane] {
                    continue;
                }
                solved += 1;
                solver.solve(&case.problem(&model, basis, lane), &mut general);
                close(&swept.end, lane, &general.end, 1e-9, "state at the end");
            }
        }
        let share = f64::from(solved) / f64::from(all);
        println!("{length_s} s: {:.2} % of the windows by sweeps", 100.0 * share);
        assert!(share >= least, "{length_s}: {share}");
    }
}

/// Samples of a window, with the general solver's idea of them.
struct Data {
    states: Vec<usize>,
    weights: Vec<f64>,
    phi: Vec<Lanes>,
    values: Vec<Lanes>,
    of_member: Vec<Vec<Datum>>,
}

impl Data {
    /// At these positions and of these states, up to `far` sd away from where the members start.
    fn new(case: &Case, bases: &[Basis], samples: &[(f64, State)], far: f64, weight: impl Fn(State) -> f64) -> Self {
        let mut data = Self {
            states: samples.iter().map(|(_, state)| *state as usize).collect(),
            weights: samples.iter().map(|(_, state)| weight(*state)).collect(),
            phi: Vec::new(),
            values: Vec::new(),
            of_member: vec![Vec::new(); bases.len()],
        };
        for (j, &(s, state)) in samples.iter().enumerate() {
            let rows: Vec<Vec<f64>> = bases
                .iter()
                .map(|basis| {
                    let mut row = vec![0.0; basis.rank()];
                    basis.values_at(s, &mut row);
                    row
                })
                .collect();
            data.phi.extend(in_lanes(&rows));
            let off = |lane: usize| far * NOISE[state as usize] * (1.3 * lane as f64 + 2.1 * j as f64).sin();
            let values: Vec<Vec<f64>> =
                (0..WIDTH).map(|lane| vec![case.xs[lane][state as usize] + off(lane)]).collect();
            data.values.extend(in_lanes(&values));
            for (lane, of_member) in data.of_member.iter_mut().enumerate() {
                let (value, weight) = (values[lane][0], data.weights[j]);
                of_member.push(Datum { s, state: state as usize, value, weight });
            }
        }
        data
    }
}

const NOISE: [f64; 6] = [2.07, 2.06, 0.146, 0.408, 0.40, 0.242];

/// The window with samples, in the way of `coupled`: the posterior of the general solver, through a beat.
#[test]
fn a_coupled_window_is_that_of_the_general_solver() {
    use Parameter as P;
    let model = Cvsim6::default();
    let shared = all_their_own(model);
    let samples = [(0.3, State::A), (0.3, State::V), (0.9, State::Pa)];
    let sets: [(&[P], f64); 4] = [
        (&[P::RPv, P::CA], 0.985),
        (&[P::HeartRate, P::BeatPhase], 0.97),
        (&[P::Systole, P::CLSys, P::CRDia, P::PTh], 0.97),
        (&[P::RLo, P::RRi, P::CPv, P::RA], 0.97),
    ];
    for (parameters, least) in sets {
        let (mut solved, mut elsewhere, mut all) = (0_u32, 0_u32, 0_u32);
        for length_s in [0.001, 0.004] {
            let bases = bases(WIDTH, FeatureSpec::default(), length_s);
            let expressions = Expressions::new(&bases).unwrap();
            let chosen: Vec<usize> = parameters.iter().map(|p| *p as usize).collect();
            let transforms: Vec<_> = chosen.iter().map(|&p| model.parameters()[p].transform).collect();
            let unknowns = coupled_unknowns(&model, &chosen, &transforms);
            let n_u = 6 + chosen.len();
            // Lower triangular, everything correlated.
            let sd = |i: usize| if i < 6 { 0.4 * NOISE[i] } else { 0.004 };
            let root: Vec<f64> = (0..n_u * n_u)
                .map(|k| (k / n_u, k % n_u))
                .map(
                    |(i, j)| {
                        if j > i { 0.0 } else { sd(i) * if i == j { 1.0 } else { 0.2 * (i as f64 - j as f64).cos() } }
                    },
                )
                .collect();
            let mut covariance = Vec::new();
            square(&root, n_u, &mut covariance);
            let (mut solver, mut general) = (CollocationSolver::default(), Solution::default());
            let mut scratch = FitScratch::default();
            for step in 0..60 {
                let case = Case::at(2 * step + step % 2);
                let data = Data::new(&case, &bases, &samples, 2.0, |state| 1.0 / NOISE[state as usize]);
                let prior = Prior { root: &root, n_xi: n_u };
                let mut run = |set: InstructionSet| {
                    let mut solutions = case.solutions();
                    _ = forecast(&shared, &expressions, 1e-11, set, &mut solutions);
                    let samples =
                        Samples { states: &data.states, weights: &data.weights, phi: &data.phi, values: &data.values };
                    let freedom = Freedom {
                        unknowns: &unknowns,
                        covariance: Covariance::Shared(&covariance),
                        physics_weights: &WEIGHTS,
                        precision: None,
                    };
                    let places = (&mut scratch, &mut solutions);
                    let progress = fit(&shared, &expressions, &samples, &freedom, 1e-11, set, places);
                    (solutions, progress)
                };
                let (swept, progress) = run(InstructionSet::Portable);
                for set in available() {
                    assert_eq!(run(set).0, swept, "every instruction set rounds alike");
                }
                for (lane, basis) in bases.iter().enumerate() {
                    all += 1;
                    if !progress.done[lane] {
                        continue;
                    }
                    solved += 1;
                    let problem = WindowProblem {
                        unknowns: &unknowns,
                        prior,
                        data: &data.of_member[lane],
                        ..case.problem(&model, basis, lane)
                    };
                    solver.solve(&problem, &mut general);
                    // Where a valve opens or closes in the window, it may do so before or after a node.
                    if (swept.start[0].0[lane] - general.start[0]).abs() > 1e-3 {
                        elsewhere += 1;
                        continue;
                    }
                    close(&swept.start, lane, &general.start, 1e-9, "state at the start");
                    close(&swept.end, lane, &general.end, 1e-9, "state at the end");
                    close(&swept.theta, lane, &general.theta, 1e-9, "parameter");
                }
            }
        }
        let share = f64::from(solved) / f64::from(all);
        println!("{parameters:?}: {:.2} % of the windows by sweeps, {elsewhere} at another minimum", 100.0 * share);
        assert!(share >= least && elsewhere <= all / 500, "{parameters:?}: {share}, {elsewhere} of {all}");
    }
}

/// The same in the way of `independent`: the paper's weighted least squares, six sensors at once.
#[test]
fn an_independent_window_is_that_of_the_general_solver() {
    let model = Cvsim6::default();
    let shared = all_their_own(model);
    let chosen = vec![Parameter::RPv as usize, Parameter::CA as usize];
    let unknowns = independent_unknowns(&chosen);
    let (mut solver, mut general) = (CollocationSolver::default(), Solution::default());
    let mut scratch = FitScratch::default();
    for (length_s, data_weight, w_theta, least) in
        [(0.001, 1.0, 10.0, 0.999), (0.001, 100.0, 10.0, 0.7), (0.004, 1.0, 10.0, 0.99)]
    {
        let bases = bases(WIDTH, FeatureSpec::default(), length_s);
        let expressions = Expressions::new(&bases).unwrap();
        let (mut solved, mut all) = (0_u32, 0_u32);
        for step in 0..120 {
            let case = Case::at(step);
            let states = [State::L, State::A, State::V, State::R, State::Pa, State::Pv];
            let samples = states.map(|state| (0.1 + 0.15 * f64::from(state as u32), state));
            let data = Data::new(&case, &bases, &samples, 2.0 / data_weight, |_| data_weight);
            let prior_sd = |theta: f64| theta / w_theta;
            let mut solutions = case.solutions();
            let variances: Vec<Lanes> =
                chosen.iter().map(|&p| solutions.theta[p].map(|theta| prior_sd(theta).powi(2))).collect();
            let set = InstructionSet::best();
            _ = forecast(&shared, &expressions, 1e-11, set, &mut solutions);
            let samples =
                Samples { states: &data.states, weights: &data.weights, phi: &data.phi, values: &data.values };
            let freedom = Freedom {
                unknowns: &unknowns,
                covariance: Covariance::Own(&variances),
                physics_weights: &WEIGHTS,
                precision: None,
            };
            let places = (&mut scratch, &mut solutions);
            let progress = fit(&shared, &expressions, &samples, &freedom, 1e-11, set, places);
            for (lane, basis) in bases.iter().enumerate() {
                all += 1;
                if !progress.done[lane] {
                    continue;
                }
                solved += 1;
                let root: Vec<f64> = chosen
                    .iter()
                    .enumerate()
                    .flat_map(|(k, &p)| (0..2).map(move |j| (k, p, j)))
                    .map(|(k, p, j)| if j == k { prior_sd(case.thetas[lane][p]) } else { 0.0 })
                    .collect();
                let problem = WindowProblem {
                    unknowns: &unknowns,
                    prior: Prior { root: &root, n_xi: 2 },
                    data: &data.of_member[lane],
                    ..case.problem(&model, basis, lane)
                };
                solver.solve(&problem, &mut general);
                close(&solutions.end, lane, &general.end, 1e-9, "state at the end");
                close(&solutions.theta, lane, &general.theta, 1e-9, "parameter");
            }
        }
        let share = f64::from(solved) / f64::from(all);
        println!("{length_s} s, {data_weight}: {:.2} % of the windows by sweeps", 100.0 * share);
        assert!(share >= least, "{length_s} {data_weight}: {share}");
    }
}

/// Forecast and fit are the same at once and one after the other, and so is what the forecast says of the samples.
#[test]
fn a_forecast_and_a_fit_at_once_are_both() {
    let model = Cvsim6::default();
    let (shared, set) = (all_their_own(model), InstructionSet::best());
    let bases = bases(WIDTH, FeatureSpec::default(), 0.004);
    let expressions = Expressions::new(&bases).unwrap();
    let chosen = [Parameter::RPv as usize, Parameter::CA as usize, Parameter::HeartRate as usize];
    let transforms: Vec<_> = chosen.iter().map(|&p| model.parameters()[p].transform).collect();
    let unknowns = coupled_unknowns(&model, &chosen, &transforms);
    let covariance: Vec<f64> = (0..81).map(|k| if k % 10 == 0 { 0.01 } else { 0.001 }).collect();
    let freedom = Freedom {
        unknowns: &unknowns,
        covariance: Covariance::Shared(&covariance),
        physics_weights: &WEIGHTS,
        precision: None,
    };
    let (mut scratch, mut expected, mut compared) = (FitScratch::default(), Vec::new(), 0);
    for step in 0..120 {
        let case = Case::at(step);
        let samples = [(0.3, State::A), (0.3, State::V), (1.0, State::Pa)];
        let data = Data::new(&case, &bases, &samples, 2.0, |state| 1.0 / NOISE[state as usize]);
        let samples = Samples { states: &data.states, weights: &data.weights, phi: &data.phi, values: &data.values };
        let mut solutions = case.solutions();
        let all = |done: [bool; WIDTH]| done.iter().all(|done| *done);
        let whole = all(forecast(&shared, &expressions, 1e-11, set, &mut solutions).done);
        let says = |j: usize| {
            let (state, phi) = (data.states[j], &data.phi[j * 5..(j + 1) * 5]);
            let beta = &solutions.beta[state * 5..(state + 1) * 5];
            phi.iter().zip(beta).fold(solutions.start[state], |x, (phi, beta)| x + *phi * *beta)
        };
        let says: Vec<Lanes> = (0..3).map(says).collect();
        let one_by_one = fit(&shared, &expressions, &samples, &freedom, 1e-11, set, (&mut scratch, &mut solutions));
        let mut other = case.solutions();
        let places = (&mut scratch, &mut other, &mut expected);
        let at_once = forecast_and_fit(&shared, &expressions, &samples, &freedom, 1e-11, set, places);
        assert_eq!(at_once.is_some(), whole, "given up if the forecast is");
        let Some(at_once) = at_once else {
            assert_eq!((&other.start, &other.theta), (&case.solutions().start, &case.solutions().theta));
            continue;
        };
        for lane in (0..WIDTH).filter(|&lane| at_once.done[lane] && one_by_one.done[lane]) {
            let of = |lanes: &[Lanes]| lanes.iter().map(|lanes| lanes.0[lane]).collect::<Vec<f64>>();
            close(&expected, lane, &of(&says), 1e-9, "expected");
            close(&other.end, lane, &of(&solutions.end), 1e-9, "state at the end");
            close(&other.start, lane, &of(&solutions.start), 1e-9, "state at the start");
            close(&other.theta, lane, &of(&solutions.theta), 1e-9, "parameter");
            compared += 1;
        }
    }
    println!("{compared} of {} member-windows compared", 120 * WIDTH);
    assert!(compared > 100 * WIDTH, "{compared}");
}

#[test]
fn batches_that_cannot_be_treated_alike_are_refused() {
    let mut short = bases(3, FeatureSpec::default(), 0.001);
    assert!(Expressions::new(&short).is_some(), "an incomplete batch is filled up");
    short.extend(bases(1, FeatureSpec { count: 6, nodes: 6, ..FeatureSpec::default() }, 0.001));
    assert!(Expressions::new(&short).is_none());
    assert!(Expressions::new(&[]).is_none());
}

/// Clocks and what else does not differ are worked out once for all members, to the same bits.
#[test]
fn what_members_share_changes_nothing() {
    let model = Cvsim6::default();
    let bases = bases(WIDTH, FeatureSpec::default(), 0.004);
    let expressions = Expressions::new(&bases).unwrap();
    for step in (0..120).step_by(2) {
        let mut solutions = Case::at(step).solutions();
        let mut other = solutions.clone();
        let chosen = [Parameter::RPv, Parameter::RA, Parameter::CA, Parameter::CLSys].map(|p| p as usize);
        // What decides over the clock is as it was before, until the window begins.
        let mut before = solutions.theta.clone();
        before[Parameter::BeatPhase as usize] = Lanes::splat(0.3);
        for own in [&chosen[..], &chosen[..3]] {
            if own.len() < 4 {
                let first = solutions.theta[Parameter::CLSys as usize].0[0];
                solutions.theta[Parameter::CLSys as usize] = Lanes::splat(first);
                other.theta.clone_from(&solutions.theta);
                before[Parameter::CLSys as usize] = Lanes::splat(first);
            }
            let mut shared = Shared::new(model, &before, own).unwrap();
            shared.begin(&solutions.theta, &[Parameter::BeatPhase as usize], &expressions, InstructionSet::best());
            let progress = forecast(&shared, &expressions, 1e-9, InstructionSet::best(), &mut solutions);
            let apart = forecast(&all_their_own(model), &expressions, 1e-9, InstructionSet::best(), &mut other);
            assert_eq!(progress, apart);
            assert_eq!(solutions, other);
            let mut derived = [[Lanes::default(); 12]; 2];
            let x = [&solutions.start[..], &solutions.theta[..]];
            derive(&shared, 0.004, InstructionSet::best(), (x[0], x[1]), &mut derived[0]);
            derive(&all_their_own(model), 0.004, InstructionSet::best(), (x[0], x[1]), &mut derived[1]);
            assert_eq!(derived[0], derived[1]);
        }
    }
}

#[test]
fn what_no_number_is_left_to_the_general_solver() {
    let model = Cvsim6::default();
    let shared = all_their_own(model);
    let bases = bases(WIDTH, FeatureSpec::default(), 0.001);
    let expressions = Expressions::new(&bases).unwrap();
    let mut case = Case::at(20);
    case.xs[3][1] = f64::NAN;
    let mut solutions = case.solutions();
    let progress = forecast(&shared, &expressions, 1e-9, InstructionSet::best(), &mut solutions);
    assert_eq!(progress.done, std::array::from_fn(|lane| lane != 3));
}

/// The whole estimator, bit for bit.
#[test]
fn estimates_do_not_depend_on_the_instruction_set() {
    let run = |instructions: InstructionSet| {
        let settings = super::twin::settings(CouplingKind::Coupled, &[State::A, State::Pa], &[Parameter::RPv]);
        let mut window = settings.window;
        window.length_ns = 1_000_000;
        let settings = EstimatorSettings { instructions, window, members: 20, ..settings };
        let model = Cvsim6::default();
        let theta = model.default_parameters();
        let mut patient = Simulator::new(model, Cvsim6::initial_pressures(&theta).unwrap(), theta, vec![]);
        let mut estimator = Estimator::new(model, settings.clone()).unwrap();
        let mut outputs = Vec::new();
        for k in 0..125_i64 {
            let time = EventTime(k * 8_000_000);
            patient.advance_to(time.as_s()).unwrap();
            for (channel, sensor) in settings.channels.iter().enumerate() {
                let samples = vec![RawSample { time, value: patient.state()[sensor.state] + (k % 3) as f64 - 1.0 }];
                estimator.handle(Input::Samples { channel, samples }, ArrivalTime(time.0), &Serial, &mut outputs);
            }
        }
        outputs.into_iter().filter(|output| matches!(output, Output::Estimate(_))).collect::<Vec<_>>()
    };
    let portable = run(InstructionSet::Portable);
    assert!(portable.len() > 40);
    for set in available() {
        assert!(run(set) == portable, "{}", set.name());
    }
}
