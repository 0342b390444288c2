//! The window cutter alone, driven by hand-made arrival times.

use proptest::prelude::*;
use proptest::sample::Index;

use hemostream::estimate::settings::{ChannelSettings, WindowSettings};
use hemostream::estimate::time::{ArrivalTime, EventTime};
use hemostream::estimate::window::{ClosedWindow, Ingested, Liveness, RawSample, Refusal, WindowCutter};

const MS: i64 = 1_000_000;

/// Of the windows \[ms\].
const LENGTH: i64 = 5;
const LATENESS: i64 = 200;
const FORECAST_LIMIT: i64 = 10_000;

/// More windows at once than any test has a use for.
const TOO_MANY: usize = 100_000;

/// A cutter whose times are all in milliseconds.
struct Bench {
    cutter: WindowCutter,
}

/// A bench with `n` channels.
fn bench(n: usize) -> Bench {
    let settings = WindowSettings {
        length_ns: LENGTH * MS,
        allowed_lateness_ns: LATENESS * MS,
        forecast_limit_ns: FORECAST_LIMIT * MS,
    };
    let channel = |state| ChannelSettings { state, noise_sd_mmhg: 1.0, plausible_mmhg: (-50.0, 350.0) };
    Bench { cutter: WindowCutter::new(settings, &(0..n).map(channel).collect::<Vec<_>>()) }
}

fn at(time_ms: i64) -> ArrivalTime {
    ArrivalTime(time_ms * MS)
}

fn sample(time_ms: i64) -> RawSample {
    RawSample { time: EventTime(time_ms * MS), value: 80.0 }
}

impl Bench {
    /// Samples of a channel, taken at `times_ms`, arrive at `now_ms`.
    fn feed(&mut self, channel: usize, times_ms: &[i64], now_ms: i64) -> Ingested {
        let samples: Vec<_> = times_ms.iter().map(|&t| sample(t)).collect();
        self.cutter.ingest(channel, &samples, at(now_ms))
    }

    fn feed_values(&mut self, channel: usize, samples: &[(i64, f64)], now_ms: i64) -> Ingested {
        let raw = |&(t, value): &(i64, f64)| RawSample { time: EventTime(t * MS), value };
        self.cutter.ingest(channel, &samples.iter().map(raw).collect::<Vec<_>>(), at(now_ms))
    }

    /// Everything that is final by `now_ms`.
    fn closed(&mut self, now_ms: i64) -> Vec<ClosedWindow> {
        let mut windows = Vec::new();
        while let Some(window) = self.cutter.next(at(now_ms)) {
            windows.push(window);
            assert!(windows.len() < TOO_MANY, "it never ends");
        }
        windows
    }

    /// As the owner does it: close, and start anew if the silence was too long; returns whether it was.
    fn closed_or_restarted(&mut self, now_ms: i64) -> (Vec<ClosedWindow>, bool) {
        let mut windows = self.closed(now_ms);
        let restart = self.cutter.needs_restart();
        if restart {
            self.cutter.restart(at(now_ms));
            windows.extend(self.closed(now_ms));
        }
        (windows, restart)
    }

    fn liveness(&self, channel: usize) -> Liveness {
        self.cutter.liveness(channel).0
    }
}

/// Start and end \[ms\].
fn spans(windows: &[ClosedWindow]) -> Vec<(i64, i64)> {
    windows.iter().map(|w| (w.start.0 / MS, w.end.0 / MS)).collect()
}

/// Times \[ms\] and channels of what a window observed.
#[allow(clippy::cast_possible_truncation)]
fn seen(window: &ClosedWindow) -> Vec<(i64, usize)> {
    let time = |s: f64| window.start.0 / MS + (s * LENGTH as f64).round() as i64;
    window.observations.iter().map(|o| (time(o.s), o.channel)).collect()
}

fn refused(ingested: &Ingested, cause: Refusal) -> usize {
    ingested.refused[cause as usize]
}

