//! `hemostream estimate`: the estimator over a file.

use std::path::{Path, PathBuf};

use clap::Args;
use hemostream::edge::config::{Config, Timing};
use hemostream::edge::files::csv::{beat_header, beat_row, estimate_header, estimate_row};
use hemostream::edge::files::record::Record;
use hemostream::edge::files::table::{EventTable, Table, TableFormat};
use hemostream::edge::files::units::Units;
use hemostream::edge::outlet::notice_text;
use hemostream::estimate::estimator::{Input, Output};
use hemostream::estimate::time::ArrivalTime;
use hemostream::estimate::window::RawSample;
use hemostream::model::Model;
use hemostream::model::cvsim6::Pressures;
use hemostream::runtime::clock::Clock;
use hemostream::runtime::offline::Offline;
use hemostream::runtime::workers::Workers;
use indicatif::ProgressBar;

use super::{ConfigArgs, Failure, failed, log_to_stderr, progress_bar, say};

/// Run the estimator over a record, as fast as the machine goes
#[derive(Args)]
#[command(after_help = "Example:  hemostream estimate observed.csv --config config/paper.toml --output out.csv")]
pub(crate) struct Estimate {
    /// Record: CSV or Parquet with `time_s` and any of the six pressures, by name or monitor label, or the header of a
    /// WFDB record
    #[arg(value_name = "INPUT", required_unless_present = "record", conflicts_with = "record")]
    input: Option<PathBuf>,
    /// The same by name
    #[arg(long, value_name = "PATH")]
    record: Option<PathBuf>,
    #[command(flatten)]
    config: ConfigArgs,
    /// Where to write the estimates (CSV or Parquet, by the ending)
    #[arg(long, value_name = "FILE")]
    output: PathBuf,
    /// Where to write what is read off each heart beat (likewise): stroke volume, cardiac output, resistances, pressures
    #[arg(long, value_name = "FILE")]
    beats: Option<PathBuf>,
    /// Where to write what happened (likewise): alarms, artefacts, beats missed, parameters that moved, a model that does
    /// not fit
    #[arg(long, value_name = "FILE")]
    events: Option<PathBuf>,
    /// Worker threads, over the configuration; 0 is one per core
    #[arg(long)]
    threads: Option<usize>,
}

/// The nearest whole number of a positive one.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)]
pub(crate) fn whole(value: f64) -> u64 {
    value.round() as u64
}

impl Estimate {
    pub(crate) fn run(&self) -> Result<(), Failure> {
        let (config, _) = self.config.load()?;
        log_to_stderr("hemostream=warn,warn")?;
        for output in [Some(&self.output), self.beats.as_ref(), self.events.as_ref()].into_iter().flatten() {
            TableFormat::of(output)?;
        }
        let Some(input) = self.record.as_ref().or(self.input.as_ref()) else {
            return Err(Failure::Input("found no record, expected INPUT or --record".to_owned()));
        };
        if config.estimator.timing == Timing::Beats {
            let message =
                "`estimator.timing`: found \"beats\", which no record has, expected \"config\" or \"tracked\"";
            return Err(Failure::Input(message.to_owned()));
        }
        let workers = Workers::start(self.threads.unwrap_or(config.service.workers)).map_err(failed)?;
        // Read it to the end once: a bad cell is reported before anything is computed or written.
        let seconds = check_record(input, &config)?;
        let reader = Record::open(input, &config)?;
        let mut run = Run::new(&config, self, &reader, seconds)?;
        workers.concentrate(|| {
            run.record(reader, &workers)?;
            run.finish(&workers)
        })
    }
}

/// Reads the whole record; returns its length \[s\].
fn check_record(path: &Path, config: &Config) -> Result<f64, Failure> {
    let mut reader = Record::open(path, config)?;
    let (mut first, mut last) = (None, None);
    while let Some(row) = reader.next_row()? {
        first.get_or_insert(row.time);
        last = Some(row.time);
    }
    Ok(first.zip(last).map_or(0.0, |(first, last)| last.as_s() - first.as_s()))
}

/// An estimator between a record and a table.
struct Run {
    bed: Offline,
    /// Channel of each column, where it is listened to.
    channels: Vec<Option<usize>>,
    table: Table,
    beats: Option<Table>,
    events: Option<EventTable>,
    /// Whether the table holds what is known after the smoothing lag.
    smoothed: bool,
    outputs: Vec<Output>,
    progress: ProgressBar,
    clock: Clock,
    seconds: f64,
    windows: u64,
    iterations: u64,
    not_converged: u64,
    one_by_one: u64,
    notices: u64,
    last: ArrivalTime,
}

