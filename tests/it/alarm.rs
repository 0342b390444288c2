//! The state machine of alarms: when one is raised, when it ends, and what missing data do to it.

use hemostream::estimate::alarm::{
    AlarmReport, AlarmSettings, AlarmState, Alarms, Band, Happening, Limit, Priority, Reading, Watched,
};
use hemostream::estimate::time::{EventTime, NS_PER_S, ns_from_s};
use hemostream::model::cvsim6::Cvsim6;
use proptest::prelude::*;

use AlarmState::{Active, Latched, Normal, Pending};
use Reading::{Forecast, Measured, Same, Unknown};

/// Cardiac output below 4 L/min for 10 s; over beyond 4.2 for 5 s.
fn low_output() -> AlarmSettings {
    AlarmSettings {
        name: "low output".to_owned(),
        watched: Watched::Clinical(2),
        limit: Limit::Below(4.0),
        probability: 0.95,
        for_ns: 10 * NS_PER_S,
        clear_margin: 0.2,
        clear_for_ns: 5 * NS_PER_S,
        priority: Priority::High,
        latched: true,
    }
}

/// A band of half width 0.3.
fn at(mean: f64) -> Band {
    Band { mean, q05: mean - 0.3, q95: mean + 0.3 }
}

const LOW: Reading = Measured(Band { mean: 3.2, q05: 2.9, q95: 3.5 });
const GOOD: Reading = Measured(Band { mean: 5.0, q05: 4.7, q95: 5.3 });

/// One alarm under way.
struct Watched1 {
    alarms: Alarms,
    happened: Vec<Happening>,
}

impl Watched1 {
    fn new(settings: AlarmSettings) -> Self {
        let mut alarms = Alarms::new(&[settings]);
        alarms.begin(EventTime(0));
        assert!(alarms.take_changed(), "said once when the bed begins");
        Self { alarms, happened: Vec::new() }
    }

    fn see(&mut self, t_s: f64, reading: Reading) -> AlarmState {
        self.alarms.look(EventTime::from_s(t_s), |_| reading);
        self.happened.extend(self.alarms.take_happened().into_iter().map(|(_, what)| what));
        self.report().state
    }

    /// The same reading every second, both ends included.
    fn during(&mut self, from_s: i32, until_s: i32, reading: Reading) -> AlarmState {
        (from_s..=until_s).map(|t| self.see(f64::from(t), reading)).last().unwrap()
    }

    fn report(&self) -> AlarmReport {
        self.alarms.reports()[0]
    }

    fn acknowledge(&mut self, name: Option<&str>, t_s: f64) -> usize {
        let mut seen = 0;
        self.alarms.acknowledge(name, EventTime::from_s(t_s), |_| seen += 1);
        seen
    }
}

#[test]
fn it_is_raised_after_the_delay_and_not_before() {
    let mut bed = Watched1::new(low_output());
    assert_eq!(bed.during(0, 4, GOOD), Normal);
    assert_eq!(bed.see(5.0, LOW), Pending);
    assert_eq!(bed.report().since, EventTime::from_s(5.0));
    assert_eq!(bed.see(14.999, LOW), Pending);
    assert!(bed.happened.is_empty(), "people hear of what is raised");
    assert_eq!(bed.see(15.0, LOW), Active);
    assert_eq!(bed.happened, [Happening::Raised]);
    let report = bed.report();
    assert_eq!((report.since, report.acknowledged), (EventTime::from_s(15.0), false));
    assert_eq!(Measured(report.band), LOW);
}

#[test]
fn a_break_begins_the_delay_anew() {
    let mut bed = Watched1::new(low_output());
    assert_eq!(bed.during(0, 9, LOW), Pending);
    // 3.71 and its band: the statement holds no longer.
    assert_eq!(bed.see(9.5, Measured(at(3.71))), Normal);
    assert_eq!(bed.during(10, 19, LOW), Pending);
    assert_eq!(bed.see(20.0, LOW), Active);
}

#[test]
fn the_band_is_judged_and_not_the_mean() {
    let mut bed = Watched1::new(low_output());
    let (wide, narrow) = (Band { mean: 3.0, q05: 1.5, q95: 4.5 }, Band { mean: 3.9, q05: 3.81, q95: 3.99 });
    assert_eq!(bed.see(0.0, Measured(wide)), Normal);
    assert_eq!(bed.see(1.0, Measured(narrow)), Pending);
    assert_eq!(bed.see(2.0, Measured(Band { q95: 4.0, ..narrow })), Normal, "at the limit is not below it");
    let high = AlarmSettings { limit: Limit::Above(4.0), ..low_output() };
    let mut bed = Watched1::new(high);
    assert_eq!(bed.see(0.0, Measured(Band { mean: 6.0, q05: 3.9, q95: 8.0 })), Normal);
    assert_eq!(bed.see(1.0, Measured(Band { mean: 4.2, q05: 4.1, q95: 4.3 })), Pending);
    assert_eq!(bed.see(2.0, Measured(Band { mean: f64::NAN, q05: f64::NAN, q95: f64::NAN })), Normal);
}