fn refused_in_all(ingested: &Ingested) -> usize {
    ingested.refused.iter().sum()
}

#[test]
fn closes_when_every_channel_has_passed() {
    let mut bench = bench(2);
    assert_eq!(bench.feed(0, &[0, 2, 4, 6], 6).kept, 4);
    assert!(bench.closed(6).is_empty(), "the other channel has not spoken");
    bench.feed(1, &[1, 3], 7);
    assert!(bench.closed(7).is_empty(), "the other channel has not passed");
    bench.feed(1, &[5], 8);
    let windows = bench.closed(8);
    assert_eq!(spans(&windows), [(0, 5)]);
    assert_eq!(seen(&windows[0]), [(0, 0), (1, 1), (2, 0), (3, 1), (4, 0), (5, 1)]);
    assert_eq!(windows[0].closed_at, at(8));
    assert!(windows[0].gone_silent.is_empty());
    assert_eq!(bench.cutter.pending(), 1);
    assert_eq!(bench.cutter.closed_to(), Some(EventTime(5 * MS)));
}

#[test]
fn waits_the_allowed_lateness_for_a_channel_and_then_goes_on_without_it() {
    let mut bench = bench(2);
    bench.feed(0, &[0, 5, 10], 10);
    bench.feed(1, &[0, 5, 10], 10);
    assert_eq!(spans(&bench.closed(10)), [(0, 5), (5, 10)]);

    bench.feed(0, &[15], 15);
    bench.feed(0, &[20], 20);
    assert!(bench.closed(15 + LATENESS - 1).is_empty());
    let windows = bench.closed(15 + LATENESS);
    assert_eq!(spans(&windows), [(10, 15), (15, 20)], "what is silent is not waited for again");
    assert_eq!(windows[0].gone_silent, [1]);
    assert_eq!(windows[0].closed_at, at(15 + LATENESS));
    assert!(windows[1].gone_silent.is_empty());
    assert_eq!(bench.liveness(1), Liveness::Silent);

    let back = bench.feed(1, &[23], 250);
    assert!(back.recovered && back.kept == 1);
    assert_eq!(bench.liveness(1), Liveness::Live);
    assert!(!bench.feed(1, &[24], 251).recovered, "it is back already");
    bench.feed(0, &[25], 252);
    assert!(bench.closed(252).is_empty(), "it is waited for again");
    bench.feed(1, &[25], 253);
    let windows = bench.closed(253);
    assert_eq!(spans(&windows), [(20, 25)]);
    assert_eq!(seen(&windows[0]), [(23, 1), (24, 1), (25, 0), (25, 1)]);
}

#[test]
fn a_channel_that_never_speaks_delays_the_start_only() {
    let mut bench = bench(2);
    bench.feed(0, &[0, 5, 10], 10);
    assert!(bench.closed(10 + LATENESS).is_empty());
    let windows = bench.closed(10 + LATENESS + 1);
    assert_eq!(spans(&windows), [(0, 5), (5, 10)]);
    bench.feed(0, &[15], 300);
    assert_eq!(spans(&bench.closed(300)), [(10, 15)]);
    assert_eq!(bench.liveness(1), Liveness::Never);
}

#[test]
fn disorder_within_the_lateness_changes_nothing() {
    let mut ordered = bench(2);
    ordered.feed(0, &[0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10], 10);
    ordered.feed(1, &[0, 2, 4, 6, 8, 10], 10);
    let expected = ordered.closed(10);
    assert_eq!(expected.len(), 2);

    let mut shuffled = bench(2);
    shuffled.feed(0, &[10, 3, 7, 0], 10);
    shuffled.feed(0, &[9, 8, 6, 1], 40);
    shuffled.feed(0, &[2, 5, 4], 60);
    assert!(shuffled.closed(60).is_empty());
    shuffled.feed(1, &[4, 10, 0, 8, 6, 2], 100);
    let windows = shuffled.closed(100);
    assert_eq!(spans(&windows), spans(&expected));
    assert!(windows.iter().zip(&expected).all(|(w, e)| w.observations == e.observations));
}

