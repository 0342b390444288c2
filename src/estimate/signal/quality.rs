//! Whether a pressure channel shows the pressure of a patient, judged from its own past alone.
//!
//! Samples are summed up in slots of 0.1 s. Two rings of slots are kept: `recent`, the last 2 s whatever they are
//! worth, and `normal`, the last 5 s that were good. From them follow
//!
//! - the range: lowest and highest sample of `normal`. A fast flush, or a line opened to air, leaves it in one step;
//! - the pulse: the range of the slot means of `recent`, and the climb: the sum of their rises per second. The pulse of
//!   a fast heart is small but its climb is not, so a line counts as damped when both collapse, against averages over
//!   10 s of good data.
//!
//! A channel is set aside with the first sample that is wrong and taken back when nothing was wrong for a settle time,
//! the samples are in the old range and, where there was a pulse, it is back. When a pulse stays outside of the old
//! range, the patient or the zero has changed: then the past is forgotten.
//!
//! What cannot be told from one channel: a stopped heart is disconnected after some 9 s; a pulse lost for good (an
//! assist device) stays damped; disturbances within the range pass. Deliberately absent: the model, other channels,
//! clocks. All times are event times.

use std::collections::VecDeque;

/// Length of a slot: averages noise, and at 180 beats per minute still resolves the pulse.
const SLOT_S: f64 = 0.1;

/// Slots in `recent`: a beat at 30 per minute.
const RECENT_SLOTS: usize = 20;

/// Slots in `normal`: a breath and several beats.
const NORMAL_SLOTS: usize = 50;

/// After being set aside for longer than `normal` reaches back, it is filled anew.
const RANGE_AGE_S: f64 = 5.0;

/// Usual pulse, climb and mean are averages over this: slower than a clot, faster than a drug.
const USUAL_S: f64 = 10.0;

/// How far out of its range a step leads: a quarter of the range, for the first beat after a pause,
const STEP_SHARE: f64 = 0.25;

/// and this much, for channels without a pulse. \[mmHg\]
const STEP_MMHG: f64 = 15.0;

/// A step rises by `STEP_MMHG` within this. Beats rise as fast, but no longer when they leave the range.
const STEP_S: f64 = 0.04;

/// However slowly, a pressure so much above its range is none of the patient: twice the step.
const FAR: f64 = 2.0;

/// Below this for `NEGATIVE_S`, no vessel: inspiration against a closed airway is less. \[mmHg\]
const NEGATIVE_MMHG: f64 = -10.0;

/// How long a pressure is at nothing before the line is off.
const NEGATIVE_S: f64 = 0.5;

/// Nothing, as a share of the usual mean: a pause of the heart does not get there within seconds.
const NOTHING: f64 = 0.15;

/// Values no further apart are the same. \[mmHg\]
const SAME_MMHG: f64 = 1e-3;

/// Equal values for longer than this are no signal,
const FLAT_S: f64 = 0.3;

/// nor are runs so many times longer than those that coarse counts produced lately.
const FLAT_RUNS: f64 = 5.0;

/// Without a pulse, or a past, coarse counts may rest for some time.
const FLAT_QUIET_S: f64 = 3.0;

/// A plateau at a rail: at least this long and three samples,
const PLATEAU_S: f64 = 0.02;

/// and entered with a corner: this share of the range in the `CORNER_S` before. Natural peaks are round.
const CORNER: f64 = 0.1;

/// Counts coarser than this share of the range make plateaus of their own: no judgement.
const COARSE: f64 = 0.02;

/// See `CORNER`.
const CORNER_S: f64 = 0.02;

/// Diastole may enter the lower rail slowly, but does not rest there this long at the same value.
const RESTING_PLATEAU_S: f64 = 0.15;

/// So many plateaus at the same value are a rail,
const PLATEAUS: u32 = 3;

/// until none came for this long: two beats at 40 per minute.
const PLATEAU_MEMORY_S: f64 = 3.0;

/// A pulse below this share of the usual has collapsed,
const COLLAPSED: f64 = 1.0 / 3.0;

/// above this it is back.
const RESTORED: f64 = 0.5;

/// How long both must have collapsed, beyond the 2 s over which they are taken.
const COLLAPSED_S: f64 = 0.3;

/// With a lower share of the usual mean, the heart may have stopped or bleed;
const MEAN_STAYS: f64 = 0.6;

/// after this the channel is set aside all the same.
const STOPPED_S: f64 = 4.0;

/// A channel has a pulse from here on: more than venous waves. \[mmHg\]
const PULSE_MMHG: f64 = 6.0;

