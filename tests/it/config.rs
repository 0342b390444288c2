//! Configuration: the files that ship, fixtures of good and bad ones, layers, ranges, origins, hash.

use std::fs;
use std::path::{Path, PathBuf};

use proptest::prelude::*;

use hemostream::edge::config::{
    Activation, AlarmPriority, Config, ConfigError, Coupling, Distribution, InitialSd, Origins, Systole, known_keys,
    render,
};
use hemostream::estimate::alarm::{Limit, Watched};
use hemostream::model::Model;
use hemostream::model::cvsim6::{Cvsim6, PARAMETERS, Parameter, Pressures, SystoleRule};

type Loaded = Result<(Config, Origins), ConfigError>;

fn in_repository(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(path)
}

fn load_file(path: &Path) -> Loaded {
    Config::load_from(Some(path), [], &[])
}

/// Loads with variables and `--set`, no file.
fn load(variables: &[(&str, &str)], sets: &[&str]) -> Loaded {
    load_over(None, variables, sets)
}

fn load_over(file: Option<&Path>, variables: &[(&str, &str)], sets: &[&str]) -> Loaded {
    let variables = variables.iter().map(|&(name, value)| (name.to_owned(), value.to_owned()));
    let sets: Vec<String> = sets.iter().map(|&set| set.to_owned()).collect();
    Config::load_from(file, variables, &sets)
}

fn refusal(variables: &[(&str, &str)], sets: &[&str]) -> String {
    load(variables, sets).expect_err("a refusal").to_string()
}

fn written(text: &str) -> tempfile::NamedTempFile {
    let file = tempfile::Builder::new().suffix(".toml").tempfile().unwrap();
    fs::write(file.path(), text).unwrap();
    file
}

fn fixtures(kind: &str) -> Vec<PathBuf> {
    let entries = fs::read_dir(in_repository("tests/fixtures/config").join(kind)).unwrap();
    let mut paths: Vec<_> = entries.map(|entry| entry.unwrap().path()).collect();
    paths.sort();
    assert!(!paths.is_empty());
    paths
}

fn presets() -> Vec<PathBuf> {
    [
        "config/default.toml",
        "config/paper.toml",
        "config/validate.toml",
        "config/recorded.toml",
        "config/alarms.toml",
        "config/patients/pulmonary_hypertension.toml",
    ]
    .map(in_repository)
    .into()
}

#[test]
fn default_file_is_the_default_and_complete() {
    let path = in_repository("config/default.toml");
    let (config, origins) = load_file(&path).unwrap();
    assert_eq!(config, Config::default());
    for setting in origins.iter() {
        assert_eq!(setting.origin, path.display().to_string(), "{} is not in default.toml", setting.key);
    }
    // Alternatives can only be mentioned.
    let text = fs::read_to_string(&path).unwrap();
    for key in known_keys() {
        let name = key.rsplit('.').next().unwrap();
        assert!(text.contains(&format!("{name} = ")), "{key} is not in default.toml");
    }
}

#[test]
fn default_is_within_its_own_ranges() {
    Config::default().check().unwrap();
    assert_eq!(Config::default().patient.theta(), Cvsim6::default().default_parameters());
}

#[test]
fn paper_preset_is_the_paper() {
    let (config, _) = load_file(&in_repository("config/paper.toml")).unwrap();
    let (estimator, window) = (&config.estimator, &config.window);
    assert_eq!(estimator.coupling, Coupling::Independent);
    assert_eq!(estimator.members, 100);
    assert_eq!(estimator.estimate, ["r_pv"]);
    let guess = estimator.initial_guess["r_pv"] / config.patient.r_pv;
    assert!((guess - 1.5).abs() < 1e-12, "{guess}");
    assert_eq!((window.length_s, window.collocation_points, window.neurons), (1e-3, 5, 5));
    assert_eq!(window.activation, Activation::Tanh);
    assert_eq!(window.weights, Distribution::Uniform([-1.0, 1.0]));
    assert_eq!(window.biases, Distribution::Uniform([-1.0, 1.0]));
    assert_eq!(config.patient.systole, Systole::Seconds(0.33));
    assert_eq!(config.observed, Pressures::NAMES);
    let maxima = [103.6, 103.0, 7.3, 20.4, 20.0, 12.1];
    for ((state, channel), maximum) in config.channels.iter().zip(maxima) {
        assert!((channel.noise_sd / maximum - 0.02).abs() < 2e-5, "{state}");
    }
}

