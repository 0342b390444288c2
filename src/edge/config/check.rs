//! Ranges: what the types of the schema cannot say.

use std::collections::BTreeSet;
use std::ops::{Bound, RangeBounds, RangeInclusive};

use figment::value::{Num, Value};

use super::effective::{leaves, toml_text};
use super::error::{ConfigError, Problem};
use super::keys::{self, KeyPath};
use super::layers::Stack;
use super::patient::{InitialSd, Patient, ScriptEntry};
use super::schema::{
    AlarmSettings, Config, Coupling, DiscrepancyForm, Distribution, EstimatorSettings, PriorSettings, PublishSettings,
    SecondOpinion, Timing, WindowSettings,
};
use crate::estimate::alarm::MAX_ALARMS;
use crate::model::cvsim6::{Cvsim6, PARAMETERS, Pressures};
use crate::model::{Model, ParameterInfo};

/// Pressures that a patient can start with \[mmHg\].
const STARTING_MMHG: RangeInclusive<f64> = -50.0..=350.0;

/// Shortest window \[s\]: event time counts nanoseconds.
const SHORTEST_S: f64 = 1e-6;

/// Largest seed: TOML has no larger integers.
const MAX_SEED: u64 = i64::MAX as u64;

/// Longest name of an alarm \[characters\].
const MAX_ALARM_NAME: usize = 64;

/// Most changes in a script.
const MAX_SCRIPT: usize = 10_000;

/// More than nothing, at most `high`.
fn positive_to(high: f64) -> (Bound<f64>, Bound<f64>) {
    (Bound::Excluded(0.0), Bound::Included(high))
}

/// A setting that is out of range.
pub(super) struct Fault {
    path: KeyPath,
    /// Another setting that makes it so.
    against: Option<KeyPath>,
    message: String,
}

impl Fault {
    /// The problem, with the place where it was set. If that is nobody's doing, it is the other setting's.
    pub(super) fn located(self, stack: &Stack) -> Problem {
        let set_by_user = |path: &&KeyPath| stack.origin(path) != "default";
        let path = [Some(&self.path), self.against.as_ref()].into_iter().flatten().find(set_by_user);
        let path = path.unwrap_or(&self.path);
        let origin = Some(stack.place(path));
        Problem { origin, ..Problem::new(self.path.to_string(), self.message) }
    }

    /// The problem alone.
    pub(super) fn unlocated(self) -> Problem {
        Problem::new(self.path.to_string(), self.message)
    }
}

/// Everything that is out of range.
pub(super) fn faults(config: &Config) -> Vec<Fault> {
    let mut check = Checker::default();
    check.finite(config);
    if check.faults.is_empty() {
        check.observed(&config.observed);
        check.patient(&config.patient);
        check.script(&config.patient);
        check.variability(&config.patient);
        check.estimator(&config.estimator);
        check.discrepancy(config);
        check.alarms(config);
        check.window(&config.window);
        check.channels(config);
        check.publish(&config.publish);
        check.service_and_network(config);
    }
    check.faults
}

#[derive(Default)]
struct Checker {
    faults: Vec<Fault>,
}

impl Checker {
    fn refuse(&mut self, key: impl Into<KeyPath>, message: impl Into<String>) {
        self.faults.push(Fault { path: key.into(), against: None, message: message.into() });
    }

    fn refuse_against(&mut self, key: impl Into<KeyPath>, against: &str, message: String) {
        self.faults.push(Fault { path: key.into(), against: Some(against.into()), message });
    }

    fn number(&mut self, key: impl Into<KeyPath>, value: f64, range: &impl RangeBounds<f64>, unit: &str) {
        if !range.contains(&value) {
            self.refuse(key, format!("found {value:?}, expected {}{unit}", range_text(range)));
        }
    }

    fn whole(&mut self, key: &str, value: usize, range: RangeInclusive<usize>) {
        if !range.contains(&value) {
            self.refuse(key, format!("found {value}, expected {} to {}", range.start(), range.end()));
        }
    }

    /// Whether a name is known.
    fn name(&mut self, key: impl Into<KeyPath>, name: &str, known: &[&str]) -> bool {
        let found = known.contains(&name);
        if !found {
            self.refuse(key, keys::unknown_name(name, known));
        }
        found
    }