/// Breathing moves venous pressures as far, but not as often. \[mmHg/s\]
const CLIMB_MMHG_PER_S: f64 = 8.0;

/// After a flush the line rings, for less than this.
const FLUSH_SETTLE_S: f64 = 0.5;

/// What comes sooner after a wrong sample may be ringing, and is not a measure of what is normal.
const RINGING_S: f64 = 0.15;

/// After anything else, a good beat.
const SETTLE_S: f64 = 1.0;

/// A pulse outside of the old range for so long is the new one.
const ADOPT_PULSE_S: f64 = 5.0;

/// Without a pulse to tell: longer than any flush.
const ADOPT_S: f64 = 30.0;

/// A silence longer than this cuts a beat.
const GAP_S: f64 = 0.5;

/// After this, what was usual is no longer known.
const FORGET_S: f64 = 60.0;

/// Samples closer than this are not compared, which bounds the memory.
const MIN_SPACING_S: f64 = 0.000_5;

/// What a pressure can be at all.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct QualitySettings {
    /// Below it, at once no vessel. \[mmHg\]
    pub lowest_mmhg: f64,
    /// Above it, at once a flush. \[mmHg\]
    pub highest_mmhg: f64,
}

impl Default for QualitySettings {
    fn default() -> Self {
        Self { lowest_mmhg: -20.0, highest_mmhg: 250.0 }
    }
}

/// Why a channel is set aside.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Artefact {
    /// The line is being flushed.
    Flush,
    /// The waveform is cut off at the end of the scale.
    Clipping,
    /// The value does not move.
    FlatLine,
    /// The line is open, closed or off.
    Disconnected,
    /// The pulse is lost on its way.
    Damped,
}

impl Artefact {
    /// All of them.
    pub const ALL: [Self; 5] = [Self::Flush, Self::Clipping, Self::FlatLine, Self::Disconnected, Self::Damped];

    /// Name in counters and events.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Flush => "flush",
            Self::Clipping => "clipping",
            Self::FlatLine => "flat_line",
            Self::Disconnected => "disconnected",
            Self::Damped => "damped",
        }
    }

    /// One sentence for people.
    #[must_use]
    pub fn text(self) -> &'static str {
        match self {
            Self::Flush => "The pressure jumped far above its range, as when the line is flushed.",
            Self::Clipping => "The waveform is cut off at the end of the scale.",
            Self::FlatLine => "The value does not move at all.",
            Self::Disconnected => "The pressure fell to nothing, as when the line is open or the transducer is off.",
            Self::Damped => "The pulse is nearly gone while the mean stays, as with a clot or a kink in the line.",
        }
    }

    /// Whether it is worth telling after the other: a lost pulse says least, and open and flushed lines are flat too.
    fn is_clearer_than(self, other: Self) -> bool {
        match self {
            Self::Damped => false,
            Self::FlatLine => matches!(other, Self::Damped | Self::Clipping),
            _ => self != other,
        }
    }

    fn settle_s(self) -> f64 {
        if self == Self::Flush { FLUSH_SETTLE_S } else { SETTLE_S }
    }
}

/// What changed with a sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Change {
    /// The channel is set aside, or its cause became clearer.
    SetAside(Artefact),
    /// The channel is good again.
    TakenBack,
}

/// What a sample is worth.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Verdict {
    /// Whether it shows the patient.
    pub use_sample: bool,
    /// What changed with it.
    pub changed: Option<Change>,
}

/// What remains of 0.1 s.
#[derive(Debug, Clone, Copy)]
struct Slot {
    start_s: f64,
    mean: f64,
    low: f64,
    high: f64,
    /// Longest run of equal values that ended in it.
    run_s: f64,
    /// Smallest step between its samples.
    count: f64,
}

/// A slot that is not over.
#[derive(Debug, Clone, Copy)]
struct OpenSlot {
    slot: Slot,
    sum: f64,
    samples: f64,
}

/// Pulse of some slots: range of their means, and sum of their rises per second.
#[derive(Debug, Clone, Copy, Default)]
struct Pulse {
    range: f64,
    climb: f64,
}

