//! The window solver: against the truth, against the general solver, against plain linear algebra.

use faer::Mat;
use hemostream::model::cvsim6::{Cvsim6, Parameter, PulmonaryResistance};
use hemostream::model::truth::Simulator;
use hemostream::model::{Model, Transform};
use hemostream::xtfc::basis::Basis;
use hemostream::xtfc::collocation::CollocationSolver;
use hemostream::xtfc::dense;
use hemostream::xtfc::features::{Activation, FeatureSpec, Nodes, RandomFeatures, WeightDistribution};
use hemostream::xtfc::problem::{Datum, Prior, Solution, Stopping, Unknowns, WindowProblem};
use proptest::prelude::*;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

const WEIGHTS: [f64; 6] = [1.0; 6];

fn basis(spec: FeatureSpec, length_s: f64, seed: u64) -> Basis {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    Basis::new(RandomFeatures::draw(spec, &mut rng).unwrap(), length_s).unwrap()
}

/// Physics alone over `seconds`; the largest pressure error against the truth, at window ends later than `from_s`.
fn forecast_error(spec: FeatureSpec, length_s: f64, from_s: f64, seconds: f64, seed: u64) -> (f64, f64) {
    let model = Cvsim6::default();
    let mut theta = model.default_parameters();
    let mut x = Cvsim6::initial_pressures(&theta).unwrap();
    let mut truth = Simulator::new(model, x.clone(), theta.clone(), vec![]);
    // To the start of the stretch with the truth itself.
    truth.advance_to(from_s).unwrap();
    x.copy_from_slice(truth.state());
    theta.copy_from_slice(truth.parameters());

    let basis = basis(spec, length_s, seed);
    let (mut solver, mut solution) = (CollocationSolver::default(), Solution::default());
    let (mut worst, mut iterations) = (0.0_f64, 0);
    let windows = (seconds / length_s).round() as usize;
    for k in 1..=windows {
        let problem = WindowProblem {
            model: &model,
            basis: &basis,
            start: &x,
            theta: &theta,
            unknowns: &Unknowns::default(),
            prior: Prior::NONE,
            data: &[],
            physics_weights: &WEIGHTS,
            stopping: Stopping::default(),
        };
        if basis.is_nodal() {
            solver.solve(&problem, &mut solution);
        } else {
            dense::solve(&problem, &mut solution);
        }
        assert!(solution.account.converged, "window {k} did not converge: {:?}", solution.account);
        iterations += solution.account.iterations;
        x.clone_from(&solution.end);
        model.advance(length_s, &mut theta);
        truth.advance_to(from_s + k as f64 * length_s).unwrap();
        let error = x.iter().zip(truth.state()).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        worst = worst.max(error);
    }
    (worst, iterations as f64 / windows as f64)
}

#[test]
fn physics_alone_follows_the_truth() {
    for placement in [Nodes::Uniform, Nodes::Legendre] {
        let errors = (0..10).map(|seed| {
            let spec = FeatureSpec { placement, ..FeatureSpec::default() };
            let (error, iterations) = forecast_error(spec, 0.001, 0.0, 2.0, seed);
            println!("{placement:?} seed {seed}: {error:.2e} mmHg, {iterations:.3} iterations per window");
            error
        });
        let worst = errors.fold(0.0, f64::max);
        assert!(worst < 5e-3, "{placement:?}: {worst} mmHg");
    }
}

/// Away from valve events and corners the scheme has the order of its collocation method.
#[test]
fn order_of_convergence_away_from_events() {
    println!("nodes placement h_ms error_mmhg order");
    let cases = [
        (Nodes::Uniform, 3, 4.0, 0.01),
        (Nodes::Uniform, 4, 4.0, 0.01),
        (Nodes::Legendre, 2, 4.0, 0.01),
        (Nodes::Legendre, 3, 6.0, 0.01),
    ];
    for (placement, nodes, expected, width) in cases {
        // On a narrow domain the features span nearly polynomials, whose order is known; a wide one adds a floor.
        let spec = FeatureSpec { nodes, count: nodes, placement, domain: (0.0, width), ..FeatureSpec::default() };
        let mut previous: Option<f64> = None;
        let mut best = 0.0_f64;
        for length_s in [0.128, 0.064, 0.032, 0.016] {
            // 0.52 to 0.776 s: diastole, inlets open, nothing stiff (stiffness would show the stage order instead).
            let (error, _) = forecast_error(spec, length_s, 0.52, 0.256, 3);
            let order = previous.map_or(f64::NAN, |p| (p / error).log2());
            println!("{nodes} {placement:?} {:.0} {error:.2e} {order:.2}", length_s * 1e3);
            best = best.max(order);
            previous = Some(error);
        }
        assert!(best > expected - 0.5, "{placement:?} with {nodes} nodes: order {best}, expected {expected}");
    }
}

