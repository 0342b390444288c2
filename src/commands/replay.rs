//! `hemostream replay`: publishes patients.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use clap::Args;
use hemostream::edge::config::{Config, ZenohMode, ZenohSettings};
use hemostream::edge::recording::playback::{Playback, play};
use hemostream::edge::replay::{Bed, ReplayOptions, Source, run, wait_for_listener, wait_for_listener_at};
use hemostream::edge::zenoh::ZenohBus;

use super::serve::{stop_when_asked, tokio_runtime};
use super::simulate::{not_negative, positive};
use super::{ConfigArgs, Failure, LOG, log_to_stderr, progress_bar, say};

/// Publish a patient, synthetic or recorded, or a whole recording, at its own pace
#[derive(Args)]
#[command(
    after_help = "Examples:  hemostream replay --config config/patients/pulmonary_hypertension.toml\n           \
                        hemostream replay --record observed.csv --speed 4 --bed icu-7\n           \
                        hemostream replay --recording recording --speed 10"
)]
pub(crate) struct Replay {
    #[command(flatten)]
    config: ConfigArgs,
    /// Replay this record (CSV, Parquet, WFDB) instead of the synthetic patient of the configuration
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
    /// Play back what `hemostream record` wrote here: all beds, with the times between messages that they arrived with
    #[arg(long, value_name = "DIR",
          conflicts_with_all = ["record", "beds", "rate_hz", "truth_hz", "block_s", "stagger_s", "start_s"])]
    recording: Option<PathBuf>,
    /// Name of the bed [default: bed1]; several beds are called NAME-1, NAME-2, ... Of a recording: a bed to play, may
    /// be repeated
    #[arg(long, value_name = "NAME")]
    bed: Vec<String>,
    /// Number of beds; synthetic ones differ in their noise
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=1000))]
    beds: u32,
    /// Patient-seconds per second
    #[arg(long, default_value_t = 1.0, value_parser = positive)]
    speed: f64,
    /// Samples per second of a synthetic patient
    #[arg(long, default_value_t = 200.0, value_parser = positive)]
    rate_hz: f64,
    /// How often per second the truth of a synthetic patient is published, which dashboards draw; 0 is never
    #[arg(long, default_value_t = 50.0, value_parser = not_negative)]
    truth_hz: f64,
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

/// A way to the daemon.
struct Connected {
    bus: ZenohBus,
    stop: Arc<AtomicBool>,
    /// Where it is.
    to: String,
    _runtime: tokio::runtime::Runtime,
}

impl Replay {
    pub(crate) fn run(&self) -> Result<(), Failure> {
        let (config, _) = self.config.load()?;
        log_to_stderr(LOG)?;
        match &self.recording {
            Some(directory) => self.play(&config, Playback::open(directory, &self.bed, &config.publish.prefix)?),
            None => self.publish(&config),
        }
    }

    /// A bus, and what is set when it is time to stop.
    fn connect(&self, config: &Config) -> Result<Connected, Failure> {
        let runtime = tokio_runtime()?;
        let stop = stop_when_asked(&runtime);
        let settings = client_settings(config, &self.connect);
        let bus = runtime.block_on(async { ZenohBus::open(&settings) })?;
        Ok(Connected { bus, stop, to: settings.connect.join(", "), _runtime: runtime })
    }

    fn play(&self, config: &Config, mut playback: Playback) -> Result<(), Failure> {
        let Connected { bus, stop, to, _runtime } = self.connect(config)?;
        let beds = playback.beds().join(", ");
        say(format!("playing {beds} under {}/ to {to}", config.publish.prefix));
        if !playback.first_key().is_some_and(|key| wait_for_listener_at(&bus, key, &stop)) {
            say("nobody listens yet; publishing all the same");
        }
        let bar = progress_bar(0, "{elapsed}  {pos} messages  {msg}");
        let played = play(&bus, &mut playback, self.speed, self.seconds, &stop, &mut |played| {
            bar.set_position(played.messages);
            bar.set_message(format!("{:.0} s of the recording", played.seconds));
        });
        bar.finish_and_clear();
        bus.close();
        let played = played?;
        say(format!("published {} messages of {:.1} recorded seconds", played.messages, played.seconds));
        Ok(())
    }

    fn publish(&self, config: &Config) -> Result<(), Failure> {
        let mut beds = self.make_beds(config)?;
        let options = ReplayOptions {
            rate_hz: self.rate_hz,
            truth_rate_hz: self.truth_hz,
            speed: self.speed,
            seconds: self.seconds,
            block_s: self.block_s,
            stagger_s: self.stagger_s,
            start_s: self.start_s,
            repeat: self.repeat,
        };
        let Connected { bus, stop, to, _runtime } = self.connect(config)?;
        say(format!("publishing {} bed(s) under {}/ to {}", self.beds, config.publish.prefix, to));
        if !beds.first().is_some_and(|bed| wait_for_listener(&bus, config, bed.name(), &stop)) {
            say("nobody listens yet; publishing all the same");
        }
        let seconds = run(&bus, config, &options, &mut beds, &stop)?;
        bus.close();
        say(format!("published {seconds:.1} patient-seconds"));
        Ok(())
    }

    fn make_beds(&self, config: &Config) -> Result<Vec<Bed>, Failure> {
        let bed = match self.bed.as_slice() {
            [] => "bed1",
            [bed] => bed.as_str(),
            _ => return Err(Failure::Input("--bed: found several, expected one, or --recording".to_owned())),
        };
        let mut beds = Vec::new();
        for i in 0..self.beds {
            let name = if self.beds == 1 { bed.to_owned() } else { format!("{bed}-{}", i + 1) };
            let source = match &self.record {
                Some(path) => Source::record(path, config)?,
                None => Source::synthetic(config, config.estimator.seed.wrapping_add(u64::from(i)))?,
            };
            beds.push(Bed::new(name, source));
        }
        Ok(beds)
    }
}