    fn unique(&mut self, key: &str, names: &[String]) {
        let mut seen = BTreeSet::new();
        for name in names {
            if !seen.insert(name) {
                self.refuse(key, format!("found \"{name}\" more than once, expected each name once"));
            }
        }
    }

    fn finite(&mut self, config: &Config) {
        let mut remaining = leaves(config);
        while let Some((path, value)) = remaining.pop() {
            match value {
                Value::Array(_, entries) => {
                    let inner = entries.into_iter().enumerate().map(|(i, value)| (path.join(i.to_string()), value));
                    remaining.extend(inner);
                }
                Value::Dict(_, entries) => {
                    remaining.extend(entries.into_iter().map(|(name, value)| (path.join(name), value)));
                }
                Value::Num(_, Num::F64(number)) if !number.is_finite() => {
                    self.refuse(path, format!("found {}, expected a finite number", toml_text(&value)));
                }
                _ => {}
            }
        }
    }

    fn observed(&mut self, observed: &[String]) {
        if observed.is_empty() {
            self.refuse("observed", "found none, expected at least one state");
        }
        for name in observed {
            self.name("observed", name, Pressures::NAMES);
        }
        self.unique("observed", observed);
    }

    fn patient(&mut self, patient: &Patient) {
        let before = self.faults.len();
        for (info, value) in PARAMETERS.iter().zip(patient.theta()) {
            let key = match info.name {
                "systole" => format!("patient.systole.{}", patient.systole.rule().1),
                name => format!("patient.{name}"),
            };
            self.bounds(key, info, value);
        }
        for (state, given) in patient.initial.iter() {
            if let Some(given) = *given {
                self.number(format!("patient.initial.{state}"), given, &STARTING_MMHG, " mmHg");
            }
        }
        match &patient.initial_sd {
            InitialSd::Relative(fraction) => self.number("patient.initial_sd", *fraction, &(0.0..=1.0), ""),
            InitialSd::Mmhg(given) => {
                for (state, sd) in given.iter() {
                    self.number(format!("patient.initial_sd.{state}"), sd.unwrap_or(0.0), &(0.0..=100.0), " mmHg");
                }
            }
        }
        // Balances of parameters that are refused anyway would only add noise.
        if self.faults.len() == before
            && let Err(ConfigError::Settings(problems)) = patient.initial_pressures()
        {
            problems.into_iter().for_each(|problem| self.refuse(problem.key, problem.message));
        }
    }

    fn bounds(&mut self, key: impl Into<KeyPath>, info: &ParameterInfo, value: f64) {
        self.number(key, value, &(info.bounds.0..=info.bounds.1), &format!(" {}", info.unit));
    }

    fn script(&mut self, patient: &Patient) {
        self.whole("patient.script", patient.script.len(), 0..=MAX_SCRIPT);
        for (position, entry) in patient.script.iter().enumerate() {
            self.script_entry(&format!("patient.script.{position}"), entry);
        }
        for (position, change) in patient.resolved_script() {
            for (p, value) in change.assignments {
                let info = &PARAMETERS[p];
                let table = if patient.script[position].set.contains_key(info.name) { "set" } else { "scale" };
                self.bounds(format!("patient.script.{position}.{table}.{}", info.name), info, value);
            }
        }
    }

    fn variability(&mut self, patient: &Patient) {
        for (name, &sd) in &patient.variability {
            let key = KeyPath::from("patient.variability").join(name);
            self.name(key.clone(), name, &scriptable("scale"));
            self.number(key, sd, &positive_to(1.0), " per square root of a second");
        }
    }

    fn script_entry(&mut self, key: &str, entry: &ScriptEntry) {
        self.number(format!("{key}.at_s"), entry.at_s, &(0.0..), " s");
        if entry.set.is_empty() && entry.scale.is_empty() {
            self.refuse(key, "found neither, expected `set` or `scale`");
        }
        for name in entry.set.keys().filter(|name| entry.scale.contains_key(*name)) {
            self.refuse(key, format!("found `{name}` in `set` and in `scale`, expected one of them"));
        }
        for (table, names) in [("set", &entry.set), ("scale", &entry.scale)] {
            for name in names.keys() {
                let key = KeyPath::from(key).join(table).join(name);
                self.name(key.clone(), name, &scriptable(table));
            }
        }
    }

