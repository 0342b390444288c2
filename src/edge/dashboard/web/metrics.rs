//! Prometheus metrics: the daemon as its status messages tell it, the patients, and this process.

use std::fmt::Error;
use std::sync::atomic::AtomicU64;
use std::time::Duration;

use prometheus_client::encoding::text::encode;
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::gauge::Gauge;
use prometheus_client::registry::{Registry, Unit};

use super::super::bed::Bed;
use super::super::ward::Ward;
use crate::edge::wire::{ChannelStatus, Status};

/// What `encode` writes.
pub(super) const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

type Labels = Vec<(&'static str, String)>;

/// Metrics of one scrape, made anew from what is known then.
struct Scrape<'a> {
    registry: Registry,
    ward: &'a Ward,
}

/// What this process does itself.
#[derive(Debug, Clone, Copy)]
pub(super) struct Own {
    /// Messages it was too slow for.
    pub(super) dropped: u64,
    /// Of a dashboard; the daemon itself has neither.
    pub(super) dashboard: Option<Dashboard>,
}

/// What only a dashboard has.
#[derive(Debug, Clone, Copy)]
pub(super) struct Dashboard {
    /// Pages that are open.
    pub(super) pages: usize,
    /// Whether there is a link to the daemon.
    pub(super) connected: bool,
}

impl Scrape<'_> {
    /// A gauge of this process.
    fn own(&mut self, name: &str, help: &str, value: f64) {
        let gauge = Gauge::<f64, AtomicU64>::default();
        gauge.set(value);
        self.registry.register(name, help, gauge);
    }

    fn own_count(&mut self, name: &str, help: &str, value: u64) {
        let counter = Counter::<u64>::default();
        counter.inc_by(value);
        self.registry.register(name, help, counter);
    }

    /// A gauge with values per bed.
    fn gauges(&mut self, name: &str, help: &str, unit: Option<Unit>, of: impl Fn(&Bed) -> Vec<(Labels, f64)>) {
        let family = Family::<Labels, Gauge<f64, AtomicU64>>::default();
        for (bed, labels, value) in self.per_bed(of) {
            family.get_or_create(&with_bed(bed, labels)).set(value);
        }
        match unit {
            Some(unit) => self.registry.register_with_unit(name, help, unit, family),
            None => self.registry.register(name, help, family),
        }
    }

    /// A counter with values per bed.
    fn counts(&mut self, name: &str, help: &str, of: impl Fn(&Bed) -> Vec<(Labels, u64)>) {
        let family = Family::<Labels, Counter<u64>>::default();
        for (bed, labels, value) in self.per_bed(of) {
            family.get_or_create(&with_bed(bed, labels)).inc_by(value);
        }
        self.registry.register(name, help, family);
    }

    fn per_bed<V>(&self, of: impl Fn(&Bed) -> Vec<(Labels, V)>) -> Vec<(&str, Labels, V)> {
        let beds = self.ward.beds.iter();
        beds.flat_map(|(name, bed)| of(bed).into_iter().map(|(labels, v)| (name.as_str(), labels, v))).collect()
    }
}

fn with_bed(bed: &str, labels: Labels) -> Labels {
    std::iter::once(("bed", bed.to_owned())).chain(labels).collect()
}

/// A value without further labels, if the daemon has told it.
fn told<V>(bed: &Bed, value: impl Fn(&Status) -> V) -> Vec<(Labels, V)> {
    bed.status.iter().map(|status| (Labels::new(), value(status))).collect()
}

fn per_channel(bed: &Bed, value: impl Fn(&ChannelStatus) -> f64) -> Vec<(Labels, f64)> {
    let channels = bed.status.iter().flat_map(|status| &status.channels);
    channels.map(|c| (vec![("channel", c.name.clone())], value(c))).collect()
}

/// All metrics as text.
///
/// # Errors
/// None in practice: writing to a string does not fail.
pub(super) fn text(ward: &Ward, now: Duration, own: Own) -> Result<String, Error> {
    let mut scrape = Scrape { registry: Registry::with_prefix("hemostream"), ward };
    of_process(&mut scrape, own);
    of_daemon(&mut scrape, now);
    of_patients(&mut scrape);
    let mut text = String::new();
    encode(&mut text, &scrape.registry)?;
    Ok(text)
}

#[allow(clippy::cast_precision_loss)]
fn of_process(scrape: &mut Scrape<'_>, own: Own) {
    scrape.own("beds", "Beds heard of", scrape.ward.beds.len() as f64);
    if let Some(Dashboard { pages, connected }) = own.dashboard {
        scrape.own("connected", "Whether there is a link to the daemon", f64::from(u8::from(connected)));
        scrape.own("pages", "Browser pages that are open", pages as f64);
    }
    scrape.own_count("messages", "Messages taken in", scrape.ward.messages);
    scrape.own_count("messages_dropped", "Messages that came faster than they were taken in", own.dropped);
    scrape.own_count("messages_unreadable", "Messages that were not understood", scrape.ward.unreadable);
    scrape.own_count("messages_refused", "Messages of beds beyond the limit", scrape.ward.refused);
}