/// Other quantiles are those of a Gaussian on the same side; at a half it is the mean.
#[test]
fn other_probabilities_reach_less_or_further() {
    let z95 = 1.644_853_626_951_472_7;
    for (probability, z) in [(0.5, 0.0), (0.8, 0.841_621_233_6), (0.99, 2.326_347_874), (0.999, 3.090_232_306)] {
        // Upper side three times as wide as the lower one.
        let band = |quantile: f64| {
            let half = 0.6;
            let mean = quantile - half * z / z95;
            Measured(Band { mean, q05: mean - half / 3.0, q95: mean + half })
        };
        let mut bed = Watched1::new(AlarmSettings { probability, ..low_output() });
        assert_eq!(bed.see(0.0, band(4.0 + 1e-6)), Normal, "{probability}");
        assert_eq!(bed.see(1.0, band(4.0 - 1e-6)), Pending, "{probability}");
    }
}

#[test]
fn the_condition_ends_beyond_the_margin_and_after_a_while() {
    let mut bed = Watched1::new(AlarmSettings { latched: false, ..low_output() });
    assert_eq!(bed.during(0, 10, LOW), Active);
    // The quantile is back beyond the limit but not beyond the margin.
    assert_eq!(bed.during(11, 30, Measured(Band { mean: 4.1, q05: 4.05, q95: 4.19 })), Active);
    assert_eq!(bed.during(31, 35, GOOD), Active);
    assert_eq!(bed.see(35.5, LOW), Active, "the way back begins anew");
    assert_eq!(bed.during(36, 40, GOOD), Active);
    assert_eq!(bed.see(41.0, GOOD), Normal);
    assert_eq!(bed.happened, [Happening::Raised, Happening::Over(false)]);
    assert_eq!(bed.report().band, at(5.0));
}

#[test]
fn it_stays_latched_until_somebody_acknowledges_it() {
    let mut bed = Watched1::new(low_output());
    assert_eq!(bed.during(0, 10, LOW), Active);
    assert_eq!(bed.during(11, 100, GOOD), Latched);
    assert_eq!(bed.happened, [Happening::Raised, Happening::Over(true)]);
    assert_eq!(bed.report().since, EventTime::from_s(16.0));
    assert_eq!(bed.acknowledge(Some("another"), 100.0), 0);
    assert_eq!(bed.report().state, Latched);
    assert_eq!(bed.acknowledge(Some("low output"), 101.0), 1);
    assert_eq!((bed.report().state, bed.report().since), (Normal, EventTime::from_s(101.0)));
    assert_eq!(bed.acknowledge(None, 102.0), 0, "nothing is left to be seen");
}

#[test]
fn a_latched_alarm_can_be_raised_again() {
    let mut bed = Watched1::new(low_output());
    bed.during(0, 10, LOW);
    assert_eq!(bed.during(11, 20, GOOD), Latched);
    assert_eq!(bed.during(21, 30, LOW), Latched, "it stays while it is pending again");
    assert_eq!(bed.see(31.0, LOW), Active);
    assert_eq!(bed.happened.last(), Some(&Happening::Raised));
}

#[test]
fn an_acknowledged_alarm_stays_active_and_does_not_latch() {
    let mut bed = Watched1::new(low_output());
    bed.during(0, 10, LOW);
    assert_eq!(bed.acknowledge(None, 11.0), 1);
    assert_eq!(bed.acknowledge(None, 12.0), 0, "once is enough");
    assert!(bed.report().acknowledged);
    assert_eq!(bed.during(12, 20, LOW), Active);
    assert_eq!(bed.during(21, 26, GOOD), Normal);
    assert!(!bed.report().acknowledged);
    // Raised anew, nobody has seen it.
    assert_eq!(bed.during(27, 37, LOW), Active);
    assert!(!bed.report().acknowledged);
    assert_eq!(bed.during(38, 50, GOOD), Latched);
}

