//! `hemostream replay`: publishes patients.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use clap::Args;
use hemostream::edge::config::{Config, ZenohMode, ZenohSettings};
use hemostream::edge::replay::{Bed, ReplayOptions, Source, run, wait_for_listener};
use hemostream::edge::zenoh::ZenohBus;

use super::serve::{asked_to_stop, tokio_runtime};
use super::simulate::{not_negative, positive};
use super::{ConfigArgs, Failure, log_to_stderr, say};

/// Publish a patient, synthetic or recorded, at its own pace
#[derive(Args)]
#[command(
    after_help = "Examples:  hemostream replay --config config/patients/pulmonary_hypertension.toml\n           \
                        hemostream replay --record observed.csv --speed 4 --bed icu-7"
)]
pub(crate) struct Replay {
    #[command(flatten)]
    config: ConfigArgs,
    /// Replay this record (CSV) instead of the synthetic patient of the configuration
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
    /// Name of the bed; several beds are called NAME-1, NAME-2, ...
    #[arg(long, default_value = "bed1")]
    bed: String,
    /// Number of beds; synthetic ones differ in their noise
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=1000))]
    beds: u32,
    /// Patient-seconds per second
    #[arg(long, default_value_t = 1.0, value_parser = positive)]
    speed: f64,
    /// Samples per second of a synthetic patient
    #[arg(long, default_value_t = 200.0, value_parser = positive)]
    rate_hz: f64,
    /// Stop after so many patient-seconds
    #[arg(long, value_parser = positive)]
    seconds: Option<f64>,
    /// Length of a block of samples [s]
    #[arg(long, default_value_t = 0.01, value_parser = positive)]
    block_s: f64,
    /// Time from the start of one bed to that of the next [s]
    #[arg(long, default_value_t = 0.01, value_parser = not_negative)]
    stagger_s: f64,
    /// Event time of the first sample of a synthetic patient, added to the times of a record [s]
    #[arg(long, default_value_t = 0.0)]
    start_s: f64,
    /// Begin the record again when it ends
    #[arg(long = "loop", requires = "record")]
    repeat: bool,
    /// Where the daemon listens; over `zenoh.connect` of the configuration
    #[arg(long, value_name = "ENDPOINT")]
    connect: Vec<String>,
}

/// How a client of the daemon reaches it: as told, or at the address it listens at by default.
pub(crate) fn client_settings(config: &Config, connect: &[String]) -> ZenohSettings {
    let told = if connect.is_empty() { &config.zenoh.connect } else { connect };
    let connect = if told.is_empty() { config.zenoh.listen.clone() } else { told.to_vec() };
    ZenohSettings { mode: ZenohMode::Client, listen: Vec::new(), connect }
}

impl Replay {
    pub(crate) fn run(&self) -> Result<(), Failure> {
        let (config, _) = self.config.load()?;
        log_to_stderr("hemostream=info,warn")?;
        let mut beds = self.make_beds(&config)?;
        let options = ReplayOptions {
            rate_hz: self.rate_hz,
            speed: self.speed,
            seconds: self.seconds,
            block_s: self.block_s,
            stagger_s: self.stagger_s,
            start_s: self.start_s,
            repeat: self.repeat,
            ..ReplayOptions::default()
        };
        let stop = Arc::new(AtomicBool::new(false));
        let runtime = tokio_runtime()?;
        let stopping = Arc::clone(&stop);
        runtime.spawn(async move {
            asked_to_stop().await;
            stopping.store(true, Ordering::Relaxed);
        });
        let settings = client_settings(&config, &self.connect);
        let bus = runtime.block_on(async { ZenohBus::open(&settings) })?;
        say(format!(
            "publishing {} bed(s) under {}/ to {}",
            self.beds,
            config.publish.prefix,
            settings.connect.join(", ")
        ));
        if !beds.first().is_some_and(|bed| wait_for_listener(&bus, &config, bed.name(), &stop)) {
            say("nobody listens yet; publishing all the same");
        }
        let seconds = run(&bus, &config, &options, &mut beds, &stop)?;
        bus.close();
        say(format!("published {seconds:.1} patient-seconds"));
        Ok(())
    }

    fn make_beds(&self, config: &Config) -> Result<Vec<Bed>, Failure> {
        let mut beds = Vec::new();
        for i in 0..self.beds {
            let name = if self.beds == 1 { self.bed.clone() } else { format!("{}-{}", self.bed, i + 1) };
            let source = match &self.record {
                Some(path) => Source::record(path, config)?,
                None => Source::synthetic(config, config.estimator.seed.wrapping_add(u64::from(i)))?,
            };
            beds.push(Bed::new(name, source));
        }
        Ok(beds)
    }
}
