//! `coupled` on a linear model with Gaussian noise, against the exact Kalman filter.

use hemostream::estimate::ensemble::{Ensemble, Observation, Serial};
use hemostream::estimate::settings::{
    Adaptation, Belief, ChannelSettings, CouplingKind, Drift, EstimatorSettings, LiveSettings, RowWeights,
    WindowSettings,
};
use hemostream::model::{Model, ParameterInfo, Quantity, Transform};
use hemostream::xtfc::features::FeatureSpec;
use hemostream::xtfc::problem::Stopping;
use nalgebra::{Matrix3, RowVector3, Vector3};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// `dx/dt = -2 x + y + u`, `dy/dt = -x - 0.5 y`, with a constant unknown input `u`.
#[derive(Clone)]
struct Linear;

const STATES: &[Quantity] = &[Quantity { name: "x", unit: "mmHg" }, Quantity { name: "y", unit: "mmHg" }];
const PARAMETERS: &[ParameterInfo] = &[ParameterInfo {
    name: "u",
    unit: "mmHg/s",
    default: 1.0,
    bounds: (-1e6, 1e6),
    transform: Transform::Linear { scale: 1.0 },
    estimable: true,
}];

impl Model for Linear {
    type Lanes = hemostream::model::lanes::NoLanes;

    fn states(&self) -> &[Quantity] {
        STATES
    }
    fn parameters(&self) -> &[ParameterInfo] {
        PARAMETERS
    }
    fn derived(&self) -> &[Quantity] {
        &[]
    }
    fn rhs(&self, _: f64, x: &[f64], theta: &[f64], dx: &mut [f64]) {
        dx[0] = -2.0 * x[0] + x[1] + theta[0];
        dx[1] = -x[0] - 0.5 * x[1];
    }
    fn rhs_and_state_jacobian(&self, t: f64, x: &[f64], theta: &[f64], dx: &mut [f64], dfdx: &mut [f64]) {
        self.rhs(t, x, theta, dx);
        dfdx.copy_from_slice(&[-2.0, 1.0, -1.0, -0.5]);
    }
    fn parameter_jacobian(&self, _: f64, _: &[f64], _: &[f64], which: &[usize], dfdtheta: &mut [f64]) {
        dfdtheta.fill(0.0);
        if which == [0] {
            dfdtheta[0] = 1.0;
        }
    }
    fn derive(&self, _: f64, _: &[f64], _: &[f64], _: &mut [f64]) {}
    fn advance(&self, _: f64, _: &mut [f64]) {}
    fn next_corner(&self, _: f64, _: f64, _: &[f64]) -> Option<f64> {
        None
    }
}

const H: f64 = 0.1;
const NOISE: f64 = 0.3;
const DRIFT_X: f64 = 0.2;
const DRIFT_U: f64 = 0.5;

fn settings(members: usize) -> EstimatorSettings {
    EstimatorSettings {
        coupling: CouplingKind::Coupled,
        estimate: vec![0],
        members,
        seed: 7,
        theta: vec![1.0],
        beliefs: Belief::of_all(&Linear, 2.0, DRIFT_U),
        initial_state: vec![1.0, -0.5],
        initial_state_sd: vec![1.0, 0.8],
        features: FeatureSpec::default(),
        window: WindowSettings {
            length_ns: 100_000_000,
            allowed_lateness_ns: 200_000_000,
            forecast_limit_ns: 1_000_000_000,
        },
        weights: RowWeights { physics: vec![1e4; 2], data: 1.0, parameter: 10.0 },
        drift: Drift { states: vec![DRIFT_X; 2], inflation: 1.0 },
        adaptation: Adaptation::OFF,
        live: LiveSettings::default(),
        stopping: Stopping::default(),
        instructions: hemostream::model::lanes::InstructionSet::default(),
        channels: vec![ChannelSettings { state: 0, noise_sd_mmhg: NOISE, plausible_mmhg: (-1e3, 1e3) }],
        aleatoric_sd_mmhg: vec![NOISE, 0.0],
        publish_period_ns: 100_000_000,
    }
}