#[test]
fn nothing_ends_because_data_are_missing() {
    let good = Band { mean: 5.0, q05: 4.7, q95: 5.3 };
    for (reading, what) in [(Forecast(good), "a forecast"), (Unknown, "settings"), (Same, "no beat")] {
        let mut bed = Watched1::new(low_output());
        bed.during(0, 10, LOW);
        assert_eq!(bed.see(11.0, GOOD), Active);
        assert_eq!(bed.during(12, 600, reading), Active, "{what}");
    }
    // A sensor falls silent while others go on: the band widens around what was last known, which is no recovery.
    let mut bed = Watched1::new(low_output());
    bed.during(0, 10, LOW);
    assert_eq!(bed.during(11, 600, Measured(Band { mean: 3.2, q05: 0.5, q95: 6.0 })), Active);
}

#[test]
fn what_is_about_to_be_raised_without_data() {
    // A forecast whose band still says so.
    let mut bed = Watched1::new(low_output());
    bed.during(0, 5, LOW);
    assert_eq!(bed.during(6, 10, Forecast(Band { mean: 3.2, q05: 2.5, q95: 3.9 })), Active);
    // One whose band has grown beyond the limit says nothing.
    let mut bed = Watched1::new(low_output());
    bed.during(0, 5, LOW);
    assert_eq!(bed.see(6.0, Forecast(Band { mean: 3.2, q05: 2.3, q95: 4.1 })), Normal);
    // No beat comes: the last one stands.
    let mut bed = Watched1::new(low_output());
    bed.during(0, 5, LOW);
    assert_eq!(bed.during(6, 9, Same), Pending);
    assert_eq!(bed.see(10.0, Same), Active);
    // What settings say raises nothing.
    let mut bed = Watched1::new(low_output());
    bed.during(0, 5, LOW);
    assert_eq!(bed.during(6, 60, Unknown), Normal);
}

#[test]
fn a_bed_that_begins_anew_keeps_what_was_raised() {
    // Pending: begins anew, even if the clock has jumped back.
    let mut bed = Watched1::new(low_output());
    bed.during(1000, 1009, LOW);
    bed.alarms.begin(EventTime::from_s(3.0));
    assert_eq!((bed.report().state, bed.report().since), (Normal, EventTime::from_s(3.0)));
    assert_eq!(bed.during(3, 12, LOW), Pending);
    assert_eq!(bed.see(13.0, LOW), Active);
    // Active: until new data say otherwise.
    bed.alarms.begin(EventTime::from_s(1.0));
    assert_eq!((bed.report().state, bed.report().since), (Active, EventTime::from_s(1.0)));
    assert_eq!(bed.during(1, 5, Unknown), Active);
    assert_eq!(bed.during(6, 10, GOOD), Active);
    assert_eq!(bed.see(11.0, GOOD), Latched);
    // Latched: still.
    bed.alarms.begin(EventTime::from_s(0.0));
    assert_eq!(bed.during(0, 60, GOOD), Latched);
    assert_eq!(bed.acknowledge(None, 61.0), 1);
    assert_eq!(bed.report().state, Normal);
}

#[test]
fn without_delay_it_is_raised_and_ends_at_once() {
    let mut bed = Watched1::new(AlarmSettings { for_ns: 0, clear_for_ns: 0, latched: false, ..low_output() });
    assert_eq!([bed.see(0.0, LOW), bed.see(1.0, GOOD), bed.see(2.0, LOW)], [Active, Normal, Active]);
}

#[test]
fn changes_are_said_and_nothing_else() {
    let mut bed = Watched1::new(low_output());
    let mut changes = 0;
    for t in 0..100 {
        bed.see(f64::from(t), if (20..40).contains(&t) { LOW } else { GOOD });
        changes += usize::from(bed.alarms.take_changed());
    }
    assert_eq!(changes, 3, "pending, active, latched");
    let mut none = Alarms::new(&[]);
    none.begin(EventTime(0));
    none.look(EventTime(1), |_| LOW);
    assert!(!none.take_changed());
}