impl Pulse {
    fn of<'a>(slots: impl Iterator<Item = &'a Slot>) -> Self {
        let (mut low, mut high, mut rise, mut length_s) = (f64::INFINITY, f64::NEG_INFINITY, 0.0, 0.0);
        let mut previous: Option<&Slot> = None;
        for slot in slots {
            low = low.min(slot.mean);
            high = high.max(slot.mean);
            if let Some(previous) = previous {
                rise += (slot.mean - previous.mean).max(0.0);
                length_s += slot.start_s - previous.start_s;
            }
            previous = Some(slot);
        }
        if length_s > 0.0 { Self { range: high - low, climb: rise / length_s } } else { Self::default() }
    }

    /// Whether neither reaches a share of the usual.
    fn is_below(self, share: f64, usual: Self) -> bool {
        self.range < share * usual.range && self.climb < share * usual.climb
    }

    fn is_pulse(self) -> bool {
        self.range >= PULSE_MMHG && self.climb >= CLIMB_MMHG_PER_S
    }
}

/// Averages of good data.
#[derive(Debug, Clone, Copy)]
struct Usual {
    pulse: Pulse,
    mean: f64,
    /// How much data is in them.
    age_s: f64,
}

/// Lowest and highest good sample of late.
#[derive(Debug, Clone, Copy)]
struct Range {
    low: f64,
    high: f64,
    run_s: f64,
}

impl Range {
    /// How far a step leads out of it.
    fn step(self) -> f64 {
        STEP_SHARE * (self.high - self.low) + STEP_MMHG
    }
}

/// Equal values in a row.
#[derive(Debug, Clone, Copy)]
struct Run {
    value: f64,
    since_s: f64,
    until_s: f64,
    samples: u32,
    /// Value some time before it.
    before: f64,
}

/// Runs at the same extreme value.
#[derive(Debug, Clone, Copy)]
struct Rail {
    value: f64,
    plateaus: u32,
    last_s: f64,
}

/// Why and since when.
#[derive(Debug, Clone, Copy)]
struct Aside {
    artefact: Artefact,
    /// The first one.
    since_s: f64,
    /// Last sample with a cause of its own.
    wrong_s: f64,
    /// Last sample out of the old range, or with a cause.
    outside_s: f64,
}

/// Judges one channel.
#[derive(Debug, Clone)]
pub struct Quality {
    settings: QualitySettings,
    aside: Option<Aside>,
    last_s: Option<f64>,
    /// Samples of the last `STEP_S`.
    trail: VecDeque<(f64, f64)>,
    open: Option<OpenSlot>,
    recent: VecDeque<Slot>,
    normal: VecDeque<Slot>,
    range: Option<Range>,
    usual: Option<Usual>,
    run: Option<Run>,
    rails: [Option<Rail>; 2],
    /// Since when the pressure is at nothing.
    nothing_since_s: Option<f64>,
    /// Since when the pulse has collapsed.
    collapsed_since_s: Option<f64>,
    /// Whether there was a pulse and `recent` has less than half of it.
    pulse_is_missing: bool,
}

impl Quality {
    /// Nothing seen yet.
    #[must_use]
    pub fn new(settings: QualitySettings) -> Self {
        Self {
            settings,
            aside: None,
            last_s: None,
            trail: VecDeque::new(),
            open: None,
            recent: VecDeque::new(),
            normal: VecDeque::new(),
            range: None,
            usual: None,
            run: None,
            rails: [None; 2],
            nothing_since_s: None,
            collapsed_since_s: None,
            pulse_is_missing: false,
        }
    }

    /// Why the channel is set aside, if it is.
    #[must_use]
    pub fn state(&self) -> Option<Artefact> {
        self.aside.map(|aside| aside.artefact)
    }

    /// Judges the next sample. Values that are no numbers, and samples that go back in time by less than a gap, are
    /// not used and change nothing.
    pub fn take(&mut self, time_s: f64, value: f64) -> Verdict {
        if !(time_s.is_finite() && value.is_finite()) {
            return Verdict { use_sample: false, changed: None };
        }
        let step_s = self.last_s.map_or(MIN_SPACING_S, |last_s| time_s - last_s);
        if step_s.abs() > GAP_S {
            self.bridge(step_s, time_s);
        } else if step_s < MIN_SPACING_S {
            return Verdict { use_sample: self.aside.is_none() && step_s >= 0.0, changed: None };
        }
        self.last_s = Some(time_s);
        self.extend_run(time_s, value);
        self.extend_slot(time_s, value);
        self.note_nothing(time_s, value);
        let changed = self.decide(time_s, value);
        self.trail.push_back((time_s, value));
        while self.trail.front().is_some_and(|(t, _)| time_s - t > STEP_S) {
            self.trail.pop_front();
        }
        Verdict { use_sample: self.aside.is_none(), changed }
    }

