//! `hemostream convert`: records from one format to another.

use std::collections::BTreeMap;
use std::path::PathBuf;

use clap::Args;
use hemostream::edge::config::Config;
use hemostream::edge::files::convert::{ConvertOptions, convert};
use hemostream::model::cvsim6::Pressures;

use super::simulate::positive;
use super::{ConfigArgs, Failure, log_to_stderr, progress_bar, say};

/// Convert a record between CSV, Parquet and WFDB
///
/// The endings say which is which: `.csv`, `.parquet`, and `.hea` or none for WFDB. Labels of monitors are read by the
/// table [labels] of the configuration and written as names of states, unless --label says otherwise.
#[derive(Args)]
#[command(after_help = "Examples:  hemostream convert waves/041s 041s.parquet\n           \
                        hemostream convert observed.csv observed.hea --label p_a=ABP --label p_pa=PAP")]
pub(crate) struct Convert {
    /// Record to read
    #[arg(value_name = "IN")]
    input: PathBuf,
    /// Record to write
    #[arg(value_name = "OUT")]
    output: PathBuf,
    #[command(flatten)]
    config: ConfigArgs,
    /// What to call a pressure in OUT; may be repeated
    #[arg(long = "label", value_name = "STATE=LABEL", value_parser = label)]
    labels: Vec<(String, String)>,
    /// Put the samples on a grid of this rate: the nearest within half a period, nothing where there is none
    #[arg(long, value_name = "HZ", value_parser = positive)]
    rate_hz: Option<f64>,
}

/// A state and what to call it.
fn label(text: &str) -> Result<(String, String), String> {
    let Some((state, label)) = text.split_once('=') else {
        return Err("expected STATE=LABEL, such as p_a=ABP".to_owned());
    };
    if !Pressures::NAMES.contains(&state) {
        return Err(format!("found the state `{state}`, expected one of {}", Pressures::NAMES.join(", ")));
    }
    let strange = |c: char| c.is_control() || matches!(c, ',' | '"');
    if label.is_empty() || label != label.trim() || label.contains(strange) || label == "time_s" {
        return Err(format!("found the label `{label}`, expected a name without commas, quotes or spaces around it"));
    }
    Ok((state.to_owned(), label.to_owned()))
}

impl Convert {
    pub(crate) fn run(&self) -> Result<(), Failure> {
        let (config, _) = self.config.load()?;
        log_to_stderr("hemostream=warn,warn")?;
        let options = ConvertOptions { labels: self.labels(&config)?, rate_hz: self.rate_hz };
        let bar = progress_bar(0, "{bar:40} {pos}/{len} rows  {eta} left");
        let mut progress = |done: u64, rows: Option<u64>| {
            // The first reading says how long it is.
            bar.set_length(rows.unwrap_or(done));
            bar.set_position(if rows.is_some() { done } else { 0 });
        };
        let converted = convert(&self.input, &self.output, &config, &options, &mut progress)?;
        bar.finish_and_clear();
        say(format!(
            "{}: {} rows of {} over {:.3} s, {} samples",
            self.output.display(),
            converted.rows,
            converted.columns.join(", "),
            converted.seconds,
            converted.samples
        ));
        Ok(())
    }

    fn labels(&self, config: &Config) -> Result<BTreeMap<String, String>, Failure> {
        let mut labels = BTreeMap::new();
        for (state, label) in &self.labels {
            if let Some(other) = config.state_of_label(label).filter(|other| other != state) {
                let message = format!("--label {state}={label}: found a label of {other}, expected one of {state}");
                return Err(Failure::Input(message));
            }
            if labels.insert(state.clone(), label.clone()).is_some() {
                return Err(Failure::Input(format!("--label {state}: found two labels, expected one")));
            }
        }
        Ok(labels)
    }
}
