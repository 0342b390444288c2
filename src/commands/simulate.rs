//! `hemostream simulate`: a synthetic record, clean and noisy.

use std::path::PathBuf;

use clap::Args;
use hemostream::edge::files::csv::truth_header;
use hemostream::edge::files::table::{Table, TableFormat};
use hemostream::edge::files::units::Units;
use hemostream::edge::synthetic::SyntheticPatient;
use hemostream::model::cvsim6::Pressures;

use super::{ConfigArgs, Failure, failed};

/// Write a synthetic record: the truth, and what noisy sensors see of it
#[derive(Args)]
#[command(
    after_help = "Example:  hemostream simulate --config config/patients/pulmonary_hypertension.toml \\\n            \
                        --seconds 30 --rate-hz 200 --truth truth.csv --observed observed.csv"
)]
pub(crate) struct Simulate {
    #[command(flatten)]
    config: ConfigArgs,
    /// Length of the record
    #[arg(long, default_value_t = 12.0, value_parser = positive)]
    seconds: f64,
    /// Samples per second
    #[arg(long, default_value_t = 500.0, value_parser = positive)]
    rate_hz: f64,
    /// Seed of sensor noise and wandering parameters; the estimator's if left out
    #[arg(long)]
    seed: Option<u64>,
    /// Where to write the truth: pressures, flows, volumes, changing parameters (CSV or Parquet, by the
    /// ending)
    #[arg(long, value_name = "FILE")]
    truth: Option<PathBuf>,
    /// Where to write the observed pressures with noise (likewise)
    #[arg(long, value_name = "FILE")]
    observed: Option<PathBuf>,
}

/// A number above zero.
pub(crate) fn positive(text: &str) -> Result<f64, String> {
    let value = text.parse::<f64>().map_err(|e| e.to_string())?;
    if value > 0.0 && value.is_finite() { Ok(value) } else { Err("expected a number above 0".to_owned()) }
}

pub(crate) fn not_negative(text: &str) -> Result<f64, String> {
    let value = text.parse::<f64>().map_err(|e| e.to_string())?;
    if value >= 0.0 && value.is_finite() { Ok(value) } else { Err("expected 0 or a number above it".to_owned()) }
}

impl Simulate {
    #[allow(clippy::cast_precision_loss)]
    pub(crate) fn run(&self) -> Result<(), Failure> {
        if self.truth.is_none() && self.observed.is_none() {
            return Err(Failure::Input("nothing to write: give --truth FILE, --observed FILE or both".to_owned()));
        }
        for output in [&self.truth, &self.observed].into_iter().flatten() {
            TableFormat::of(output)?;
        }
        let (config, _) = self.config.load()?;
        let mut patient = SyntheticPatient::new(&config, self.seed.unwrap_or(config.estimator.seed))?;
        let changing = patient.changing().to_vec();
        let observed = config.observed_states();
        let mut header = vec!["time_s".to_owned()];
        header.extend(observed.iter().map(|&i| Pressures::NAMES[i].to_owned()));
        let units = Units::of_model(&patient.model());
        let create = |path: &PathBuf, header: &[String]| Table::create(path, header, &units);
        let mut truth =
            self.truth.as_ref().map(|p| create(p, &truth_header(patient.model(), &changing))).transpose()?;
        let mut noisy = self.observed.as_ref().map(|p| create(p, &header)).transpose()?;

        let rows = super::estimate::whole(self.seconds * self.rate_hz);
        for k in 0..=rows {
            let t = k as f64 / self.rate_hz;
            patient.advance_to(t).map_err(failed)?;
            if let Some(table) = &mut truth {
                let parameters = changing.iter().map(|&p| patient.parameters()[p]);
                let row: Vec<f64> = std::iter::once(t).chain(patient.truth()).chain(parameters).collect();
                table.row(&row)?;
            }
            let read = patient.observe();
            if let Some(table) = &mut noisy {
                let row: Vec<f64> = std::iter::once(t).chain(observed.iter().map(|&i| read[i])).collect();
                table.row(&row)?;
            }
        }
        truth.map(Table::finish).transpose()?;
        noisy.map(Table::finish).transpose()?;
        Ok(())
    }
}