impl Run {
    fn new(config: &Config, args: &Estimate, reader: &Record, seconds: f64) -> Result<Self, Failure> {
        let model = config.circulation()?;
        let bed = Offline::new(model.clone(), config.estimator_settings()?).map_err(failed)?;
        let estimator = bed.estimator();
        let channel = |state: &usize| estimator.settings().channels.iter().position(|c| c.state == *state);
        let channels: Vec<Option<usize>> = reader.states().iter().map(channel).collect();
        for (state, _) in reader.states().iter().zip(&channels).filter(|(_, c)| c.is_none()) {
            tracing::warn!("column {} is not in `observed` and is ignored", Pressures::NAMES[*state]);
        }
        if channels.iter().all(Option::is_none) {
            let expected = config.observed.join(", ");
            return Err(Failure::Input(format!("no column of the record is observed, expected one of {expected}")));
        }
        let progress = progress_bar(whole(seconds), "{bar:40} {pos}/{len} s  {eta} left");
        let units = Units::of_model(&model);
        let create = |path: &Path, header: &[String]| Table::create(path, header, &units);
        Ok(Self {
            table: create(&args.output, &estimate_header(&model, estimator.estimated()))?,
            events: args.events.as_deref().map(EventTable::create).transpose()?,
            beats: args.beats.as_deref().map(|path| create(path, &beat_header(&model))).transpose()?,
            smoothed: config.estimator.smoothing_lag_s > 0.0,
            bed,
            channels,
            outputs: Vec::new(),
            progress,
            clock: Clock::start(),
            seconds,
            windows: 0,
            iterations: 0,
            not_converged: 0,
            one_by_one: 0,
            notices: 0,
            last: ArrivalTime(0),
        })
    }

    /// A file has no arrivals: every sample arrives when it was taken.
    fn record(&mut self, mut reader: Record, workers: &Workers) -> Result<(), Failure> {
        let mut start = None;
        while let Some(row) = reader.next_row()? {
            self.last = ArrivalTime(row.time.0);
            for (column, value) in row.values.iter().enumerate() {
                if let (Some(channel), Some(value)) = (self.channels[column], *value) {
                    let samples = vec![RawSample { time: row.time, value }];
                    self.drive(Input::Samples { channel, samples }, workers)?;
                }
            }
            // A row without a sample still tells the time.
            if row.values.iter().all(Option::is_none) {
                self.drive(Input::Tick, workers)?;
            }
            let start = *start.get_or_insert(row.time.as_s());
            self.progress.set_position(whole(row.time.as_s() - start));
        }
        Ok(())
    }

    fn drive(&mut self, input: Input, workers: &Workers) -> Result<(), Failure> {
        self.bed.handle(input, self.last, workers, &mut self.outputs);
        for output in self.outputs.drain(..) {
            match output {
                Output::Estimate(estimate) if !self.smoothed => self.table.row(&estimate_row(&estimate))?,
                Output::Smoothed(estimate) => self.table.row(&estimate_row(&estimate))?,
                Output::Beat(beat) => {
                    if let Some(table) = &mut self.beats {
                        table.row(&beat_row(&beat))?;
                    }
                }
                // Their notices say the same.
                Output::Estimate(_) | Output::Alarms(_) => {}
                Output::Window(window) => {
                    self.windows += 1;
                    self.iterations += window.report.iterations as u64;
                    self.not_converged += window.report.not_converged as u64;
                    self.one_by_one += window.report.one_by_one as u64;
                }
                Output::Notice(notice) => {
                    self.notices += 1;
                    let (channel, model) = (notice.channel, self.bed.estimator().model());
                    let name =
                        channel.map_or("", |c| model.states()[self.bed.estimator().settings().channels[c].state].name);
                    let text = notice_text(model, &notice);
                    if let Some(events) = &mut self.events {
                        events.row(notice.time, notice.kind.name(), name, &text)?;
                    }
                    tracing::info!(time_s = notice.time.as_s(), channel = name, "{}: {text}", notice.kind.name());
                }
            }
        }
        Ok(())
    }

    #[allow(clippy::cast_precision_loss)]
    fn finish(mut self, workers: &Workers) -> Result<(), Failure> {
        self.drive(Input::End, workers)?;
        self.progress.finish_and_clear();
        self.table.finish()?;
        if let Some(beats) = self.beats {
            beats.finish()?;
        }
        if let Some(events) = self.events {
            events.finish()?;
        }
        let wall = hemostream::estimate::time::s_from_ns(self.clock.now().0);
        let member_windows = self.windows as f64 * self.bed.estimator().settings().members as f64;
        say(format!(
            "{:.3} s of record in {wall:.2} s ({:.1} patient-seconds per second), {} windows, {:.2} iterations per \
             member and window, {:.2} % solved one by one, {} not converged",
            self.seconds,
            self.seconds / wall,
            self.windows,
            self.iterations as f64 / member_windows.max(1.0),
            100.0 * self.one_by_one as f64 / member_windows.max(1.0),
            self.not_converged,
        ));
        let refused: Vec<String> =
            self.bed.estimator().refused().iter().map(|(cause, n)| format!("{n} {}", cause.name())).collect();
        if !refused.is_empty() {
            say(format!("samples refused: {}", refused.join(", ")));
        }
        Ok(())
    }
}