    /// Goes on after a silence, or in another time.
    fn bridge(&mut self, step_s: f64, time_s: f64) {
        self.trail.clear();
        self.open = None;
        self.recent.clear();
        self.run = None;
        self.rails = [None; 2];
        self.nothing_since_s = None;
        self.collapsed_since_s = None;
        if let Some(aside) = &mut self.aside {
            aside.wrong_s = time_s;
            aside.outside_s = time_s;
        }
        if !(0.0..=FORGET_S).contains(&step_s) {
            self.forget();
        }
    }

    fn forget_range(&mut self) {
        self.normal.clear();
        self.range = None;
    }

    fn forget(&mut self) {
        self.forget_range();
        self.usual = None;
        self.collapsed_since_s = None;
        self.pulse_is_missing = false;
    }

    fn decide(&mut self, time_s: f64, value: f64) -> Option<Change> {
        let cause = self.cause(time_s, value);
        let Some(mut aside) = self.aside else {
            let artefact = cause.or_else(|| self.step(value))?;
            self.set_aside(artefact, time_s);
            return Some(Change::SetAside(artefact));
        };
        let mut changed = None;
        if let Some(cause) = cause {
            aside.wrong_s = time_s;
            if cause.is_clearer_than(aside.artefact) {
                aside.artefact = cause;
                changed = Some(Change::SetAside(cause));
            }
        }
        if cause.is_some() || self.is_outside(value) {
            aside.outside_s = time_s;
        }
        if self.pulse_is_missing {
            aside.wrong_s = time_s;
        }
        self.aside = Some(aside);
        if self.is_back(aside, time_s) {
            if time_s - aside.since_s > RANGE_AGE_S {
                self.forget_range();
            }
            self.take_back(aside.outside_s);
            changed = Some(Change::TakenBack);
        } else if self.is_another(aside, time_s) {
            self.forget();
            self.take_back(aside.wrong_s);
            changed = Some(Change::TakenBack);
        }
        changed
    }

    /// What is wrong with this sample whatever came before it, or for long enough.
    fn cause(&self, time_s: f64, value: f64) -> Option<Artefact> {
        if self.rails.iter().flatten().any(|rail| rail.is_certain(time_s)) {
            return Some(Artefact::Clipping);
        }
        if value > self.settings.highest_mmhg {
            return Some(Artefact::Flush);
        }
        let nothing_s = self.nothing_since_s.map_or(0.0, |since_s| time_s - since_s);
        if value < self.settings.lowest_mmhg && nothing_s <= NEGATIVE_S && self.state() == Some(Artefact::Flush) {
            // It rings.
            return Some(Artefact::Flush);
        }
        let is_off = self.state() == Some(Artefact::Disconnected) && self.nothing_since_s.is_some();
        if value < self.settings.lowest_mmhg || nothing_s > NEGATIVE_S || is_off {
            return Some(Artefact::Disconnected);
        }
        if self.run.is_some_and(|run| run.until_s - run.since_s > self.longest_run_s()) {
            return Some(Artefact::FlatLine);
        }
        self.collapse(time_s)
    }

    fn longest_run_s(&self) -> f64 {
        let shortest_s = if self.has_pulse() { FLAT_S } else { FLAT_QUIET_S };
        self.range.map_or(shortest_s, |range| (FLAT_RUNS * range.run_s).max(shortest_s))
    }

    /// A pulse that is gone.
    fn collapse(&self, time_s: f64) -> Option<Artefact> {
        let collapsed_s = time_s - self.collapsed_since_s?;
        let mean_stays = mean(&self.recent)? > MEAN_STAYS * self.usual?.mean;
        match mean_stays {
            true if collapsed_s > COLLAPSED_S => Some(Artefact::Damped),
            false if collapsed_s > STOPPED_S => Some(Artefact::Disconnected),
            _ => None,
        }
    }

    /// A sudden way out of the range.
    fn step(&self, value: f64) -> Option<Artefact> {
        let range = self.range?;
        let lowest = self.trail.iter().map(|s| s.1).fold(f64::INFINITY, f64::min);
        let highest = self.trail.iter().map(|s| s.1).fold(f64::NEG_INFINITY, f64::max);
        let above = value - range.high;
        let below = range.low - value;
        if above > FAR * range.step() || (above > range.step() && value - lowest >= STEP_MMHG) {
            Some(Artefact::Flush)
        } else if below > range.step() && highest - value >= STEP_MMHG {
            Some(Artefact::Disconnected)
        } else {
            None
        }
    }

    /// Half as far as a step leads.
    fn is_outside(&self, value: f64) -> bool {
        self.range.is_some_and(|range| (value - range.high).max(range.low - value) > 0.5 * range.step())
    }

