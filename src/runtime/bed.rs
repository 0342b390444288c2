//! A bed as the runtime keeps it: its estimator, and the tallies of how it goes.

use std::collections::BTreeMap;

use hdrhistogram::Histogram;

use super::clock::Clock;
use crate::estimate::ensemble::Parallel;
use crate::estimate::estimator::{
    ChannelHealth, Disagreement, Estimator, Input, Notice, NoticeKind, Output, REPORT_EVERY_NS,
};
use crate::estimate::time::{ArrivalTime, EventTime, s_from_ns};
use crate::estimate::window::{Liveness, RawSample};
use crate::model::discrepancy::Circulation;

/// Longest lag that the histogram tells apart \[us\].
const MAX_LAG_US: u64 = 600_000_000;

/// Fewer members no overload leaves. In twin experiments (two parameters, arterial and pulmonary line) the 90 % band held
/// 91 % of the truth with 24 members, 68 % with 16.
const LEAST_MEMBERS: usize = 24;

/// Weight of the newest job in the running mean of the solve time.
const SOLVE_WEIGHT: f64 = 0.1;

/// Lags are told of the last one to two of these \[ns\].
const LATELY_NS: i64 = 30_000_000_000;

/// What a bed is asked to do.
#[derive(Debug, Clone, PartialEq)]
pub enum Task {
    /// Samples of a channel.
    Samples {
        /// Index of the channel.
        channel: usize,
        /// Sender's count of blocks.
        sequence: u64,
        /// The sender will send no more on this channel.
        last: bool,
        /// The samples.
        samples: Vec<RawSample>,
    },
    /// Onsets of heart beats.
    Beats(Vec<EventTime>),
    /// An operator has seen an alarm, by name, or all of them.
    Acknowledge {
        /// Its name; None for all.
        alarm: Option<String>,
        /// Who; empty if that is not said.
        author: String,
    },
    /// Something came that the edge could not make sense of.
    Refused(&'static str),
    /// Time has passed.
    Tick,
    /// Go on with this share of the members.
    Share(f64),
    /// Say how it goes.
    Report {
        /// Whether somebody wants the whole ensemble.
        want_members: bool,
        /// Tasks that are waiting.
        queue_depth: usize,
        /// Tasks lost because too many were waiting.
        queue_full: u64,
        /// Events of all beds lost before they got here.
        inlet_full: u64,
    },
}

/// How a bed goes.
#[derive(Debug, Clone, PartialEq)]
pub struct Health {
    /// End of the last window.
    pub time: EventTime,
    /// Members configured.
    pub members: usize,
    /// Members that took part in the last window.
    pub members_alive: usize,
    /// Windows solved.
    pub windows: u64,
    /// Of these, without a sample.
    pub windows_without_data: u64,
    /// Median lag from the closing of a window to its estimates being handed over for publishing \[ms\], over the
    /// windows of the last minute or so.
    pub lag_p50_ms: f64,
    /// 99th percentile.
    pub lag_p99_ms: f64,
    /// Largest.
    pub lag_max_ms: f64,
    /// Mean time per window, lately \[ms\].
    pub solve_ms: f64,
    /// Mean iterations per member and window.
    pub iterations: f64,
    /// Member-windows that did not converge.
    pub not_converged: u64,
    /// Tasks waiting.
    pub queue_depth: usize,
    /// What was refused or lost, by cause.
    pub counters: BTreeMap<&'static str, u64>,
    /// The channels.
    pub channels: Vec<ChannelHealth>,
    /// How far a second filter is from the ensemble, and the parameters that are estimated; None without one.
    pub disagreement: Option<(Disagreement, Vec<usize>)>,
}

/// What beds did, all together.
#[derive(Debug, Clone, Default)]
pub struct Account {
    /// Beds.
    pub beds: usize,
    /// Windows solved.
    pub windows: u64,
    /// Member-windows that the kernels left to the general solver.
    pub one_by_one: u64,
    /// Member-windows that did not converge.
    pub not_converged: u64,
    /// Messages and samples that were lost or refused.
    pub lost: u64,
    /// From the closing of a window to what is said of it handed over \[us\].
    pub lag_us: Option<Histogram<u64>>,
}

/// Lags of the present stretch of time and of the one before: an alert on them ends when the trouble does.
struct Lately {
    /// The present one first \[us\]; coarser than those since the start, because there are two per bed.
    stretches: Option<[Histogram<u32>; 2]>,
    began: ArrivalTime,
}

impl Lately {
    fn new() -> Self {
        let histogram = || Histogram::new_with_max(MAX_LAG_US, 2).ok();
        Self { stretches: histogram().zip(histogram()).map(<[_; 2]>::from), began: ArrivalTime(0) }
    }