#[test]
fn pulmonary_hypertension_doubles_the_resistance() {
    let (config, _) = load_file(&in_repository("config/patients/pulmonary_hypertension.toml")).unwrap();
    assert_eq!(config.observed, ["p_a", "p_pa"]);
    let changes = config.patient.changes();
    assert_eq!(changes.len(), 1);
    assert_eq!(changes[0].at_s, 20.0);
    assert_eq!(changes[0].assignments, [(Parameter::RPv as usize, 2.0 * PARAMETERS[Parameter::RPv as usize].default)]);
}

#[test]
fn alarms_are_filled_in_and_listed() {
    let (config, origins) = load_file(&in_repository("tests/fixtures/config/valid/alarms.toml")).unwrap();
    let low = &config.alarms[0];
    assert_eq!((low.below, low.above, low.probability, low.for_s), (Some(4.0), None, 0.95, 10.0));
    assert_eq!((low.clear_margin, low.clear_for_s, low.priority, low.latched), (0.0, 5.0, AlarmPriority::Medium, true));
    let told = config.estimator_settings().unwrap().live.alarms;
    let watched: Vec<Watched> = told.iter().map(|alarm| alarm.watched).collect();
    // Six pressures and what is lacking are the states.
    assert_eq!(watched, [Watched::Clinical(2), Watched::Parameter(Parameter::RA as usize), Watched::Quantity(6)]);
    assert_eq!((told[0].limit, told[1].limit), (Limit::Below(4.0), Limit::Above(2.5)));
    assert_eq!((told[1].for_ns, told[1].clear_for_ns), (20_000_000_000, 15_000_000_000));
    let listed = origins.get("alarms").unwrap();
    assert!(listed.value.contains("\"high resistance\""), "{}", listed.value);
    assert!(listed.origin.ends_with("alarms.toml"), "{}", listed.origin);
}