#[test]
fn a_duplicate_is_refused_and_the_first_stays() {
    let mut bench = bench(1);
    let ingested = bench.feed_values(0, &[(1, 80.0), (3, 81.0), (1, 99.0), (3, 98.0), (4, 82.0)], 4);
    assert_eq!((ingested.kept, refused(&ingested, Refusal::Duplicate)), (3, 2));
    assert_eq!(refused(&bench.feed(0, &[4, 5], 5), Refusal::Duplicate), 1);
    let windows = bench.closed(5);
    let values: Vec<f64> = windows[0].observations.iter().map(|o| o.value).collect();
    assert_eq!(values, [80.0, 81.0, 82.0, 80.0]);
}

#[test]
fn what_comes_after_its_window_is_late() {
    let mut bench = bench(1);
    bench.feed(0, &[0, 5], 5);
    assert_eq!(bench.closed(5).len(), 1);
    let ingested = bench.feed(0, &[3, 5, 7], 6);
    assert_eq!((ingested.kept, refused(&ingested, Refusal::Late)), (1, 2));
    assert_eq!(bench.cutter.pending(), 1);
}

/// Or else one that always comes a little after the others would never be waited for again.
#[test]
fn a_silent_channel_that_comes_late_is_waited_for_again() {
    let mut bench = bench(2);
    bench.feed(0, &[0, 5], 5);
    bench.feed(1, &[0, 5], 5);
    bench.feed(0, &[10], 10);
    assert_eq!(bench.closed(10 + LATENESS).len(), 2);
    let late = bench.feed(1, &[8, 9], 220);
    assert_eq!((late.kept, late.recovered, refused(&late, Refusal::Late)), (0, true, 2));
    assert_eq!(bench.liveness(1), Liveness::Live);
    bench.feed(0, &[15], 221);
    assert!(bench.closed(221).is_empty());
    bench.feed(1, &[14, 15], 240);
    assert_eq!(seen(&bench.closed(240)[0]), [(14, 1), (15, 0), (15, 1)]);
}

#[test]
fn nonsense_is_refused_by_cause() {
    let mut bench = bench(1);
    let (nan, inf) = (f64::NAN, f64::INFINITY);
    let values = [(1, nan), (2, inf), (3, -inf), (4, 1e9), (5, -50.5), (6, 350.0), (7, -50.0), (8, f64::MAX)];
    let ingested = bench.feed_values(0, &values, 8);
    assert_eq!(ingested.kept, 2);
    assert_eq!(refused(&ingested, Refusal::NotFinite), 3);
    assert_eq!(refused(&ingested, Refusal::Implausible), 3);
    let windows = bench.closed(8);
    assert_eq!(spans(&windows), [(5, 10)][..0], "the only good samples lie in a window that is not over");
    bench.feed(0, &[10], 10);
    assert_eq!(seen(&bench.closed(10)[0]), [(6, 0), (7, 0), (10, 0)]);
}

/// A sensor that is flushed or unplugged still tells the time: windows need not wait for it.
#[test]
fn a_channel_that_sends_nonsense_is_there() {
    for nonsense in [f64::NAN, 1e9] {
        let mut bench = bench(2);
        bench.feed(0, &[0, 5], 5);
        bench.feed(1, &[0, 5], 5);
        assert_eq!(bench.closed(5).len(), 1);
        bench.feed_values(1, &[(7, nonsense), (10, nonsense)], 10);
        bench.feed(0, &[10], 10);
        assert_eq!(spans(&bench.closed(10)), [(5, 10)], "with {nonsense}");
        assert_eq!(bench.liveness(1), Liveness::Live);
    }
}