    fn set_aside(&mut self, artefact: Artefact, time_s: f64) {
        self.aside = Some(Aside { artefact, since_s: time_s, wrong_s: time_s, outside_s: time_s });
        // It may have begun before it was noticed.
        if self.normal.len() > 1 {
            self.normal.pop_back();
            self.measure_range();
        }
    }

    fn has_pulse(&self) -> bool {
        self.usual.is_some_and(|usual| usual.pulse.is_pulse())
    }

    /// In the old range for long enough, with the pulse where there was one.
    fn is_back(&self, aside: Aside, time_s: f64) -> bool {
        if time_s - aside.outside_s < aside.artefact.settle_s() {
            return false;
        }
        let pulse = Pulse::of(self.recent.iter().filter(|slot| slot.start_s >= aside.outside_s));
        self.usual.is_none_or(|usual| !usual.pulse.is_pulse() || !pulse.is_below(RESTORED, usual.pulse))
    }

    /// Out of the old range for so long, and with such a pulse, that this is the new one.
    fn is_another(&self, aside: Aside, time_s: f64) -> bool {
        time_s - aside.wrong_s >= if self.has_pulse() { ADOPT_PULSE_S } else { ADOPT_S }
    }

    /// What was seen since then was good after all, and what came before it teaches nothing.
    fn take_back(&mut self, since_s: f64) {
        self.aside = None;
        self.collapsed_since_s = None;
        self.pulse_is_missing = false;
        self.recent.retain(|slot| slot.start_s > since_s + RINGING_S);
        for slot in &self.recent {
            push_bounded(&mut self.normal, *slot, NORMAL_SLOTS);
        }
        self.measure_range();
    }

    /// At nothing: negative, or next to nothing where there was a pulse well above.
    fn note_nothing(&mut self, time_s: f64, value: f64) {
        let nothing = match (self.usual, self.range) {
            (Some(usual), Some(range)) if usual.pulse.is_pulse() => {
                (NOTHING * usual.mean).min(range.low - STEP_SHARE * (range.high - range.low)).max(NEGATIVE_MMHG)
            }
            _ => NEGATIVE_MMHG,
        };
        if value < nothing {
            self.nothing_since_s.get_or_insert(time_s);
        } else {
            self.nothing_since_s = None;
        }
    }

    fn extend_run(&mut self, time_s: f64, value: f64) {
        if let Some(run) = self.run.as_mut().filter(|run| (run.value - value).abs() <= SAME_MMHG) {
            run.until_s = time_s;
            run.samples += 1;
            return;
        }
        if let Some(run) = self.run.take() {
            self.end_run(run, (value - run.value).abs());
        }
        let before = self.trail.iter().rev().find(|s| time_s - s.0 >= CORNER_S).map_or(value, |s| s.1);
        self.run = Some(Run { value, since_s: time_s, until_s: time_s, samples: 1, before });
    }

    /// A run is over with a step to another value.
    fn end_run(&mut self, run: Run, step: f64) {
        let length_s = run.until_s - run.since_s;
        if let Some(open) = &mut self.open {
            open.slot.run_s = open.slot.run_s.max(length_s);
            open.slot.count = open.slot.count.min(step);
        }
        if run.samples < 3 || length_s < PLATEAU_S || !self.has_pulse() || self.pulse_is_missing {
            return;
        }
        let (low, high) = extremes(&self.recent);
        let count = self.recent.iter().map(|slot| slot.count).fold(f64::INFINITY, f64::min);
        if count > COARSE * (high - low) {
            return;
        }
        let corner = CORNER * (high - low);
        let at_top = run.value >= high && run.value - run.before > corner;
        let at_bottom = run.value <= low && (run.before - run.value > corner || length_s >= RESTING_PLATEAU_S);
        for (rail, _) in self.rails.iter_mut().zip([at_top, at_bottom]).filter(|(_, hit)| *hit) {
            let known = rail.filter(|r| r.is_recent(run.until_s) && (r.value - run.value).abs() <= SAME_MMHG);
            let plateaus = known.map_or(0, |r| r.plateaus) + 1;
            *rail = Some(Rail { value: run.value, plateaus, last_s: run.until_s });
        }
    }

    fn extend_slot(&mut self, time_s: f64, value: f64) {
        if let Some(open) = self.open.filter(|open| time_s - open.slot.start_s >= SLOT_S) {
            self.close_slot(Slot { mean: open.sum / open.samples, ..open.slot });
            self.open = None;
        }
        let fresh = Slot { start_s: time_s, mean: value, low: value, high: value, run_s: 0.0, count: f64::INFINITY };
        let open = self.open.get_or_insert(OpenSlot { slot: fresh, sum: 0.0, samples: 0.0 });
        open.slot.low = open.slot.low.min(value);
        open.slot.high = open.slot.high.max(value);
        open.sum += value;
        open.samples += 1.0;
    }

