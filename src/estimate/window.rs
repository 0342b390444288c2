//! Samples in, closed windows out.
//!
//! Windows are cut in event time: `(start, end]` on a grid of multiples of the window length; the very first also
//! takes its start. A window closes
//!
//! - when every live channel has delivered past its end, or
//! - when the allowed lateness is over: counted in arrival time from the moment at which the first channel delivered
//!   past the end or, when none does, at which it was due.
//!
//! Then it is final: later samples for it are counted and dropped. In which order the channels arrive and how they are
//! cut into blocks changes nothing else; one channel's own blocks are expected in order. Every refusal has a [`Refusal`] and a counter.

use std::collections::VecDeque;

use super::ensemble::Observation;
use super::settings::{ChannelSettings, WindowSettings};
use super::time::{ArrivalTime, EventTime};

/// Samples a channel may have waiting; at 1 kHz about a minute.
const MAX_PENDING: usize = 65_536;

/// Blocks in a row from another time before it is believed that the sender's clock has changed.
const CLOCK_JUMP_BLOCKS: u32 = 3;

/// Event times beyond this, 146 years to either side of zero, are nobody's; sums of the others stay integers.
const MAX_TIME_NS: u64 = 1 << 62;

/// Moments at which the frontier moved that are remembered; enough for the allowed lateness at a few kHz.
const MAX_FRONTIER_MARKS: usize = 4096;

/// Why a sample was not used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Refusal {
    /// NaN or infinite.
    NotFinite,
    /// Outside of the plausible range of its channel.
    Implausible,
    /// Its window is closed.
    Late,
    /// The channel has a sample at this time already.
    Duplicate,
    /// Too many samples waiting.
    Overflow,
    /// From a time far from now; the sender's clock may have jumped.
    ClockJump,
}

impl Refusal {
    /// All causes.
    pub const ALL: [Self; 6] =
        [Self::NotFinite, Self::Implausible, Self::Late, Self::Duplicate, Self::Overflow, Self::ClockJump];

    /// Name in counters and events.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::NotFinite => "not_finite",
            Self::Implausible => "implausible",
            Self::Late => "late",
            Self::Duplicate => "duplicate",
            Self::Overflow => "overflow",
            Self::ClockJump => "clock_jump",
        }
    }
}

/// A sample as it came.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RawSample {
    /// When it was taken.
    pub time: EventTime,
    /// \[mmHg\]
    pub value: f64,
}

/// Whether a channel delivers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Liveness {
    /// Nothing so far.
    Never,
    /// Windows wait for it.
    Live,
    /// It missed a deadline; windows do not wait until it delivers again.
    Silent,
}

/// What became of a block.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Ingested {
    /// Samples kept.
    pub kept: usize,
    /// Samples refused, with the causes in the order of [`Refusal::ALL`].
    pub refused: [usize; Refusal::ALL.len()],
    /// The channel was silent and is back.
    pub recovered: bool,
    /// The sender lives in another time: nothing was taken, and whoever owns this must start again with this block.
    pub clock_changed: bool,
}

/// A window that is final.
#[derive(Debug, Clone, PartialEq)]
pub struct ClosedWindow {
    /// Its start (not part of it, unless it is the first).
    pub start: EventTime,
    /// Its end.
    pub end: EventTime,
    /// In order of time, then channel.
    pub observations: Vec<Observation>,
    /// Channels that missed the deadline with this window.
    pub gone_silent: Vec<usize>,
    /// When the input came that closed it; the deadline if none did.
    pub closed_at: ArrivalTime,
}

#[derive(Debug, Clone)]
struct Channel {
    settings: ChannelSettings,
    /// Ascending in time.
    pending: VecDeque<RawSample>,
    /// Latest sample seen.
    delivered: Option<EventTime>,
    liveness: Liveness,
    /// Blocks in a row from another time.
    strikes: u32,
}

