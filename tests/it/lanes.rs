//! Kernels over eight members against the general solver, on every instruction set.

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
use hemostream::xtfc::problem::{Prior, Solution, Stopping, Unknowns, WindowProblem};
use hemostream::xtfc::sweeps::{Batch, Expressions};
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

/// Through a whole beat, valves and all, at the lengths of windows in use: the sweeps end where the general solver does.
#[test]
fn sweeps_find_what_the_general_solver_finds_on_every_instruction_set() {
    let model = Cvsim6::default();
    let stopping = Stopping { max_iterations: 40, tolerance_mmhg: 1e-11 };
    for (length_s, least) in [(0.0005, 1.0), (0.001, 1.0), (0.002, 0.99), (0.004, 0.9), (0.005, 0.8)] {
        let bases = bases(WIDTH, FeatureSpec::default(), length_s);
        let expressions = Expressions::new(&bases.iter().collect::<Vec<_>>()).unwrap();
        let (mut solver, mut general, mut swept) =
            (CollocationSolver::default(), Solution::default(), Solution::default());
        let mut batches: Vec<Batch> = available().iter().map(|_| Batch::default()).collect();
        let (mut solved, mut all) = (0_u32, 0_u32);
        for step in 0..120 {
            let (xs, thetas) = members(0.85 + 0.007 * f64::from(step), step % 2 == 1);
            for (set, batch) in available().into_iter().zip(&mut batches) {
                (batch.start, batch.theta) = (in_lanes(&xs), in_lanes(&thetas));
                assert!(batch.solve(&model, &expressions, stopping.tolerance_mmhg, set));
            }
            for lane in 0..WIDTH {
                let problem = WindowProblem {
                    model: &model,
                    basis: &bases[lane],
                    start: &xs[lane],
                    theta: &thetas[lane],
                    unknowns: &Unknowns::default(),
                    prior: Prior::NONE,
                    data: &[],
                    physics_weights: &WEIGHTS,
                    stopping,
                };
                solver.solve(&problem, &mut general);
                all += 1;
                let mut first: Option<Solution> = None;
                for batch in &batches {
                    if !batch.read(lane, &thetas[lane], &mut swept) {
                        continue;
                    }
                    for (a, b) in swept.end.iter().zip(&general.end) {
                        assert!((a - b).abs() <= 1e-9 * b.abs().max(1.0), "{length_s} {step} {lane}: {a} {b}");
                    }
                    let same = first.get_or_insert_with(|| swept.clone());
                    assert_eq!(same.beta, swept.beta, "every instruction set rounds alike");
                }
                solved += u32::from(first.is_some());
            }
        }
        let share = f64::from(solved) / f64::from(all);
        println!("{length_s} s: {:.2} % of the windows by sweeps", 100.0 * share);
        assert!(share >= least, "{length_s}: {share}");
    }
}

#[test]
fn batches_that_cannot_be_treated_alike_are_refused() {
    let short = bases(3, FeatureSpec::default(), 0.001);
    assert!(Expressions::new(&short.iter().collect::<Vec<_>>()).is_some(), "an incomplete batch is filled up");
    let other = bases(1, FeatureSpec { count: 6, nodes: 6, ..FeatureSpec::default() }, 0.001);
    assert!(Expressions::new(&[&short[0], &other[0]]).is_none());
    assert!(Expressions::new(&[]).is_none());
}

#[test]
fn what_no_number_is_left_to_the_general_solver() {
    let model = Cvsim6::default();
    let bases = bases(WIDTH, FeatureSpec::default(), 0.001);
    let expressions = Expressions::new(&bases.iter().collect::<Vec<_>>()).unwrap();
    let (mut xs, thetas) = members(1.0, false);
    xs[3][1] = f64::NAN;
    let mut batch = Batch::default();
    (batch.start, batch.theta) = (in_lanes(&xs), in_lanes(&thetas));
    assert!(batch.solve(&model, &expressions, 1e-9, InstructionSet::best()));
    let mut out = Solution::default();
    for (lane, theta) in thetas.iter().enumerate() {
        assert_eq!(batch.read(lane, theta, &mut out), lane != 3, "{lane}");
    }
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
