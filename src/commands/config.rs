//! `hemostream config`: checks a configuration and prints what is in force and why.

use std::path::PathBuf;

use clap::Args;
use hemostream::edge::config::{Config, render};

use super::{Failure, say};

/// Check a configuration file and print the effective settings with their origin
#[derive(Args)]
#[command(after_help = "Example:  hemostream config config/paper.toml --set estimator.members=50")]
pub(crate) struct ConfigCommand {
    /// Configuration file (TOML); defaults where left out
    #[arg(value_name = "FILE")]
    file: Option<PathBuf>,
    /// The same, as other commands spell it
    #[arg(long, value_name = "FILE", conflicts_with = "file")]
    config: Option<PathBuf>,
    /// One setting, over file and environment; may be repeated
    #[arg(long = "set", value_name = "KEY=VALUE")]
    sets: Vec<String>,
}

impl ConfigCommand {
    pub(crate) fn run(&self) -> Result<(), Failure> {
        let file = self.file.as_deref().or(self.config.as_deref());
        let (config, origins) = Config::load(file, &self.sets)?;
        say(render(&config, &origins).trim_end());
        Ok(())
    }
}
