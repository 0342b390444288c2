//! The web server: what it answers, over HTTP and a bus in memory.

use std::sync::Arc;
use std::time::Duration;

use hemostream::edge::bus::{Bus, BusError, Delivery, Encoding, MemoryBus, Message};
use hemostream::edge::config::Config;
use hemostream::edge::dashboard::web::{Topics, Web};
use hemostream::edge::wire::{self, BeatEstimate, Header, SCHEMA, STATE_STATISTICS, StateEstimate, Status};
use serde_json::Value;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};

fn header() -> Header {
    Header { schema: SCHEMA, seed: 1, config_hash: 2, sequence: 0, time_ns: 5_000_000_000 }
}

fn publish<T: serde::Serialize>(bus: &dyn Bus, key: &str, message: &T) {
    let payload = wire::encode(message).unwrap();
    let message = Message { key: format!("ward/{key}"), encoding: Encoding::Bincode, payload };
    bus.publish(message, Delivery::Estimates).unwrap();
}

fn status() -> Status {
    Status {
        header: header(),
        members_alive: 90,
        members: 100,
        windows: 12,
        windows_without_data: 3,
        lag_p50_ms: 1.0,
        lag_p99_ms: 250.0,
        lag_max_ms: 300.0,
        solve_ms: 0.5,
        iterations: 2.0,
        not_converged: 0,
        queue_depth: 4,
        counters: vec![("late".to_owned(), 7)],
        channels: Vec::new(),
        disagreement: Vec::new(),
    }
}

/// Publishes what a daemon says of one bed.
fn daemon_says(bus: &dyn Bus) {
    let values = [90.0, 2.1, 0.4, 2.0, 0.0, 89.0, 91.0];
    assert_eq!(values.len(), STATE_STATISTICS.len());
    let state = StateEstimate {
        header: header(),
        members: 90,
        times_ns: vec![5_000_000_000],
        since_data_s: vec![0.0],
        names: vec!["p_a".to_owned()],
        values: values.to_vec(),
    };
    publish(bus, "bed1/estimate/state", &state);
    let (names, units) = (vec!["cardiac_output".to_owned()], vec!["L/min".to_owned()]);
    let values = vec![4.5, 0.1, 4.3, 4.7];
    let beat = BeatEstimate { header: header(), members: 90, end_ns: 4_900_000_000, names, units, values };
    publish(bus, "bed1/estimate/beat", &beat);
    publish(bus, "bed1/status", &status());
}

async fn ask(web: &Web, path: &str, more: &str) -> (u16, String) {
    let mut stream = TcpStream::connect(web.address()).await.unwrap();
    let request = format!("GET {path} HTTP/1.1\r\nHost: here\r\n{more}Connection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).await.unwrap();
    let (head, body) = answer.split_once("\r\n\r\n").unwrap();
    (head.split(' ').nth(1).unwrap().parse().unwrap(), body.to_owned())
}

/// Asks until the server knows the bed.
async fn known(web: &Web, path: &str) -> String {
    for _ in 0..500 {
        let (code, body) = ask(web, path, "").await;
        if code == 200 && body.contains("bed1") && body.contains("cardiac_output") && body.contains("late") {
            return body;
        }
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    panic!("{path} never tells of the bed");
}

async fn start(bus: &MemoryBus, topics: Topics) -> Web {
    let bus = bus.clone();
    let connect = Box::new(move || -> Result<Arc<dyn Bus>, BusError> { Ok(Arc::new(bus.clone())) });
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let config = Config::load_from(None, [], &["publish.prefix=ward".to_owned()]).unwrap().0;
    let web = Web::start(listener, &config, topics, connect).unwrap();
    for _ in 0..500 {
        if ask(&web, "/readyz", "").await.0 == 200 {
            break;
        }
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    web
}

#[tokio::test(flavor = "multi_thread")]
async fn a_snapshot_holds_what_the_daemon_said() {
    let bus = MemoryBus::new();
    let web = start(&bus, Topics::All).await;
    while !bus.is_wanted("ward/bed1/note") {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    daemon_says(&bus);
    let snapshot: Value = serde_json::from_str(&known(&web, "/api/beds").await).unwrap();
    let bed = &snapshot["beds"][0];
    assert_eq!((bed["bed"].as_str(), bed["liveness"].as_str()), (Some("bed1"), Some("live")));
    assert_eq!(bed["quantities"]["p_a"]["mean"], 90.0);
    assert_eq!((&bed["quantities"]["p_a"]["q05"], &bed["quantities"]["p_a"]["q95"]), (&89.0.into(), &91.0.into()));
    assert_eq!(bed["beat"]["cardiac_output"]["unit"], "L/min");
    assert_eq!(bed["health"]["counters"]["late"], 7);
    // No sensor is live, so that nothing of it can be trusted.
    assert_eq!(bed["quality"], "bad");
    web.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn metrics_have_what_alerts_need() {
    let bus = MemoryBus::new();
    let web = start(&bus, Topics::Health).await;
    while !bus.is_wanted("ward/bed1/alarm") {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    assert!(!bus.is_wanted("ward/bed1/estimate/state"), "waveforms are no metrics");
    daemon_says(&bus);
    let text = known(&web, "/metrics").await;
    for line in [
        "hemostream_bed_window_lag_seconds{bed=\"bed1\",stat=\"p99\"} 0.25",
        "hemostream_bed_members_alive{bed=\"bed1\"} 90.0",
        "hemostream_bed_refused_total{bed=\"bed1\",cause=\"late\"} 7",
        "hemostream_bed_windows_total{bed=\"bed1\"} 12",
        "hemostream_beds 1.0",
    ] {
        assert!(text.lines().any(|l| l == line), "`{line}` is not in\n{text}");
    }
    assert_eq!(ask(&web, "/", "").await.0, 404, "the daemon has no page");
    web.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn pages_of_other_sites_are_turned_away() {
    let bus = MemoryBus::new();
    let web = start(&bus, Topics::All).await;
    let upgrade = "Upgrade: websocket\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n";
    let foreign =
        format!("Origin: http://elsewhere\r\n{}", upgrade.replace("Upgrade:", "Connection: upgrade\r\nUpgrade:"));
    assert_eq!(ask(&web, "/live", &foreign).await.0, 403);
    let (code, page) = ask(&web, "/", "").await;
    assert!(code == 200 && page.contains("<title>hemostream</title>"));
    web.stop().await;
}