/// Cuts the samples of one bed into windows.
#[derive(Debug, Clone)]
pub struct WindowCutter {
    settings: WindowSettings,
    channels: Vec<Channel>,
    /// End of the last closed window.
    closed_to: Option<EventTime>,
    /// Latest event time delivered by any channel, and when it got there.
    marks: VecDeque<(EventTime, ArrivalTime)>,
    /// Arrival of the first sample, and of the last.
    first_arrival: Option<ArrivalTime>,
    last_arrival: ArrivalTime,
    /// Event time of the last sample that entered a window.
    last_data: Option<EventTime>,
    ended: bool,
    /// Vectors to be used again.
    taken: Vec<(EventTime, Observation)>,
    spare: Vec<Observation>,
}

impl WindowCutter {
    /// Nothing delivered yet.
    #[must_use]
    pub fn new(settings: WindowSettings, channels: &[ChannelSettings]) -> Self {
        let channel = |settings: &ChannelSettings| Channel {
            settings: settings.clone(),
            pending: VecDeque::new(),
            delivered: None,
            liveness: Liveness::Never,
            strikes: 0,
        };
        Self {
            settings,
            channels: channels.iter().map(channel).collect(),
            closed_to: None,
            marks: VecDeque::new(),
            first_arrival: None,
            last_arrival: ArrivalTime(0),
            last_data: None,
            ended: false,
            taken: Vec::new(),
            spare: Vec::new(),
        }
    }

    /// Whether channel `i` delivers, and its latest sample.
    #[must_use]
    pub fn liveness(&self, i: usize) -> (Liveness, Option<EventTime>) {
        (self.channels[i].liveness, self.channels[i].delivered)
    }

    /// End of the last closed window.
    #[must_use]
    pub fn closed_to(&self) -> Option<EventTime> {
        self.closed_to
    }

    /// Samples waiting.
    #[must_use]
    pub fn pending(&self) -> usize {
        self.channels.iter().map(|c| c.pending.len()).sum()
    }

    /// Takes a block of one channel.
    pub fn ingest(&mut self, channel: usize, samples: &[RawSample], now: ArrivalTime) -> Ingested {
        let mut result = Ingested::default();
        let Some(newest) = samples.iter().map(|s| s.time).filter(|t| is_possible(*t)).max() else {
            result.refused[Refusal::ClockJump as usize] = samples.len();
            return result;
        };
        if self.is_from_another_time(newest, now) {
            let strikes = &mut self.channels[channel].strikes;
            *strikes = strikes.saturating_add(1);
            result.clock_changed = self.believes_in_another_time(channel);
            if !result.clock_changed {
                result.refused[Refusal::ClockJump as usize] = samples.len();
            }
            return result;
        }
        self.channels[channel].strikes = 0;
        self.ended = false;
        let present = self.marks.back().map_or(newest, |(frontier, _)| *frontier);
        let oldest = present.plus_ns(-self.settings.forecast_limit_ns);
        for sample in samples {
            match self.take(channel, *sample, oldest) {
                Ok(()) => result.kept += 1,
                Err(refusal) => result.refused[refusal as usize] += 1,
            }
        }
        // Whatever its samples are worth, it is there. Nonsense tells the time; and a channel that always comes a
        // little after the others would stay silent for ever if windows did not begin to wait for it again.
        let liveness = &mut self.channels[channel].liveness;
        result.recovered = *liveness == Liveness::Silent;
        *liveness = Liveness::Live;
        self.advance_frontier(now);
        result
    }

    /// Whether the sender's clock has changed, rather than that of one of several devices.
    fn believes_in_another_time(&self, channel: usize) -> bool {
        let here = |(i, c): (usize, &Channel)| i != channel && c.liveness == Liveness::Live && c.strikes == 0;
        self.channels[channel].strikes >= CLOCK_JUMP_BLOCKS && !self.channels.iter().enumerate().any(here)
    }

    /// Far from where this bed is, beyond what the time passed since would explain.
    fn is_from_another_time(&self, time: EventTime, now: ArrivalTime) -> bool {
        let Some(&(frontier, at)) = self.marks.back() else {
            return false;
        };
        let limit = self.settings.forecast_limit_ns;
        let ahead = time.ns_since(frontier);
        ahead > limit.saturating_add(now.ns_since(at).max(0)) || ahead < -limit
    }

