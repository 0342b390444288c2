//! `hemostream validate`: twin experiments.

use std::path::PathBuf;
use std::time::Duration;

use clap::Args;
use clap::builder::PossibleValuesParser;
use hemostream::edge::config::{Config, Coupling};
use hemostream::estimate::time::s_from_ns;
use hemostream::report;
use hemostream::runtime::clock::Clock;
use hemostream::runtime::workers::Workers;
use hemostream::validate::experiment::Plan;
use hemostream::validate::scenario::{Rival, Scenario};
use hemostream::validate::table::{self, Overview};
use hemostream::validate::{PRESET, ValidateError, patients, pictures};

use super::{Failure, failed, progress_bar, say};

/// The name that stands for all scenarios.
const ALL: &str = "all";
/// The name that stands for no rival.
const NONE: &str = "none";

/// Length of a record \[s\], and that of a quick one.
const SECONDS: f64 = 24.0;
const QUICK_SECONDS: f64 = 8.0;
/// Shorter records have no beats to score; longer ones are better cut into seeds.
const LENGTHS_S: std::ops::RangeInclusive<f64> = 4.0..=600.0;

/// Records per patient: a single one says as much about its own noise and start as about the filters.
const SEEDS: u64 = 5;

/// Members of a quick experiment.
const QUICK: &str = "estimator.members=30";

const EXAMPLES: &str = "\
Examples:
  hemostream validate --output validation
  hemostream validate --scenario all --output validation
  hemostream validate --patient hemorrhage --patient my_patient.toml --rival none --observed p_a
  hemostream validate --quick --set estimator.members=50

Patients: healthy, pulmonary_hypertension_stable, hemorrhage, vasodilation, left_failure,
right_failure, tachycardia, or a TOML file whose [patient] and [channels] are the truth.
--config and --set say what the estimator believes and how it works; the truth stays as it is.";

/// Twin experiments: synthetic patients with a known truth; error, bands and CRPS beside the UKF and the EnKF
#[derive(Args)]
#[command(after_help = EXAMPLES)]
pub(crate) struct Validate {
    /// Built-in patient or TOML file; may be repeated [default: all built-in ones]
    #[arg(long = "patient", value_name = "NAME_OR_FILE")]
    patients: Vec<String>,
    /// What happens, or what is believed wrongly; may be repeated
    #[arg(long = "scenario", value_name = "NAME", default_value = "step",
          value_parser = PossibleValuesParser::new(scenario_names()))]
    scenarios: Vec<String>,
    /// Records of every patient, each with another start, noise and wandering [default: 5, quick 1]
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..=1000))]
    seeds: Option<u64>,
    /// Length of a record [default: 24, quick 8]
    #[arg(long, value_parser = length)]
    seconds: Option<f64>,
    /// Who watches the same samples; may be repeated [default: both]
    #[arg(long = "rival", value_name = "NAME", value_parser = PossibleValuesParser::new(rival_names()))]
    rivals: Vec<String>,
    /// Pressures that have a sensor [default: p_a,p_v,p_pa]
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    observed: Vec<String>,
    /// Also score estimates that are looked back at after so many seconds
    #[arg(long, value_name = "S")]
    lag: Option<f64>,
    /// Worker threads; 0 is one per core
    #[arg(long, default_value_t = 0)]
    threads: usize,
    /// One setting of the estimator, over file and environment; may be repeated
    #[arg(long = "set", value_name = "KEY=VALUE")]
    sets: Vec<String>,
    /// Configuration file of the estimator (TOML); defaults where left out
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Directory for scores.csv, events.csv, summary.json, report.html, report.md and pictures; created if missing
    #[arg(long, value_name = "DIR")]
    output: Option<PathBuf>,
    /// Few members and short records: whether everything works, not what comes out
    #[arg(long)]
    quick: bool,
}

fn scenario_names() -> Vec<&'static str> {
    Scenario::ALL.iter().map(|scenario| scenario.name()).chain([ALL]).collect()
}

fn rival_names() -> Vec<&'static str> {
    Rival::ALL.iter().map(|rival| rival.name()).chain([NONE]).collect()
}

fn length(text: &str) -> Result<f64, String> {
    let seconds = text.parse().ok().filter(|seconds| LENGTHS_S.contains(seconds));
    seconds
        .ok_or_else(|| format!("found `{text}`, expected a number from {} to {}", LENGTHS_S.start(), LENGTHS_S.end()))
}

