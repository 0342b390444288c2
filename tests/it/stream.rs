//! A seeded simulation of a bad network and of bad senders, in front of the estimator of one bed.

use std::collections::BTreeMap;
use std::f64::consts::TAU;
use std::panic::{AssertUnwindSafe, catch_unwind};

use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use hemostream::estimate::ensemble::Serial;
use hemostream::estimate::estimator::{Estimate, Estimator, Input, Notice, NoticeKind, Output, WindowDone};
use hemostream::estimate::settings::{CouplingKind, EstimatorSettings};
use hemostream::estimate::time::{ArrivalTime, EventTime, NS_PER_S};
use hemostream::estimate::window::{RawSample, Refusal};
use hemostream::model::cvsim6::{Cvsim6, Parameter, State};
use hemostream::model::{Model, ParameterInfo, Quantity};

use super::twin;

const MS: i64 = 1_000_000;

const PUBLISH_NS: i64 = 20 * MS;

const TICK_NS: i64 = 20 * MS;

/// Simulated time per seed.
const LENGTH_NS: i64 = 40 * NS_PER_S;

/// More than a network with these delays can keep waiting.
const MAX_PENDING: usize = 2_000;

fn settings() -> EstimatorSettings {
    let mut settings = twin::settings(CouplingKind::Coupled, &[State::A, State::Pa], &[Parameter::RPv, Parameter::CA]);
    settings.members = 8;
    settings.publish_period_ns = PUBLISH_NS;
    settings.window.forecast_limit_ns = 2 * NS_PER_S;
    settings
}

/// What can go wrong, as probabilities per block.
#[derive(Debug, Clone, Copy)]
struct Faults {
    lost: f64,
    doubled: f64,
    /// Delayed beyond the allowed lateness.
    very_late: f64,
    /// Overtakes blocks of its channel that were sent before.
    overtaking: f64,
    /// Samples out of order within the block.
    shuffled: f64,
    /// Per sample: not a number, absurd, or from another world.
    nonsense: f64,
    /// A channel falls silent.
    gap: f64,
    /// Everything falls silent, now and then longer than is forecast.
    outage: f64,
    /// The sender's clock is set.
    jump: f64,
    /// A single block from another time.
    stray: f64,
}

const PERFECT: Faults = Faults {
    lost: 0.0,
    doubled: 0.0,
    very_late: 0.0,
    overtaking: 0.0,
    shuffled: 0.0,
    nonsense: 0.0,
    gap: 0.0,
    outage: 0.0,
    jump: 0.0,
    stray: 0.0,
};

const BAD: Faults = Faults {
    lost: 0.05,
    doubled: 0.05,
    very_late: 0.02,
    overtaking: 0.3,
    shuffled: 0.1,
    nonsense: 0.02,
    gap: 0.002,
    outage: 0.001,
    jump: 0.0005,
    stray: 0.005,
};

/// A block on its way.
struct Block {
    channel: usize,
    samples: Vec<RawSample>,
}

/// Everything that arrives in one run, by time of arrival.
struct Network {
    rng: ChaCha8Rng,
    faults: Faults,
    /// Of the sender's clock \[ns\].
    offset_ns: i64,
    /// Until when each channel is silent.
    silent_until_ns: [i64; 2],
    /// Latest arrival of each channel.
    arrived_ns: [i64; 2],
    arrivals: BTreeMap<(i64, u64), Block>,
    count: u64,
}

impl Network {
    fn new(seed: u64, faults: Faults) -> Self {
        Self {
            rng: ChaCha8Rng::seed_from_u64(seed),
            faults,
            offset_ns: 0,
            silent_until_ns: [0; 2],
            arrived_ns: [0; 2],
            arrivals: BTreeMap::new(),
            count: 0,
        }
    }

    fn happens(&mut self, probability: f64) -> bool {
        self.rng.random_bool(probability)
    }

    /// Whole milliseconds between two bounds, in nanoseconds.
    fn between_ms(&mut self, low: i64, high: i64) -> i64 {
        self.rng.random_range(low..high) * MS
    }

    /// Sends all blocks: 200 Hz and 125 Hz, blocks of 10 to 50 ms.
    fn send_everything(mut self) -> Vec<(ArrivalTime, Block)> {
        let mut sent_to = [0_i64; 2];
        while let Some(channel) = (0..2).filter(|&c| sent_to[c] < LENGTH_NS).min_by_key(|&c| sent_to[c]) {
            let from = sent_to[channel];
            let to = from + self.between_ms(10, 50);
            sent_to[channel] = to;
            self.misfortunes(channel, from);
            if self.silent_until_ns[channel] <= from {
                self.send(channel, from, to);
            }
        }
        self.arrivals.into_iter().map(|((at, _), block)| (ArrivalTime(at), block)).collect()
    }