    fn take(&mut self, channel: usize, sample: RawSample, oldest: EventTime) -> Result<(), Refusal> {
        let closed_to = self.closed_to;
        let channel = &mut self.channels[channel];
        let from_another_time = !is_possible(sample.time) || (closed_to.is_none() && sample.time < oldest);
        if from_another_time {
            return Err(Refusal::ClockJump);
        }
        // The clock of the channel goes on, whatever the value is worth.
        channel.delivered = channel.delivered.max(Some(sample.time));
        if !sample.value.is_finite() {
            return Err(Refusal::NotFinite);
        }
        let (low, high) = channel.settings.plausible_mmhg;
        if sample.value < low || sample.value > high {
            return Err(Refusal::Implausible);
        }
        if closed_to.is_some_and(|closed| sample.time <= closed) {
            return Err(Refusal::Late);
        }
        if channel.pending.len() >= MAX_PENDING {
            return Err(Refusal::Overflow);
        }
        // Nearly always the back.
        let at = channel.pending.partition_point(|s| s.time < sample.time);
        if channel.pending.get(at).is_some_and(|s| s.time == sample.time) {
            return Err(Refusal::Duplicate);
        }
        channel.pending.insert(at, sample);
        Ok(())
    }

    fn advance_frontier(&mut self, now: ArrivalTime) {
        let Some(frontier) = self.channels.iter().filter_map(|c| c.delivered).max() else {
            return;
        };
        self.first_arrival.get_or_insert(now);
        self.last_arrival = now;
        if self.marks.back().is_none_or(|(time, _)| *time < frontier) {
            self.marks.push_back((frontier, now));
            if self.marks.len() > MAX_FRONTIER_MARKS {
                self.marks.pop_front();
            }
        }
    }

    /// No more samples will come: everything delivered may be closed.
    pub fn end(&mut self) {
        self.ended = true;
    }

    /// Whether everything delivered may be closed.
    #[must_use]
    pub fn has_ended(&self) -> bool {
        self.ended
    }

    /// The next window that is final at `now`, if any; call until there is none.
    pub fn next(&mut self, now: ArrivalTime) -> Option<ClosedWindow> {
        let (start, first) = match self.closed_to {
            Some(closed) => (closed, false),
            None => (self.origin(now)?, true),
        };
        let end = start.plus_ns(self.settings.length_ns);
        let closed_at = self.closes(end, now)?;
        let gone_silent = self.silence_the_missing(end);
        let observations = self.observations(start, end, first);
        if !observations.is_empty() {
            self.last_data = Some(end);
        }
        self.closed_to = Some(end);
        while self.marks.get(1).is_some_and(|(time, _)| *time <= end) {
            self.marks.pop_front();
        }
        Some(ClosedWindow { start, end, observations, gone_silent, closed_at })
    }

    /// Takes back a window that is done with, so that the next one need not be allocated.
    pub fn recycle(&mut self, window: ClosedWindow) {
        self.spare = window.observations;
    }

    /// Start of the first window: once every channel has spoken, or the first has waited long enough.
    fn origin(&self, now: ArrivalTime) -> Option<EventTime> {
        let waited = now.ns_since(self.first_arrival?) > self.settings.allowed_lateness_ns;
        let all_spoke = self.channels.iter().all(|c| c.delivered.is_some());
        if !(waited || all_spoke || self.ended) {
            return None;
        }
        let earliest = self.next_pending()?.0;
        // Down to the grid, so that the windows do not depend on who spoke first.
        Some(EventTime(earliest - earliest.rem_euclid(self.settings.length_ns)))
    }

