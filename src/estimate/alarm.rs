//! Alarms: limits on a quantity, judged on its band and not on its mean.
//!
//! # What is stated
//!
//! A limit `below` with a probability `p` states that `P(x < below) >= p`: the `p` quantile lies below the limit. Of a
//! band the 5 and the 95 % quantile are known, so that 0.95 is exact. Other quantiles are taken to lie as those of a
//! Gaussian do on that side: `mean + (q95 - mean) z_p / z_0.95`, which at 0.5 is the mean. `above` is the same with
//! `q05`. A wider band makes the same statement weaker, and that is meant: what is not known is not stated.
//!
//! # When it is raised, and when it ends
//!
//! ```text
//! normal -> pending -> active -> normal        acknowledged, or not latched
//!                             -> latched       nobody has acknowledged it; acknowledging makes it normal
//! ```
//!
//! An alarm is `pending` while the statement holds and `active` once it has held without a break for `for_s` of event
//! time. The condition of an active alarm is over when the same quantile has been back beyond the limit by
//! `clear_margin`, and the mean back beyond the limit, for `clear_for_s`. The second is there for missing data: a
//! sensor that falls silent widens a band, which moves a quantile and not a mean, and is no recovery. While it is
//! latched, an alarm can be raised again.
//!
//! # When data are missing
//!
//! Nothing ends for lack of data: only a [`Reading::Measured`] ends a condition.
//!
//! | | pending | active |
//! |---|---|---|
//! | a forecast | judged by its band, which grows | stays |
//! | a parameter that is not identifiable, no data yet | normal: settings have no alarms | stays |
//! | no beat comes (asystole, of quantities of a beat) | the last beat stands: goes on to active | stays |
//! | a bed begins anew, event time may jump back | normal | stays until new data say otherwise |
//!
//! A heart that stands still brings no new beat, so that a limit on a quantity of a beat says nothing new of it. A limit
//! on a pressure itself does: `p_a` is judged in every estimate, beat or not.
//!
//! Invariants: pure, time is an argument. Deliberately absent: sounds, escalation, and who is to be told.

use super::statistics::Summary;
use super::time::{EventTime, s_from_ns};
use crate::model::{Model, Quantity};

/// Most alarms of a bed.
pub const MAX_ALARMS: usize = 64;

/// What an alarm watches.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Watched {
    /// A state or derived quantity, by its place among both, states first.
    Quantity(usize),
    /// An estimated parameter, by its index in the model.
    Parameter(usize),
    /// A clinical quantity of a beat.
    Clinical(usize),
}

impl Watched {
    /// What a name stands for in a model. The heart rate is that of the beats, which are there whether it is estimated
    /// or not.
    #[must_use]
    pub fn by_name<M: Model>(model: &M, name: &str) -> Option<Self> {
        let quantity = model.states().iter().chain(model.derived()).position(|q| q.name == name).map(Self::Quantity);
        let clinical = || model.clinical().iter().position(|q| q.name == name).map(Self::Clinical);
        quantity.or_else(clinical).or_else(|| model.parameter_index(name).map(Self::Parameter))
    }

    /// Name and unit.
    #[must_use]
    pub fn info<M: Model>(self, model: &M) -> Quantity {
        let found = match self {
            Self::Quantity(q) => model.states().iter().chain(model.derived()).nth(q).copied(),
            Self::Clinical(q) => model.clinical().get(q).copied(),
            Self::Parameter(p) => model.parameters().get(p).map(|p| Quantity { name: p.name, unit: p.unit }),
        };
        found.unwrap_or(Quantity { name: "", unit: "" })
    }
}

/// On which side of what an alarm is raised, in the unit of the quantity.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Limit {
    /// Below this.
    Below(f64),
    /// Above this.
    Above(f64),
}

impl Limit {
    /// Name in topics.
    #[must_use]
    pub fn side(self) -> &'static str {
        match self {
            Self::Below(_) => "below",
            Self::Above(_) => "above",
        }
    }

    /// The number.
    #[must_use]
    pub fn value(self) -> f64 {
        match self {
            Self::Below(value) | Self::Above(value) => value,
        }
    }

    /// How far `value` lies beyond the limit on the side of the alarm; negative on the other.
    fn excess(self, value: f64) -> f64 {
        match self {
            Self::Below(limit) => limit - value,
            Self::Above(limit) => value - limit,
        }
    }
}

/// How urgent an alarm is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[expect(missing_docs, reason = "the names are the documentation")]
pub enum Priority {
    Low,
    #[default]
    Medium,
    High,
}

impl Priority {
    /// Name in topics.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Low => "low",
            Self::Medium => "medium",
            Self::High => "high",
        }
    }
}

