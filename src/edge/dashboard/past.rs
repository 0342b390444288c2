//! A bed as it was a while ago, from what is kept of its past.
//!
//! Deliberately absent: what has no past here. The split of the uncertainty is that of the newest estimate only;
//! status and alarms stay those of the present, and whoever shows them beside the past must say so.

use super::bed::{Bed, Parameter};

impl Bed {
    /// The same bed, knowing nothing that happened after `time_ns`.
    pub(super) fn as_of(&self, time_ns: i64) -> Self {
        let mut past = self.clone();
        past.history = self.history.until(time_ns);
        past.samples = self.samples.each_ref().map(|samples| samples.until(time_ns));
        past.truth = self.truth.until(time_ns);
        past.state = self.history.at(time_ns).map(|(t, row)| (t, row.clone()));
        past.spread.clear();
        for parameter in &mut past.parameters {
            parameter.go_back(time_ns);
        }
        past.events.retain(|event| event.time_ns <= time_ns);
        past.take_back_beats(time_ns);
        past
    }

    fn take_back_beats(&mut self, time_ns: i64) {
        for trend in self.beat_trends.values_mut() {
            *trend = trend.until(time_ns);
        }
        let mut newest_ns = i64::MIN;
        let (_, readings) = &mut self.beat;
        readings.retain_mut(|reading| {
            let then = self.beat_trends.get(&reading.name).and_then(|trend| trend.at(time_ns));
            let Some((end_ns, band)) = then else { return false };
            (newest_ns, reading.band) = (newest_ns.max(end_ns), *band);
            true
        });
        self.beat.0 = newest_ns;
    }
}

impl Parameter {
    fn go_back(&mut self, time_ns: i64) {
        self.trend = self.trend.until(time_ns);
        let then = self.trend.at(time_ns).map(|(_, point)| (point.band, point.is_informed));
        let [mean, low, high] = then.map_or([f64::NAN; 3], |(b, _)| [b.mean, b.low, b.high].map(f64::from));
        (self.mean, self.low, self.high) = (mean, low, high);
        // Whether, not since when, is kept.
        let is_informed = then.is_some_and(|(_, is_informed)| is_informed);
        self.since_informed_s = if is_informed { 0.0 } else { f64::INFINITY };
    }
}