    /// When a window with this end became final, if it is by `now`.
    fn closes(&self, end: EventTime, now: ArrivalTime) -> Option<ArrivalTime> {
        let waited_for = |c: &&Channel| c.liveness == Liveness::Live;
        let mut live = self.channels.iter().filter(waited_for).peekable();
        let passed = |c: &Channel| c.delivered.is_some_and(|d| d >= end);
        let all_passed = live.peek().is_some() && live.all(passed);
        let (frontier, frontier_at) = *self.marks.back()?;
        if self.forecasts_enough(end) {
            return None;
        }
        if all_passed {
            return Some(self.last_arrival);
        }
        if self.ended {
            let something_left = frontier >= end || self.channels.iter().any(|c| !c.pending.is_empty());
            return something_left.then_some(self.last_arrival);
        }
        let due = match self.marks.iter().find(|(time, _)| *time >= end) {
            Some((_, at)) => at.0,
            None => frontier_at.0.saturating_add(end.ns_since(frontier)),
        };
        let deadline = ArrivalTime(due.saturating_add(self.settings.allowed_lateness_ns));
        (now >= deadline).then_some(deadline)
    }

    fn silence_the_missing(&mut self, end: EventTime) -> Vec<usize> {
        let mut gone = Vec::new();
        for (i, channel) in self.channels.iter_mut().enumerate() {
            if channel.liveness == Liveness::Live && channel.delivered.is_none_or(|d| d < end) && !self.ended {
                channel.liveness = Liveness::Silent;
                gone.push(i);
            }
        }
        gone
    }

    #[allow(clippy::cast_precision_loss)]
    fn observations(&mut self, start: EventTime, end: EventTime, first: bool) -> Vec<Observation> {
        let length = self.settings.length_ns as f64;
        let taken = &mut self.taken;
        taken.clear();
        for (i, channel) in self.channels.iter_mut().enumerate() {
            while let Some(sample) = channel.pending.front().copied().filter(|s| s.time <= end) {
                channel.pending.pop_front();
                if sample.time > start || first {
                    let s = sample.time.ns_since(start) as f64 / length;
                    taken.push((sample.time, Observation { s, channel: i, value: sample.value }));
                }
            }
        }
        // No two are alike: of a channel, the same time is refused.
        taken.sort_unstable_by_key(|(time, o)| (*time, o.channel));
        let mut observations = std::mem::take(&mut self.spare);
        observations.clear();
        observations.extend(taken.iter().map(|(_, o)| *o));
        observations
    }

    /// Whether silence has lasted so long that a window with this end is not even forecast.
    fn forecasts_enough(&self, end: EventTime) -> bool {
        let over = self.last_data.is_some_and(|last| end.ns_since(last) > self.settings.forecast_limit_ns);
        over && self.next_pending().is_none_or(|next| next > end)
    }

    fn next_pending(&self) -> Option<EventTime> {
        self.channels.iter().filter_map(|c| c.pending.front()).map(|s| s.time).min()
    }

    /// Whether samples wait beyond a silence too long to bridge: the owner must start anew.
    #[must_use]
    pub fn needs_restart(&self) -> bool {
        let next_end = self.closed_to.map(|closed| closed.plus_ns(self.settings.length_ns));
        self.next_pending().is_some() && next_end.is_some_and(|end| self.forecasts_enough(end))
    }

    /// Forgets where it was and keeps what is waiting.
    pub fn restart(&mut self, now: ArrivalTime) {
        self.closed_to = None;
        self.last_data = None;
        self.marks.clear();
        self.first_arrival = None;
        for channel in &mut self.channels {
            channel.strikes = 0;
            channel.delivered = channel.pending.back().map(|s| s.time);
            channel.liveness = if channel.delivered.is_some() { Liveness::Live } else { Liveness::Never };
        }
        self.advance_frontier(now);
    }

    /// Forgets everything, for a sender whose clock has changed; returns how many samples were waiting.
    pub fn clear(&mut self, now: ArrivalTime) -> usize {
        let dropped = self.pending();
        for channel in &mut self.channels {
            channel.pending.clear();
        }
        self.restart(now);
        dropped
    }
}

fn is_possible(time: EventTime) -> bool {
    time.0.unsigned_abs() <= MAX_TIME_NS
}