/// A state on the way through a beat, and what is free: everything a window can ask for.
fn compare_solvers(seed: u64, phase: f64, initial_state: bool, length_s: f64, nonlinear: bool) {
    let law = if nonlinear { PulmonaryResistance::Nonlinear } else { PulmonaryResistance::Linear };
    let model = Cvsim6 { pulmonary_resistance: law, ..Cvsim6::default() };
    let mut theta = model.default_parameters();
    let mut patient = Simulator::new(model, Cvsim6::initial_pressures(&theta).unwrap(), theta.clone(), vec![]);
    patient.advance_to(0.01 + phase).unwrap();
    theta.copy_from_slice(patient.parameters());
    let basis = basis(FeatureSpec::default(), length_s, seed);

    let parameters = vec![Parameter::RPv as usize, Parameter::CA as usize, Parameter::PTh as usize];
    let transforms = parameters.iter().map(|&p| model.parameters()[p].transform).collect();
    let unknowns = Unknowns { initial_state, parameters, transforms, max_steps: vec![1.0; 3] };
    let n_u = unknowns.len(6);
    // A full root with correlations between states and parameters.
    let root: Vec<f64> = (0..n_u * n_u)
        .map(|k| if k / n_u >= k % n_u { 0.1 / (1.0 + (k / n_u - k % n_u) as f64) } else { 0.0 })
        .collect();
    let value = |state: usize, off: f64| patient.state()[state] + off;
    let data = [
        Datum { s: 0.3, state: 1, value: value(1, 1.5), weight: 0.5 },
        Datum { s: 0.3, state: 4, value: value(4, -0.4), weight: 2.5 },
        Datum { s: 1.0, state: 1, value: value(1, -0.7), weight: 0.5 },
    ];
    let problem = WindowProblem {
        model: &model,
        basis: &basis,
        start: patient.state(),
        theta: &theta,
        unknowns: &unknowns,
        prior: Prior { root: &root, n_xi: n_u },
        data: &data,
        physics_weights: &[1.0, 0.5, 2.0, 1.0, 0.1, 1.0],
        stopping: Stopping { max_iterations: 40, tolerance_mmhg: 1e-10 },
    };
    let (mut fast, mut reference) = (Solution::default(), Solution::default());
    CollocationSolver::default().solve(&problem, &mut fast);
    dense::solve(&problem, &mut reference);
    assert!(fast.account.converged && reference.account.converged, "{:?} {:?}", fast.account, reference.account);
    for (a, b) in fast.end.iter().chain(&fast.start).zip(reference.end.iter().chain(&reference.start)) {
        assert!((a - b).abs() < 1e-7 * (1.0 + b.abs()), "pressure {a} against {b}");
    }
    for (a, b) in fast.theta.iter().zip(&reference.theta) {
        assert!((a - b).abs() <= 1e-7 * b.abs(), "parameter {a} against {b}");
    }
    assert!(initial_state == (fast.start != patient.state()), "the start moves exactly if it is free");
    assert!(fast.theta != theta, "the data move the parameters");
}

#[test]
fn samples_and_parameters_between_rank_and_nodes_use_the_general_solver() {
    // More nodes than features: least squares proper, still within reach of the truth.
    let spec = FeatureSpec { nodes: 8, count: 5, ..FeatureSpec::default() };
    assert!(!basis(spec, 0.001, 1).is_nodal());
    let (error, _) = forecast_error(spec, 0.002, 0.0, 0.2, 1);
    assert!(error < 2e-2, "{error}");
    // More features than nodes: underdetermined. The shortest coefficients lean towards resting pressures.
    let spec = FeatureSpec { nodes: 4, count: 7, ..FeatureSpec::default() };
    assert!(!basis(spec, 0.001, 1).is_nodal());
    let (error, _) = forecast_error(spec, 0.002, 0.0, 0.2, 1);
    assert!(error < 0.5, "{error}");
}

#[test]
fn every_activation_and_distribution_solves() {
    use Activation::{Arctan, Logistic, Sine, Softplus, Swish, Tanh};
    let distributions = [
        WeightDistribution::Uniform { low: -1.0, high: 1.0 },
        WeightDistribution::Normal { mean: 0.0, sd: 1.0 },
        WeightDistribution::Exponential { mean: 1.0 },
    ];
    for activation in [Tanh, Logistic, Sine, Arctan, Softplus, Swish] {
        for weights in distributions {
            let spec = FeatureSpec { activation, weights, biases: weights, ..FeatureSpec::default() };
            let (error, _) = forecast_error(spec, 0.001, 0.0, 0.1, 5);
            assert!(error < 5e-3, "{activation:?} {weights:?}: {error}");
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(60))]

    #[test]
    fn the_square_solver_finds_the_minimiser_of_the_general_one(
        seed in 0_u64..1000, phase in 0.0..0.8, free: bool, fine: bool, nonlinear: bool
    ) {
        compare_solvers(seed, phase, free, if fine { 0.001 } else { 0.004 }, nonlinear);
    }

    #[test]
    fn least_squares_agrees_with_plain_svd(
        entries in proptest::collection::vec(-1.0..1.0_f64, 12 * 7), rhs in proptest::collection::vec(-1.0..1.0_f64, 12)
    ) {
        let a = Mat::from_fn(12, 7, |i, j| entries[i * 7 + j]);
        let (qr, condition) = dense::least_squares(&a, &rhs);
        let (svd, _) = dense::shortest_least_squares(&a, &rhs);
        for (x, y) in qr.iter().zip(&svd) {
            prop_assert!((x - y).abs() <= 1e-11 * condition.max(10.0) * (1.0 + y.abs()), "{} against {}", x, y);
        }
    }

    #[test]
    fn transforms_invert(value in 0.01..100.0_f64) {
        for transform in [Transform::Log, Transform::Linear { scale: 4.0 }] {
            let u = transform.forward(value);
            prop_assert!((transform.inverse(u) - value).abs() < 1e-12 * value);
            let slope = (transform.inverse(u + 1e-6) - transform.inverse(u - 1e-6)) / 2e-6;
            prop_assert!((slope - transform.slope(value)).abs() < 1e-6 * slope.abs());
        }
    }
}
