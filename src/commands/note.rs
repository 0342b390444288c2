//! `hemostream note`: says something about a bed, for dashboards and recorders.

use clap::Args;
use hemostream::edge::operator::Operator;
use hemostream::edge::zenoh::ZenohBus;
use hemostream::estimate::time::EventTime;

use super::replay::client_settings;
use super::serve::tokio_runtime;
use super::{ConfigArgs, Failure, say};

/// Say something about a bed: dashboards show it, recorders keep it
#[derive(Args)]
#[command(after_help = "Example:  hemostream note --bed bed1 \"250 mL of crystalloid\" --author \"Dr. Weber\"")]
pub(crate) struct Note {
    /// What
    #[arg(value_name = "TEXT")]
    text: String,
    /// The bed that it is about
    #[arg(long)]
    bed: String,
    /// Who says it
    #[arg(long, default_value = "")]
    author: String,
    /// Event time that it is about [s]; the newest of the bed where left out
    #[arg(long, value_name = "SECONDS", value_parser = event_time, allow_negative_numbers = true)]
    time_s: Option<f64>,
    #[command(flatten)]
    config: ConfigArgs,
    /// Where the daemon listens; over `zenoh.connect` of the configuration
    #[arg(long, value_name = "ENDPOINT")]
    connect: Vec<String>,
}

/// A time that fits into nanoseconds.
fn event_time(text: &str) -> Result<f64, String> {
    let fits = |seconds: &f64| seconds.abs() < 9e9;
    text.parse().ok().filter(fits).ok_or_else(|| format!("found `{text}`, expected seconds between -9e9 and 9e9"))
}

impl Note {
    pub(crate) fn run(&self) -> Result<(), Failure> {
        let (config, _) = self.config.load()?;
        let runtime = tokio_runtime()?;
        let settings = client_settings(&config, &self.connect);
        let bus = runtime.block_on(async { ZenohBus::open(&settings) })?;
        let operator = Operator { bus: &bus, prefix: &config.publish.prefix, bed: &self.bed };
        let noted = operator.note(&self.text, &self.author, self.time_s.map(EventTime::from_s));
        bus.close();
        let (time, heard) = noted?;
        say(format!("noted at {} s of {}", time.as_s(), self.bed));
        if !heard {
            say("nobody listens: neither a dashboard nor a recorder has heard it");
        }
        Ok(())
    }
}
