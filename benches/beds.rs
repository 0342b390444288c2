//! What beds cost. A second of a bed through the whole estimator, from samples to bands, on one thread: by window, members,
//! channels and neurons, and what the filters of the textbooks cost beside it; and a second of many beds through the
//! service on all cores. Elements are patient-seconds. Draws `cost.svg` beside the figures of criterion.
#![allow(missing_docs, clippy::unwrap_used)]

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use criterion::{BatchSize, BenchmarkId, Criterion, Throughput};
use hemostream::edge::config::Config;
use hemostream::estimate::ensemble::Serial;
use hemostream::estimate::estimator::{Estimator, Input, Output};
use hemostream::estimate::time::{ArrivalTime, EventTime};
use hemostream::estimate::window::RawSample;
use hemostream::model::Model;
use hemostream::model::cvsim6::Cvsim6;
use hemostream::model::discrepancy::Circulation;
use hemostream::model::truth::Simulator;
use hemostream::report::plot::{Chart, Colour, Figure};
use hemostream::runtime::bed::{Bed, Health, Task};
use hemostream::runtime::clock::Clock;
use hemostream::runtime::service::{Event, Limits, Service, Sink};
use hemostream::runtime::workers::Workers;
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

const GROUP: &str = "a second of a bed";
const SERVICE: &str = "a second of the service";
const THREE: &str = "observed=[\"p_a\", \"p_v\", \"p_pa\"]";
const FOUR: &str = "window.length_s=0.004";

/// What the cost is drawn against, with the values measured.
const WINDOWS_MS: [u32; 5] = [1, 2, 4, 8, 16];
const MEMBERS: [u32; 6] = [10, 30, 100, 200, 300, 1000];
const NEURONS: [u32; 6] = [3, 4, 5, 6, 8, 10];
const CHANNELS: [&str; 6] = ["p_a", "p_v", "p_pa", "p_r", "p_l", "p_pv"];
const BEDS: [usize; 6] = [1, 3, 10, 30, 100, 150];

fn seconds(criterion: &mut Criterion) {
    let mut cases: Vec<(String, Vec<String>, i64)> = Vec::new();
    let mut add = |name: String, sets: &[&str], rate_hz: i64| {
        cases.push((name, sets.iter().map(|s| (*s).to_owned()).collect(), rate_hz));
    };
    for length_ms in WINDOWS_MS {
        let window = format!("window.length_s={}", f64::from(length_ms) / 1e3);
        add(format!("windows of {length_ms} ms"), &[THREE, &window], 125);
    }
    let rate = "estimator.estimate=[\"r_pv\", \"c_a\", \"heart_rate\"]";
    add("heart rate too".to_owned(), &[THREE, FOUR, rate], 125);
    for members in MEMBERS {
        add(format!("{members} members"), &[THREE, FOUR, &format!("estimator.members={members}")], 125);
    }
    for neurons in NEURONS {
        let sets = [format!("window.collocation_points={neurons}"), format!("window.neurons={neurons}")];
        add(format!("{neurons} neurons"), &[THREE, FOUR, &sets[0], &sets[1]], 125);
    }
    for channels in 1..=CHANNELS.len() {
        let observed = format!("observed={:?}", &CHANNELS[..channels]);
        add(format!("{channels} channels"), &[&observed, FOUR], 125);
    }
    let six = format!("observed={CHANNELS:?}");
    let paper = ["window.length_s=0.001", "estimator.coupling=independent", "estimator.estimate=[\"r_pv\"]"];
    add("independent as in the paper, 500 Hz".to_owned(), &[&six, paper[0], paper[1], paper[2]], 500);
    for rival in ["ukf", "enkf"] {
        add(rival.to_owned(), &[THREE, FOUR, &format!("estimator.coupling={rival}")], 125);
    }

    let mut group = criterion.benchmark_group(GROUP);
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

/// Counts windows.
#[derive(Default)]
struct Counter(AtomicUsize);

impl Sink for Counter {
    fn put(&self, _: &Bed, outputs: &[Output], _: Option<&Health>) {
        let windows = outputs.iter().filter(|output| matches!(output, Output::Window(_))).count();
        self.0.fetch_add(windows, Ordering::Release);
    }

    fn wants_members(&self, _: &str) -> bool {
        false
    }

    fn lost(&self, _: &str) {}
}

/// Beds that all get their blocks of 40 ms at the same moment, the next as soon as all windows of the last are solved.
fn service(criterion: &mut Criterion) {
    const BLOCK: usize = 5;
    // A second passes as soon as it can: nobody is late.
    let sets = [THREE, FOUR, "window.allowed_lateness_s=600"].map(str::to_owned);
    let config = Config::load_from(None, [], &sets).unwrap().0;
    let (model, settings) = (Cvsim6::default(), config.estimator_settings().unwrap());
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
    let clock = Clock::start();
    let mut group = criterion.benchmark_group(SERVICE);
    group.warm_up_time(Duration::from_millis(300)).measurement_time(Duration::from_secs(5)).sample_size(10);
    for beds in BEDS {
        group.throughput(Throughput::Elements(beds as u64));
        let sink = Arc::new(Counter::default());
        let limits = Limits {
            max_beds: beds,
            forget_after: Duration::MAX,
            queue_tasks: 4096,
            report_every: Duration::from_secs(3600),
        };
        let (workers, said) = (Arc::new(Workers::start(0).unwrap()), Arc::clone(&sink));
        let _inside = runtime.enter();
        let (service, inlet) =
            Service::new(config.circulation().unwrap(), settings.clone(), limits, workers, said, clock).unwrap();
        let task = runtime.spawn(service.run());
        let theta = model.default_parameters();
        let mut patient = Simulator::new(model, Cvsim6::initial_pressures(&theta).unwrap(), theta, vec![]);
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let (mut sample, mut block) = (0, 0);
        let mut second = || {
            let mut spent = Duration::ZERO;
            for _ in 0..25 {
                let mut samples = vec![Vec::new(); settings.channels.len()];
                for _ in 0..BLOCK {
                    let time = EventTime(sample * 8_000_000);
                    patient.advance_to(time.as_s()).unwrap();
                    for (sensor, samples) in settings.channels.iter().zip(&mut samples) {
                        let noise: f64 = StandardNormal.sample(&mut rng);
                        let value = patient.state()[sensor.state] + sensor.noise_sd_mmhg * noise;
                        samples.push(RawSample { time, value });
                    }
                    sample += 1;
                }
                let started = clock.now();
                for bed in 0..beds {
                    for (channel, samples) in samples.iter().enumerate() {
                        let task = Task::Samples { channel, sequence: block, last: false, samples: samples.clone() };
                        inlet.offer(Event::Task { bed: format!("bed{bed}"), task });
                    }
                }
                block += 1;
                // The grid begins with the first sample: the window after the last sample is not closed yet.
                let expected = beds * (2 * (usize::try_from(sample).unwrap() - 1)).max(1);
                while sink.0.load(Ordering::Acquire) < expected {
                    std::thread::sleep(Duration::from_micros(100));
                }
                spent += Duration::from_nanos(u64::try_from(clock.now().ns_since(started)).unwrap());
            }
            spent
        };
        // What is estimated is found first.
        (0..BEFORE_S).for_each(|_| _ = second());
        group.bench_function(BenchmarkId::from_parameter(format!("{beds} beds")), |bencher| {
            bencher.iter_custom(|seconds| (0..seconds).map(|_| second()).sum());
        });
        runtime.block_on(async {
            inlet.stop().await;
            let account = task.await.unwrap();
            assert_eq!(account.lost, 0, "all of it was done");
        });
    }
    group.finish();
}

/// Milliseconds per patient-second and their 95 % interval, as criterion has kept them; None where that was not run.
fn measured(group: &str, name: &str, patients: f64) -> Option<(f64, f64)> {
    let path = figures().join(group).join(name).join("new/estimates.json");
    let estimates: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(path).ok()?).ok()?;
    let interval = &estimates["mean"]["confidence_interval"];
    let per_second_ms = |v: &serde_json::Value| Some(v.as_f64()? / 1e6 / patients);
    let (low, high) = (per_second_ms(&interval["lower_bound"])?, per_second_ms(&interval["upper_bound"])?);
    Some((0.5 * (low + high), 0.5 * (high - low)))
}