/// The first block of a channel decides nothing about its second, whatever it is worth.
#[test]
fn a_channel_that_begins_with_nonsense_is_waited_for() {
    for nonsense in [f64::NAN, 1e9] {
        let mut bench = bench(2);
        bench.feed_values(1, &[(0, nonsense), (1, nonsense)], 1);
        bench.feed(0, &[0, 5, 10], 10);
        assert!(bench.closed(10).is_empty());
        assert_eq!(bench.feed(1, &[3, 5], 11).kept, 2, "with {nonsense}");
        let windows = bench.closed(11);
        assert_eq!(spans(&windows), [(0, 5)]);
        assert_eq!(seen(&windows[0]), [(0, 0), (3, 1), (5, 0), (5, 1)]);
    }
}

#[test]
fn the_number_of_waiting_samples_is_bounded() {
    let limit = 65_536;
    let mut bench = bench(2);
    let flood = |from: i64, n: i64| -> Vec<RawSample> {
        (from..from + n).map(|i| RawSample { time: EventTime(i * MS / 10), value: 80.0 }).collect()
    };
    let (mut kept, mut overflow) = (0, 0);
    for block in 0..70 {
        let ingested = bench.cutter.ingest(0, &flood(block * 1000, 1000), at(0));
        kept += ingested.kept;
        overflow += refused(&ingested, Refusal::Overflow);
        assert!(bench.cutter.pending() <= limit);
    }
    assert_eq!((kept, overflow), (limit, 70_000 - limit));
    // Once the other channel comes everything drains, and nothing is left behind.
    bench.feed(1, &[0, 7_000], 1);
    let windows = bench.closed(1);
    assert_eq!(spans(&windows).last(), Some(&(6_990, 6_995)));
    assert_eq!(windows.iter().map(|w| w.observations.len()).sum::<usize>(), limit + 1);
    assert_eq!(bench.cutter.pending(), 1);
}

#[test]
fn channels_may_differ_in_rate() {
    let mut bench = bench(3);
    let mut windows = Vec::new();
    for t in 0..=60 {
        bench.feed(0, &[t], t);
        if t % 4 == 1 {
            bench.feed(1, &[t], t);
        }
        if t % 30 == 0 {
            bench.feed(2, &[t], t);
        }
        windows.extend(bench.closed(t));
    }
    assert_eq!(spans(&windows).last(), Some(&(50, 55)), "the slower channel stands at 57");
    let seen: Vec<_> = windows.iter().flat_map(seen).collect();
    let times = |channel| seen.iter().filter(|(_, c)| *c == channel).map(|(t, _)| *t).collect::<Vec<i64>>();
    assert_eq!(times(0), (0..=55).collect::<Vec<_>>());
    assert_eq!(times(1), (0..=55).filter(|t| t % 4 == 1).collect::<Vec<_>>());
    assert_eq!(times(2), [0, 30]);
}

#[test]
fn the_grid_does_not_depend_on_who_speaks_first() {
    for order in [[0, 1], [1, 0]] {
        let mut bench = bench(2);
        for channel in order {
            bench.feed(channel, if channel == 0 { &[112, 117, 122] } else { &[103, 113, 120] }, 122);
        }
        let windows = bench.closed(122);
        assert_eq!(spans(&windows), [(100, 105), (105, 110), (110, 115), (115, 120)]);
        assert_eq!(seen(&windows[0]), [(103, 1)]);
        assert!(windows[1].observations.is_empty());
    }
}

#[test]
fn event_times_may_be_negative() {
    let mut bench = bench(1);
    bench.feed(0, &[-13, -8, 0, 3], 0);
    let windows = bench.closed(0);
    assert_eq!(spans(&windows), [(-15, -10), (-10, -5), (-5, 0)]);
    let positions: Vec<f64> = windows.iter().flat_map(|w| &w.observations).map(|o| o.s).collect();
    assert_eq!(positions, [0.4, 0.4, 1.0]);
}