    /// What befalls the sender.
    fn misfortunes(&mut self, channel: usize, now: i64) {
        if self.happens(self.faults.gap) {
            self.silent_until_ns[channel] = now + self.between_ms(50, 3_000);
        }
        if self.happens(self.faults.outage) {
            self.silent_until_ns = [now + self.between_ms(500, 6_000); 2];
        }
        if self.happens(self.faults.jump) {
            let hours = self.rng.random_range(-5_i64..6);
            self.offset_ns = hours * 3_600 * NS_PER_S + self.between_ms(-1_000, 1_000);
        }
    }

    fn send(&mut self, channel: usize, from: i64, to: i64) {
        if self.happens(self.faults.lost) {
            return;
        }
        let period = if channel == 0 { 5 * MS } else { 8 * MS };
        let first = from.div_euclid(period) + i64::from(from.rem_euclid(period) > 0);
        let times = (first..).map(|k| k * period).take_while(|&t| t < to);
        let stray = if self.happens(self.faults.stray) { self.between_ms(-90_000, 90_000) } else { 0 };
        let mut samples: Vec<RawSample> = Vec::new();
        for t in times {
            let value = if self.happens(self.faults.nonsense) { self.nonsense() } else { pressure(channel, t) };
            samples.push(RawSample { time: EventTime(t + self.offset_ns + stray), value });
        }
        if self.happens(self.faults.nonsense)
            && let Some(sample) = samples.last_mut()
        {
            sample.time = EventTime(self.rng.next_u64() as i64);
        }
        if self.happens(self.faults.shuffled) {
            let turn = self.rng.random_range(0..=samples.len());
            samples.rotate_left(turn);
        }
        let copies = 1 + usize::from(self.happens(self.faults.doubled));
        for _ in 0..copies {
            let very_late = self.happens(self.faults.very_late);
            let delay = if very_late { self.between_ms(150, 1_500) } else { self.between_ms(1, 60) };
            let overtaking = very_late || self.happens(self.faults.overtaking);
            let arrival = if overtaking { to + delay } else { self.arrived_ns[channel].max(to + delay) };
            if !very_late {
                self.arrived_ns[channel] = self.arrived_ns[channel].max(arrival);
            }
            self.count += 1;
            self.arrivals.insert((arrival, self.count), Block { channel, samples: samples.clone() });
        }
    }

    fn nonsense(&mut self) -> f64 {
        let all =
            [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 1e9, -1e9, f64::MAX, -50.001, 350.001, 349.0, -49.0, 0.0];
        all[self.rng.random_range(0..all.len())]
    }
}

/// Something like an arterial and a pulmonary pressure \[mmHg\].
fn pressure(channel: usize, time_ns: i64) -> f64 {
    let phase = TAU * 1.2 * EventTime(time_ns).as_s();
    if channel == 0 { 93.0 + 22.0 * phase.sin() } else { 16.0 + 5.0 * phase.sin() }
}

/// What a run must account for.
#[derive(Debug, Default, PartialEq)]
struct Account {
    sent: u64,
    used: u64,
    refused: BTreeMap<Refusal, u64>,
    pending: usize,
    most_pending: usize,
    restarts: u64,
    windows: usize,
    estimates: usize,
    gaps: usize,
    recovered: usize,
    /// Over the bits of all published numbers.
    hash: u64,
}

/// Follows the outputs of one estimator and complains.
#[derive(Default)]
struct Observer {
    account: Account,
    /// End of the last window since the last restart.
    window: Option<EventTime>,
    /// Last published time since the last restart.
    published: Option<EventTime>,
}

impl Observer {
    fn see(&mut self, output: &Output) {
        match output {
            Output::Estimate(estimate) => self.estimate(estimate),
            Output::Beat(_) | Output::Smoothed(_) | Output::Alarms(_) => {}
            Output::Window(window) => self.window(window),
            Output::Notice(notice) => self.notice(notice),
        }
    }