/// One limit and how it is judged.
#[derive(Debug, Clone, PartialEq)]
pub struct AlarmSettings {
    /// What people call it.
    pub name: String,
    /// What it watches.
    pub watched: Watched,
    /// Where it is raised.
    pub limit: Limit,
    /// Probability of being beyond the limit from which on it is stated, 0.5 to 0.999.
    pub probability: f64,
    /// How long the statement must hold before it is raised \[ns of event time\].
    pub for_ns: i64,
    /// How far the quantile must be back before the condition is over, in the unit of the quantity.
    pub clear_margin: f64,
    /// How long it must be back \[ns of event time\].
    pub clear_for_ns: i64,
    /// How urgent it is.
    pub priority: Priority,
    /// Whether it stays until somebody has acknowledged it.
    pub latched: bool,
}

impl AlarmSettings {
    /// `cardiac output below 4 L/min`.
    fn condition<M: Model>(&self, model: &M) -> String {
        let Quantity { name, unit } = self.watched.info(model);
        let condition = format!("{} {} {} {unit}", spoken(name), self.limit.side(), short(self.limit.value()));
        condition.trim_end().to_owned()
    }

    /// For people: what is the matter; empty while nothing is.
    #[must_use]
    pub fn text<M: Model>(&self, model: &M, report: &AlarmReport) -> String {
        let condition = self.condition(model);
        let percent = short(100.0 * self.probability);
        match report.state {
            AlarmState::Normal => String::new(),
            AlarmState::Pending => format!("{condition} with {percent} % probability: {}", report.band.text()),
            AlarmState::Active => self.raised_text(model, report.band),
            AlarmState::Latched => {
                format!("{condition} is over and nobody has acknowledged it: {}", report.band.text())
            }
        }
    }

    /// For people: it is raised at this band.
    #[must_use]
    pub fn raised_text<M: Model>(&self, model: &M, band: Band) -> String {
        let (condition, percent) = (self.condition(model), short(100.0 * self.probability));
        let held = if self.for_ns > 0 { format!(" for {} s", short(s_from_ns(self.for_ns))) } else { String::new() };
        format!("{condition} with {percent} % probability{held}: {}", band.text())
    }

    /// For people: its condition has ended at this band.
    #[must_use]
    pub fn over_text<M: Model>(&self, model: &M, band: Band, latched: bool) -> String {
        let latched = if latched { "; latched until somebody acknowledges it" } else { "" };
        let Quantity { name, unit } = self.watched.info(model);
        let (name, side, limit) = (spoken(name), self.limit.side(), short(self.limit.value()));
        let unit = if unit.is_empty() { String::new() } else { format!(" {unit}") };
        format!("{name} no longer {side} {limit}{unit}: {}{latched}", band.text())
    }
}

/// A name in words; the subscript of a symbol (`p_a`) stays with it.
fn spoken(name: &str) -> String {
    let subscripts = usize::from(name.as_bytes().get(1) == Some(&b'_'));
    let mut seen = 0;
    let mut letter = |c: char| {
        seen += usize::from(c == '_');
        if c == '_' && seen > subscripts { ' ' } else { c }
    };
    name.chars().map(&mut letter).collect()
}

/// Three digits.
fn short(number: f64) -> String {
    format!("{number:.2e}").parse::<f64>().unwrap_or(number).to_string()
}

/// A quantity with what is known of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Band {
    /// Mean.
    pub mean: f64,
    /// 5 % quantile.
    pub q05: f64,
    /// 95 % quantile.
    pub q95: f64,
}

impl Band {
    /// Nothing is known.
    pub const UNKNOWN: Self = Self { mean: f64::NAN, q05: f64::NAN, q95: f64::NAN };

    fn text(self) -> String {
        format!("{} [{} {}]", short(self.mean), short(self.q05), short(self.q95))
    }
}

impl From<&Summary> for Band {
    fn from(summary: &Summary) -> Self {
        Self { mean: summary.mean, q05: summary.q05, q95: summary.q95 }
    }
}

/// What a look finds of a quantity.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Reading {
    /// Nothing new: what was last known stands.
    Same,
    /// What is said of it is not what data say.
    Unknown,
    /// A band without new data behind it.
    Forecast(Band),
    /// A band that data stand behind.
    Measured(Band),
}

/// Where an alarm stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum AlarmState {
    /// Nothing is the matter.
    #[default]
    Normal,
    /// Beyond the limit, not yet long enough.
    Pending,
    /// Raised.
    Active,
    /// It was raised, its condition is over, and nobody has acknowledged it.
    Latched,
}

impl AlarmState {
    /// Name in topics.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Normal => "normal",
            Self::Pending => "pending",
            Self::Active => "active",
            Self::Latched => "latched",
        }
    }
}

