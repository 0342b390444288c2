//! `hemostream demo`: patients, the daemon and the dashboard in one process, over zenoh on loopback.

mod patients;
mod summary;

use std::collections::BTreeMap;
use std::net::TcpListener;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use clap::Args;
use hemostream::edge::bus::{Bus, Handler, Message, Subscription};
use hemostream::edge::config::{Config, ZenohMode, ZenohSettings};
use hemostream::edge::dashboard::terminal;
use hemostream::edge::dashboard::web::{Topics, Web};
use hemostream::edge::replay::{ReplayOptions, run, wait_for_listener};
use hemostream::edge::scoreboard::Scoreboard;
use hemostream::edge::zenoh::ZenohBus;

use super::dashboard::{Link, page_listener};
use super::serve::{Running, stop_when_asked, tokio_runtime};
use super::simulate::positive;
use super::{Failure, failed, say};

/// What the demo changes in the defaults. The patients' resistances and compliances wander a little, as those of
/// people do; the estimator starts 50 % wrong about two of them and is told how fast parameters wander.
const SETTINGS: &[&str] = &[
    "observed=[\"p_a\", \"p_pa\"]",
    "estimator.estimate=[\"r_pv\", \"c_a\", \"r_a\"]",
    "estimator.initial_guess.r_pv=0.12",
    "estimator.initial_guess.c_a=2.4",
    "patient.variability={ r_pv = 0.01, c_a = 0.01, r_a = 0.01 }",
    "estimator.parameter_drift=0.01",
    "estimator.pressure_drift=0.002",
    "estimator.seed=4",
    // What the embolism brings about; the other two patients stay clear of it.
    "alarms=[\
        { name = \"high pulmonary pressure\", quantity = \"p_pa_mean\", above = 25.0, for_s = 5.0, clear_margin = 1.0, \
          priority = \"high\" }, \
        { name = \"low arterial mean\", quantity = \"p_a_mean\", below = 65.0, for_s = 10.0, clear_margin = 3.0, \
          priority = \"high\" }, \
        { name = \"low output\", quantity = \"cardiac_output\", below = 4.4, for_s = 10.0, clear_margin = 0.2 }, \
        { name = \"high pulmonary resistance\", quantity = \"r_pv\", above = 0.15, for_s = 5.0, clear_margin = 0.01, \
          priority = \"low\", latched = false }]",
];

/// Blocks as a monitor sends them, and the beds one after the other.
const BLOCK_S: f64 = 0.04;
const STAGGER_S: f64 = 0.01;

/// Messages that may wait for the scoreboard.
const QUEUE: usize = 4096;

/// See it work: three synthetic patients over zenoh on loopback, estimated live, and the dashboard in your browser
#[derive(Args)]
#[command(
    after_help = "Example:  hemostream demo\n\nNo configuration, no server. Open the address that it prints; one \
                        of the patients has a pulmonary embolism from 15 s on. With --seconds it ends by itself and \
                        compares with the truth; Ctrl-C does so too."
)]
pub(crate) struct Demo {
    /// Stop by itself after so many seconds
    #[arg(long, value_parser = positive)]
    seconds: Option<f64>,
    /// One setting over those of the demo; may be repeated
    #[arg(long = "set", value_name = "KEY=VALUE")]
    sets: Vec<String>,
    /// Address and port of the dashboard; any free port if this one is taken [default: 127.0.0.1:8787]
    #[arg(long, value_name = "ADDRESS")]
    listen: Option<String>,
    /// Show the terminal dashboard as well, in place of a line per second (q quits)
    #[arg(long)]
    terminal: bool,
}

/// By bed.
type Boards = BTreeMap<String, Scoreboard>;
type Shared = Arc<Mutex<Boards>>;

impl Demo {
    pub(crate) fn run(&self) -> Result<(), Failure> {
        let sets: Vec<String> = SETTINGS.iter().map(|s| (*s).to_owned()).chain(self.sets.iter().cloned()).collect();
        let (mut config, _) = Config::load(None, &sets)?;
        config.zenoh = ZenohSettings { mode: ZenohMode::Peer, listen: vec![free_endpoint()?], connect: Vec::new() };
        let client =
            ZenohSettings { mode: ZenohMode::Client, listen: Vec::new(), connect: config.zenoh.listen.clone() };

        let runtime = tokio_runtime()?;
        let stop = stop_when_asked(&runtime);
        runtime.block_on(async {
            let listener = page_listener(self.listen.as_deref()).await?;
            let daemon = ZenohBus::open(&config.zenoh)?;
            let running = Running::start(Arc::new(daemon.clone()), &config)?;
            let link = Link::default();
            let connect = link.connect(client.clone());
            let web = Web::start(listener, &config, Topics::All, connect).map_err(failed)?;
            say(format!("open  http://{}/  to watch; Ctrl-C stops\n", web.address()));
            let viewer = ZenohBus::open(&client)?;
            let shown = tokio::task::block_in_place(|| self.show(&config, &sets, &viewer, &stop));
            web.stop().await;
            running.stop().await;
            link.close();
            viewer.close();
            daemon.close();
            shown
        })
    }