    fn record(&mut self, lag_us: u64, now: ArrivalTime) {
        let Some(stretches) = &mut self.stretches else { return };
        if now.ns_since(self.began) > LATELY_NS {
            stretches.swap(0, 1);
            stretches[0].reset();
            self.began = now;
        }
        stretches[0].saturating_record(lag_us);
    }

    fn all(&self) -> Option<Histogram<u32>> {
        let [present, before] = self.stretches.as_ref()?;
        let mut all = present.clone();
        all.add(before).ok()?;
        Some(all)
    }
}

/// A bed.
pub struct Bed {
    /// Its name.
    pub name: String,
    estimator: Estimator<Circulation>,
    clock: Clock,
    windows: u64,
    windows_without_data: u64,
    members_alive: usize,
    iterations: u64,
    not_converged: u64,
    one_by_one: u64,
    solve_ms: f64,
    /// Since the start.
    lag_us: Option<Histogram<u64>>,
    lately: Lately,
    /// When the windows were closed of which nothing is said yet.
    closed: Vec<ArrivalTime>,
    counters: BTreeMap<&'static str, u64>,
    /// Last event about each cause.
    reported: BTreeMap<&'static str, ArrivalTime>,
    /// Next sequence number per channel.
    expected: Vec<Option<u64>>,
    ended: Vec<bool>,
    last_window: EventTime,
}

impl Bed {
    /// A bed that waits for its first sample.
    #[must_use]
    pub fn new(name: String, estimator: Estimator<Circulation>, clock: Clock) -> Self {
        let channels = estimator.settings().channels.len();
        Self {
            name,
            clock,
            windows: 0,
            windows_without_data: 0,
            members_alive: estimator.settings().members,
            iterations: 0,
            not_converged: 0,
            one_by_one: 0,
            solve_ms: 0.0,
            lag_us: Histogram::new_with_max(MAX_LAG_US, 3).ok(),
            lately: Lately::new(),
            closed: Vec::new(),
            counters: BTreeMap::new(),
            reported: BTreeMap::new(),
            expected: vec![None; channels],
            ended: vec![false; channels],
            last_window: EventTime(0),
            estimator,
        }
    }

    /// The estimator.
    #[must_use]
    pub fn estimator(&self) -> &Estimator<Circulation> {
        &self.estimator
    }

    /// Does one task; `arrived` is when it came in.
    pub fn handle(
        &mut self,
        task: Task,
        arrived: ArrivalTime,
        parallel: &dyn Parallel,
        out: &mut Vec<Output>,
    ) -> Option<Health> {
        match task {
            Task::Samples { channel, sequence, last, samples } => {
                self.count_lost(channel, sequence);
                self.drive(Input::Samples { channel, samples }, arrived, parallel, out);
                if let Some(ended) = self.ended.get_mut(channel) {
                    *ended = last;
                }
                if last && self.every_live_channel_ended() {
                    self.drive(Input::End, arrived, parallel, out);
                }
            }
            Task::Refused(cause) => self.refuse(cause, arrived, out),
            Task::Beats(onsets) => self.drive(Input::Beats(onsets), arrived, parallel, out),
            Task::Acknowledge { alarm, author } => {
                self.drive(Input::Acknowledge { alarm, author }, arrived, parallel, out);
            }
            Task::Tick => self.drive(Input::Tick, arrived, parallel, out),
            Task::Share(share) => {
                #[allow(clippy::cast_precision_loss, clippy::cast_possible_truncation, clippy::cast_sign_loss)]
                let members = (self.estimator.settings().members as f64 * share).ceil() as usize;
                self.drive(Input::Members(members.max(LEAST_MEMBERS)), arrived, parallel, out);
            }
            Task::Report { want_members, queue_depth, queue_full, inlet_full } => {
                self.drive(Input::WantMembers(want_members), arrived, parallel, out);
                return Some(self.health(queue_depth, &[("queue_full", queue_full), ("inlet_full", inlet_full)]));
            }
        }
        None
    }

    /// What was put out by the last task has been handed over.
    pub(super) fn handed_over(&mut self) {
        let now = self.clock.now();
        for closed_at in self.closed.drain(..) {
            let lag_us = u64::try_from(now.ns_since(closed_at) / 1000).unwrap_or(0);
            if let Some(histogram) = &mut self.lag_us {
                histogram.saturating_record(lag_us);
            }
            self.lately.record(lag_us, now);
        }
    }

