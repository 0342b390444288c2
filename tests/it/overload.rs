//! Fewer members when the machine cannot keep up, and all of them again when it can.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use hemostream::edge::config::Config;
use hemostream::estimate::ensemble::{Ensemble, Serial};
use hemostream::estimate::estimator::{NoticeKind, Output};
use hemostream::estimate::settings::{CouplingKind, EstimatorSettings};
use hemostream::estimate::statistics::mean_and_sd;
use hemostream::estimate::time::EventTime;
use hemostream::estimate::window::RawSample;
use hemostream::model::cvsim6::{Cvsim6, Parameter, State};
use hemostream::runtime::bed::{Bed, Health, Task};
use hemostream::runtime::clock::Clock;
use hemostream::runtime::service::{Event, Limits, Service, Sink};
use hemostream::runtime::workers::Workers;

/// Longest wait for the service.
const PATIENCE: Duration = Duration::from_secs(30);

/// States and estimated parameters, one row each over the members.
fn rows(ensemble: &Ensemble<Cvsim6>) -> Vec<Vec<f64>> {
    let (values, m) = (ensemble.members_at_end(), ensemble.len());
    let n = values.len() / m;
    (0..n).map(|k| values.iter().skip(k).step_by(n).copied().collect()).collect()
}

#[test]
fn mean_and_spread_are_kept_when_members_rest_and_when_they_come_back() {
    let settings = super::twin::settings(CouplingKind::Coupled, &[State::A, State::Pa], &[Parameter::RPv]);
    let settings = EstimatorSettings { members: 100, ..settings };
    let mut ensemble = Ensemble::new(Cvsim6::default(), settings, &Serial).unwrap();
    (0..40).for_each(|_| _ = ensemble.step(&[], &Serial));
    let before = rows(&ensemble);
    for (members, expected) in [(50, 56), (20, 24), (3, 16), (60, 64), (1000, 100)] {
        assert!(ensemble.set_members(members));
        assert_eq!(ensemble.len(), expected);
        assert!(!ensemble.set_members(members), "that is what there are");
        let now = rows(&ensemble);
        for (k, (before, now)) in before.iter().zip(&now).enumerate() {
            let ((mean, sd), (new_mean, new_sd)) = (mean_and_sd(before), mean_and_sd(now));
            // A parameter is placed by its logarithm, so that its own mean follows to second order.
            // Directions without spread, to rounding, are left out.
            let tolerance = if k < 6 { 1e-6 } else { 0.1 };
            assert!((new_mean - mean).abs() <= tolerance * sd, "{members} {k}: {new_mean} {mean}");
            let spread = if expected == 64 || expected == 100 { 0.1 } else { tolerance };
            assert!((new_sd / sd - 1.0).abs() <= spread, "{members} {k}: {new_sd} {sd}");
        }
    }
    let report = ensemble.step(&[], &Serial);
    assert_eq!((report.solved, report.not_converged), (100, 0));
}

/// Takes its time for a while.
struct Slow {
    is_slow: AtomicBool,
    said: Mutex<Vec<Output>>,
}

impl Sink for Slow {
    fn put(&self, _: &Bed, outputs: &[Output], _: Option<&Health>) {
        if self.is_slow.load(Ordering::Relaxed) {
            std::thread::sleep(Duration::from_millis(60));
        }
        self.said.lock().unwrap().extend(outputs.iter().cloned());
    }

    fn wants_members(&self, _: &str) -> bool {
        false
    }

    fn lost(&self, _: &str) {}
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn overload_is_said_in_every_estimate_and_ends() {
    let sets = ["estimator.members=40", "window.length_s=0.005", "observed=[\"p_a\"]"].map(str::to_owned);
    let config = Config::load_from(None, [], &sets).unwrap().0;
    let sink = Arc::new(Slow { is_slow: AtomicBool::new(true), said: Mutex::default() });
    let limits =
        Limits { max_beds: 4, forget_after: Duration::MAX, queue_tasks: 256, report_every: Duration::from_secs(60) };
    let workers = Arc::new(Workers::start(1).unwrap());
    let settings = config.estimator_settings().unwrap();
    let said = Arc::clone(&sink);
    let (service, inlet) =
        Service::new(config.circulation().unwrap(), settings, limits, workers, said, Clock::start()).unwrap();
    let service = tokio::spawn(service.run());

    let wait = async {
        for block in 0_u32.. {
            let samples = (0..5_i64).map(|k| {
                let time = EventTime((i64::from(block) * 5 + k) * 5_000_000);
                RawSample { time, value: 90.0 + (k % 3) as f64 }
            });
            let task =
                Task::Samples { channel: 0, sequence: u64::from(block), last: false, samples: samples.collect() };
            inlet.offer(Event::Task { bed: "b".to_owned(), task });
            tokio::time::sleep(Duration::from_millis(25)).await;
            let said = sink.said.lock().unwrap();
            let is = |kind: fn(&NoticeKind) -> bool| {
                said.iter().any(|output| matches!(output, Output::Notice(notice) if kind(&notice.kind)))
            };
            if is(|kind| matches!(kind, NoticeKind::Overload(_))) {
                sink.is_slow.store(false, Ordering::Relaxed);
            }
            if is(|kind| *kind == NoticeKind::OverloadOver) {
                break;
            }
        }
    };
    tokio::time::timeout(PATIENCE, wait).await.expect("overload begins and ends");
    inlet.stop().await;
    service.await.unwrap();

    // Every estimate tells how many members made it.
    let mut members = 40;
    let mut reduced = 0;
    for output in sink.said.lock().unwrap().iter() {
        match output {
            Output::Notice(notice) => match notice.kind {
                NoticeKind::Overload(now) => members = now,
                NoticeKind::OverloadOver => members = 40,
                _ => {}
            },
            Output::Estimate(estimate) => {
                assert_eq!(estimate.members, members);
                reduced += u32::from(members < 40);
            }
            _ => {}
        }
    }
    assert!(reduced > 0);
    assert_eq!(members, 40);
}
