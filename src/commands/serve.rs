//! `hemostream serve`: the daemon.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use clap::Args;
use hemostream::edge::bus::Bus;
use hemostream::edge::config::Config;
use hemostream::edge::dashboard::web::{Topics, Web};
use hemostream::edge::zenoh::ZenohBus;
use hemostream::edge::{inlet, outlet::Outlet};
use hemostream::runtime::bed::Account;
use hemostream::runtime::clock::Clock;
use hemostream::runtime::service::{Inlet, Limits, Service};
use hemostream::runtime::workers::Workers;

use super::dashboard::bind;
use super::{ConfigArgs, Failure, LOG, failed, log_to_stderr, say};

/// A bed that has had no samples for so long makes room for a new one where there are as many as there may be.
const FORGET_AFTER: Duration = Duration::from_secs(3600);

/// Run the daemon: estimate every bed whose pressures arrive
#[derive(Args)]
#[command(after_help = "Example:  hemostream serve --config config/default.toml\n\nBeds appear with their first \
                        sample on PREFIX/BED/pressure/CHANNEL. Stops on Ctrl-C or SIGTERM.")]
pub(crate) struct Serve {
    #[command(flatten)]
    config: ConfigArgs,
    /// Serve /metrics (Prometheus), /healthz and /readyz at this address and port
    #[arg(long, value_name = "ADDRESS")]
    metrics: Option<String>,
}

/// A running daemon within this process.
pub(crate) struct Running {
    inlet: Inlet,
    task: tokio::task::JoinHandle<Account>,
    _listening: Vec<hemostream::edge::bus::Subscription>,
}

impl Running {
    /// Starts the service on a bus; needs a tokio runtime.
    pub(crate) fn start(bus: Arc<dyn Bus>, config: &Config) -> Result<Self, Failure> {
        let workers = Arc::new(Workers::start(config.service.workers).map_err(failed)?);
        let sink = Arc::new(Outlet::start(Arc::clone(&bus), config)?);
        let limits = Limits {
            max_beds: config.service.max_beds,
            forget_after: FORGET_AFTER,
            queue_tasks: config.service.queue_blocks,
            report_every: Duration::from_secs_f64(1.0 / config.publish.status_rate_hz),
        };
        let (settings, recent) = (config.estimator_settings()?, sink.recent());
        let (service, inlet) =
            Service::new(config.circulation()?, settings, limits, workers, sink, Clock::start()).map_err(failed)?;
        let task = tokio::spawn(service.run());
        let listening = inlet::listen(bus.as_ref(), config, inlet.clone(), recent)?;
        Ok(Self { inlet, task, _listening: listening })
    }

    /// Waits until the service ends by itself, which only a defect in the program can make it do.
    async fn ended(&mut self) {
        let _ = (&mut self.task).await;
    }

    /// Finishes what is waiting and stops.
    pub(crate) async fn stop(self) {
        self.inlet.stop().await;
        match tokio::time::timeout(Duration::from_secs(10), self.task).await {
            Ok(Ok(account)) => summarise(&account),
            _ => tracing::warn!("the service did not stop in time"),
        }
        if self.inlet.dropped() > 0 {
            tracing::warn!(dropped = self.inlet.dropped(), "messages were dropped because the service was behind");
        }
    }
}

/// What the run came to, for whoever reads the log.
#[allow(clippy::cast_precision_loss)]
fn summarise(account: &Account) {
    let lag = |quantile: f64| account.lag_us.as_ref().map_or(f64::NAN, |h| h.value_at_quantile(quantile) as f64 / 1e3);
    let resident_mb = resident_bytes().map_or(f64::NAN, |bytes| bytes as f64 / 1e6);
    tracing::info!(
        beds = account.beds,
        windows = account.windows,
        lost = account.lost,
        one_by_one = account.one_by_one,
        not_converged = account.not_converged,
        lag_p50_ms = lag(0.5),
        lag_p99_ms = lag(0.99),
        lag_max_ms = lag(1.0),
        resident_mb,
        resident_mb_per_bed = resident_mb / account.beds.max(1) as f64,
        "stopped"
    );
}

/// Memory of this process; None where the system does not tell.
fn resident_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
    let kib: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kib * 1024)
}

/// A tokio runtime small enough to leave the cores to the solves.
pub(crate) fn tokio_runtime() -> Result<tokio::runtime::Runtime, Failure> {
    tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().map_err(failed)
}

/// Waits for Ctrl-C or SIGTERM.
pub(crate) async fn asked_to_stop() {
    #[cfg(unix)]
    {
        let terminate = tokio::signal::unix::signal(tokio::signal::unix::SignalKind::terminate());
        if let Ok(mut terminate) = terminate {
            tokio::select! {
                _ = tokio::signal::ctrl_c() => {}
                _ = terminate.recv() => {}
            }
            return;
        }
    }
    let _ = tokio::signal::ctrl_c().await;
}

/// A flag for threads, which cannot wait on a signal: set on Ctrl-C or SIGTERM.
pub(crate) fn stop_when_asked(runtime: &tokio::runtime::Runtime) -> Arc<AtomicBool> {
    let stop = Arc::new(AtomicBool::new(false));
    let stopping = Arc::clone(&stop);
    runtime.spawn(async move {
        asked_to_stop().await;
        stopping.store(true, Ordering::Relaxed);
    });
    stop
}

impl Serve {
    pub(crate) fn run(&self) -> Result<(), Failure> {
        let (config, _) = self.config.load()?;
        log_to_stderr(LOG)?;
        tokio_runtime()?.block_on(async {
            let bus = ZenohBus::open(&config.zenoh)?;
            let mut running = Running::start(Arc::new(bus.clone()), &config)?;
            let metrics = match &self.metrics {
                Some(address) => Some(observe(address, &config, &bus).await?),
                None => None,
            };
            say(format!(
                "hemostream serves {}/*/pressure/* at {} (config {:016x}); Ctrl-C stops",
                config.publish.prefix,
                config.zenoh.listen.iter().chain(&config.zenoh.connect).cloned().collect::<Vec<_>>().join(", "),
                config.hash(),
            ));
            tokio::select! {
                () = asked_to_stop() => running.stop().await,
                () = running.ended() => {
                    return Err(Failure::Failed("the service ended by itself: a defect in the program".to_owned()));
                }
            }
            if let Some(metrics) = metrics {
                metrics.stop().await;
            }
            bus.close();
            Ok(())
        })
    }
}

/// Metrics and health of this daemon, as its own messages tell them.
async fn observe(address: &str, config: &Config, bus: &ZenohBus) -> Result<Web, Failure> {
    let listener = bind("--metrics", address).await?;
    let bus: Arc<dyn Bus> = Arc::new(bus.clone());
    let web = Web::start(listener, config, Topics::Health, Box::new(move || Ok(Arc::clone(&bus))));
    let web = web.map_err(failed)?;
    say(format!("metrics at http://{}/metrics", web.address()));
    Ok(web)
}