    /// Adds what this bed did.
    pub(super) fn account(&self, all: &mut Account) {
        all.beds += 1;
        all.windows += self.windows;
        all.one_by_one += self.one_by_one;
        all.not_converged += self.not_converged;
        let lost = self.counters.values().chain(self.estimator.refused().values());
        all.lost = lost.fold(all.lost, |sum, n| sum.saturating_add(*n));
        if let (Some(all), Some(own)) = (&mut all.lag_us, &self.lag_us) {
            // Of the same range, so that they fit.
            let _ = all.add(own);
        } else {
            all.lag_us.clone_from(&self.lag_us);
        }
    }

    /// Counts a message that the edge did not understand, and says so once in a while.
    fn refuse(&mut self, cause: &'static str, arrived: ArrivalTime, out: &mut Vec<Output>) {
        *self.counters.entry(cause).or_default() += 1;
        if self.reported.get(cause).is_none_or(|at| arrived.ns_since(*at) >= REPORT_EVERY_NS) {
            self.reported.insert(cause, arrived);
            out.push(Output::Notice(Notice {
                time: self.last_window,
                kind: NoticeKind::NotUnderstood(cause),
                channel: None,
                text: None,
            }));
        }
    }

    fn every_live_channel_ended(&self) -> bool {
        let channels = self.estimator.channels();
        channels.iter().zip(&self.ended).all(|(c, ended)| *ended || c.liveness != Liveness::Live)
    }

    fn count_lost(&mut self, channel: usize, sequence: u64) {
        let Some(expected) = self.expected.get_mut(channel) else { return };
        if let Some(due) = *expected {
            // A sender that starts again counts from 0.
            let lost = sequence.saturating_sub(due);
            if lost > 0 {
                let counter = self.counters.entry("lost_blocks").or_default();
                *counter = counter.saturating_add(lost);
            }
        }
        *expected = Some(sequence.wrapping_add(1));
    }

    #[allow(clippy::cast_precision_loss)]
    fn drive(&mut self, input: Input, arrived: ArrivalTime, parallel: &dyn Parallel, out: &mut Vec<Output>) {
        let first = out.len();
        let started = self.clock.now();
        self.estimator.handle(input, arrived, parallel, out);
        let finished = self.clock.now();
        let mut windows = 0_u32;
        for output in &out[first..] {
            let Output::Window(window) = output else { continue };
            windows += 1;
            self.windows += 1;
            self.windows_without_data += u64::from(window.samples == 0);
            self.members_alive = window.report.solved;
            self.iterations += window.report.iterations as u64;
            self.not_converged += window.report.not_converged as u64;
            self.one_by_one += window.report.one_by_one as u64;
            self.last_window = window.end;
            self.closed.push(window.closed_at);
        }
        if windows > 0 {
            let per_window_ms = s_from_ns(finished.ns_since(started)) * 1e3 / f64::from(windows);
            self.solve_ms += if self.solve_ms > 0.0 { SOLVE_WEIGHT } else { 1.0 } * (per_window_ms - self.solve_ms);
        }
    }

    #[allow(clippy::cast_precision_loss)]
    fn health(&self, queue_depth: usize, lost: &[(&'static str, u64)]) -> Health {
        let lately = self.lately.all();
        let lag = |quantile: f64| lately.as_ref().map_or(f64::NAN, |h| h.value_at_quantile(quantile) as f64 / 1e3);
        let members = self.estimator.settings().members;
        let mut counters = self.counters.clone();
        counters.extend(self.estimator.refused().iter().map(|(cause, n)| (cause.name(), *n)));
        counters.insert("restarts", self.estimator.restarts());
        counters.extend(lost.iter().copied());
        counters.retain(|_, n| *n > 0);
        Health {
            time: self.last_window,
            members,
            members_alive: self.members_alive,
            windows: self.windows,
            windows_without_data: self.windows_without_data,
            lag_p50_ms: lag(0.5),
            lag_p99_ms: lag(0.99),
            lag_max_ms: lag(1.0),
            solve_ms: self.solve_ms,
            iterations: self.iterations as f64 / (self.windows.max(1) * members as u64) as f64,
            not_converged: self.not_converged,
            queue_depth,
            counters,
            channels: self.estimator.channels(),
            disagreement: self.estimator.disagreement().map(|apart| (apart, self.estimator.estimated().to_vec())),
        }
    }
}
