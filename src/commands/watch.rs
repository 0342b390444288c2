//! `hemostream watch`: the terminal dashboard.

use std::io::IsTerminal;

use clap::Args;
use hemostream::edge::dashboard::terminal;
use hemostream::edge::zenoh::ZenohBus;

use super::replay::client_settings;
use super::serve::{stop_when_asked, tokio_runtime};
use super::{ConfigArgs, Failure, failed};

/// Watch beds in the terminal: waveforms, bands, parameters, alarms, health; acknowledge alarms, write notes
#[derive(Args)]
#[command(after_help = "Example:  hemostream watch --bed bed1 --connect tcp/127.0.0.1:7447")]
pub(crate) struct Watch {
    #[command(flatten)]
    config: ConfigArgs,
    /// Bed to show first
    #[arg(long)]
    bed: Option<String>,
    /// Who signs notes and acknowledgements
    #[arg(long, value_name = "NAME", default_value = "")]
    author: String,
    /// Where the daemon listens; over `zenoh.connect` of the configuration
    #[arg(long, value_name = "ENDPOINT")]
    connect: Vec<String>,
}

impl Watch {
    pub(crate) fn run(&self) -> Result<(), Failure> {
        let (config, _) = self.config.load()?;
        if !std::io::stdout().is_terminal() {
            return Err(Failure::Input("watch draws on a terminal, and this is none".to_owned()));
        }
        let runtime = tokio_runtime()?;
        let stop = stop_when_asked(&runtime);
        let settings = client_settings(&config, &self.connect);
        let bus = runtime.block_on(async { ZenohBus::open(&settings) })?;
        let watched = terminal::run(&bus, &config, self.bed.as_deref(), &self.author, &stop);
        bus.close();
        watched.map_err(failed)
    }
}