    fn close_slot(&mut self, slot: Slot) {
        push_bounded(&mut self.recent, slot, RECENT_SLOTS);
        if self.aside.is_none() {
            push_bounded(&mut self.normal, slot, NORMAL_SLOTS);
            self.measure_range();
        }
        if self.recent.len() < RECENT_SLOTS {
            return;
        }
        let pulse = Pulse::of(self.recent.iter());
        let is_below = |share: f64| self.usual.is_some_and(|u| u.pulse.is_pulse() && pulse.is_below(share, u.pulse));
        self.pulse_is_missing = is_below(RESTORED);
        if is_below(if self.collapsed_since_s.is_some() { RESTORED } else { COLLAPSED }) {
            self.collapsed_since_s.get_or_insert(slot.start_s);
        } else {
            self.collapsed_since_s = None;
            if self.aside.is_none() {
                self.learn_usual(pulse);
            }
        }
    }

    fn learn_usual(&mut self, pulse: Pulse) {
        let Some(mean) = mean(&self.recent) else {
            return;
        };
        let usual = self.usual.get_or_insert(Usual { pulse, mean, age_s: 0.0 });
        usual.age_s = (usual.age_s + SLOT_S).min(USUAL_S);
        let share = SLOT_S / usual.age_s;
        usual.pulse.range += share * (pulse.range - usual.pulse.range);
        usual.pulse.climb += share * (pulse.climb - usual.pulse.climb);
        usual.mean += share * (mean - usual.mean);
    }

    /// The range is known from 2 s, or from a pulse with its rise and its fall.
    fn measure_range(&mut self) {
        if self.range.is_none() && self.normal.len() < RECENT_SLOTS && !has_whole_pulse(&self.normal) {
            return;
        }
        let (low, high) = extremes(&self.normal);
        let run_s = self.normal.iter().map(|slot| slot.run_s).fold(0.0, f64::max);
        self.range = Some(Range { low, high, run_s });
    }
}

impl Rail {
    fn is_recent(&self, time_s: f64) -> bool {
        time_s - self.last_s < PLATEAU_MEMORY_S
    }

    fn is_certain(&self, time_s: f64) -> bool {
        self.plateaus >= PLATEAUS && self.is_recent(time_s)
    }
}

fn push_bounded(ring: &mut VecDeque<Slot>, slot: Slot, limit: usize) {
    if ring.len() == limit {
        ring.pop_front();
    }
    ring.push_back(slot);
}

fn extremes(slots: &VecDeque<Slot>) -> (f64, f64) {
    let low = slots.iter().map(|slot| slot.low).fold(f64::INFINITY, f64::min);
    let high = slots.iter().map(|slot| slot.high).fold(f64::NEG_INFINITY, f64::max);
    (low, high)
}

#[allow(clippy::cast_precision_loss)]
fn mean(slots: &VecDeque<Slot>) -> Option<f64> {
    (!slots.is_empty()).then(|| slots.iter().map(|slot| slot.mean).sum::<f64>() / slots.len() as f64)
}

/// Whether the highest slot stands out by half of the range, and by a pulse, on both of its sides.
fn has_whole_pulse(slots: &VecDeque<Slot>) -> bool {
    let Some(top) = (0..slots.len()).max_by(|a, b| slots[*a].mean.total_cmp(&slots[*b].mean)) else {
        return false;
    };
    let lowest = |slots: &mut dyn Iterator<Item = &Slot>| slots.map(|s| s.mean).fold(f64::INFINITY, f64::min);
    let before = lowest(&mut slots.iter().take(top + 1));
    let after = lowest(&mut slots.iter().skip(top));
    let high = slots[top].mean;
    let enough = (0.5 * (high - before.min(after))).max(PULSE_MMHG);
    high - before >= enough && high - after >= enough
}

#[cfg(test)]
mod tests {
    use super::*;

    const RATE_HZ: f64 = 125.0;

    /// Uniform noise of unit standard deviation.
    struct Noise(u64);

    impl Noise {
        #[allow(clippy::cast_precision_loss)]
        fn next(&mut self) -> f64 {
            self.0 ^= self.0 << 13;
            self.0 ^= self.0 >> 7;
            self.0 ^= self.0 << 17;
            ((self.0 >> 11) as f64 / (1_u64 << 53) as f64 - 0.5) * 12_f64.sqrt()
        }
    }