#[test]
fn a_first_sample_on_the_grid_is_used() {
    let mut bench = bench(1);
    bench.feed(0, &[100, 105, 110], 110);
    let windows = bench.closed(110);
    assert_eq!(spans(&windows), [(100, 105), (105, 110)]);
    let positions: Vec<Vec<f64>> = windows.iter().map(|w| w.observations.iter().map(|o| o.s).collect()).collect();
    assert_eq!(positions, [vec![0.0, 1.0], vec![1.0]], "later ones belong to the window that they end");
}

#[test]
fn silence_is_forecast_up_to_the_limit() {
    let mut bench = bench(2);
    bench.feed(0, &[0, 5], 5);
    bench.feed(1, &[0, 5], 5);
    assert_eq!(bench.closed(5).len(), 1);
    assert!(bench.closed(10 + LATENESS - 1).is_empty());
    let first = bench.closed(10 + LATENESS);
    assert_eq!(spans(&first), [(5, 10)]);
    assert_eq!(first[0].gone_silent, [0, 1]);
    // The grid goes on at the pace of time, however rarely it is looked at.
    assert_eq!(spans(&bench.closed(24 + LATENESS)), [(10, 15), (15, 20)]);
    let rest = bench.closed(100_000);
    assert_eq!(rest.last().unwrap().end, EventTime((5 + FORECAST_LIMIT) * MS));
    assert!(rest.iter().all(|w| w.observations.is_empty() && w.gone_silent.is_empty()));
    assert!(rest.windows(2).all(|pair| pair[0].end == pair[1].start));
    assert!(bench.closed(10_000_000).is_empty());
    assert!(!bench.cutter.needs_restart());
}

#[test]
fn a_return_after_a_long_silence_is_a_new_start() {
    let mut bench = bench(2);
    bench.feed(0, &[0, 5], 5);
    bench.feed(1, &[0, 5], 5);
    assert_eq!(bench.closed(5).len(), 1);
    let back = 5 + 2 * FORECAST_LIMIT;
    for tick in (5..back).step_by(20) {
        bench.closed(tick);
    }
    let ingested = bench.feed(0, &[back + 2, back + 5], back + 5);
    assert_eq!(ingested.kept, 2);
    assert!(ingested.recovered && !ingested.clock_changed);
    let (windows, restarted) = bench.closed_or_restarted(back + 5);
    assert!(restarted && windows.is_empty(), "the other channel has the allowed lateness to join");
    bench.feed(1, &[back + 1, back + 5], back + 6);
    let (windows, restarted) = bench.closed_or_restarted(back + 6);
    assert_eq!(spans(&windows), [(back, back + 5)]);
    assert_eq!(seen(&windows[0]).len(), 4);
    assert!(!restarted);
}

#[test]
fn a_short_silence_is_bridged_without_a_new_start() {
    let mut bench = bench(1);
    bench.feed(0, &[0, 5], 5);
    bench.closed(5);
    let back = FORECAST_LIMIT;
    bench.feed(0, &[back], back);
    let (windows, restarted) = bench.closed_or_restarted(back);
    assert!(!restarted);
    assert_eq!(spans(&windows).last(), Some(&(back - 5, back)));
    assert_eq!(windows.len() as i64, (back - 5) / LENGTH);
}

/// A sender whose clock is set, to either side.
#[test]
fn a_changed_clock_is_believed_at_the_third_block() {
    for jump in [3_600_000, -3_600_000, FORECAST_LIMIT + 100, -FORECAST_LIMIT - 100] {
        let mut bench = bench(1);
        bench.feed(0, &[0, 5, 10], 10);
        assert_eq!(bench.closed(10).len(), 2);
        for (k, t) in [(1, 15), (2, 20)] {
            let ingested = bench.feed(0, &[t + jump], t);
            assert_eq!(refused(&ingested, Refusal::ClockJump), 1, "jump {jump}, block {k}");
            assert!(!ingested.clock_changed);
            assert!(bench.closed(t).is_empty());
        }
        let third = bench.feed(0, &[25 + jump], 25);
        assert!(third.clock_changed, "jump {jump}");
        assert_eq!((third.kept, refused_in_all(&third)), (0, 0), "its owner gives it again");
        assert_eq!(bench.cutter.clear(at(25)), 0);
        assert_eq!(bench.feed(0, &[25 + jump], 25).kept, 1);
        assert!(bench.closed(25).is_empty());
        bench.feed(0, &[30 + jump], 30);
        let windows = bench.closed(30);
        assert_eq!(spans(&windows), [(25 + jump, 30 + jump)]);
        assert_eq!(windows[0].observations.len(), 2, "the first sample is on the grid");
    }
}

