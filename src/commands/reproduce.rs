//! `hemostream reproduce`: the paper's examples, tables and figures.

use std::path::PathBuf;

use clap::Args;
use clap::builder::PossibleValuesParser;
use hemostream::estimate::time::s_from_ns;
use hemostream::report;
use hemostream::reproduce::{Context, HEADING, STUDIES, StudyError};
use hemostream::runtime::clock::Clock;
use hemostream::runtime::workers::Workers;

use super::{Failure, failed, progress_bar, say};

/// The name that stands for all studies.
const ALL: &str = "all";

/// Reproduce the paper: numbers, tables and pictures beside the published ones
#[derive(Args)]
#[command(after_help = "Example:  hemostream reproduce all --output report")]
pub(crate) struct Reproduce {
    /// Which study, or all of them
    #[arg(value_name = "WHAT", value_parser = PossibleValuesParser::new(names()))]
    what: String,
    /// Directory for report.html, report.md, summary.json, pictures and CSV; created if missing
    #[arg(long, value_name = "DIR")]
    output: PathBuf,
    /// Few members and short records: whether everything works, not what comes out
    #[arg(long)]
    quick: bool,
    /// Worker threads; 0 is one per core
    #[arg(long, default_value_t = 0)]
    threads: usize,
}

/// A study that is not in this build is the user's to ask for differently.
fn refused(error: StudyError) -> Failure {
    match error {
        StudyError::NotBuilt => Failure::Input(error.to_string()),
        error => failed(error),
    }
}

fn names() -> Vec<&'static str> {
    STUDIES.iter().map(|study| study.name).chain([ALL]).collect()
}

impl Reproduce {
    pub(crate) fn run(&self) -> Result<(), Failure> {
        let reason = |e: std::io::Error| Failure::Input(format!("{}: cannot be written: {e}", self.output.display()));
        std::fs::create_dir_all(&self.output).map_err(reason)?;
        let workers = Workers::start(self.threads).map_err(failed)?;
        let wanted: Vec<_> =
            STUDIES.iter().filter(|study| self.what == study.name || (self.what == ALL && study.is_built())).collect();
        let bar = progress_bar(wanted.len() as u64, "{bar:30} {pos}/{len} {elapsed} {msg}");
        bar.enable_steady_tick(std::time::Duration::from_millis(200));
        let progress = |what: &str| bar.set_message(what.to_owned());

        let clock = Clock::start();
        let context = Context::new(self.quick, &workers, &progress);
        let (mut reports, mut failure) = (Vec::new(), None);
        for study in wanted {
            let started = clock.now();
            match context.study(study) {
                Ok(report) => reports.push(report),
                // What is done already is still worth reading.
                Err(error) => {
                    failure = Some(refused(error));
                    break;
                }
            }
            let wall_s = s_from_ns(clock.now().ns_since(started));
            bar.suspend(|| say(format!("{:<22} {wall_s:>7.1} s   {}", study.name, study.about)));
            bar.inc(1);
        }
        bar.finish_and_clear();
        if !reports.is_empty() {
            let page = report::write(&self.output, HEADING, &reports).map_err(failed)?;
            say(format!("{:.1} s in all; read {}", s_from_ns(clock.now().0), page.display()));
        }
        failure.map_or(Ok(()), Err)
    }
}
