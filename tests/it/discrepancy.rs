//! What the equations lack: the forms, the solvers, the ensemble, the configuration.

use hemostream::edge::config::Config;
use hemostream::estimate::ensemble::{Ensemble, Observation, Serial, Snapshot};
use hemostream::estimate::statistics::{Explainers, correlation};
use hemostream::model::cvsim6::{Cvsim6, Parameter, PulmonaryResistance, State};
use hemostream::model::discrepancy::{Discrepancy, DiscrepancyError, Discrepant, Form};
use hemostream::model::truth::Simulator;
use hemostream::model::{Model, Transform};
use hemostream::xtfc::basis::Basis;
use hemostream::xtfc::collocation::CollocationSolver;
use hemostream::xtfc::dense;
use hemostream::xtfc::features::{FeatureSpec, RandomFeatures};
use hemostream::xtfc::problem::{Datum, Prior, Solution, Stopping, Unknowns, WindowProblem};
use proptest::prelude::*;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

fn discrepancy(parameter: Parameter, form: Form) -> Discrepancy {
    Discrepancy { parameter: parameter as usize, form }
}

#[test]
fn what_the_model_does_not_have_is_refused() {
    let new = |all: &[Discrepancy]| Discrepant::new(Cvsim6::default(), all).map(|_| ()).unwrap_err();
    let twice = discrepancy(Parameter::DeltaQPv, Form::Tracked);
    assert_eq!(new(&[twice, twice]), DiscrepancyError::Parameter(Parameter::DeltaQPv as usize));
    assert_eq!(new(&[Discrepancy { parameter: 999, form: Form::Free }]), DiscrepancyError::Parameter(999));
    let valve = discrepancy(Parameter::DeltaQLo, Form::Inertial { ratio_s: 10.0 });
    assert_eq!(new(&[valve]), DiscrepancyError::NoInertia("delta_q_lo".to_owned()));
}

