//! `hemostream record`: what crosses the bus, into columnar files.

use std::path::PathBuf;

use clap::Args;
use hemostream::edge::files::units::Units;
use hemostream::edge::recording::recorder::{RecordError, RecordOptions, Summary, run};
use hemostream::edge::zenoh::ZenohBus;

use super::replay::client_settings;
use super::serve::{stop_when_asked, tokio_runtime};
use super::simulate::positive;
use super::{ConfigArgs, Failure, LOG, log_to_stderr, progress_bar, say};

/// Record samples, estimates, events and health of all beds in Parquet files
///
/// DIR/TABLE/bed=NAME/hour=YYYY-MM-DDTHH/part-SEQ.parquet, which DuckDB (hive_partitioning) and pandas read as one table
/// each: samples, estimates, smoothed, parameters, beats, events, truth, status, members. Stops on Ctrl-C or SIGTERM and
/// goes on in the same directory when started again. What the network drops is got from the daemon, which remembers it for
/// some seconds. `hemostream replay --recording DIR` plays it back.
#[derive(Args)]
#[command(after_help = "Example:  hemostream record --output recording --connect tcp/127.0.0.1:7447")]
pub(crate) struct Record {
    /// Where to write
    #[arg(long, value_name = "DIR")]
    output: PathBuf,
    #[command(flatten)]
    config: ConfigArgs,
    /// Bed to record; may be repeated, all if left out
    #[arg(long, value_name = "NAME")]
    bed: Vec<String>,
    /// Longest time that rows wait in memory [s]; what arrives waits a second before it becomes one
    #[arg(long, default_value_t = 2.0, value_parser = positive)]
    flush_s: f64,
    /// Record the whole ensembles as well
    #[arg(long)]
    members: bool,
    /// Where the daemon listens; over `zenoh.connect` of the configuration
    #[arg(long, value_name = "ENDPOINT")]
    connect: Vec<String>,
}

impl Record {
    pub(crate) fn run(&self) -> Result<(), Failure> {
        let (config, _) = self.config.load()?;
        log_to_stderr(LOG)?;
        let options = RecordOptions {
            prefix: config.publish.prefix.clone(),
            beds: self.bed.clone(),
            members: self.members,
            flush_s: self.flush_s,
            max_beds: config.service.max_beds,
        };
        let units = Units::of_model(&config.circulation()?);
        let runtime = tokio_runtime()?;
        let stop = stop_when_asked(&runtime);
        let settings = client_settings(&config, &self.connect);
        let bus = runtime.block_on(async { ZenohBus::open(&settings) })?;
        say(format!("recording {}/* into {}; Ctrl-C stops", options.prefix, self.output.display()));
        let bar = progress_bar(0, "{elapsed}  {pos} rows  {msg}");
        let mut progress = |rows: u64, dropped: u64| {
            bar.set_position(rows);
            if dropped > 0 {
                bar.set_message(format!("{dropped} messages dropped"));
            }
        };
        let recorded = run(&bus, &self.output, options, units, &stop, &mut progress);
        bar.finish_and_clear();
        bus.close();
        summarise(&recorded?);
        Ok(())
    }
}

impl From<RecordError> for Failure {
    fn from(error: RecordError) -> Self {
        Self::Failed(error.to_string())
    }
}

#[allow(clippy::cast_precision_loss)]
fn summarise(summary: &Summary) {
    let list = |counts: Vec<String>| if counts.is_empty() { "nothing".to_owned() } else { counts.join(", ") };
    let rows = list(summary.rows.iter().map(|(table, n)| format!("{n} {table}")).collect());
    say(format!(
        "recorded {rows}; beds: {}, parts: {}, {:.1} MB written, messages dropped: {}",
        summary.beds,
        summary.parts,
        summary.bytes as f64 / 1e6,
        summary.dropped
    ));
    if summary.recovered > 0 {
        say(format!("messages that the network dropped and the daemon gave again: {}", summary.recovered));
    }
    if summary.lost > 0 {
        say(format!("messages that never came, by their sequence numbers: {}", summary.lost));
    }
    if !summary.refused.is_empty() {
        let refused = list(summary.refused.iter().map(|(cause, n)| format!("{n} {cause}")).collect());
        say(format!("messages not recorded: {refused}"));
    }
}