fn of_daemon(scrape: &mut Scrape<'_>, now: Duration) {
    const LAG: &str = "From the closing of a window to its estimate being handed over, in the last minute or so";
    scrape.gauges("bed_window_lag", LAG, Some(Unit::Seconds), |bed| {
        let statistics = |s: &Status| [("p50", s.lag_p50_ms), ("p99", s.lag_p99_ms), ("max", s.lag_max_ms)];
        let all = bed.status.iter().flat_map(statistics);
        all.map(|(stat, ms)| (vec![("stat", stat.to_owned())], ms * 1e-3)).collect()
    });
    let age = "Since the newest estimate arrived";
    scrape.gauges("bed_estimate_age", age, Some(Unit::Seconds), |bed| {
        bed.silence(now).map(|age| (Labels::new(), age.as_secs_f64())).into_iter().collect()
    });
    let age = "Since the daemon last said how it does with the bed";
    scrape.gauges("bed_status_age", age, Some(Unit::Seconds), |bed| {
        let age = bed.status_arrival.map(|arrival| now.saturating_sub(arrival));
        age.map(|age| (Labels::new(), age.as_secs_f64())).into_iter().collect()
    });
    let solve = "Mean time to solve a window for all members, lately";
    scrape.gauges("bed_solve_time", solve, Some(Unit::Seconds), |bed| told(bed, |s| s.solve_ms * 1e-3));
    scrape.gauges("bed_members", "Members configured", None, |bed| told(bed, |s| f64::from(s.members)));
    scrape.gauges("bed_members_alive", "Members alive", None, |bed| told(bed, |s| f64::from(s.members_alive)));
    scrape.gauges("bed_queue_depth", "Inputs waiting", None, |bed| told(bed, |s| f64::from(s.queue_depth)));
    scrape.gauges("bed_iterations", "Mean iterations per member and window", None, |bed| told(bed, |s| s.iterations));
    scrape.counts("bed_windows", "Windows solved", |bed| told(bed, |s| s.windows));
    let forecasts = "Windows solved without a sample";
    scrape.counts("bed_windows_without_data", forecasts, |bed| told(bed, |s| s.windows_without_data));
    let stuck = "Member-windows that did not converge";
    scrape.counts("bed_not_converged", stuck, |bed| told(bed, |s| s.not_converged));
    scrape.counts("bed_refused", "What was refused or lost, by cause", |bed| {
        let counters = bed.status.iter().flat_map(|status| &status.counters);
        counters.map(|(cause, n)| (vec![("cause", cause.clone())], *n)).collect()
    });
    let live = |c: &ChannelStatus| f64::from(u8::from(c.state == "live" && c.artefact.is_empty()));
    scrape.gauges("bed_channel_live", "Whether a sensor delivers", None, |bed| per_channel(bed, live));
    let rms = "Root mean square of normalised innovations, lately: 1 when model and noise fit";
    scrape.gauges("bed_channel_innovation_rms", rms, None, |bed| per_channel(bed, |c| c.innovation_rms));
    let misfit = |c: &ChannelStatus| f64::from(u8::from(c.misfit));
    let help = "Whether the model no longer fits a channel";
    scrape.gauges("bed_channel_misfit", help, None, |bed| per_channel(bed, misfit));
}

fn of_patients(scrape: &mut Scrape<'_>) {
    let help = "Whether an alarm is active, or latched until somebody acknowledges it";
    scrape.gauges("bed_alarm", help, None, |bed| {
        let standing = |state: &str| f64::from(u8::from(state == "active" || state == "latched"));
        let labels = |name: &str, priority: &str| vec![("alarm", name.to_owned()), ("priority", priority.to_owned())];
        bed.alarms.iter().map(|a| (labels(&a.name, &a.priority), standing(&a.state))).collect()
    });
    let help = "Clinical quantities of the last beat, in the units of the topic estimate/beat";
    scrape.gauges("bed_beat", help, None, |bed| {
        let of = |name: &str, statistic: &str| vec![("quantity", name.to_owned()), ("statistic", statistic.to_owned())];
        let rows = bed.beat().iter().flat_map(|r| {
            [("mean", r.band.mean), ("q05", r.band.low), ("q95", r.band.high)]
                .map(|(s, v)| (of(&r.name, s), f64::from(v)))
        });
        rows.collect()
    });
}