    fn estimator(&mut self, estimator: &EstimatorSettings) {
        self.estimate(&estimator.estimate);
        for (name, &value) in &estimator.initial_guess {
            self.initial_guess(name, value, &estimator.estimate);
        }
        self.number("estimator.initial_guess_sd", estimator.initial_guess_sd, &positive_to(10.0), "");
        // One member has no spread.
        self.whole("estimator.members", estimator.members, 2..=10_000);
        if estimator.seed > MAX_SEED {
            self.refuse("estimator.seed", format!("found {}, expected 0 to {MAX_SEED}", estimator.seed));
        }
        self.number("estimator.parameter_drift", estimator.parameter_drift, &(0.0..=10.0), " /sqrt(s)");
        self.number("estimator.pressure_drift", estimator.pressure_drift, &(0.0..=100.0), " mmHg/sqrt(s)");
        self.number("estimator.inflation", estimator.inflation, &(1.0..=100.0), " per second");
        for (name, prior) in &estimator.prior {
            self.prior(name, prior, &estimator.estimate);
        }
        let [low, high] = estimator.noise_range;
        self.number("estimator.noise_range.0", low, &positive_to(1.0), "");
        self.number("estimator.noise_range.1", high, &(1.0..=1000.0), "");
        self.number("estimator.outlier_sd", estimator.outlier_sd, &(1.0..=1e9), "");
        self.number("estimator.smoothing_lag_s", estimator.smoothing_lag_s, &(0.0..=60.0), " s");
        let estimates_rate = estimator.estimate.iter().any(|name| name == "heart_rate");
        match estimator.timing {
            Timing::Tracked if !estimates_rate => {
                let message = "found \"tracked\", expected \"heart_rate\" in `estimator.estimate` with it";
                self.refuse_against("estimator.timing", "estimator.estimate", message.to_owned());
            }
            Timing::Beats if estimates_rate => {
                let message =
                    "found \"beats\", which tell the heart rate, expected no \"heart_rate\" in `estimator.estimate`";
                self.refuse_against("estimator.timing", "estimator.estimate", message.to_owned());
            }
            _ => {}
        }
        let name = match estimator.coupling {
            Coupling::Coupled => None,
            Coupling::Independent => Some("independent"),
            Coupling::Enkf => Some("enkf"),
            Coupling::Ukf => Some("ukf"),
        };
        let needs_coupled = estimator.timing != Timing::Config || estimator.smoothing_lag_s > 0.0;
        if let Some(name) = name.filter(|_| needs_coupled) {
            let expected = "expected \"coupled\" where beats are followed or estimates looked back at";
            self.refuse("estimator.coupling", format!("found \"{name}\", {expected}"));
        }
        if estimator.second_opinion != SecondOpinion::None && estimator.timing != Timing::Config {
            let message = "found a filter, expected \"none\" where beats are followed: filters keep to their own clock";
            self.refuse_against("estimator.second_opinion", "estimator.timing", message.to_owned());
        }
        self.whole("estimator.max_iterations", estimator.max_iterations, 1..=100);
        let fraction = (Bound::Excluded(0.0), Bound::Excluded(1.0));
        self.number("estimator.tolerance", estimator.tolerance, &fraction, "");
    }

    fn discrepancy(&mut self, config: &Config) {
        let known: Vec<&str> = PARAMETERS.iter().filter_map(|info| info.name.strip_prefix("delta_")).collect();
        for (name, settings) in &config.discrepancy {
            let key = KeyPath::from("discrepancy").join(name);
            let Some(info) = parameter(&format!("delta_{name}")) else {
                self.name(key, name, &known);
                continue;
            };
            if config.estimator.estimate.iter().any(|estimated| estimated == info.name) {
                let message =
                    format!("found \"{}\" in `estimator.estimate` as well, expected one of the two", info.name);
                self.refuse(key.clone(), message);
            }
            let inertial: Vec<&str> = inertial().collect();
            if settings.form == DiscrepancyForm::Inertial && !inertial.contains(&name.as_str()) {
                let expected = inertial.join(" or ");
                self.refuse(key.join("form"), format!("found \"inertial\", which only {expected} can be"));
            }
            let unit = format!(" {}", info.unit);
            let limit = info.bounds.1;
            let number = |value: Option<f64>| value.unwrap_or(limit);
            self.number(key.join("change"), number(settings.change), &positive_to(limit), &unit);
            self.number(key.join("magnitude"), number(settings.magnitude), &positive_to(limit), &unit);
            self.number(key.join("inertance"), settings.inertance.unwrap_or(1.0), &positive_to(1e6), " s");
            self.number(key.join("initial_sd"), settings.initial_sd.unwrap_or(0.0), &(0.0..=limit), &unit);
        }
    }

