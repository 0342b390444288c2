//! `hemostream demo`: a patient, the daemon and a viewer in one process, over zenoh on loopback.

use std::io::IsTerminal;
use std::net::TcpListener;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use clap::Args;
use hemostream::edge::bus::{Bus, Message, Subscription};
use hemostream::edge::config::{Config, ZenohMode, ZenohSettings};
use hemostream::edge::dashboard::terminal;
use hemostream::edge::replay::{Bed, ReplayOptions, Source, run, wait_for_listener};
use hemostream::edge::scoreboard::Scoreboard;
use hemostream::edge::synthetic::draw_start;
use hemostream::edge::zenoh::ZenohBus;
use hemostream::model::Model;
use hemostream::model::cvsim6::Pressures;

use super::serve::{Running, asked_to_stop, tokio_runtime};
use super::simulate::positive;
use super::{Failure, failed, say};

/// What the demo changes in the defaults. The patient's resistance and compliance wander a little, as those of
/// people do; the estimator starts 50 % wrong and is told how fast parameters wander.
const SETTINGS: &[&str] = &[
    "observed=[\"p_a\", \"p_pa\"]",
    "estimator.estimate=[\"r_pv\", \"c_a\"]",
    "estimator.initial_guess.r_pv=0.12",
    "estimator.initial_guess.c_a=2.4",
    "patient.variability={ r_pv = 0.01, c_a = 0.01 }",
    "estimator.parameter_drift=0.01",
    "estimator.pressure_drift=0.002",
    "estimator.seed=4",
];

const BED: &str = "demo";

/// Messages that may wait for the scoreboard.
const QUEUE: usize = 4096;

/// See it work: a synthetic patient over zenoh on loopback, estimated live; no configuration, no server
#[derive(Args)]
#[command(after_help = "Example:  hemostream demo --seconds 30\n\nOn a terminal it shows the dashboard (q quits), \
                        otherwise a line per second; at the end it compares with the truth.")]
pub(crate) struct Demo {
    /// Stop by itself after so many seconds
    #[arg(long, value_parser = positive)]
    seconds: Option<f64>,
    /// One setting over those of the demo; may be repeated
    #[arg(long = "set", value_name = "KEY=VALUE")]
    sets: Vec<String>,
    /// A line per second even on a terminal
    #[arg(long)]
    plain: bool,
}

type Shared = Arc<Mutex<Scoreboard>>;

impl Demo {
    pub(crate) fn run(&self) -> Result<(), Failure> {
        let sets: Vec<String> = SETTINGS.iter().map(|s| (*s).to_owned()).chain(self.sets.iter().cloned()).collect();
        let (mut config, _) = Config::load(None, &sets)?;
        config.zenoh = ZenohSettings { mode: ZenohMode::Peer, listen: vec![free_endpoint()?], connect: Vec::new() };
        let client =
            ZenohSettings { mode: ZenohMode::Client, listen: Vec::new(), connect: config.zenoh.listen.clone() };

        let stop = Arc::new(AtomicBool::new(false));
        let runtime = tokio_runtime()?;
        let stopping = Arc::clone(&stop);
        runtime.spawn(async move {
            asked_to_stop().await;
            stopping.store(true, Ordering::Relaxed);
        });
        runtime.block_on(async {
            let daemon = ZenohBus::open(&config.zenoh)?;
            let running = Running::start(Arc::new(daemon.clone()), &config)?;
            let viewer = ZenohBus::open(&client)?;
            let shown = tokio::task::block_in_place(|| self.show(&config, &viewer, &stop));
            running.stop().await;
            viewer.close();
            daemon.close();
            shown
        })
    }

    /// Replays and shows until it ends; then the summary.
    fn show(&self, config: &Config, bus: &ZenohBus, stop: &Arc<AtomicBool>) -> Result<(), Failure> {
        let board = Shared::default();
        let (_subscription, messages) = subscribe(bus, config)?;
        let options = ReplayOptions { seconds: self.seconds, ..ReplayOptions::default() };
        let mut beds = [Bed::new(BED, Source::synthetic(&patient(config)?, config.estimator.seed)?)];
        wait_for_listener(bus, config, BED, stop);
        let ended = AtomicBool::new(false);
        let replayed = std::thread::scope(|scope| {
            let replay = scope.spawn(|| {
                let result = run(bus, config, &options, &mut beds, stop);
                // What is on its way still counts.
                std::thread::sleep(Duration::from_millis(500));
                ended.store(true, Ordering::Relaxed);
                result
            });
            let (scored, scoring_ended) = (&board, &ended);
            scope.spawn(move || score(&messages, scored, scoring_ended));
            let shown = if std::io::stdout().is_terminal() && !self.plain {
                terminal::run(bus, &config.publish.prefix, Some(BED), &ended).map_err(failed)
            } else {
                lines(&board, &ended);
                Ok(())
            };
            stop.store(true, Ordering::Relaxed);
            let replayed = replay.join().map_err(|_| Failure::Failed("the replay panicked".to_owned()));
            shown.and(replayed)
        })??;
        summary(config, &board.lock().unwrap_or_else(PoisonError::into_inner), replayed, options.rate_hz);
        Ok(())
    }
}