#[test]
fn a_new_clock_drops_what_was_waiting_and_says_how_much() {
    let mut bench = bench(2);
    bench.feed(0, &[0, 5, 10, 15], 10);
    bench.feed(1, &[0, 5], 10);
    assert_eq!(bench.closed(10).len(), 1);
    assert_eq!(bench.cutter.pending(), 2);
    assert_eq!(bench.cutter.clear(at(20)), 2);
    assert_eq!(bench.cutter.pending(), 0);
    assert_eq!(bench.cutter.closed_to(), None);
}

#[test]
fn a_block_from_another_time_disturbs_nobody() {
    let mut bench = bench(2);
    let mut windows = Vec::new();
    for t in (0..=100).step_by(5) {
        if t % 15 != 0 {
            let lost = bench.feed(0, &[t + 90_000], t);
            assert_eq!((refused(&lost, Refusal::ClockJump), lost.clock_changed), (1, false));
        }
        if t > 0 {
            bench.feed(1, &[t - 90_000], t);
        }
        bench.feed(0, &[t], t);
        bench.feed(1, &[t], t);
        windows.extend(bench.closed(t));
    }
    assert_eq!(windows.len(), 20);
    assert!(windows.iter().skip(1).all(|w| seen(w).len() == 2));
}

/// Two devices, one of which has a wrong clock: the bed goes on with the other one.
#[test]
fn one_channel_in_another_time_does_not_restart_the_others() {
    let mut bench = bench(2);
    bench.feed(0, &[0], 0);
    bench.feed(1, &[0], 0);
    let mut windows = Vec::new();
    for t in (5..=1000).step_by(5) {
        bench.feed(0, &[t], t);
        let lost = bench.feed(1, &[t - 3_600_000], t);
        assert!(!lost.clock_changed, "at {t} ms");
        assert_eq!(refused(&lost, Refusal::ClockJump), 1);
        windows.extend(bench.closed(t));
    }
    assert_eq!(spans(&windows).last(), Some(&(995, 1000)));
    assert_eq!(windows.iter().map(|w| w.observations.len()).sum::<usize>(), 202);
    assert_eq!(bench.liveness(1), Liveness::Silent);
}

#[test]
fn channels_that_jump_together_are_believed() {
    let mut bench = bench(2);
    bench.feed(0, &[0, 5], 5);
    bench.feed(1, &[0, 5], 5);
    bench.closed(5);
    let jump = 7_200_000;
    let mut changed = Vec::new();
    for t in [10, 15, 20] {
        for channel in [0, 1] {
            changed.push(bench.feed(channel, &[t + jump], t).clock_changed);
        }
    }
    assert_eq!(changed, [false, false, false, false, true, true]);
}

#[test]
fn a_channel_that_jumps_while_the_other_is_silent_is_believed() {
    let mut bench = bench(2);
    bench.feed(0, &[0, 5], 5);
    bench.feed(1, &[0, 5], 5);
    bench.closed(5);
    let believed = (10..1000).step_by(5).find(|&t| {
        let changed = bench.feed(0, &[t + 3_600_000], t).clock_changed;
        bench.closed(t);
        changed
    });
    assert_eq!(believed, Some(10 + LATENESS + 5), "as soon as the other one is known to be silent");
}