#[test]
fn people_are_told_in_words() {
    let (model, settings) = (Cvsim6::default(), low_output());
    let band = Band { mean: 3.2049, q05: 2.9, q95: 3.5 };
    let raised = "cardiac output below 4 L/min with 95 % probability for 10 s: 3.2 [2.9 3.5]";
    assert_eq!(settings.raised_text(&model, band), raised);
    assert_eq!(settings.over_text(&model, at(5.0), false), "cardiac output no longer below 4 L/min: 5 [4.7 5.3]");
    assert!(settings.over_text(&model, at(5.0), true).ends_with("; latched until somebody acknowledges it"));
    let report = |state| AlarmReport { state, acknowledged: false, since: EventTime(0), band };
    assert_eq!(settings.text(&model, &report(Normal)), "");
    assert_eq!(settings.text(&model, &report(Active)), raised);
    let fraction = AlarmSettings {
        watched: Watched::by_name(&model, "ejection_fraction").unwrap(),
        limit: Limit::Below(0.35),
        probability: 0.999,
        for_ns: 0,
        ..settings
    };
    let text = fraction.raised_text(&model, band);
    assert_eq!(text, "ejection fraction below 0.35 with 99.9 % probability: 3.2 [2.9 3.5]");
}

#[test]
fn names_are_found_where_they_belong() {
    let model = Cvsim6::default();
    let found = ["p_a", "q_lo", "heart_rate", "r_pv", "p_pa_mean", "nothing"].map(|n| Watched::by_name(&model, n));
    assert_eq!(found[0], Some(Watched::Quantity(1)));
    assert_eq!(found[1], Some(Watched::Quantity(7)));
    assert_eq!(found[2], Some(Watched::Clinical(0)), "the heart rate is that of the beats");
    assert!(matches!(found[3], Some(Watched::Parameter(_))));
    assert!(matches!(found[4], Some(Watched::Clinical(_))));
    assert_eq!(found[5], None);
    let info = found[4].unwrap().info(&model);
    assert_eq!((info.name, info.unit), ("p_pa_mean", "mmHg"));
}

fn any_reading() -> impl Strategy<Value = Reading> {
    // Runs of the same kind, so that delays pass.
    let band = (3.0..5.0_f64, 0.05..1.0_f64).prop_map(|(mean, half)| Band { mean, q05: mean - half, q95: mean + half });
    prop_oneof![
        4 => Just(LOW), 4 => Just(GOOD), 2 => band.clone().prop_map(Measured),
        1 => band.prop_map(Forecast), 1 => Just(Same), 1 => Just(Unknown),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(512))]

    /// Whatever is seen: an alarm is raised if and only if its condition has held for so long without a break, and
    /// leaves that only after data have said for so long that it is over.
    #[test]
    fn active_means_that_the_condition_has_held(
        runs in prop::collection::vec((any_reading(), 1_usize..15, 0.1..2.0_f64), 1..40),
        for_s in 0.0..12.0_f64,
        clear_for_s in 0.0..8.0_f64,
        latched in any::<bool>(),
    ) {
        let (for_ns, clear_for_ns) = (ns_from_s(for_s), ns_from_s(clear_for_s));
        let mut bed = Watched1::new(AlarmSettings { for_ns, clear_for_ns, latched, ..low_output() });
        // Looks so far: time, whether the condition held, and whether data said that it was over (None: said nothing).
        let mut looks: Vec<(EventTime, bool, Option<bool>)> = Vec::new();
        let (mut t_s, mut known, mut before) = (0.0, None, Normal);
        for (reading, count, step_s) in runs {
            for _ in 0..count {
                t_s += step_s;
                let over = match reading {
                    Same => None,
                    Unknown => { known = None; Some(false) }
                    Forecast(band) => { known = Some(band); Some(false) }
                    Measured(band) => { known = Some(band); Some(band.q95 >= 4.2 && band.mean >= 4.0) }
                };
                let time = EventTime::from_s(t_s);
                looks.push((time, known.is_some_and(|band| band.q95 < 4.0), over));
                let state = bed.see(t_s, reading);
                let held = looks.iter().rev().take_while(|look| look.1).last().map(|look| time.ns_since(look.0));
                let has_held = held.is_some_and(|ns| ns >= for_ns);
                prop_assert_eq!(bed.happened.pop(), match (before, state) {
                    (Active, Active) => None,
                    (_, Active) => Some(Happening::Raised),
                    (Active, now) => Some(Happening::Over(now == Latched)),
                    _ => None,
                });
                match (before, state) {
                    (Active, Active) => {}
                    (Active, now) => {
                        let since = looks.iter().rev().take_while(|look| look.2 != Some(false));
                        let since = since.filter(|look| look.2 == Some(true)).last();
                        prop_assert!(since.is_some_and(|look| time.ns_since(look.0) >= clear_for_ns));
                        prop_assert_eq!(now, if latched { Latched } else { Normal });
                    }
                    (_, now) => prop_assert_eq!(now == Active, has_held, "at {} s, held for {:?} ns", t_s, held),
                }
                before = state;
            }
        }
    }
}