/// A window somewhere in a beat with three discrepancies, solved by both solvers.
fn compare_solvers(seed: u64, phase: f64, initial_state: bool, with_data: bool) {
    let model = Discrepant::new(
        Cvsim6::default(),
        &[
            discrepancy(Parameter::DeltaQPv, Form::Free),
            discrepancy(Parameter::DeltaQA, Form::Inertial { ratio_s: 10.0 }),
            discrepancy(Parameter::DeltaPPa, Form::Tracked),
        ],
    )
    .unwrap();
    let mut theta = model.default_parameters();
    let x0 = Cvsim6::initial_pressures(&theta).unwrap();
    let mut patient = Simulator::new(Cvsim6::default(), x0, theta.clone(), vec![]);
    patient.advance_to(0.01 + phase).unwrap();
    theta.copy_from_slice(patient.parameters());
    let start: Vec<f64> = patient.state().iter().copied().chain([0.0, 5.0, -2.0]).collect();
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let features = RandomFeatures::draw(FeatureSpec::default(), &mut rng).unwrap();
    let basis = Basis::new(features, 0.002).unwrap().with_free().unwrap();
    assert!(basis.is_nodal());

    let parameters = vec![Parameter::RPv as usize, Parameter::RA as usize];
    let transforms = vec![Transform::Log; 2];
    let unknowns = Unknowns { initial_state, parameters, transforms, max_steps: vec![1.0; 2] };
    let n_u = unknowns.len(9);
    let root: Vec<f64> = (0..n_u * n_u)
        .map(|k| if k / n_u >= k % n_u { 0.1 / (1.0 + (k / n_u - k % n_u) as f64) } else { 0.0 })
        .collect();
    let data: Vec<Datum> = [(0.3, 1, 1.5, 0.5), (0.3, 4, -0.4, 2.5), (1.0, 4, 0.2, 2.5), (1.0, 5, 0.1, 4.0)]
        .map(|(s, state, off, weight)| Datum { s, state, value: start[state] + off, weight })
        .into_iter()
        .filter(|_| with_data)
        .collect();
    let problem = WindowProblem {
        model: &model,
        basis: &basis,
        start: &start,
        theta: &theta,
        unknowns: &unknowns,
        prior: Prior { root: &root, n_xi: n_u },
        data: &data,
        physics_weights: &[1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1e-3, 0.5, 1e-2],
        stopping: Stopping { max_iterations: 60, tolerance_mmhg: 1e-10 },
    };
    let (mut fast, mut reference) = (Solution::default(), Solution::default());
    CollocationSolver::default().solve(&problem, &mut fast);
    dense::solve(&problem, &mut reference);
    assert!(fast.account.converged && reference.account.converged, "{:?} {:?}", fast.account, reference.account);
    for (a, b) in fast.end.iter().zip(&reference.end) {
        // Weak equations leave directions that data of 1e-9 decide.
        assert!((a - b).abs() < 1e-5 * (1.0 + b.abs()), "{:?}\n{:?}", fast.end, reference.end);
    }
    // The free function is looked up inside the window as well, and does not start where it ended.
    let (mut phi, mut a, mut b) = (vec![0.0; basis.rank()], vec![0.0; 9], vec![0.0; 9]);
    fast.state_at(&model, &basis, 0.4, &mut phi, &mut a);
    reference.state_at(&model, &basis, 0.4, &mut phi, &mut b);
    assert!(a.iter().zip(&b).all(|(a, b)| (a - b).abs() < 1e-5 * (1.0 + b.abs())), "{a:?}\n{b:?}");
    if with_data {
        assert!(a[6].abs() > 1e-3, "the data move what is free: {}", a[6]);
    } else {
        assert!(a[6].abs() < 1e-6, "nothing moves what is believed to be zero: {}", a[6]);
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    #[test]
    fn the_solvers_agree_on_discrepancies(seed in 0_u64..1000, phase in 0.0..0.8, free: bool, with_data: bool) {
        compare_solvers(seed, phase, free, with_data);
    }
}

/// Manufactured: the linear law stands for the nonlinear one, and delta must be exactly the flow between them.
#[test]
fn tracked_delta_is_the_flow_that_is_missing() {
    let truth = Cvsim6 { pulmonary_resistance: PulmonaryResistance::Nonlinear, ..Cvsim6::default() };
    let mut config = Config::default();
    for (key, value) in [
        ("estimator.coupling", "independent"),
        ("estimator.estimate", "[]"),
        ("estimator.members", "4"),
        ("window.length_s", "0.01"),
        ("window.collocation_points", "10"),
        ("window.neurons", "10"),
        ("window.domain", "[-1.0, 1.0]"),
        ("window.data_weight", "100.0"),
        ("patient.initial_sd", "0.0"),
        ("discrepancy.q_pv", "{ form = \"tracked\", change = 1e4 }"),
    ]
    .map(|(key, value)| (key, value.to_owned()))
    {
        let set = format!("{key}={value}");
        config = with_set(&config, &set);
    }
    let mut settings = config.estimator_settings().unwrap();
    settings.channels.iter_mut().for_each(|c| c.noise_sd_mmhg = 1e-6);
    let mut patient =
        Simulator::new(truth, config.patient.initial_pressures().unwrap(), config.patient.theta(), vec![]);
    let mut ensemble = Ensemble::new(config.circulation().unwrap(), settings, &Serial).unwrap();
    let mut scratch = Snapshot::default();
    let (mut error, mut size) = (0.0, 0.0);
    for window in 0..170 {
        let mut observations = Vec::new();
        for i in 1..=10 {
            patient.advance_to(f64::from(window) * 0.01 + f64::from(i) * 0.001).unwrap();
            let state = patient.state().iter().enumerate();
            let seen = |(channel, &value)| Observation { s: f64::from(i) / 10.0, channel, value };
            observations.extend(state.map(seen));
        }
        ensemble.step(&observations, &Serial);
        if window < 85 {
            continue;
        }
        let summary = ensemble.summarise_at(1.0, &mut scratch, &Serial);
        let (x, q) = (patient.state(), patient.derived()[5]);
        let r_pv = config.patient.r_pv;
        let missing = q - (x[State::Pa as usize] - x[State::Pv as usize]) / r_pv;
        error += (summary[6].mean - missing).powi(2);
        size += missing.powi(2);
    }
    let relative = f64::sqrt(error / size);
    println!("relative L2 error of delta: {relative:.4}");
    assert!(relative < 0.03, "{relative}");
}

fn with_set(config: &Config, set: &str) -> Config {
    // Layers on top of what is there: rendered settings load to the same configuration.
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("settings.toml");
    std::fs::write(&path, toml::to_string(config).unwrap()).unwrap();
    Config::load_from(Some(&path), [], &[set.to_owned()]).unwrap().0
}

/// The band of what a discrepancy touches says so; without one it is all the members' own.
#[test]
fn the_models_part_of_the_band_is_published() {
    let sets = ["estimator.members=40", "discrepancy.q_pv={ form = \"tracked\", change = 200.0 }"];
    let with = sets.iter().fold(Config::default(), |config, set| with_set(&config, set));
    let without = with_set(&Config::default(), "estimator.members=40");
    for (config, discrepant) in [(with, true), (without, false)] {
        let settings = config.estimator_settings().unwrap();
        let mut ensemble = Ensemble::new(config.circulation().unwrap(), settings, &Serial).unwrap();
        for _ in 0..100 {
            ensemble.step(&[], &Serial);
        }
        let summary = ensemble.summarise_at(1.0, &mut Snapshot::default(), &Serial);
        let first = if discrepant { 7 } else { 6 };
        let (p_pa, q_pv) = (&summary[State::Pa as usize], &summary[first + 5]);
        assert_eq!(discrepant, q_pv.model_sd > 0.0, "{q_pv:?}");
        assert_eq!(discrepant, p_pa.model_sd > 0.0, "{p_pa:?}");
        for s in &summary {
            let squares = s.epistemic_sd.powi(2) + s.aleatoric_sd.powi(2) + s.model_sd.powi(2);
            assert!((s.sd.powi(2) - squares).abs() <= 1e-9 * squares, "the parts make the whole: {s:?}");
        }
        if discrepant {
            assert!(summary[6].epistemic_sd < 1e-6 * summary[6].sd, "delta itself is all model: {:?}", summary[6]);
            assert!(q_pv.model_sd > 0.5 * q_pv.epistemic_sd, "{q_pv:?}");
        }
    }
}

/// Without discrepancies the wrapped model is the model, digit by digit.
#[test]
fn no_discrepancy_changes_nothing() {
    let config = with_set(&Config::default(), "estimator.members=8");
    let settings = config.estimator_settings().unwrap();
    let mut plain = Ensemble::new(config.patient.model(), settings.clone(), &Serial).unwrap();
    let mut wrapped = Ensemble::new(config.circulation().unwrap(), settings, &Serial).unwrap();
    for k in 0..50 {
        let observations = [Observation { s: 0.5, channel: 1, value: 90.0 + f64::from(k) }];
        plain.step(&observations, &Serial);
        wrapped.step(&observations, &Serial);
    }
    assert_eq!(plain.members_at_end(), wrapped.members_at_end());
}

#[test]
fn explained_share_is_that_of_regression() {
    // y = 3 a + b with b orthogonal to a and the constant.
    let a = [1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0];
    let b = [1.0, 1.0, -1.0, -1.0, 1.0, 1.0, -1.0, -1.0];
    let y: Vec<f64> = a.iter().zip(&b).map(|(a, b)| 3.0 * a + b + 7.0).collect();
    let share = Explainers::new(&a, 8).share_of(&y);
    // R^2 = 0.9; adjusted for one variable and eight members.
    assert!((share - (1.0 - 0.1 * 7.0 / 6.0)).abs() < 1e-12, "{share}");
    assert!((Explainers::new(&a, 8).share_of(&a) - 1.0).abs() < 1e-12);
    assert_eq!(Explainers::new(&a, 8).share_of(&b), 0.0, "not negative where nothing is explained");
    assert_eq!(Explainers::new(&[], 8).share_of(&y), 0.0);
    // The same variable twice is one variable.
    let twice: Vec<f64> = a.iter().chain(&a).copied().collect();
    assert!((Explainers::new(&twice, 8).share_of(&y) - share).abs() < 1e-12);

    let matrix = correlation(&[a, b].concat(), 8);
    assert!((matrix[0] - 1.0).abs() < 1e-12 && matrix[1].abs() < 1e-12 && (matrix[3] - 1.0).abs() < 1e-12);
}

/// Wide distributions now and then draw a member whose features are all saturated.
#[test]
fn saturated_features_are_drawn_again() {
    let config = with_set(&Config::default(), "window.biases={ normal = [0.0, 30.0] }");
    let settings = config.estimator_settings().unwrap();
    let ensemble = Ensemble::new(config.circulation().unwrap(), settings, &Serial).unwrap();
    assert_eq!(ensemble.len(), 100);
    let hopeless = with_set(&Config::default(), "window.biases={ uniform = [100.0, 200.0] }");
    let settings = hopeless.estimator_settings().unwrap();
    let refused = Ensemble::new(hopeless.circulation().unwrap(), settings, &Serial).map(|_| ()).unwrap_err();
    assert!(refused.to_string().contains("span nothing"), "{refused}");
}
