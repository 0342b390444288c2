//! The commands: arguments, exit codes, and what is printed. The work is done by the library.

mod acknowledge;
mod config;
mod convert;
mod dashboard;
mod demo;
mod estimate;
mod note;
mod record;
mod replay;
mod reproduce;
mod serve;
mod simulate;
mod validate;
mod watch;

use std::io::{IsTerminal, Write};
use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Args, Parser, Subcommand};
use hemostream::edge::bus::BusError;
use hemostream::edge::config::{Config, ConfigError, Origins};
use hemostream::edge::files::error::FileError;
use hemostream::edge::operator::OperatorError;
use hemostream::edge::replay::ReplayError;
use indicatif::{ProgressBar, ProgressStyle};

/// Live hemodynamics with honest uncertainty.
///
/// Watches blood pressures arrive on zenoh topics and says what the circulation behind them is doing: pressures no
/// sensor sees, flows, volumes, resistances and compliances, each with a 5-95 % band.
#[derive(Parser)]
#[command(version, max_term_width = 100, after_help = "Start here:  hemostream demo")]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Demo(demo::Demo),
    Serve(serve::Serve),
    Replay(replay::Replay),
    Record(record::Record),
    Watch(watch::Watch),
    Dashboard(dashboard::Dashboard),
    Acknowledge(acknowledge::Acknowledge),
    Note(note::Note),
    Simulate(simulate::Simulate),
    Estimate(estimate::Estimate),
    Convert(convert::Convert),
    Validate(validate::Validate),
    Reproduce(reproduce::Reproduce),
    Config(config::ConfigCommand),
}

/// Where settings come from.
#[derive(Args)]
pub(crate) struct ConfigArgs {
    /// Configuration file (TOML); defaults where left out.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// One setting, over file and environment; may be repeated.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    sets: Vec<String>,
}

impl ConfigArgs {
    fn load(&self) -> Result<(Config, Origins), Failure> {
        Ok(Config::load(self.config.as_deref(), &self.sets)?)
    }
}

/// Why a command ends badly.
#[derive(Debug)]
pub(crate) enum Failure {
    /// The user's input: exit code 2.
    Input(String),
    /// Everything else: exit code 1.
    Failed(String),
}

impl From<ConfigError> for Failure {
    fn from(error: ConfigError) -> Self {
        Self::Input(error.to_string())
    }
}

impl From<FileError> for Failure {
    fn from(error: FileError) -> Self {
        Self::Input(error.to_string())
    }
}

impl From<BusError> for Failure {
    fn from(error: BusError) -> Self {
        Self::Failed(error.to_string())
    }
}

impl From<ReplayError> for Failure {
    fn from(error: ReplayError) -> Self {
        match error {
            ReplayError::Record(_) | ReplayError::Config(_) => Self::Input(error.to_string()),
            ReplayError::Simulation(_) | ReplayError::Bus(_) | ReplayError::Wire(_) => Self::Failed(error.to_string()),
        }
    }
}

impl From<OperatorError> for Failure {
    fn from(error: OperatorError) -> Self {
        if error.is_input() { Self::Input(error.to_string()) } else { Self::Failed(error.to_string()) }
    }
}

/// Something the program itself could not do.
pub(crate) fn failed(error: impl std::fmt::Display) -> Failure {
    Failure::Failed(error.to_string())
}

/// Prints a line for the user; a closed pipe ends the program quietly, as users of `head` expect.
pub(crate) fn say(line: impl AsRef<str>) {
    if writeln!(std::io::stdout().lock(), "{}", line.as_ref()).is_err() {
        std::process::exit(0);
    }
}

/// A bar on a terminal, nothing elsewhere.
pub(crate) fn progress_bar(length: u64, template: &str) -> ProgressBar {
    let bar = if std::io::stderr().is_terminal() { ProgressBar::new(length) } else { ProgressBar::hidden() };
    let style = ProgressStyle::with_template(template);
    bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
    bar
}

/// What services log unless `HEMOSTREAM_LOG` says otherwise. That peers do not gossip is what the settings ask for.
const LOG: &str = "hemostream=info,warn,zenoh::net::routing::hat::peer=error";

/// Starts the log: what is written says `HEMOSTREAM_LOG`, how says `HEMOSTREAM_LOG_FORMAT` (text or json).
fn log_to_stderr(default: &str) -> Result<(), Failure> {
    let filter = tracing_subscriber::EnvFilter::try_from_env("HEMOSTREAM_LOG")
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new(default));
    let log = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr);
    match std::env::var("HEMOSTREAM_LOG_FORMAT").as_deref() {
        Err(_) | Ok("" | "text") => log.with_ansi(std::io::stderr().is_terminal()).init(),
        // One object per line, the fields at its top: what collectors of logs read.
        Ok("json") => log.json().flatten_event(true).init(),
        Ok(other) => {
            return Err(Failure::Input(format!("HEMOSTREAM_LOG_FORMAT: found \"{other}\", expected text or json")));
        }
    }
    Ok(())
}

pub(crate) fn main() -> ExitCode {
    let result = match Cli::parse().command {
        Command::Demo(command) => command.run(),
        Command::Serve(command) => command.run(),
        Command::Replay(command) => command.run(),
        Command::Record(command) => command.run(),
        Command::Watch(command) => command.run(),
        Command::Dashboard(command) => command.run(),
        Command::Acknowledge(command) => command.run(),
        Command::Note(command) => command.run(),
        Command::Simulate(command) => command.run(),
        Command::Estimate(command) => command.run(),
        Command::Convert(command) => command.run(),
        Command::Validate(command) => command.run(),
        Command::Reproduce(command) => command.run(),
        Command::Config(command) => command.run(),
    };
    let (message, code) = match result {
        Ok(()) => return ExitCode::SUCCESS,
        Err(Failure::Failed(message)) => (message, 1),
        Err(Failure::Input(message)) => (message, 2),
    };
    // Nothing is left to do if stderr is closed.
    let _ = writeln!(std::io::stderr(), "error: {message}");
    ExitCode::from(code)
}