#[test]
fn the_end_closes_the_last_window_early() {
    let mut bench = bench(2);
    bench.feed(0, &[0, 5, 10, 12], 12);
    bench.feed(1, &[0, 7], 12);
    assert_eq!(spans(&bench.closed(12)), [(0, 5)]);
    bench.cutter.end();
    let windows = bench.closed(12);
    assert_eq!(spans(&windows), [(5, 10), (10, 15)]);
    assert_eq!(seen(&windows[1]), [(12, 0)]);
    assert!(windows.iter().all(|w| w.gone_silent.is_empty()), "who has ended is not missing");
    assert!(bench.closed(1_000_000).is_empty(), "after the end there is nothing to forecast");
    assert_eq!(bench.cutter.pending(), 0);
}

#[test]
fn the_end_does_not_wait_for_who_never_spoke() {
    let mut bench = bench(2);
    bench.feed(0, &[1, 3], 3);
    bench.cutter.end();
    assert_eq!(spans(&bench.closed(3)), [(0, 5)]);
}

#[test]
fn an_end_of_nothing_is_nothing() {
    let mut bench = bench(2);
    bench.cutter.end();
    assert!(bench.closed(1_000).is_empty());
    assert_eq!(bench.feed(0, &[], 1_000), Ingested::default());
}

#[test]
fn samples_after_the_end_begin_again() {
    let mut bench = bench(1);
    bench.feed(0, &[0, 4], 4);
    bench.cutter.end();
    assert_eq!(bench.closed(4).len(), 1);
    bench.feed(0, &[6, 11], 11);
    assert_eq!(spans(&bench.closed(11)), [(5, 10)]);
    assert!(bench.closed(12).is_empty());
}

/// Times at which sums of times would leave the integers.
#[test]
fn impossible_times_are_refused() {
    for time in [i64::MAX, i64::MAX - 1, i64::MIN, i64::MIN + 1, i64::MAX / 2 + 2] {
        let mut bench = bench(1);
        let raw = [RawSample { time: EventTime(time), value: 80.0 }];
        for now in 0..5 {
            let ingested = bench.cutter.ingest(0, &raw, at(now));
            assert_eq!((ingested.kept, refused(&ingested, Refusal::ClockJump)), (0, 1), "{time}");
            assert!(!ingested.clock_changed);
        }
        assert!(bench.closed(10).is_empty());
        // Nor do they spoil the block they come in, or the bed.
        let mut block = vec![sample(0), sample(5)];
        block.extend(raw);
        let ingested = bench.cutter.ingest(0, &block, at(10));
        assert_eq!((ingested.kept, refused(&ingested, Refusal::ClockJump)), (2, 1), "{time}");
        assert_eq!(bench.closed(10).len(), 1);
    }
}

/// One block must not make hours of forecasts.
#[test]
fn a_first_block_lives_in_one_time() {
    let mut bench = bench(1);
    let ingested = bench.feed(0, &[0, 3_600_000, 7_200_000, 7_200_005], 1);
    assert_eq!((ingested.kept, refused(&ingested, Refusal::ClockJump)), (2, 2));
    let (windows, restarted) = bench.closed_or_restarted(1);
    assert_eq!(spans(&windows), [(7_200_000, 7_200_005)]);
    assert!(!restarted);
}

/// A block of a channel: when it arrives \[ms\], and what.
#[derive(Debug, Clone)]
struct Block {
    arrival_ms: i64,
    channel: usize,
    samples: Vec<RawSample>,
}