    /// 75 to 120 mmHg at 75 per minute.
    fn artery(time_s: f64) -> f64 {
        let t = time_s.rem_euclid(0.8);
        let rise = 1.0 - (-t / 0.04).exp();
        let end = 1.0 - (-0.8_f64 / 0.04).exp();
        58.0 + 17.0 * (1.0 - rise / end) + 68.0 * rise * (-t / 0.6).exp()
    }

    /// 6 mmHg, breathing.
    fn vein(time_s: f64) -> f64 {
        6.0 + 0.8 * (1.6 * time_s).sin() + 0.3 * (7.8 * time_s).sin()
    }

    fn times(from_s: f64, to_s: f64) -> impl Iterator<Item = f64> {
        let first = (from_s * RATE_HZ).ceil();
        (0_u32..).map(move |i| (first + f64::from(i)) / RATE_HZ).take_while(move |t| *t < to_s)
    }

    fn changes(length_s: f64, mut value: impl FnMut(f64) -> f64) -> Vec<(f64, Change)> {
        let mut quality = Quality::new(QualitySettings::default());
        times(0.0, length_s).filter_map(|t| quality.take(t, value(t)).changed.map(|change| (t, change))).collect()
    }

    /// Set aside with this cause (the last, where it became clearer) between the first two times, taken back between
    /// the last two, and nothing else.
    fn expect(found: &[(f64, Change)], artefact: Artefact, aside: (f64, f64), back: (f64, f64)) {
        let within = |t: f64, (from, to): (f64, f64)| (from - 1e-9..=to + 1e-9).contains(&t);
        let [causes @ .., (back_s, Change::TakenBack)] = found else {
            panic!("{found:?}");
        };
        assert!(within(causes.first().unwrap().0, aside) && within(*back_s, back), "{found:?}");
        assert!(causes.iter().all(|(_, change)| *change != Change::TakenBack), "{found:?}");
        assert_eq!(causes.last().unwrap().1, Change::SetAside(artefact), "{found:?}");
    }

    #[test]
    fn what_a_patient_does_is_good() {
        let mut noise = Noise(3);
        let mut check = |name: &str, value: &dyn Fn(f64) -> f64, sd: f64| {
            let found = changes(60.0, |t| value(t) + sd * noise.next());
            assert!(found.is_empty(), "{name}: {found:?}");
        };
        check("artery", &artery, 0.0);
        check("noisy artery", &artery, 2.0);
        check("vein", &vein, 0.15);
        check("counts", &|t| (artery(t) / 1.2).round() * 1.2, 0.0);
        check("breathing", &|t| artery(t) + 8.0 * (1.5 * t).sin(), 1.0);
        check("mean halves", &|t| artery(t) * (1.0 - 0.05 * (t - 20.0)).clamp(0.5, 1.0), 1.0);
        // Twice the rate with half of the pulse, and back.
        let fast = |t: f64| 82.0 + 0.35 * (artery(2.4 * t) - 82.0);
        check("rate", &|t| if (20.0..40.0).contains(&t) { fast(t) } else { artery(t) }, 1.0);
        let pause = |t: f64| 80.0 * (-(t - 24.0) / 1.6).exp();
        check("pause", &|t| if (24.0..26.4).contains(&t) { pause(t).min(artery(t)) } else { artery(t) }, 1.0);
    }

    #[test]
    fn a_flush_is_noticed_at_once_and_over_soon_after_its_ringing() {
        let ringing = |t: f64| 60.0 * (-t / 0.05).exp() * (t * 110.0).cos();
        for plateau in [200.0, 240.0, 300.0] {
            for end_s in [11.0, 13.0, 18.0] {
                for channel in [artery, vein] {
                    let found = changes(30.0, |t| match t {
                        t if t < 10.0 => channel(t),
                        t if t < end_s => plateau - (plateau - channel(10.0)) * (-(t - 9.995) / 0.02).exp(),
                        t => channel(t) + ringing(t - end_s),
                    });
                    let noticed_s = 10.0 + 2.5 / RATE_HZ;
                    expect(&found, Artefact::Flush, (10.0, noticed_s), (end_s + 0.4, end_s + 1.6));
                }
            }
        }
    }

    #[test]
    fn a_flush_is_known_without_a_past() {
        let found = changes(10.0, |t| if t < 1.0 { 270.0 } else { artery(t) });
        expect(&found, Artefact::Flush, (0.0, 0.0), (1.49, 2.3));
    }

