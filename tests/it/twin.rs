//! Twin experiments: a patient whose truth is known, watched through noisy sensors.

use hemostream::estimate::ensemble::Serial;
use hemostream::estimate::estimator::{Estimate, Estimator, Input, Output};
use hemostream::estimate::settings::{
    Adaptation, Belief, ChannelSettings, CouplingKind, Drift, EstimatorSettings, LiveSettings, RowWeights,
    WindowSettings,
};
use hemostream::estimate::time::{ArrivalTime, EventTime, ns_from_s};
use hemostream::estimate::window::RawSample;
use hemostream::model::Model;
use hemostream::model::cvsim6::{Cvsim6, Parameter, State};
use hemostream::model::truth::Simulator;
use hemostream::xtfc::features::FeatureSpec;
use hemostream::xtfc::problem::Stopping;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

pub const NOISE: [f64; 6] = [2.07, 2.06, 0.146, 0.408, 0.40, 0.242];

/// Settings for the healthy patient; parameters start 50 % wrong.
pub fn settings(coupling: CouplingKind, observed: &[State], estimate: &[Parameter]) -> EstimatorSettings {
    let model = Cvsim6::default();
    let mut theta = model.default_parameters();
    let initial_state = Cvsim6::initial_pressures(&theta).unwrap();
    estimate.iter().for_each(|&p| theta[p as usize] *= 1.5);
    let channel = |&state: &State| ChannelSettings {
        state: state as usize,
        noise_sd_mmhg: NOISE[state as usize],
        plausible_mmhg: (-50.0, 350.0),
    };
    EstimatorSettings {
        coupling,
        estimate: estimate.iter().map(|&p| p as usize).collect(),
        members: 100,
        seed: 1,
        theta,
        beliefs: Belief::of_all(&model, 0.3, 0.02),
        initial_state_sd: initial_state.iter().map(|p| 0.04 * p).collect(),
        initial_state,
        features: FeatureSpec::default(),
        window: WindowSettings {
            length_ns: 5_000_000,
            allowed_lateness_ns: 200_000_000,
            forecast_limit_ns: 10_000_000_000,
        },
        weights: RowWeights { physics: vec![1.0; 6], data: 1.0, parameter: 10.0 },
        drift: Drift { states: vec![0.01; 6], inflation: 1.0 },
        adaptation: Adaptation::OFF,
        live: LiveSettings::default(),
        stopping: Stopping::default(),
        instructions: hemostream::model::lanes::InstructionSet::default(),
        channels: observed.iter().map(channel).collect(),
        aleatoric_sd_mmhg: NOISE.to_vec(),
        publish_period_ns: 20_000_000,
    }
}

/// What a run left behind, at the published times.
pub struct Run {
    pub estimates: Vec<Estimate>,
    /// States then derived quantities, at the same times.
    pub truth: Vec<Vec<f64>>,
}

/// Watches the default patient for `seconds` at `rate_hz`.
pub fn watch(settings: &EstimatorSettings, seconds: f64, rate_hz: f64, noise_seed: u64) -> Run {
    let model = Cvsim6::default();
    let theta = model.default_parameters();
    let x0 = Cvsim6::initial_pressures(&theta).unwrap();
    let mut patient = Simulator::new(model, x0, theta, vec![]);
    let mut reference = patient.clone();
    let mut rng = ChaCha8Rng::seed_from_u64(noise_seed);
    let mut estimator = Estimator::new(model, settings.clone()).unwrap();
    let mut outputs = Vec::new();
    for k in 0..=(seconds * rate_hz) as usize {
        let t = k as f64 / rate_hz;
        patient.advance_to(t).unwrap();
        let time = EventTime::from_s(t);
        for (channel, sensor) in settings.channels.iter().enumerate() {
            let e: f64 = StandardNormal.sample(&mut rng);
            let value = patient.state()[sensor.state] + sensor.noise_sd_mmhg * e;
            let input = Input::Samples { channel, samples: vec![RawSample { time, value }] };
            estimator.handle(input, ArrivalTime(ns_from_s(t)), &Serial, &mut outputs);
        }
    }
    estimator.handle(Input::End, ArrivalTime(ns_from_s(seconds)), &Serial, &mut outputs);
    let estimates: Vec<Estimate> =
        outputs.into_iter().filter_map(|o| if let Output::Estimate(e) = o { Some(e) } else { None }).collect();
    let truth = estimates
        .iter()
        .map(|e| {
            reference.advance_to(e.time.as_s()).unwrap();
            let mut row = reference.state().to_vec();
            row.extend(reference.derived());
            row
        })
        .collect();
    Run { estimates, truth }
}