/// How an alarm stands.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AlarmReport {
    /// Where it stands.
    pub state: AlarmState,
    /// Whether somebody has seen it; false unless it is active.
    pub acknowledged: bool,
    /// Event time since which it has been there.
    pub since: EventTime,
    /// The band when it got there; unknown before anything has happened.
    pub band: Band,
}

/// What people are to hear of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Happening {
    /// It was raised.
    Raised,
    /// Its condition is over; whether it is latched.
    Over(bool),
}

/// One alarm under way.
#[derive(Debug, Clone)]
struct Watch {
    settings: AlarmSettings,
    /// Half width of the statement's quantile over that of the band.
    reach: f64,
    report: AlarmReport,
    known: Option<Band>,
    /// Since when the statement has held.
    held_since: Option<EventTime>,
    /// Since when data have said that it is over.
    over_since: Option<EventTime>,
}

impl Watch {
    fn new(settings: AlarmSettings) -> Self {
        let report = AlarmReport {
            state: AlarmState::Normal,
            acknowledged: false,
            since: EventTime(i64::MIN),
            band: Band::UNKNOWN,
        };
        let reach = normal_quantile(settings.probability) / normal_quantile(0.95);
        Self { settings, reach, report, known: None, held_since: None, over_since: None }
    }

    /// The quantile that the statement is about.
    fn quantile(&self, band: Band) -> f64 {
        let end = match self.settings.limit {
            Limit::Below(_) => band.q95,
            Limit::Above(_) => band.q05,
        };
        // Exactly the quantile that is known, where it is the one asked for.
        if (self.reach - 1.0).abs() < 1e-12 { end } else { band.mean + (end - band.mean) * self.reach }
    }

    fn holds(&self, band: Band) -> bool {
        self.settings.limit.excess(self.quantile(band)) > 0.0
    }

    fn is_over(&self, band: Band) -> bool {
        let AlarmSettings { limit, clear_margin, .. } = self.settings;
        limit.excess(self.quantile(band)) <= -clear_margin && limit.excess(band.mean) <= 0.0
    }

    /// Takes in a reading; whether the alarm has changed, and what people are to hear of it.
    fn look(&mut self, time: EventTime, reading: Reading) -> (bool, Option<Happening>) {
        match reading {
            Reading::Same => {}
            Reading::Unknown => self.known = None,
            Reading::Forecast(band) | Reading::Measured(band) => self.known = Some(band),
        }
        let holds = self.known.is_some_and(|band| self.holds(band));
        self.held_since = self.held_since.or(Some(time)).filter(|_| holds);
        let over = match reading {
            Reading::Same => None,
            Reading::Measured(band) if self.is_over(band) => {
                let since = *self.over_since.get_or_insert(time);
                Some(time.ns_since(since) >= self.settings.clear_for_ns)
            }
            _ => {
                self.over_since = None;
                None
            }
        };
        let held = self.held_since.is_some_and(|since| time.ns_since(since) >= self.settings.for_ns);
        let latched = self.settings.latched && !self.report.acknowledged;
        let next = match self.report.state {
            AlarmState::Active if over == Some(true) => {
                if latched {
                    AlarmState::Latched
                } else {
                    AlarmState::Normal
                }
            }
            AlarmState::Active => AlarmState::Active,
            _ if held => AlarmState::Active,
            AlarmState::Latched => AlarmState::Latched,
            _ if holds => AlarmState::Pending,
            _ => AlarmState::Normal,
        };
        self.go_to(next, time)
    }

    fn go_to(&mut self, next: AlarmState, time: EventTime) -> (bool, Option<Happening>) {
        let before = self.report.state;
        // Event time may have jumped back.
        let from_the_future = self.report.since > time;
        if next == before && !from_the_future {
            return (false, None);
        }
        self.report.since = time;
        if next == before {
            return (true, None);
        }
        (self.report.state, self.report.band) = (next, self.known.unwrap_or(self.report.band));
        (self.report.acknowledged, self.over_since) = (false, None);
        let happened = match (before, next) {
            (_, AlarmState::Active) => Some(Happening::Raised),
            (AlarmState::Active, _) => Some(Happening::Over(next == AlarmState::Latched)),
            _ => None,
        };
        (true, happened)
    }
}

/// The alarms of a bed.
#[derive(Debug, Clone)]
pub struct Alarms {
    watches: Vec<Watch>,
    changed: bool,
    happened: Vec<(usize, Happening)>,
}

impl Alarms {
    /// Alarms that have not seen anything yet.
    #[must_use]
    pub fn new(settings: &[AlarmSettings]) -> Self {
        let watches = settings.iter().cloned().map(Watch::new).collect();
        Self { watches, changed: false, happened: Vec::new() }
    }