    #[test]
    fn an_open_line_is_set_aside_until_the_pulse_is_back() {
        let mut noise = Noise(5);
        let found = changes(60.0, |t| if (20.0..40.0).contains(&t) { 3.0 + noise.next() } else { artery(t) });
        expect(&found, Artefact::Disconnected, (20.0, 20.03), (41.0, 42.0));
        // So slowly that nothing jumps, and below zero.
        let slow = |t: f64| (artery(t) * (1.0 - 0.25 * (t - 20.0)).min(1.0)).max(-15.0);
        let found = changes(60.0, |t| if (20.0..40.0).contains(&t) { slow(t) } else { artery(t) });
        expect(&found, Artefact::Disconnected, (23.0, 25.0), (41.0, 42.0));
        let found = changes(60.0, |t| if (20.0..40.0).contains(&t) { -12.0 } else { vein(t) });
        assert_eq!(found[0].1, Change::SetAside(Artefact::Disconnected));
    }

    #[test]
    fn a_value_that_does_not_move_is_flat() {
        let held = |t: f64| if (20.0..25.0).contains(&t) { artery(20.5) } else { artery(t) };
        expect(&changes(40.0, held), Artefact::FlatLine, (20.3, 20.4), (25.9, 27.0));
        let counts = |t: f64| (held(t) / 1.2).round() * 1.2;
        expect(&changes(40.0, counts), Artefact::FlatLine, (20.3, 20.8), (25.9, 27.0));
        let vein_held = |t: f64| if (20.0..25.0).contains(&t) { 6.0 } else { vein(t) };
        expect(&changes(40.0, vein_held), Artefact::FlatLine, (22.9, 23.1), (25.9, 27.0));
        let from_the_start = changes(5.0, |_| 80.0);
        assert!(from_the_start.len() == 1 && (from_the_start[0].0 - 3.0).abs() < 0.02, "{from_the_start:?}");
    }

    #[test]
    fn a_waveform_cut_off_is_clipped() {
        let top = changes(50.0, |t| if (20.0..30.0).contains(&t) { artery(t).min(100.0) } else { artery(t) });
        expect(&top, Artefact::Clipping, (22.0, 24.5), (33.0, 35.0));
        let bottom = changes(50.0, |t| if (20.0..30.0).contains(&t) { artery(t).max(85.0) } else { artery(t) });
        expect(&bottom, Artefact::Clipping, (22.0, 24.5), (33.0, 35.0));
    }

    #[test]
    fn a_damped_pulse_is_set_aside_and_taken_back() {
        let mut noise = Noise(9);
        let damped = |t: f64| 85.0 + 0.15 * (artery(t) - 85.0);
        let found =
            changes(60.0, |t| 0.5 * noise.next() + if (20.0..40.0).contains(&t) { damped(t) } else { artery(t) });
        expect(&found, Artefact::Damped, (21.5, 23.0), (41.0, 42.0));
    }

    #[test]
    fn another_level_is_believed_when_it_beats() {
        let found = changes(60.0, |t| if t < 20.0 { artery(t) } else { artery(t) + 90.0 });
        expect(&found, Artefact::Flush, (20.0, 20.1), (24.9, 26.0));
    }

    #[test]
    fn a_silence_is_no_artefact() {
        let mut quality = Quality::new(QualitySettings::default());
        for t in times(0.0, 10.0).chain(times(12.0, 20.0)).chain(times(300.0, 320.0)).chain(times(5.0, 20.0)) {
            let verdict = quality.take(t, artery(t));
            assert!(verdict.use_sample && verdict.changed.is_none(), "{t} {verdict:?}");
        }
    }

    #[test]
    fn rubbish_is_not_used_and_memory_is_bounded() {
        let mut quality = Quality::new(QualitySettings::default());
        assert!(!quality.take(0.0, f64::NAN).use_sample);
        assert!(!quality.take(f64::INFINITY, 80.0).use_sample);
        assert_eq!(quality.state(), None);
        for i in 0..20_000 {
            quality.take(f64::from(i) * 1e-4, artery(f64::from(i) * 1e-4));
        }
        assert!(
            quality.trail.len() <= 82 && quality.recent.len() <= RECENT_SLOTS && quality.normal.len() <= NORMAL_SLOTS
        );
    }

    #[test]
    fn every_artefact_has_its_name_and_its_sentence() {
        for artefact in Artefact::ALL {
            assert!(artefact.name().chars().all(|c| c.is_ascii_lowercase() || c == '_'));
            assert!(artefact.text().ends_with('.'));
        }
    }
}
