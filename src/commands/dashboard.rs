//! `hemostream dashboard`: the web dashboard.

use std::sync::{Arc, OnceLock};

use clap::Args;
use hemostream::edge::bus::{Bus, BusError};
use hemostream::edge::config::ZenohSettings;
use hemostream::edge::dashboard::web::{Connect, Topics, Web};
use hemostream::edge::zenoh::ZenohBus;
use tokio::net::TcpListener;

use super::replay::client_settings;
use super::serve::{asked_to_stop, tokio_runtime};
use super::{ConfigArgs, Failure, LOG, log_to_stderr, say};

/// Where the page is, unless told otherwise.
const ADDRESS: &str = "127.0.0.1:8787";

/// Show beds in a browser: ward, waveforms, loops, trends, alarms; and metrics for Prometheus
#[derive(Args)]
#[command(
    after_help = "Example:  hemostream dashboard --connect tcp/127.0.0.1:7447 --listen 127.0.0.1:8787\n\nServes \
                        the page at /, a snapshot at /api/beds, and /metrics, /healthz, /readyz. Waits for the daemon \
                        if it is not there yet. Stops on Ctrl-C or SIGTERM."
)]
pub(crate) struct Dashboard {
    #[command(flatten)]
    config: ConfigArgs,
    /// Address and port of the page; any free port if this one is taken [default: 127.0.0.1:8787]. Whoever reaches it sees
    /// patients
    #[arg(long, value_name = "ADDRESS")]
    listen: Option<String>,
    /// Where the daemon listens; over `zenoh.connect` of the configuration
    #[arg(long, value_name = "ENDPOINT")]
    connect: Vec<String>,
}

impl Dashboard {
    pub(crate) fn run(&self) -> Result<(), Failure> {
        let (config, _) = self.config.load()?;
        log_to_stderr(LOG)?;
        let settings = client_settings(&config, &self.connect);
        tokio_runtime()?.block_on(async {
            let listener = page_listener(self.listen.as_deref()).await?;
            let link = Link::default();
            let web =
                Web::start(listener, &config, Topics::All, link.connect(settings.clone())).map_err(super::failed)?;
            say(format!(
                "hemostream dashboard of {} at http://{}/ ; Ctrl-C stops",
                settings.connect.join(", "),
                web.address()
            ));
            asked_to_stop().await;
            web.stop().await;
            link.close();
            Ok(())
        })
    }
}

/// A listener for the page: where the user says, or else at [`ADDRESS`], or else at any port.
pub(crate) async fn page_listener(address: Option<&str>) -> Result<TcpListener, Failure> {
    let Some(address) = address else {
        return match bind("--listen", ADDRESS).await {
            Ok(listener) => Ok(listener),
            Err(_) => bind("--listen", "127.0.0.1:0").await,
        };
    };
    bind("--listen", address).await
}

/// A listener at an address that a user gave.
pub(crate) async fn bind(option: &str, address: &str) -> Result<TcpListener, Failure> {
    TcpListener::bind(address).await.map_err(|error| {
        let hint = "expected ADDRESS:PORT with a port that is free; 127.0.0.1:0 finds one";
        Failure::Input(format!("{option} {address}: {error}; {hint}"))
    })
}

/// A session that a server opens when the daemon is there, and that is closed at the end.
#[derive(Clone, Default)]
pub(crate) struct Link(Arc<OnceLock<ZenohBus>>);

impl Link {
    /// Opens it.
    pub(crate) fn connect(&self, settings: ZenohSettings) -> Connect {
        let opened = Arc::clone(&self.0);
        Box::new(move || -> Result<Arc<dyn Bus>, BusError> {
            let bus = ZenohBus::open(&settings)?;
            let _ = opened.set(bus.clone());
            Ok(Arc::new(bus))
        })
    }

    /// Closes it.
    pub(crate) fn close(&self) {
        if let Some(bus) = self.0.get() {
            bus.close();
        }
    }
}
