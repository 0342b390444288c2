//! `hemostream watch`: the terminal dashboard.

use std::io::IsTerminal;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use clap::Args;
use hemostream::edge::dashboard::terminal;
use hemostream::edge::zenoh::ZenohBus;

use super::replay::client_settings;
use super::serve::{asked_to_stop, tokio_runtime};
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
        let stop = Arc::new(AtomicBool::new(false));
        let runtime = tokio_runtime()?;
        let stopping = Arc::clone(&stop);
        runtime.spawn(async move {
            asked_to_stop().await;
            stopping.store(true, Ordering::Relaxed);
        });
        let settings = client_settings(&config, &self.connect);
        let bus = runtime.block_on(async { ZenohBus::open(&settings) })?;
        let watched = terminal::run(&bus, &config.publish.prefix, self.bed.as_deref(), &self.author, &stop);
        bus.close();
        watched.map_err(failed)
    }
}