    /// The bed begins at this time, or begins anew. What was raised stays; what was about to be begins anew.
    pub fn begin(&mut self, time: EventTime) {
        for watch in &mut self.watches {
            (watch.known, watch.held_since, watch.over_since) = (None, None, None);
            let pending = watch.report.state == AlarmState::Pending;
            if pending {
                watch.report.state = AlarmState::Normal;
            }
            if pending || watch.report.since == EventTime(i64::MIN) || watch.report.since > time {
                watch.report.since = time;
            }
        }
        self.changed = !self.watches.is_empty();
    }

    /// Looks at what every alarm watches; times only grow until the bed begins anew.
    pub fn look(&mut self, time: EventTime, read: impl Fn(Watched) -> Reading) {
        for (i, watch) in self.watches.iter_mut().enumerate() {
            let (changed, happened) = watch.look(time, read(watch.settings.watched));
            self.changed |= changed;
            self.happened.extend(happened.map(|what| (i, what)));
        }
    }

    /// Somebody has seen the alarm called `name`, or all of them; calls `seen` with each that was active or latched and
    /// not acknowledged yet.
    pub fn acknowledge(&mut self, name: Option<&str>, time: EventTime, mut seen: impl FnMut(&AlarmSettings)) {
        for watch in &mut self.watches {
            if name.is_some_and(|name| name != watch.settings.name) {
                continue;
            }
            match watch.report.state {
                AlarmState::Active if !watch.report.acknowledged => watch.report.acknowledged = true,
                AlarmState::Latched => (watch.report.state, watch.report.since) = (AlarmState::Normal, time),
                _ => continue,
            }
            self.changed = true;
            seen(&watch.settings);
        }
    }

    /// Whether anything has changed since this was last asked.
    pub fn take_changed(&mut self) -> bool {
        std::mem::take(&mut self.changed)
    }

    /// What people are to hear of since this was last asked: which alarm, and what.
    pub fn take_happened(&mut self) -> Vec<(usize, Happening)> {
        std::mem::take(&mut self.happened)
    }

    /// How each stands, in the order of the settings.
    #[must_use]
    pub fn reports(&self) -> Vec<AlarmReport> {
        self.watches.iter().map(|watch| watch.report).collect()
    }
}

/// Quantile of the standard normal distribution (P. J. Acklam's rational approximation, relative error 1.2e-9), for
/// shares from 0.5 to 0.999.
fn normal_quantile(share: f64) -> f64 {
    const A: [f64; 6] = [
        -3.969_683_028_665_376e1,
        2.209_460_984_245_205e2,
        -2.759_285_104_469_687e2,
        1.383_577_518_672_69e2,
        -3.066_479_806_614_716e1,
        2.506_628_277_459_239,
    ];
    const B: [f64; 6] = [
        -5.447_609_879_822_406e1,
        1.615_858_368_580_409e2,
        -1.556_989_798_598_866e2,
        6.680_131_188_771_972e1,
        -1.328_068_155_288_572e1,
        1.0,
    ];
    const C: [f64; 6] = [
        -7.784_894_002_430_293e-3,
        -3.223_964_580_411_365e-1,
        -2.400_758_277_161_838,
        -2.549_732_539_343_734,
        4.374_664_141_464_968,
        2.938_163_982_698_783,
    ];
    const D: [f64; 5] =
        [7.784_695_709_041_462e-3, 3.224_671_290_700_398e-1, 2.445_134_137_142_996, 3.754_408_661_907_416, 1.0];
    /// Where the tail begins.
    const TAIL: f64 = 0.975_75;
    let of = |coefficients: &[f64], x: f64| coefficients.iter().fold(0.0, |sum, c| sum * x + c);
    if share <= TAIL {
        let q = share - 0.5;
        q * of(&A, q * q) / of(&B, q * q)
    } else {
        let q = (-2.0 * (1.0 - share).ln()).sqrt();
        -of(&C, q) / of(&D, q)
    }
}

#[cfg(test)]
mod tests {
    use super::{normal_quantile, short, spoken};

    #[test]
    fn normal_quantiles_are_those_of_the_tables() {
        let table = [(0.5, 0.0), (0.8, 0.841_621_233_6), (0.95, 1.644_853_627_0), (0.975, 1.959_963_984_5)];
        for (share, expected) in table.into_iter().chain([(0.99, 2.326_347_874_0), (0.999, 3.090_232_306_2)]) {
            let found = normal_quantile(share);
            assert!((found - expected).abs() < 1e-8, "{share}: {found} {expected}");
        }
    }

    #[test]
    fn names_and_numbers_are_for_people() {
        let names = ["cardiac_output", "p_a", "p_pa_mean", "c_l_sys", "svr"].map(spoken);
        assert_eq!(names, ["cardiac output", "p_a", "p_pa mean", "c_l sys", "svr"]);
        assert_eq!([4.0, 3.2049, 112.3, 0.080_018, -0.5].map(short), ["4", "3.2", "112", "0.08", "-0.5"]);
    }
}