    fn alarms(&mut self, config: &Config) {
        self.whole("alarms", config.alarms.len(), 0..=MAX_ALARMS);
        for (position, alarm) in config.alarms.iter().enumerate() {
            let key = format!("alarms.{position}");
            let longest = alarm.name.chars().count() > MAX_ALARM_NAME;
            if alarm.name.trim().is_empty() || longest || alarm.name.chars().any(char::is_control) {
                let expected = format!("expected text of 1 to {MAX_ALARM_NAME} characters on one line");
                self.refuse(format!("{key}.name"), format!("found {:?}, {expected}", alarm.name));
            }
            if config.alarms[..position].iter().any(|other| other.name == alarm.name) {
                let message = format!("found \"{}\" more than once, expected each name once", alarm.name);
                self.refuse(format!("{key}.name"), message);
            }
            self.watched(&format!("{key}.quantity"), &alarm.quantity, config);
            self.alarm(&key, alarm);
        }
    }

    fn alarm(&mut self, key: &str, alarm: &AlarmSettings) {
        if alarm.below.is_some() == alarm.above.is_some() {
            let found = if alarm.below.is_some() { "both" } else { "neither" };
            self.refuse(key, format!("found {found}, expected exactly one of `below` and `above`"));
        }
        // Beyond that, members cannot tell; below a half, it would be more likely than not that nothing is the matter.
        self.number(format!("{key}.probability"), alarm.probability, &(0.5..=0.999), "");
        self.number(format!("{key}.for_s"), alarm.for_s, &(0.0..=3600.0), " s");
        self.number(format!("{key}.clear_margin"), alarm.clear_margin, &(0.0..=1e6), "");
        self.number(format!("{key}.clear_for_s"), alarm.clear_for_s, &(0.0..=3600.0), " s");
    }

    /// What an alarm watches must be known and estimated.
    fn watched(&mut self, key: &str, name: &str, config: &Config) {
        let model = config.patient.model();
        let quantities = model.states().iter().chain(model.derived()).chain(model.clinical()).map(|q| q.name);
        let lacking = config.discrepancy.keys().map(|name| format!("delta_{name}")).collect::<Vec<_>>();
        let estimated = config.estimator.estimate.iter().chain(&lacking).map(String::as_str);
        let known: Vec<&str> = quantities.chain(estimated).collect();
        if parameter(name).is_some() && !known.contains(&name) {
            let expected = "expected a parameter of `estimator.estimate` or another quantity";
            let message = format!("found \"{name}\", which is not estimated, {expected}");
            self.refuse_against(key, "estimator.estimate", message);
        } else {
            self.name(key, name, &known);
        }
    }

    fn estimate(&mut self, names: &[String]) {
        let estimable: Vec<_> = PARAMETERS.iter().filter(|info| info.estimable).map(|info| info.name).collect();
        for name in names {
            if parameter(name).is_some_and(|info| !info.estimable) {
                let expected = estimable.join(", ");
                let message = format!("found \"{name}\", of which pressures say nothing, expected one of {expected}");
                self.refuse("estimator.estimate", message);
            } else {
                self.name("estimator.estimate", name, &estimable);
            }
        }
        self.unique("estimator.estimate", names);
    }

    fn initial_guess(&mut self, name: &str, value: f64, estimate: &[String]) {
        let key = KeyPath::from("estimator.initial_guess").join(name);
        match parameter(name) {
            Some(info) if estimate.iter().any(|estimated| estimated == name) => self.bounds(key, info, value),
            _ => {
                let estimated = estimate.join(", ");
                let message = format!("found a guess of what is not in `estimator.estimate`, expected {estimated}");
                self.refuse_against(key, "estimator.estimate", message);
            }
        }
    }