    fn estimate(&mut self, estimate: &Estimate) {
        assert_eq!(estimate.time.0.rem_euclid(PUBLISH_NS), 0, "{:?} is not a published time", estimate.time);
        if let Some(before) = self.published.replace(estimate.time) {
            assert_eq!(estimate.time.ns_since(before), PUBLISH_NS, "after {before:?}");
        }
        assert_eq!(estimate.members, 8);
        assert!(estimate.since_data_ns >= 0);
        let quantities = estimate.quantities.iter();
        for summary in quantities.chain(estimate.parameters.iter().map(|(p, _)| &p.summary)) {
            let all = [summary.mean, summary.sd, summary.epistemic_sd, summary.aleatoric_sd, summary.q05, summary.q95];
            assert!(all.iter().all(|v| v.is_finite()), "{summary:?} at {:?}", estimate.time);
            assert!(summary.q05 <= summary.q95 && summary.sd >= 0.0);
            for value in all {
                self.account.hash = self.account.hash.rotate_left(5).wrapping_mul(0x9e37_79b9) ^ value.to_bits();
            }
        }
        assert!(estimate.parameters.iter().all(|(p, since)| p.identifiability.is_finite() && *since >= 0));
        self.account.estimates += 1;
    }

    fn window(&mut self, window: &WindowDone) {
        if let Some(before) = self.window.replace(window.end) {
            assert_eq!(window.end.ns_since(before), settings().window.length_ns, "after {before:?}");
        }
        // Everything up to its end has been published.
        if let Some(published) = self.published {
            let left = window.end.ns_since(published);
            assert!((0..PUBLISH_NS).contains(&left), "{published:?} is the last before {:?}", window.end);
        }
        self.account.windows += 1;
    }

    fn notice(&mut self, notice: &Notice) {
        match notice.kind {
            NoticeKind::Restart => (self.window, self.published) = (None, None),
            NoticeKind::Start => assert_eq!((self.window, self.published), (None, None), "a start in the middle"),
            NoticeKind::Gap => self.account.gaps += 1,
            NoticeKind::Recovered => self.account.recovered += 1,
            _ => {}
        }
    }
}

/// Runs everything that a network delivers through an estimator.
fn run(seed: u64, faults: Faults) -> Account {
    let arrivals = Network::new(seed, faults).send_everything();
    let mut estimator = Estimator::new(Cvsim6::default(), settings()).unwrap();
    let mut observer = Observer::default();
    let mut outputs = Vec::new();
    let mut now = ArrivalTime(0);
    let mut drive = |estimator: &mut Estimator<Cvsim6>, observer: &mut Observer, input: Input, now: ArrivalTime| {
        outputs.clear();
        estimator.handle(input, now, &Serial, &mut outputs);
        outputs.iter().for_each(|output| observer.see(output));
        let pending = estimator.pending();
        assert!(pending <= MAX_PENDING, "{pending} samples are waiting");
        observer.account.most_pending = observer.account.most_pending.max(pending);
    };
    for (arrival, Block { channel, samples }) in arrivals {
        while now.0 + TICK_NS < arrival.0 {
            now.0 += TICK_NS;
            drive(&mut estimator, &mut observer, Input::Tick, now);
        }
        now = arrival;
        observer.account.sent += samples.len() as u64;
        drive(&mut estimator, &mut observer, Input::Samples { channel, samples }, now);
        let account = reckoning(&estimator);
        assert_eq!(account, observer.account.sent, "not every sample is accounted for at {now:?}");
    }
    drive(&mut estimator, &mut observer, Input::End, now);
    assert_eq!(reckoning(&estimator), observer.account.sent);
    let mut account = observer.account;
    account.pending = estimator.pending();
    account.refused = estimator.refused().clone();
    account.used = estimator.channels().iter().map(|c| c.samples_used).sum();
    account.restarts = estimator.restarts();
    account
}

/// Used, refused or waiting.
fn reckoning(estimator: &Estimator<Cvsim6>) -> u64 {
    let used: u64 = estimator.channels().iter().map(|c| c.samples_used).sum();
    used + estimator.refused().values().sum::<u64>() + estimator.pending() as u64
}

/// As [`run`]; whatever goes wrong, the seed is told.
fn run_telling_the_seed(seed: u64, faults: Faults) -> Account {
    catch_unwind(AssertUnwindSafe(|| run(seed, faults))).unwrap_or_else(|cause| {
        let text = cause.downcast_ref::<String>().map(String::as_str);
        let text = text.or_else(|| cause.downcast_ref::<&str>().copied()).unwrap_or("no message");
        panic!("seed {seed}: {text}")
    })
}

#[test]
fn a_good_network_loses_nothing() {
    let account = run_telling_the_seed(1, PERFECT);
    assert!(account.refused.is_empty(), "{account:?}");
    assert_eq!((account.restarts, account.pending, account.gaps), (0, 0, 0));
    assert_eq!(account.used, account.sent);
    assert!(account.windows as i64 >= LENGTH_NS / (5 * MS) - 1);
    assert!(account.estimates as i64 >= LENGTH_NS / PUBLISH_NS);
}