/// Transition of `(x, y, u)` over `dt`.
fn transition(dt: f64) -> Matrix3<f64> {
    (Matrix3::new(-2.0, 1.0, 1.0, -1.0, -0.5, 0.0, 0.0, 0.0, 0.0) * dt).exp()
}

/// Noise is drawn with exact moments, so that forty members are enough; what is left is that X-TFC weighs the physics,
/// rather than imposing it.
#[test]
fn coupled_and_its_rivals_are_the_kalman_filter_of_a_linear_model() {
    for coupling in [CouplingKind::Coupled, CouplingKind::Enkf, CouplingKind::Ukf] {
        compare_with_the_kalman_filter(coupling);
    }
}

fn compare_with_the_kalman_filter(coupling: CouplingKind) {
    let members = 40;
    let settings = EstimatorSettings { coupling, ..settings(members) };
    let mut ensemble = Ensemble::new(Linear, settings, &Serial).unwrap();
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
    let mut truth = Vector3::new(0.0, 0.5, 2.5);
    let mut mean = Vector3::new(1.0, -0.5, 1.0);
    let mut covariance = Matrix3::from_diagonal(&Vector3::new(1.0, 0.64, 4.0));
    let drift = Matrix3::from_diagonal(&Vector3::new(DRIFT_X * DRIFT_X, DRIFT_X * DRIFT_X, DRIFT_U * DRIFT_U)) * H;
    let observe = RowVector3::new(1.0, 0.0, 0.0);

    for window in 0..25 {
        truth += Vector3::new(DRIFT_X * normal(), DRIFT_X * normal(), DRIFT_U * normal()) * H.sqrt();
        covariance += drift;
        // Two samples within the window, none in every fifth.
        let times: &[f64] = if window % 5 == 4 { &[] } else { &[0.4, 1.0] };
        let (mut observations, mut done) = (Vec::new(), 0.0);
        for &s in times.iter().chain(std::iter::once(&1.0)) {
            let step = transition((s - done) * H);
            done = s;
            truth = step * truth;
            mean = step * mean;
            covariance = step * covariance * step.transpose();
            if observations.len() < times.len() {
                let value = truth[0] + NOISE * normal();
                observations.push(Observation { s, channel: 0, value });
                let innovation_variance = (observe * covariance * observe.transpose())[0] + NOISE * NOISE;
                let gain = covariance * observe.transpose() / innovation_variance;
                mean += gain * (value - mean[0]);
                covariance = (Matrix3::identity() - gain * observe) * covariance;
            }
        }
        let report = ensemble.step(&observations, &Serial);
        assert_eq!((report.solved, report.not_converged), (members, 0));

        let values = ensemble.members_at_end();
        for i in 0..3 {
            let column: Vec<f64> = values.iter().skip(i).step_by(3).copied().collect();
            let m = column.iter().sum::<f64>() / members as f64;
            let sd = covariance[(i, i)].sqrt();
            let off = (m - mean[i]).abs() / sd;
            assert!(off < 1e-4, "{coupling:?}, window {window}, mean {i}: {m} against {} (sd {sd})", mean[i]);
            for j in 0..=i {
                let other: Vec<f64> = values.iter().skip(j).step_by(3).copied().collect();
                let mj = other.iter().sum::<f64>() / members as f64;
                let sample: f64 =
                    column.iter().zip(&other).map(|(a, b)| (a - m) * (b - mj)).sum::<f64>() / (members - 1) as f64;
                let scale = (covariance[(i, i)] * covariance[(j, j)]).sqrt();
                let error = (sample - covariance[(i, j)]).abs() / scale;
                let expected = covariance[(i, j)];
                assert!(error < 1e-4, "{coupling:?}, window {window}, covariance {i},{j}: {sample} against {expected}");
            }
        }
    }
}