    fn prior(&mut self, name: &str, prior: &PriorSettings, estimate: &[String]) {
        let key = KeyPath::from("estimator.prior").join(name);
        let companion = name == "beat_phase" && estimate.iter().any(|estimated| estimated == "heart_rate");
        let Some(info) = parameter(name).filter(|_| companion || estimate.iter().any(|estimated| estimated == name))
        else {
            let estimated = estimate.join(", ");
            let message = format!("found a prior of what is not in `estimator.estimate`, expected {estimated}");
            return self.refuse_against(key, "estimator.estimate", message);
        };
        self.number(key.clone().join("sd"), prior.sd.unwrap_or(1.0), &positive_to(10.0), "");
        self.number(key.clone().join("drift"), prior.drift.unwrap_or(0.0), &(0.0..=10.0), " /sqrt(s)");
        self.number(key.clone().join("reversion"), prior.reversion.unwrap_or(0.0), &(0.0..=1000.0), " /s");
        let (low, high) = (prior.min.unwrap_or(info.bounds.0), prior.max.unwrap_or(info.bounds.1));
        self.bounds(key.clone().join("min"), info, low);
        self.bounds(key.clone().join("max"), info, high);
        if low >= high {
            self.refuse(key.join("min"), format!("found {low:?}, expected less than `max` ({high:?})"));
        }
    }

    fn window(&mut self, window: &WindowSettings) {
        self.number("window.allowed_lateness_s", window.allowed_lateness_s, &positive_to(3600.0), " s");
        let (length_s, lateness_s) = (window.length_s, window.allowed_lateness_s);
        if !(SHORTEST_S..=lateness_s).contains(&length_s) {
            let expected =
                format!("{SHORTEST_S:?} s or more and at most `window.allowed_lateness_s` ({lateness_s:?} s)");
            let message = format!("found {length_s:?}, expected {expected}");
            self.refuse_against("window.length_s", "window.allowed_lateness_s", message);
        }
        self.number("window.forecast_limit_s", window.forecast_limit_s, &(SHORTEST_S..=86_400.0), " s");
        self.whole("window.collocation_points", window.collocation_points, 2..=64);
        self.whole("window.neurons", window.neurons, 1..=256);
        self.distribution("window.weights", window.weights);
        self.distribution("window.biases", window.biases);
        self.interval("window.domain", window.domain);
        self.number("window.physics_weight", window.physics_weight, &positive_to(1e9), "");
        self.number("window.data_weight", window.data_weight, &positive_to(1e9), "");
        self.number("window.parameter_weight", window.parameter_weight, &positive_to(1e9), "");
    }

    fn distribution(&mut self, key: &str, distribution: Distribution) {
        match distribution {
            Distribution::Uniform(ends) => self.interval(&format!("{key}.uniform"), ends),
            Distribution::Normal([_, sd]) => {
                self.number(format!("{key}.normal.1"), sd, &positive_to(f64::MAX), " (standard deviation)");
            }
            Distribution::Exponential(mean) => {
                self.number(format!("{key}.exponential"), mean, &positive_to(f64::MAX), " (mean)");
            }
        }
    }

    fn interval(&mut self, key: &str, [low, high]: [f64; 2]) {
        if low >= high {
            self.refuse(key, format!("found [{low:?}, {high:?}], expected the lower end first and the ends apart"));
        }
    }

    fn channels(&mut self, config: &Config) {
        for (state, channel) in config.channels.iter() {
            let key = format!("channels.{state}");
            self.number(format!("{key}.noise_sd"), channel.noise_sd, &positive_to(1000.0), " mmHg");
            if channel.min_mmhg >= channel.max_mmhg {
                let (low, high) = (channel.min_mmhg, channel.max_mmhg);
                let message = format!("found {low:?}, expected less than `{key}.max_mmhg` ({high:?} mmHg)");
                self.refuse_against(format!("{key}.min_mmhg"), &format!("{key}.max_mmhg"), message);
            }
        }
        for (label, state) in &config.labels {
            let key = KeyPath::from("labels").join(label);
            if !is_topic(label) || label.contains('/') {
                let message = "found a label that cannot be part of a topic, expected text without `/ * $ # ?`";
                self.refuse(key, message);
            } else if self.name(key.clone(), state, Pressures::NAMES)
                && Pressures::NAMES.contains(&label.as_str())
                && label != state
            {
                let message = format!("found \"{state}\" for a label that is itself a state, expected \"{label}\"");
                self.refuse(key, message);
            }
        }
    }