impl Run {
    /// Root mean square error and coverage of the 90 % band per quantity, after `from_s`.
    pub fn score(&self, from_s: f64) -> Vec<(f64, f64)> {
        let rows: Vec<_> = self.estimates.iter().zip(&self.truth).filter(|(e, _)| e.time.as_s() > from_s).collect();
        (0..self.truth[0].len())
            .map(|q| {
                let square: f64 = rows.iter().map(|(e, t)| (e.quantities[q].mean - t[q]).powi(2)).sum();
                let inside = rows.iter().filter(|(e, t)| (e.quantities[q].q05..=e.quantities[q].q95).contains(&t[q]));
                let n = rows.len() as f64;
                ((square / n).sqrt(), inside.count() as f64 / n)
            })
            .collect()
    }
}

/// Scenario 6 of the paper from a 50 % wrong start. One run says little about coverage (the error of the blood volume
/// hardly changes within it), so it is judged over runs.
#[test]
fn coupled_finds_resistance_and_compliance_from_two_channels() {
    let model = Cvsim6::default();
    let seeds = 12;
    let mut mean_coverage = [0.0; 6];
    for seed in 0..seeds {
        let mut settings = settings(CouplingKind::Coupled, &[State::A, State::Pa], &[Parameter::RPv, Parameter::CA]);
        settings.seed = seed;
        let run = watch(&settings, 5.0, 200.0, 50 + seed);
        let last = run.estimates.last().unwrap();
        for (p, _) in &last.parameters {
            let off = p.summary.mean / model.parameters()[p.parameter].default - 1.0;
            let name = model.parameters()[p.parameter].name;
            println!("seed {seed} {name}: {:+.1} % (sd {:.1} %)", 100.0 * off, 100.0 * p.summary.sd / p.summary.mean);
            assert!(off.abs() < 0.05, "seed {seed}, parameter {name}: {off}");
            assert!(p.identifiability > 0.95, "learnt from data: {}", p.identifiability);
        }
        for (q, (rmse, coverage)) in run.score(1.0).iter().enumerate().take(6) {
            println!("seed {seed} state {q}: rms {rmse:.3} mmHg, coverage {coverage:.2}");
            assert!(*rmse < NOISE[q], "seed {seed} state {q}: {rmse}");
            mean_coverage[q] += coverage / seeds as f64;
        }
    }
    println!("coverage over runs: {mean_coverage:.2?}");
    // Nominal 0.9; the assumed drift, which this truth does not have, makes for a little more.
    assert!(mean_coverage.iter().all(|c| (0.8..=1.0).contains(c)), "{mean_coverage:.2?}");
}

/// The paper's own coupling on the paper's own setting, scenario 1: the band is wide because the data cannot correct
/// the blood volume, and the parameter is still found.
#[test]
fn independent_finds_the_resistance_and_keeps_the_spread_of_its_start() {
    use State::{A, L, Pa, Pv, R, V};
    let mut settings = settings(CouplingKind::Independent, &[L, A, V, R, Pa, Pv], &[Parameter::RPv]);
    settings.members = 20;
    settings.window.length_ns = 1_000_000;
    let run = watch(&settings, 3.0, 1000.0, 5);
    let last = run.estimates.last().unwrap();
    let (r_pv, _) = last.parameters[0];
    let truth = Cvsim6::default().parameters()[r_pv.parameter].default;
    assert!((r_pv.summary.mean / truth - 1.0).abs() < 0.1, "{}", r_pv.summary.mean / truth);
    let p_a = last.quantities[A as usize];
    assert!(p_a.epistemic_sd > 0.3, "{p_a:?}");
    assert!((p_a.aleatoric_sd - NOISE[A as usize]).abs() < 1e-12);
    assert!((p_a.sd.powi(2) - p_a.epistemic_sd.powi(2) - p_a.aleatoric_sd.powi(2)).abs() < 1e-9);
}