#[test]
fn a_bad_network_changes_what_is_observed_and_not_whether_there_are_estimates() {
    let seeds = [11, 12, 13, 14];
    let accounts: Vec<Account> = std::thread::scope(|scope| {
        let runs: Vec<_> = seeds.iter().map(|&seed| scope.spawn(move || run_telling_the_seed(seed, BAD))).collect();
        runs.into_iter().map(|run| run.join().unwrap_or_else(|cause| std::panic::resume_unwind(cause))).collect()
    });
    // The simulation is as bad as it claims to be.
    for cause in Refusal::ALL.into_iter().filter(|cause| *cause != Refusal::Overflow) {
        assert!(accounts.iter().any(|a| a.refused.contains_key(&cause)), "no sample was {}", cause.name());
    }
    assert!(accounts.iter().any(|a| a.restarts > 0), "nothing ever started anew");
    assert!(accounts.iter().any(|a| a.gaps > 0 && a.recovered > 0));
    for (seed, account) in seeds.iter().zip(&accounts) {
        assert!(account.used * 2 > account.sent, "seed {seed}: {account:?}");
    }
}

#[test]
fn the_same_seed_gives_the_same_numbers() {
    assert_eq!(run_telling_the_seed(21, BAD), run_telling_the_seed(21, BAD));
}

/// The circulation, without numbers in a tenth of every beat.
#[derive(Clone)]
struct Broken(Cvsim6);

impl Broken {
    fn fails(theta: &[f64]) -> bool {
        (0.5..0.6).contains(&theta[Parameter::BeatPhase as usize].rem_euclid(1.0))
    }

    fn spoil(theta: &[f64], numbers: &mut [f64]) {
        if Self::fails(theta) {
            numbers.fill(f64::NAN);
        }
    }
}

impl Model for Broken {
    type Lanes = hemostream::model::lanes::NoLanes;

    fn states(&self) -> &[Quantity] {
        self.0.states()
    }

    fn parameters(&self) -> &[ParameterInfo] {
        self.0.parameters()
    }

    fn derived(&self) -> &[Quantity] {
        self.0.derived()
    }

    fn rhs(&self, t_s: f64, x: &[f64], theta: &[f64], dx: &mut [f64]) {
        self.0.rhs(t_s, x, theta, dx);
        Self::spoil(theta, dx);
    }

    fn rhs_and_state_jacobian(&self, t_s: f64, x: &[f64], theta: &[f64], dx: &mut [f64], dfdx: &mut [f64]) {
        self.0.rhs_and_state_jacobian(t_s, x, theta, dx, dfdx);
        Self::spoil(theta, dx);
    }

    fn parameter_jacobian(&self, t_s: f64, x: &[f64], theta: &[f64], which: &[usize], dfdtheta: &mut [f64]) {
        self.0.parameter_jacobian(t_s, x, theta, which, dfdtheta);
        Self::spoil(theta, dfdtheta);
    }

    fn derive(&self, t_s: f64, x: &[f64], theta: &[f64], out: &mut [f64]) {
        self.0.derive(t_s, x, theta, out);
    }

    fn advance(&self, dt_s: f64, theta: &mut [f64]) {
        self.0.advance(dt_s, theta);
    }

    fn next_corner(&self, t_s: f64, until_s: f64, theta: &[f64]) -> Option<f64> {
        self.0.next_corner(t_s, until_s, theta)
    }
}

/// Nobody can solve some of the windows: nothing without a number is published, and it goes on afterwards.
#[test]
fn windows_without_a_solution_are_survived() {
    for coupling in [CouplingKind::Coupled, CouplingKind::Independent] {
        let settings = EstimatorSettings { coupling, ..settings() };
        let mut estimator = Estimator::new(Broken(Cvsim6::default()), settings).unwrap();
        let mut observer = Observer::default();
        let (mut outputs, mut failed) = (Vec::new(), 0);
        for k in 0..600 {
            let time = k * 5 * MS;
            for channel in 0..2 {
                let samples = vec![RawSample { time: EventTime(time), value: pressure(channel, time) }];
                estimator.handle(Input::Samples { channel, samples }, ArrivalTime(time), &Serial, &mut outputs);
            }
            for output in outputs.drain(..) {
                observer.see(&output);
                if let Output::Window(window) = output {
                    failed += usize::from(window.report.solved == 0 || window.report.not_converged > 0);
                }
            }
        }
        assert_eq!(observer.account.windows, 599);
        assert!((20..200).contains(&failed), "{failed} windows failed");
    }
}
