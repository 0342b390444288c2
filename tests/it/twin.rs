//! Twin experiments: a patient whose truth is known, watched through noisy sensors.

use hemostream::estimate::ensemble::Serial;
use hemostream::estimate::estimator::{Estimate, Estimator, Input, Output};
use hemostream::estimate::settings::{
    ChannelSettings, CouplingKind, Drift, EstimatorSettings, RowWeights, WindowSettings,
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
        initial_guess_sd: 0.3,
        initial_state_sd: initial_state.iter().map(|p| 0.04 * p).collect(),
        initial_state,
        features: FeatureSpec::default(),
        window: WindowSettings {
            length_ns: 5_000_000,
            allowed_lateness_ns: 200_000_000,
            forecast_limit_ns: 10_000_000_000,
        },
        weights: RowWeights { physics: vec![1.0; 6], data: 1.0, parameter: 10.0 },
        drift: Drift { parameters: 0.02, pressures_mmhg: 0.01, inflation: 1.0 },
        stopping: Stopping::default(),
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
    let estimates: Vec<Estimate> = outputs
        .into_iter()
        .filter_map(|o| if let Output::Estimate(e) = o { Some(e) } else { None })
        .collect();
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

#[test]
#[ignore]
fn explore() {
    let seeds: u64 = std::env::var("SEEDS").map_or(4, |v| v.parse().unwrap());
    let get = |name: &str, default: f64| std::env::var(name).map_or(default, |v| v.parse().unwrap());
    let run_one = |seed: u64| {
        let mut s = settings(CouplingKind::Coupled, &[State::A, State::Pa], &[Parameter::RPv, Parameter::CA]);
        s.drift = Drift { parameters: get("PD", 0.02), pressures_mmhg: get("XD", 0.01), inflation: get("INF", 1.0) };
        s.window.length_ns = (get("H", 0.005) * 1e9) as i64;
        s.seed = seed;
        s.members = get("M", 100.0) as usize;
        let start = std::time::Instant::now();
        let run = watch(&s, get("T", 30.0), 200.0, 100 + seed);
        let last = run.estimates.last().unwrap();
        let p: Vec<f64> = last.parameters.iter().map(|(p, _)| p.summary.mean / Cvsim6::default().parameters()[p.parameter].default).collect();
        let cov: Vec<f64> = last.parameters.iter().map(|(p,_)| p.summary.sd/p.summary.mean).collect();
        let at5 = run.estimates.iter().find(|e| e.time.as_s() > 5.0).unwrap();
        let p5: Vec<f64> = at5.parameters.iter().map(|(p, _)| p.summary.mean / Cvsim6::default().parameters()[p.parameter].default).collect();
        (run.score(0.0), run.score(5.0), p, cov, p5, start.elapsed().as_secs_f64())
    };
    let results: Vec<_> = std::thread::scope(|scope| {
        let handles: Vec<_> = (0..2).map(|w| scope.spawn(move || (0..seeds).filter(|s| s % 2 == w).map(run_one).collect::<Vec<_>>())).collect();
        handles.into_iter().flat_map(|h| h.join().unwrap()).collect()
    });
    for (all, late, p, cov, p5, wall) in &results {
        print!("rmse "); late[..6].iter().for_each(|(r, _)| print!("{r:.3} "));
        print!("| cov all "); all[..6].iter().for_each(|(_, c)| print!("{:.0} ", 100.0 * c));
        print!("| late "); late[..6].iter().for_each(|(_, c)| print!("{:.0} ", 100.0 * c));
        println!("| p5 {p5:.3?} p {p:.3?} sd {cov:.3?} wall {wall:.1}");
    }
    for q in 0..18 {
        let mean: f64 = results.iter().map(|r| r.1[q].1).sum::<f64>() / results.len() as f64;
        print!("{:.1} ", 100.0 * mean);
    }
    println!();
}