    /// Replays and shows until it ends; then the summary.
    fn show(&self, config: &Config, sets: &[String], bus: &ZenohBus, stop: &Arc<AtomicBool>) -> Result<(), Failure> {
        let boards = Shared::default();
        let (_subscriptions, messages) = subscribe(bus, config)?;
        let options =
            ReplayOptions { seconds: self.seconds, stagger_s: STAGGER_S, block_s: BLOCK_S, ..ReplayOptions::default() };
        let mut beds = patients::beds(sets, config.estimator.seed)?;
        wait_for_listener(bus, config, patients::CRISIS_BED, stop);
        let ended = AtomicBool::new(false);
        let replayed = std::thread::scope(|scope| {
            let replay = scope.spawn(|| {
                let result = run(bus, config, &options, &mut beds, stop);
                // What is on its way still counts.
                std::thread::sleep(Duration::from_millis(500));
                ended.store(true, Ordering::Relaxed);
                result
            });
            let (scored, scoring_ended) = (&boards, &ended);
            scope.spawn(move || score(&messages, scored, scoring_ended));
            let shown = if self.terminal {
                terminal::run(bus, config, Some(patients::CRISIS_BED), "", &ended).map_err(failed)
            } else {
                lines(&boards, &ended);
                Ok(())
            };
            stop.store(true, Ordering::Relaxed);
            let replayed = replay.join().map_err(|_| Failure::Failed("the replay panicked".to_owned()));
            shown.and(replayed)
        })??;
        let boards = boards.lock().unwrap_or_else(PoisonError::into_inner);
        summary::print(&summary::Run { config, boards: &boards, seconds: replayed, rate_hz: options.rate_hz });
        Ok(())
    }
}

/// A loopback endpoint on a port that is free now.
fn free_endpoint() -> Result<String, Failure> {
    let listener = TcpListener::bind(("127.0.0.1", 0)).map_err(failed)?;
    let port = listener.local_addr().map_err(failed)?.port();
    Ok(format!("tcp/127.0.0.1:{port}"))
}

fn subscribe(bus: &ZenohBus, config: &Config) -> Result<(Vec<Subscription>, Receiver<Message>), Failure> {
    let (sender, messages) = sync_channel(QUEUE);
    let handler: Handler = Arc::new(move |message: Message| {
        // A viewer that falls behind misses some; the estimator does not wait for it.
        let _ = sender.try_send(message);
    });
    let topics = ["estimate/state", "estimate/parameters", "truth", "status"];
    let pattern = |topic: &str| format!("{}/*/{topic}", config.publish.prefix);
    let subscriptions = topics.iter().map(|topic| bus.subscribe(&pattern(topic), Arc::clone(&handler)));
    Ok((subscriptions.collect::<Result<_, _>>()?, messages))
}

fn score(messages: &Receiver<Message>, boards: &Shared, ended: &AtomicBool) {
    loop {
        match messages.recv_timeout(Duration::from_millis(50)) {
            Ok(message) => {
                let Some(bed) = message.key.split('/').rev().find(|chunk| chunk.starts_with("icu-")) else { continue };
                let mut boards = boards.lock().unwrap_or_else(PoisonError::into_inner);
                boards.entry(bed.to_owned()).or_default().take(&message);
            }
            Err(RecvTimeoutError::Timeout) if !ended.load(Ordering::Relaxed) => {}
            Err(_) => return,
        }
    }
}

/// A line per second and bed.
fn lines(boards: &Shared, ended: &AtomicBool) {
    let mut next_ns = 0;
    while !ended.load(Ordering::Relaxed) {
        std::thread::sleep(Duration::from_millis(100));
        let boards = boards.lock().unwrap_or_else(PoisonError::into_inner);
        let newest = |board: &Scoreboard| board.latest.as_ref().map(|estimate| estimate.header.time_ns);
        let Some(slowest) = boards.values().map(newest).min().flatten().filter(|t| *t >= next_ns) else { continue };
        next_ns = slowest.div_euclid(1_000_000_000) * 1_000_000_000 + 1_000_000_000;
        for (bed, board) in boards.iter() {
            say(summary::line(bed, board));
        }
    }
}