/// A channel: a sample every `period` ms from `phase` ms on, some of them nonsense.
fn record() -> impl Strategy<Value = Vec<Vec<RawSample>>> {
    let kind = prop_oneof![20 => Just(0), 1 => Just(1), 1 => Just(2), 1 => Just(3)];
    let channel = (1_i64..20, 0_i64..40, prop::collection::vec((kind, 0_i64..900_000), 30..120));
    prop::collection::vec(channel, 1..4).prop_map(|channels| {
        let samples = |(period, phase, kinds): (i64, i64, Vec<(i32, i64)>)| {
            let one = |(i, (kind, jitter)): (usize, (i32, i64))| {
                let time = EventTime((1_000_000 + phase + period * i as i64) * MS + jitter * i64::from(kind != 3));
                let value = [80.0 + i as f64 / 10.0, f64::NAN, 1e9, 90.0][kind as usize];
                RawSample { time, value }
            };
            kinds.into_iter().enumerate().map(one).collect()
        };
        channels.into_iter().map(samples).collect()
    })
}

/// Cuts every channel into blocks and delays them, at most `LATENESS` in all, channels apart.
fn network(record: &[Vec<RawSample>], cuts: &[Index], delays: &[i64]) -> Vec<Block> {
    let mut blocks = Vec::new();
    let mut draw = cuts.iter().cycle();
    let mut delay = delays.iter().cycle();
    for (channel, samples) in record.iter().enumerate() {
        let (mut from, mut arrived) = (0, 0);
        while from < samples.len() {
            let span = |to: usize| samples[to].time.0 - samples[from].time.0;
            let most = (from..samples.len()).take_while(|&to| span(to) <= 40 * MS).count();
            let to = from + 1 + draw.next().unwrap().index(most);
            let taken = samples[to - 1].time.0 / MS + 1;
            arrived = arrived.max(taken + delay.next().unwrap());
            let mut block = samples[from..to].to_vec();
            // Within a block the order is free.
            let turn = draw.next().unwrap().index(block.len());
            block.rotate_left(turn);
            blocks.push(Block { arrival_ms: arrived, channel, samples: block });
            from = to;
        }
    }
    blocks.sort_by_key(|b| (b.arrival_ms, (b.channel + blocks_turn(cuts)) % record.len()));
    blocks
}

/// Who comes first when several arrive at once.
fn blocks_turn(cuts: &[Index]) -> usize {
    cuts[0].index(3)
}

type Content = (EventTime, EventTime, Vec<(u64, usize, u64)>);

fn content(window: &ClosedWindow) -> Content {
    let bits = window.observations.iter().map(|o| (o.s.to_bits(), o.channel, o.value.to_bits())).collect();
    (window.start, window.end, bits)
}

/// What is cut out of blocks that arrive like this, looked at after each and every `tick_ms`.
fn cut(channels: usize, blocks: &[Block], tick_ms: i64) -> Vec<Content> {
    let mut bench = bench(channels);
    let mut windows = Vec::new();
    let mut now = blocks[0].arrival_ms;
    for block in blocks {
        while now + tick_ms < block.arrival_ms {
            now += tick_ms;
            windows.extend(bench.closed(now));
        }
        now = block.arrival_ms;
        bench.cutter.ingest(block.channel, &block.samples, at(now));
        windows.extend(bench.closed(now));
        assert!(!bench.cutter.needs_restart());
    }
    bench.cutter.end();
    windows.extend(bench.closed(now));
    assert_eq!(bench.cutter.pending(), 0);
    windows.iter().map(content).collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(256))]

    /// However a record is cut into blocks, and in whatever interleaving within the lateness they arrive, the
    /// windows are the same.
    #[test]
    fn windows_depend_on_the_record_alone(
        record in record(),
        cuts in prop::collection::vec(any::<Index>(), 64),
        delays in prop::collection::vec(0_i64..100, 17),
        tick in 1_i64..50,
    ) {
        let end = record.iter().flatten().map(|s| s.time.0 / MS + 1).max().unwrap();
        let whole = |(channel, samples): (usize, &Vec<RawSample>)| {
            Block { arrival_ms: end, channel, samples: samples.clone() }
        };
        let at_once: Vec<Block> = record.iter().enumerate().map(whole).collect();
        let expected = cut(record.len(), &at_once, tick);
        prop_assert_eq!(cut(record.len(), &network(&record, &cuts, &delays), tick), expected);
    }
}