impl From<ValidateError> for Failure {
    fn from(error: ValidateError) -> Self {
        match error {
            ValidateError::UnknownPatient { .. }
            | ValidateError::PatientTwice(_)
            | ValidateError::Config(_)
            | ValidateError::Settings(_) => Self::Input(error.to_string()),
            ValidateError::Simulation { .. } | ValidateError::File { .. } => Self::Failed(error.to_string()),
        }
    }
}

impl Validate {
    pub(crate) fn run(&self) -> Result<(), Failure> {
        let plan = self.plan()?;
        if let Some(output) = &self.output {
            let reason = |e: std::io::Error| Failure::Input(format!("{}: cannot be written: {e}", output.display()));
            std::fs::create_dir_all(output).map_err(reason)?;
        }
        let workers = Workers::start(self.threads).map_err(failed)?;
        let bar = progress_bar(plan.work_s(), "{bar:40} {pos}/{len} patient-seconds  {eta} left");
        bar.enable_steady_tick(Duration::from_millis(500));
        let clock = Clock::start();
        let results = plan.run(&workers, &|| bar.inc(1))?;
        bar.finish_and_clear();

        for overview in Overview::all(&results) {
            overview.lines().into_iter().chain([String::new()]).for_each(say);
            let (verdicts, notices) = (overview.verdicts(), overview.notices());
            verdicts.into_iter().chain(notices).chain([String::new()]).for_each(say);
        }
        if let Some(output) = &self.output {
            table::write(output, &results)?;
            let page = report::write(output, pictures::HEADING, &pictures::reports(&results)).map_err(failed)?;
            say(format!("read {}", page.display()));
        }
        say(format!("{} patient-seconds in {:.1} s", plan.work_s(), s_from_ns(clock.now().0)));
        Ok(())
    }

    fn plan(&self) -> Result<Plan, Failure> {
        let patients = if self.patients.is_empty() { patients::built_in() } else { patients::find_all(&self.patients) };
        let chosen = |scenario: &Scenario| self.scenarios.iter().any(|name| name == scenario.name() || name == ALL);
        let rivals: Vec<Rival> = match self.rivals.as_slice() {
            [] => Rival::ALL.to_vec(),
            names if names.iter().any(|name| name == NONE) => Vec::new(),
            names => Rival::ALL.into_iter().filter(|rival| names.iter().any(|name| name == rival.name())).collect(),
        };
        Ok(Plan {
            patients: patients?,
            scenarios: Scenario::ALL.into_iter().filter(chosen).collect(),
            seeds: self.seeds.unwrap_or(if self.quick { 1 } else { SEEDS }),
            seconds: self.seconds.unwrap_or(if self.quick { QUICK_SECONDS } else { SECONDS }),
            ensemble: self.ensemble()?,
            rivals,
        })
    }

    /// The estimator that is validated.
    fn ensemble(&self) -> Result<Config, Failure> {
        let mut sets = Vec::new();
        if self.quick {
            sets.push(QUICK.to_owned());
        }
        sets.extend(self.sets.iter().cloned());
        if !self.observed.is_empty() {
            let names: Vec<String> = self.observed.iter().map(|name| format!("\"{}\"", name.trim())).collect();
            sets.push(format!("observed=[{}]", names.join(", ")));
        }
        if let Some(lag_s) = self.lag {
            sets.push(format!("estimator.smoothing_lag_s={lag_s:?}"));
        }
        let (config, origins) = Config::load_over(PRESET, self.config.as_deref(), &sets)?;
        // Silently ignored it would be believed to have been the truth.
        let patient = origins.iter().find(|setting| setting.key.starts_with("patient.") && setting.origin != "default");
        if let Some(setting) = patient {
            return Err(Failure::Input(format!(
                "{}: `{}`: found a setting of the patient, expected settings of the estimator: who is watched is said by \
                 --patient",
                setting.origin, setting.key
            )));
        }
        if matches!(config.estimator.coupling, Coupling::Ukf | Coupling::Enkf) {
            let message =
                "`estimator.coupling`: found a rival, expected coupled or independent: rivals are named by --rival";
            return Err(Failure::Input(message.to_owned()));
        }
        Ok(config)
    }
}