/// Where criterion keeps its figures.
fn figures() -> PathBuf {
    let target = std::env::var_os("CARGO_TARGET_DIR").map_or_else(|| PathBuf::from("target"), PathBuf::from);
    std::env::var_os("CRITERION_HOME").map_or_else(|| target.join("criterion"), PathBuf::from)
}

fn draw() {
    let points = |group: &str, values: &[usize], unit: &str, of_all: bool| -> Vec<(f64, f64, f64)> {
        let point = |value: &usize| {
            let patients = if of_all { *value as f64 } else { 1.0 };
            let (mean, half) = measured(group, &format!("{value} {unit}"), patients)?;
            Some((*value as f64, mean, half))
        };
        values.iter().filter_map(point).collect()
    };
    let whole = |values: &[u32]| values.iter().map(|v| *v as usize).collect::<Vec<_>>();
    let members = points(GROUP, &whole(&MEMBERS), "members", false);
    let windows: Vec<_> = WINDOWS_MS
        .iter()
        .filter_map(|ms| {
            let (mean, half) = measured(GROUP, &format!("windows of {ms} ms"), 1.0)?;
            Some((f64::from(*ms), mean, half))
        })
        .collect();
    let chart = |x: &str, points: Vec<(f64, f64, f64)>, log: bool| {
        let top = points.iter().map(|(_, y, _)| *y).fold(0.0, f64::max);
        let chart = Chart::new("", x, "ms per patient-second").log(log, log).error_bars("", points, Colour::Blue);
        if log { chart } else { chart.y_range(0.0, 1.15 * top) }
    };
    let mut of_members = chart("members", members.clone(), true);
    // In proportion to the members, through the hundred of the default.
    if let Some((_, hundred, _)) = members.iter().find(|(m, ..)| (*m - 100.0).abs() < 0.5) {
        let line = [10.0, 1000.0].map(|m| (m, hundred * m / 100.0)).to_vec();
        of_members = of_members.dashed("in proportion", line, Colour::Grey);
    }
    let channels: Vec<usize> = (1..=CHANNELS.len()).collect();
    let figure = Figure::new("", 3)
        .panel(of_members)
        .panel(chart("window (ms)", windows, false))
        .panel(chart("neurons and nodes", points(GROUP, &whole(&NEURONS), "neurons", false), true))
        .panel(chart("channels", points(GROUP, &channels, "channels", false), false))
        .panel(chart("beds, on all cores", points(SERVICE, &BEDS, "beds", true), false));
    figure.write(&figures(), "cost").unwrap();
}

fn main() {
    let mut criterion = Criterion::default().configure_from_args();
    seconds(&mut criterion);
    service(&mut criterion);
    criterion.final_summary();
    draw();
}