/// All sixteen physical parameters and the intrathoracic pressure at once: bounded, finite, and the data still fit.
#[test]
fn every_parameter_can_be_estimated() {
    let model = Cvsim6::default();
    let physical = |p: &usize| model.parameters()[*p].estimable && !model.parameters()[*p].name.starts_with("delta_");
    let all: Vec<usize> = (0..model.parameters().len()).filter(physical).collect();
    assert_eq!(all.len(), 18, "sixteen physical ones, p_th and the beat phase");
    let mut settings = settings(CouplingKind::Coupled, &[State::A, State::V, State::Pa], &[]);
    settings.estimate = all.clone();
    settings.beliefs.iter_mut().for_each(|b| b.sd = 0.05);
    settings.members = 60;
    settings.theta[Parameter::RPv as usize] *= 1.1;
    let run = watch(&settings, 2.0, 125.0, 9);
    let last = run.estimates.last().unwrap();
    assert_eq!(last.parameters.len(), all.len());
    for (p, _) in &last.parameters {
        let (low, high) = model.parameters()[p.parameter].bounds;
        assert!(p.summary.q05 >= low && p.summary.q95 <= high && p.summary.sd.is_finite());
    }
    let (rmse, _) = run.score(1.0)[State::A as usize];
    assert!(rmse < NOISE[State::A as usize], "{rmse}");
}

/// Without samples an estimate is a forecast: it says so, and its band grows.
#[test]
fn a_gap_is_forecast_with_growing_bands() {
    let mut settings = settings(CouplingKind::Coupled, &[State::A, State::Pa], &[Parameter::RPv]);
    // By quantiles, the band of few members is that of those in its tails.
    settings.members = 200;
    let model = Cvsim6::default();
    let theta = model.default_parameters();
    let mut patient = Simulator::new(model, Cvsim6::initial_pressures(&theta).unwrap(), theta, vec![]);
    let mut estimator = Estimator::new(model, settings).unwrap();
    let mut outputs = Vec::new();
    for k in 0..=600_u32 {
        let t = f64::from(k) * 0.005;
        patient.advance_to(t).unwrap();
        let now = ArrivalTime(ns_from_s(t));
        // Both channels are gone from 1 to 3 s.
        if !(1.0..3.0).contains(&t) {
            for (channel, state) in [(0, State::A), (1, State::Pa)] {
                let value = patient.state()[state as usize];
                let samples = vec![RawSample { time: EventTime::from_s(t), value }];
                estimator.handle(Input::Samples { channel, samples }, now, &Serial, &mut outputs);
            }
        }
        estimator.handle(Input::Tick, now, &Serial, &mut outputs);
    }
    let estimates: Vec<&Estimate> =
        outputs.iter().filter_map(|o| if let Output::Estimate(e) = o { Some(e) } else { None }).collect();
    // The same phase of the beat, before the gap and at its end (72 bpm).
    let at = |t: f64| estimates.iter().find(|e| (e.time.as_s() - t).abs() < 1e-6).unwrap();
    let (before, late) = (at(0.98), at(2.64));
    assert!(before.since_data_ns < 10_000_000, "{}", before.since_data_ns);
    assert!((late.since_data_ns - 1_645_000_000).abs() < 10_000_000, "{}", late.since_data_ns);
    let band = |e: &Estimate| e.quantities[State::A as usize].q95 - e.quantities[State::A as usize].q05;
    assert!(band(late) > band(before), "the band grows without data: {} {}", band(before), band(late));
    let gaps = outputs.iter().filter(|o| matches!(o, Output::Notice(n) if n.kind.name() == "gap")).count();
    let back = outputs.iter().filter(|o| matches!(o, Output::Notice(n) if n.kind.name() == "recovered")).count();
    assert_eq!((gaps, back), (2, 2));
}