/// The patient starts somewhere in what the estimator is told of the start, and so with a blood volume that it does
/// not know.
fn patient(config: &Config) -> Result<Config, Failure> {
    let mut patient = config.clone();
    draw_start(&mut patient, config.estimator.seed)?;
    Ok(patient)
}

/// A loopback endpoint on a port that is free now.
fn free_endpoint() -> Result<String, Failure> {
    let listener = TcpListener::bind(("127.0.0.1", 0)).map_err(failed)?;
    let port = listener.local_addr().map_err(failed)?.port();
    Ok(format!("tcp/127.0.0.1:{port}"))
}

fn subscribe(bus: &ZenohBus, config: &Config) -> Result<(Subscription, Receiver<Message>), Failure> {
    let (sender, messages) = sync_channel(QUEUE);
    let pattern = format!("{}/{BED}/**", config.publish.prefix);
    let handler = Arc::new(move |message: Message| {
        // A viewer that falls behind misses some; the estimator does not wait for it.
        if !message.key.contains("/pressure/") && !message.key.ends_with("/json") {
            let _ = sender.try_send(message);
        }
    });
    Ok((bus.subscribe(&pattern, handler)?, messages))
}

fn score(messages: &Receiver<Message>, board: &Shared, ended: &AtomicBool) {
    loop {
        match messages.recv_timeout(Duration::from_millis(50)) {
            Ok(message) => board.lock().unwrap_or_else(PoisonError::into_inner).take(&message),
            Err(RecvTimeoutError::Timeout) if !ended.load(Ordering::Relaxed) => {}
            Err(_) => return,
        }
    }
}

fn lines(board: &Shared, ended: &AtomicBool) {
    let mut next_ns = 0;
    while !ended.load(Ordering::Relaxed) {
        std::thread::sleep(Duration::from_millis(100));
        let board = board.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(estimate) = board.latest.as_ref().filter(|e| e.header.time_ns >= next_ns) else { continue };
        next_ns = estimate.header.time_ns.div_euclid(1_000_000_000) * 1_000_000_000 + 1_000_000_000;
        let k = hemostream::edge::wire::STATE_STATISTICS.len();
        let pressures = estimate.names.iter().zip(estimate.values.chunks_exact(k)).take(Pressures::LEN);
        let pressures: Vec<String> =
            pressures.map(|(name, row)| format!("{name} {:.2} [{:.2} {:.2}]", row[0], row[5], row[6])).collect();
        let parameters: Vec<String> = board
            .parameters
            .iter()
            .map(|(name, mean, q05, q95, truth)| format!("{name} {mean:.4} [{q05:.4} {q95:.4}] true {truth:.4}"))
            .collect();
        say(format!(
            "{:6.2} s  {}  |  {}",
            estimate.header.time_ns as f64 * 1e-9,
            pressures.join("  "),
            parameters.join("  ")
        ));
    }
}

fn summary(config: &Config, board: &Scoreboard, seconds: f64, rate_hz: f64) {
    say(format!(
        "\n{seconds:.0} s of a synthetic patient, {} observed at {rate_hz:.0} Hz with noise; {} members, {} ms windows",
        config.observed.join(" and "),
        config.estimator.members,
        config.window.length_s * 1e3,
    ));
    say("\nparameter    start guess   estimate  [   5 %     95 %]     truth     off");
    let (model, theta) = (config.patient.model(), config.patient.theta());
    for (name, mean, q05, q95, truth) in &board.parameters {
        let assumed = model.parameter_index(name).map_or(f64::NAN, |p| theta[p]);
        let guess = config.estimator.initial_guess.get(name).copied().unwrap_or(assumed);
        let off = 100.0 * (mean / truth - 1.0);
        say(format!("{name:<12} {guess:>11.4} {mean:>10.4}  [{q05:.4}  {q95:.4}]  {truth:>8.4}  {off:>+5.1} %"));
    }
    say("\nquantity               rms error   band width   coverage of the 90 % band");
    let names = model.states().iter().chain(model.derived());
    for quantity in names {
        let Some(score) = board.scores.get(quantity.name) else { continue };
        let observed = config.observed.iter().any(|o| o == quantity.name);
        let label = format!("{} [{}]", quantity.name, quantity.unit);
        let note = if observed { "  (observed)" } else { "" };
        let (rmse, width, coverage) = (score.rmse(), score.width(), 100.0 * score.coverage());
        say(format!("{label:<20} {rmse:>11.4} {width:>12.4}   {coverage:>5.1} %{note}"));
    }
    if let Some(status) = &board.status {
        let lost: Vec<String> = status.counters.iter().map(|(cause, n)| format!("{cause} {n}")).collect();
        say(format!(
            "\nwindow lag p50 {:.2} ms, p99 {:.2} ms, max {:.2} ms; {} windows, {:.2} ms each; lost or refused: {}",
            status.lag_p50_ms,
            status.lag_p99_ms,
            status.lag_max_ms,
            status.windows,
            status.solve_ms,
            if lost.is_empty() { "nothing".to_owned() } else { lost.join(", ") },
        ));
    }
}