#[test]
fn valid_fixtures_load() {
    for path in fixtures("valid") {
        let (config, _) = load_file(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        config.check().unwrap();
    }
}

#[test]
fn invalid_fixtures_are_refused_with_key_and_place() {
    for path in fixtures("invalid") {
        let text = fs::read_to_string(&path).unwrap();
        let expected = text.lines().next().and_then(|line| line.strip_prefix("# expect: "));
        let expected = expected.unwrap_or_else(|| panic!("{}: no expectation", path.display()));
        let message = match load_file(&path) {
            Err(error) => error.to_string(),
            Ok(_) => panic!("{}: accepted", path.display()),
        };
        assert!(message.contains(expected), "{}:\nfound    {message}\nexpected {expected}", path.display());
        assert!(message.starts_with(&format!("{}:", path.display())), "{message}");
        assert_eq!(message.lines().count(), 1, "one cause, one line:\n{message}");
    }
}

#[test]
fn rendered_settings_load_to_the_same_configuration() {
    for path in fixtures("valid").into_iter().chain(presets()) {
        let (config, origins) = load_file(&path).unwrap();
        let text = render(&config, &origins);
        let (again, _) = load_file(written(&text).path()).unwrap_or_else(|error| panic!("{error}\n{text}"));
        assert_eq!(again, config, "{}", path.display());
        assert!(text.contains(&format!("{:016x}", config.hash())));
    }
}

#[test]
fn later_layers_win_and_origins_say_so() {
    let file = written("[window]\nlength_s = 0.003\nneurons = 6\n[estimator]\nmembers = 50\nseed = 2\n");
    let variables = [("HEMOSTREAM_WINDOW__NEURONS", "7"), ("HEMOSTREAM_ESTIMATOR__SEED", "3"), ("PATH", "/bin")];
    let sets = ["estimator.seed=4", "window.activation=sine", "estimator.seed=5"];
    let (config, origins) = load_over(Some(file.path()), &variables, &sets).unwrap();
    assert_eq!((config.estimator.members, config.window.length_s), (50, 0.003));
    assert_eq!((config.window.neurons, config.estimator.seed), (7, 5));
    assert_eq!(config.window.activation, Activation::Sine);
    let origin = |key: &str| origins.get(key).unwrap().origin.clone();
    assert_eq!(origin("window.collocation_points"), "default");
    assert_eq!(origin("window.length_s"), file.path().display().to_string());
    assert_eq!(origin("window.neurons"), "environment HEMOSTREAM_WINDOW__NEURONS");
    assert_eq!(origin("estimator.seed"), "--set");
    assert_eq!(origins.get("estimator.seed").unwrap().value, "5");
    assert_eq!(origins.get("window.activation").unwrap().value, "\"sine\"");
}

#[test]
fn origins_list_every_setting_once_in_the_order_of_the_schema() {
    let (_, origins) = load(&[], &[]).unwrap();
    let keys: Vec<_> = origins.iter().map(|setting| setting.key.as_str()).collect();
    assert_eq!(keys[..4], ["observed", "alarms", "discrepancy", "patient.heart_rate"]);
    assert_eq!(keys.last(), Some(&"zenoh.connect"));
    let mut unique = keys.clone();
    unique.sort_unstable();
    unique.dedup();
    assert_eq!(unique.len(), keys.len());
    assert!(keys.iter().all(|&key| known_keys().iter().any(|known| known == key)));
}

#[test]
fn a_preset_lies_between_the_defaults_and_the_file() {
    let preset = ("preset.toml", "[window]\nlength_s = 0.004\nneurons = 7\nweights = { normal = [0.0, 1.0] }\n");
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("file.toml");
    std::fs::write(&file, "[window]\nneurons = 9\nweights = { exponential = 1.0 }\n").unwrap();
    let (config, origins) = Config::load_over(preset, Some(&file), &[]).unwrap();
    assert_eq!((config.window.length_s, config.window.neurons), (0.004, 9));
    assert_eq!(config.window.weights, Distribution::Exponential(1.0));
    assert_eq!(origins.get("window.length_s").unwrap().origin, "preset.toml");
    let wrong = Config::load_text("preset.toml", "[window]\nlenght_s = 0.004\n").unwrap_err().to_string();
    assert!(wrong.contains("preset.toml:2"), "{wrong}");
}

#[test]
fn one_of_tables_replace_those_of_lower_layers() {
    let file = written("[patient]\nsystole = { fraction = 0.4 }\n[window]\nweights.exponential = 2.0\n");
    let (config, origins) = load_over(Some(file.path()), &[], &[]).unwrap();
    assert_eq!(config.patient.systole, Systole::Fraction(0.4));
    assert_eq!(config.window.weights, Distribution::Exponential(2.0));
    assert!(origins.get("patient.systole.seconds").is_none());

    let variables = [("HEMOSTREAM_PATIENT__SYSTOLE__BAZETT", "0.3")];
    let sets = ["window.weights.uniform=[0, 1]", "window.weights={ normal = [0, 3] }"];
    let (config, _) = load_over(Some(file.path()), &variables, &sets).unwrap();
    assert_eq!(config.patient.systole, Systole::Bazett(0.3));
    assert_eq!(config.window.weights, Distribution::Normal([0.0, 3.0]));
    assert_eq!(config.window.biases, Distribution::Uniform([-1.0, 1.0]));

    // The environment is one source: two alternatives in it contradict each other.
    let both = [("HEMOSTREAM_PATIENT__SYSTOLE__BAZETT", "0.3"), ("HEMOSTREAM_PATIENT__SYSTOLE__SECONDS", "0.3")];
    assert!(refusal(&both, &[]).contains("`patient.systole`: found bazett, seconds, expected exactly one"));
}

#[test]
fn maps_merge_and_lists_replace() {
    let file = written(concat!(
        "observed = [\"p_a\", \"p_v\"]\n",
        "[estimator]\nestimate = [\"r_pv\", \"r_a\"]\ninitial_guess = { r_pv = 0.1 }\n",
        "[labels]\nABP = \"p_pa\"\nP2 = \"p_v\"\n[channels.p_a]\nmax_mmhg = 300\n",
    ));
    let sets = ["estimator.initial_guess.r_a=1.2", "observed=[\"p_pa\"]", "labels.\"P 3\"=p_l"];
    let (config, _) = load_over(Some(file.path()), &[("HEMOSTREAM_LABELS__P4", "p_r")], &sets).unwrap();
    assert_eq!(config.observed, ["p_pa"]);
    assert_eq!(config.estimator.initial_guess, [("r_a".to_owned(), 1.2), ("r_pv".to_owned(), 0.1)].into());
    let labels = ["ABP", "ART", "P2", "P 3", "P4"].map(|label| config.labels[label].as_str());
    assert_eq!(labels, ["p_pa", "p_a", "p_v", "p_l", "p_r"]);
    let channel = config.channels.get("p_a").unwrap();
    assert_eq!((channel.noise_sd, channel.max_mmhg), (2.06, 300.0));
}

#[test]
fn words_need_no_quotes_outside_files() {
    let (config, _) = load(&[("HEMOSTREAM_PUBLISH__PREFIX", "ward 7/icu")], &["labels.X=p_a"]).unwrap();
    assert_eq!(config.publish.prefix, "ward 7/icu");
    let (config, _) = load(&[], &["publish.prefix=2026-01-01", "publish.json=false"]).unwrap();
    assert_eq!((config.publish.prefix.as_str(), config.publish.json), ("2026-01-01", false));
    let script = "[{ at_s = 1, scale = { r_a = 1.1 } }]";
    let (config, _) = load(&[("HEMOSTREAM_PATIENT__SCRIPT", script)], &[]).unwrap();
    assert_eq!(config.patient.script.len(), 1);
}

#[test]
fn environment_is_refused_by_name() {
    load(&[("HEMOSTREAM_LOG", "debug"), ("HEMO", "1"), ("hemostream_x", "1")], &[]).unwrap();
    let message = refusal(&[("HEMOSTREAM_MEMBERS", "10")], &[]);
    assert_eq!(
        message,
        "environment HEMOSTREAM_MEMBERS: `members`: unknown key, did you mean HEMOSTREAM_ESTIMATOR__MEMBERS?"
    );
    let message = refusal(&[("HEMOSTREAM_WINDOW_LENGTH_S", "10")], &[]);
    assert!(message.ends_with("did you mean HEMOSTREAM_WINDOW__LENGTH_S?"), "{message}");
    let message = refusal(&[("HEMOSTREAM_WINDOW__LENGTH_S", "2ms")], &[]);
    let expected = "environment HEMOSTREAM_WINDOW__LENGTH_S: `window.length_s`: found \"2ms\", expected a number";
    assert_eq!(message, expected);
    // A value in the place of a table must not hide it from the next variable.
    let message = refusal(&[("HEMOSTREAM_WINDOW", "3"), ("HEMOSTREAM_WINDOW__LENGTH_S", "0.001")], &[]);
    assert_eq!(message, "environment HEMOSTREAM_WINDOW: `window`: found 3, expected a table");
    for odd in ["HEMOSTREAM_", "HEMOSTREAM___", "HEMOSTREAM_WINDOW__"] {
        refusal(&[(odd, "1")], &[]);
    }
}

#[test]
fn arguments_are_refused_by_key() {
    for malformed in ["window.length_s", "", "=1", "window.=1", "a b=1", "window.length_s"] {
        assert!(matches!(load(&[], &[malformed]), Err(ConfigError::Argument { .. })), "{malformed}");
    }
    assert_eq!(refusal(&[], &["window.neurons=0"]), "--set: `window.neurons`: found 0, expected 1 to 256");
    assert!(refusal(&[], &["window.neuron=3"]).ends_with("did you mean `window.neurons`?"));
}

#[test]
fn all_ranges_are_reported_at_once() {
    let message = refusal(&[], &["window.neurons=0", "publish.rate_hz=-1", "estimator.members=1"]);
    assert_eq!(message.lines().count(), 3, "{message}");
}

#[test]
fn unreadable_files_are_named() {
    let error = load_file(Path::new("/no/such/file.toml")).unwrap_err();
    assert!(error.to_string().starts_with("/no/such/file.toml: cannot be read:"), "{error}");
    let file = tempfile::NamedTempFile::new().unwrap();
    fs::write(file.path(), [0xff, 0xfe]).unwrap();
    assert!(matches!(load_file(file.path()), Err(ConfigError::Unreadable { .. })));
    fs::write(file.path(), "#".repeat(2 << 20)).unwrap();
    assert!(load_file(file.path()).unwrap_err().to_string().contains("found more than 1048576 bytes"));
}

/// Whatever is written at whatever key, there is an answer, and a refusal names the key.
#[test]
fn every_key_refuses_nonsense() {
    for key in known_keys() {
        for nonsense in ["{ zz = 1 }", "nan", "[[1]]", "-inf"] {
            let message = refusal(&[], &[&format!("{key}={nonsense}")]);
            assert!(message.contains(&format!("`{key}")), "{key}={nonsense}: {message}");
            assert!(message.starts_with("--set: "), "{key}={nonsense}: {message}");
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// A damaged file or argument is answered, never a panic; what loads is within all ranges.
    #[test]
    fn damaged_input_is_answered(start in any::<prop::sample::Index>(), length in 0_usize..40, with in "\\PC{0,12}") {
        let text = fs::read_to_string(in_repository("config/default.toml")).unwrap();
        let start = text.floor_char_boundary(start.index(text.len()));
        let end = text.floor_char_boundary(start + length);
        let damaged = format!("{}{with}{}", &text[..start], &text[end..]);
        if let Ok((config, _)) = load_file(written(&damaged).path()) {
            prop_assert_eq!(config.check(), Ok(()));
        }
        let _ = load(&[(&format!("HEMOSTREAM_{with}"), &with)], &[&with, &format!("window.length_s={with}")]);
    }
}

#[test]
fn initial_pressures_are_given_or_balanced() {
    let balanced = Config::default().patient.initial_pressures().unwrap();
    for (found, expected) in balanced.iter().zip([6.51, 87.92, 6.60, 0.53, 14.23, 7.73]) {
        assert!((found - expected).abs() < 5e-3, "{found} {expected}");
    }
    let (config, _) = load_file(&in_repository("tests/fixtures/config/valid/initial.toml")).unwrap();
    let pressures = config.patient.initial_pressures().unwrap();
    assert_eq!(pressures, [balanced[0], 95.0, 6.0, balanced[3], balanced[4], balanced[5]]);
    let sd = config.patient.initial_sd();
    assert_eq!(sd, [0.04 * balanced[0], 5.0, 1.0, 0.04 * balanced[3], 0.04 * balanced[4], 0.04 * balanced[5]]);
    let (config, _) = load_file(&in_repository("tests/fixtures/config/valid/initial_sd.toml")).unwrap();
    assert_eq!(config.patient.initial_sd, InitialSd::Relative(0.1));
    assert_eq!(config.patient.initial_sd()[1], 0.1 * balanced[1]);
}

#[test]
fn uncertainty_of_the_start_can_be_written_in_two_places() {
    let file = written("[patient.initial]\ninitial_sd = 0.2\n");
    let (config, origins) = load_file(file.path()).unwrap();
    assert_eq!(config.patient.initial_sd, InitialSd::Relative(0.2));
    assert_eq!(origins.get("patient.initial_sd").unwrap().origin, file.path().display().to_string());
    assert_eq!(origins.get("patient.initial").unwrap().origin, "default");
    let (config, _) = load_over(Some(file.path()), &[], &["patient.initial_sd=0.3"]).unwrap();
    assert_eq!(config.patient.initial_sd, InitialSd::Relative(0.3));
}

#[test]
fn scripts_are_sorted_and_factors_accumulate() {
    let (config, _) = load_file(&in_repository("tests/fixtures/config/valid/script.toml")).unwrap();
    let changes = config.patient.changes();
    let default = |parameter: Parameter| PARAMETERS[parameter as usize].default;
    assert_eq!(changes.iter().map(|change| change.at_s).collect::<Vec<_>>(), [10.0, 30.0]);
    let r_pv = default(Parameter::RPv) * 1.5;
    assert_eq!(changes[0].assignments, [(Parameter::Systole as usize, 0.3), (Parameter::RPv as usize, r_pv)]);
    let later = [(Parameter::HeartRate, 90.0), (Parameter::PTh, 4.0), (Parameter::RPv, 2.0 * r_pv)];
    assert_eq!(changes[1].assignments, later.map(|(parameter, value)| (parameter as usize, value)));
}

#[test]
fn more_alarms_than_a_bed_has_room_for_are_refused() {
    let many = |n: usize| {
        let one = |i: usize| format!("{{ name = \"{i}\", quantity = \"p_a\", below = 60 }}");
        format!("alarms=[{}]", (0..n).map(one).collect::<Vec<_>>().join(", "))
    };
    assert_eq!(load(&[], &[&many(64)]).unwrap().0.alarms.len(), 64);
    assert_eq!(refusal(&[], &[&many(65)]), "--set: `alarms`: found 65, expected 0 to 64");
}

#[test]
fn systole_chooses_the_rule_of_the_model() {
    for (name, rule) in
        [("seconds", SystoleRule::Seconds), ("fraction", SystoleRule::Fraction), ("bazett", SystoleRule::Bazett)]
    {
        let (config, _) = load(&[], &[&format!("patient.systole.{name}=0.3")]).unwrap();
        assert_eq!(config.patient.model().systole, rule);
        assert_eq!(config.patient.theta()[Parameter::Systole as usize], 0.3);
    }
}

#[test]
fn hash_follows_what_can_change_an_estimate() {
    let hash = |sets: &[&str]| load(&[], sets).unwrap().0.hash();
    let default = hash(&[]);
    assert_eq!(default, Config::default().hash());
    for neutral in ["zenoh.mode=client", "service.workers=3", "publish.prefix=ward", "window.length_s=2e-3"] {
        assert_eq!(hash(&[neutral]), default, "{neutral}");
    }
    let changing = [
        "publish.rate_hz=51",
        "window.length_s=0.0020000000000000005",
        "estimator.seed=2",
        "labels.X=p_a",
        "patient.systole.fraction=0.33",
        "patient.initial.p_a=90",
        "observed=[\"p_a\"]",
        "alarms=[{ name = \"a\", quantity = \"p_a\", below = 60 }]",
        "alarms=[{ name = \"a\", quantity = \"p_a\", below = 61 }]",
    ];
    let mut hashes = changing.map(|set| hash(&[set])).to_vec();
    hashes.push(default);
    hashes.sort_unstable();
    hashes.dedup();
    assert_eq!(hashes.len(), changing.len() + 1);
}
