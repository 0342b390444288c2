//! A second of a bed through the whole estimator, from samples to bands, on one thread: what a bed costs, by window,
//! members, channels and neurons, and what the filters of the textbooks cost beside it. Elements are patient-seconds.
#![allow(missing_docs, clippy::unwrap_used)]

use std::time::Duration;

use criterion::{BatchSize, BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use hemostream::edge::config::Config;
use hemostream::estimate::ensemble::Serial;
use hemostream::estimate::estimator::{Estimator, Input};
use hemostream::estimate::time::{ArrivalTime, EventTime};
use hemostream::estimate::window::RawSample;
use hemostream::model::Model;
use hemostream::model::cvsim6::Cvsim6;
use hemostream::model::discrepancy::Circulation;
use hemostream::model::truth::Simulator;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// Seconds before the one that is timed: what is estimated has been found by then.
const BEFORE_S: i64 = 5;

/// A bed that has been going for a while, and its next second.
struct Going {
    estimator: Estimator<Circulation>,
    next: Vec<(usize, RawSample)>,
}

fn going(sets: &[&str], rate_hz: i64) -> Going {
    let sets: Vec<String> = sets.iter().map(|s| (*s).to_owned()).collect();
    let config = Config::load_from(None, [], &sets).unwrap().0;
    let mut estimator = Estimator::new(config.circulation().unwrap(), config.estimator_settings().unwrap()).unwrap();
    let (model, channels) = (Cvsim6::default(), estimator.settings().channels.clone());
    let theta = model.default_parameters();
    let mut patient = Simulator::new(model, Cvsim6::initial_pressures(&theta).unwrap(), theta, vec![]);
    let (mut next, mut out) = (Vec::new(), Vec::new());
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    for k in 0..(BEFORE_S + 1) * rate_hz {
        let time = EventTime(k * 1_000_000_000 / rate_hz);
        patient.advance_to(time.as_s()).unwrap();
        for (channel, sensor) in channels.iter().enumerate() {
            let noise: f64 = StandardNormal.sample(&mut rng);
            let value = patient.state()[sensor.state] + sensor.noise_sd_mmhg * noise;
            let sample = RawSample { time, value };
            if k < BEFORE_S * rate_hz {
                let input = Input::Samples { channel, samples: vec![sample] };
                estimator.handle(input, ArrivalTime(time.0), &Serial, &mut out);
                out.clear();
            } else {
                next.push((channel, sample));
            }
        }
    }
    Going { estimator, next }
}

fn seconds(criterion: &mut Criterion) {
    let three = "observed=[\"p_a\", \"p_v\", \"p_pa\"]";
    let mut cases: Vec<(String, Vec<String>, i64)> = Vec::new();
    let mut add = |name: String, sets: &[&str], rate_hz: i64| {
        cases.push((name, sets.iter().map(|s| (*s).to_owned()).collect(), rate_hz));
    };
    for length_ms in [1, 2, 4, 8] {
        let window = format!("window.length_s={}", f64::from(length_ms) / 1e3);
        add(format!("coupled, windows of {length_ms} ms"), &[three, &window], 125);
    }
    let four = "window.length_s=0.004";
    let rate = "estimator.estimate=[\"r_pv\", \"c_a\", \"heart_rate\"]";
    add("coupled, 4 ms, heart rate too".to_owned(), &[three, four, rate], 125);
    for members in [10, 30, 300, 1000] {
        add(format!("coupled, 4 ms, {members} members"), &[three, four, &format!("estimator.members={members}")], 125);
    }
    for neurons in [3, 4, 6, 8, 10] {
        let (nodes, neurons) = (format!("window.collocation_points={neurons}"), format!("window.neurons={neurons}"));
        add(format!("coupled, 4 ms, {nodes}"), &[three, four, &nodes, &neurons], 125);
    }
    add("coupled, 4 ms, one channel".to_owned(), &["observed=[\"p_a\"]", four], 125);
    let six = "observed=[\"p_l\", \"p_a\", \"p_v\", \"p_r\", \"p_pa\", \"p_pv\"]";
    add("coupled, 4 ms, six channels".to_owned(), &[six, four], 125);
    let paper = ["window.length_s=0.001", "estimator.coupling=independent", "estimator.estimate=[\"r_pv\"]"];
    add("independent as in the paper, 500 Hz".to_owned(), &[six, paper[0], paper[1], paper[2]], 500);
    for rival in ["ukf", "enkf"] {
        add(format!("{rival}, windows of 4 ms"), &[three, four, &format!("estimator.coupling={rival}")], 125);
    }

    let mut group = criterion.benchmark_group("a second of a bed");
    group.throughput(Throughput::Elements(1));
    group.warm_up_time(Duration::from_millis(300)).measurement_time(Duration::from_secs(2)).sample_size(10);
    for (name, sets, rate_hz) in &cases {
        let sets: Vec<&str> = sets.iter().map(String::as_str).collect();
        let Going { estimator, next } = going(&sets, *rate_hz);
        group.bench_function(BenchmarkId::from_parameter(name), |bencher| {
            let run = |mut estimator: Estimator<Circulation>| {
                let mut out = Vec::new();
                for (channel, sample) in &next {
                    let input = Input::Samples { channel: *channel, samples: vec![*sample] };
                    estimator.handle(input, ArrivalTime(sample.time.0), &Serial, &mut out);
                    out.clear();
                }
                estimator
            };
            bencher.iter_batched(|| estimator.clone(), run, BatchSize::LargeInput);
        });
    }
    group.finish();
}

criterion_group!(benches, seconds);
criterion_main!(benches);