    fn publish(&mut self, publish: &PublishSettings) {
        if !is_topic(&publish.prefix) {
            let message = format!(
                "found {:?}, expected text without `* $ # ?`, not empty, without `/` at an end or twice in a row",
                publish.prefix
            );
            self.refuse("publish.prefix", message);
        }
        self.number("publish.rate_hz", publish.rate_hz, &positive_to(100_000.0), " Hz");
        self.number("publish.status_rate_hz", publish.status_rate_hz, &positive_to(1000.0), " Hz");
    }

    fn service_and_network(&mut self, config: &Config) {
        let instructions = config.service.instruction_set.set();
        if !instructions.is_available() {
            let name = instructions.name();
            self.refuse("service.instruction_set", format!("found \"{name}\", expected one that this processor has"));
        }
        self.whole("service.workers", config.service.workers, 0..=1024);
        self.whole("service.max_beds", config.service.max_beds, 1..=65_536);
        self.whole("service.queue_blocks", config.service.queue_blocks, 1..=1_000_000);
        for (key, endpoints) in [("zenoh.listen", &config.zenoh.listen), ("zenoh.connect", &config.zenoh.connect)] {
            for (position, endpoint) in endpoints.iter().enumerate() {
                let parts = endpoint.split_once('/');
                if !parts.is_some_and(|(protocol, address)| !protocol.is_empty() && !address.is_empty()) {
                    let message = format!("found {endpoint:?}, expected PROTOCOL/ADDRESS such as tcp/127.0.0.1:7447");
                    self.refuse(format!("{key}.{position}"), message);
                }
            }
        }
    }
}

fn parameter(name: &str) -> Option<&'static ParameterInfo> {
    PARAMETERS.iter().find(|info| info.name == name)
}

/// Flows that can have inertia.
fn inertial() -> impl Iterator<Item = &'static str> {
    let model = Cvsim6::default();
    let infos = PARAMETERS.iter().enumerate().filter(move |(p, _)| model.inductance_path(*p).is_some());
    infos.filter_map(|(_, info)| info.name.strip_prefix("delta_"))
}

/// Parameters that a script can change.
fn scriptable(table: &str) -> Vec<&'static str> {
    let names = PARAMETERS.iter().map(|info| info.name);
    // The volume enters only the start; the phase runs by itself and nothing is lacking at first, so factors on them
    // would mean nothing.
    names
        .filter(|&name| {
            name != "blood_volume" && !(table == "scale" && (name == "beat_phase" || name.starts_with("delta_")))
        })
        .collect()
}

/// Whether text can be one or more chunks of a topic.
fn is_topic(text: &str) -> bool {
    !text.contains(['*', '$', '#', '?']) && text.split('/').all(|chunk| !chunk.is_empty())
}

fn range_text(range: &impl RangeBounds<f64>) -> String {
    let high = match range.end_bound() {
        Bound::Included(&high) if high < f64::MAX => Some((high, "at most")),
        Bound::Excluded(&high) => Some((high, "less than")),
        _ => None,
    };
    match (range.start_bound(), high) {
        (Bound::Included(&low), None) => format!("{} or more", short(low)),
        (Bound::Included(&low), Some((high, _))) => format!("{} to {}", short(low), short(high)),
        (Bound::Excluded(&low), Some((high, words))) => format!("more than {} and {words} {}", short(low), short(high)),
        (Bound::Excluded(&low), None) => format!("more than {}", short(low)),
        (Bound::Unbounded, _) => "a number".to_owned(),
    }
}

/// Four digits: bounds that follow from defaults have sixteen, which nobody wants to read.
fn short(number: f64) -> String {
    let rounded: f64 = format!("{number:.3e}").parse().unwrap_or(number);
    format!("{rounded}")
}
