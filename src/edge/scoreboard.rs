//! Estimates against the truth, live: error, coverage and how far the parameters are off.

use std::collections::{BTreeMap, VecDeque};

use super::bus::{Encoding, Message};
use super::wire::{self, ParameterEstimate, StateEstimate, Status, Truth};

/// Estimates or truths that wait for their counterpart.
const MAX_WAITING: usize = 4096;

/// Score of one quantity.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Score {
    /// Times compared.
    pub count: u64,
    /// Of these, with the truth between the 5 and 95 % quantiles.
    pub inside: u64,
    square: f64,
    width: f64,
}

#[allow(clippy::cast_precision_loss)]
impl Score {
    /// Share of times with the truth in the band.
    #[must_use]
    pub fn coverage(&self) -> f64 {
        self.inside as f64 / self.count as f64
    }

    /// Root mean square error of the mean.
    #[must_use]
    pub fn rmse(&self) -> f64 {
        (self.square / self.count as f64).sqrt()
    }

    /// Mean width of the band.
    #[must_use]
    pub fn width(&self) -> f64 {
        self.width / self.count as f64
    }

    fn add(&mut self, truth: f64, mean: f64, q05: f64, q95: f64) {
        self.count += 1;
        self.inside += u64::from((q05..=q95).contains(&truth));
        self.square += (mean - truth) * (mean - truth);
        self.width += q95 - q05;
    }
}

/// A band at one time: name, mean, 5 and 95 % quantile.
type Bands = Vec<(String, f64, f64, f64)>;

/// Compares the estimates of one bed with its truth, as both arrive.
#[derive(Debug, Clone, Default)]
pub struct Scoreboard {
    /// By name of the quantity or parameter.
    pub scores: BTreeMap<String, Score>,
    /// Latest parameters: name, mean, 5 and 95 % quantile, truth.
    pub parameters: Vec<(String, f64, f64, f64, f64)>,
    /// Latest status.
    pub status: Option<Status>,
    /// Latest estimate.
    pub latest: Option<StateEstimate>,
    /// Messages that were not understood.
    pub malformed: u64,
    truths: VecDeque<Truth>,
    waiting: VecDeque<(i64, Bands)>,
}

impl Scoreboard {
    /// Takes a message of the bed.
    pub fn take(&mut self, message: &Message) {
        if message.encoding != Encoding::Bincode {
            return;
        }
        let payload = &message.payload;
        let understood = if message.key.ends_with("/estimate/state") {
            wire::decode(payload, Encoding::Bincode).map(|e| self.state(e))
        } else if message.key.ends_with("/estimate/parameters") {
            wire::decode(payload, Encoding::Bincode).map(|e| self.parameter(&e))
        } else if message.key.ends_with("/truth") {
            wire::decode(payload, Encoding::Bincode).map(|t| self.truth(t))
        } else if message.key.ends_with("/status") {
            wire::decode(payload, Encoding::Bincode).map(|s| self.status = Some(s))
        } else {
            Ok(())
        };
        self.malformed += u64::from(understood.is_err());
    }

    fn state(&mut self, estimate: StateEstimate) {
        let k = wire::STATE_STATISTICS.len();
        for (t, time) in estimate.times_ns.iter().enumerate() {
            let rows = estimate.values.chunks_exact(k).skip(t * estimate.names.len());
            let bands = estimate.names.iter().zip(rows).map(|(name, row)| (name.clone(), row[0], row[5], row[6]));
            self.waiting.push_back((*time, bands.collect()));
        }
        self.latest = Some(estimate);
        self.settle();
    }

    fn parameter(&mut self, estimate: &ParameterEstimate) {
        let rows = estimate.values.chunks_exact(wire::PARAMETER_STATISTICS.len());
        let bands: Bands =
            estimate.names.iter().zip(rows).map(|(name, row)| (name.clone(), row[0], row[2], row[3])).collect();
        self.waiting.push_back((estimate.header.time_ns, bands));
        self.settle();
    }

    fn truth(&mut self, truth: Truth) {
        self.truths.push_back(truth);
        if self.truths.len() > MAX_WAITING {
            self.truths.pop_front();
        }
        self.settle();
    }

    /// Scores what has its truth at the same time; forgets what will not get one.
    fn settle(&mut self) {
        let newest = self.truths.back().map_or(i64::MIN, |t| t.time_ns);
        let mut unsettled = VecDeque::new();
        while let Some((time, bands)) = self.waiting.pop_front() {
            if let Ok(at) = self.truths.binary_search_by_key(&time, |t| t.time_ns) {
                let truth = self.truths[at].clone();
                self.score(&bands, &truth);
            } else if time > newest && unsettled.len() < MAX_WAITING {
                unsettled.push_back((time, bands));
            }
        }
        self.waiting = unsettled;
    }

    fn score(&mut self, bands: &Bands, truth: &Truth) {
        for (name, mean, q05, q95) in bands {
            let Some(at) = truth.names.iter().position(|n| n == name) else { continue };
            let Some(&value) = truth.values.get(at) else { continue };
            self.scores.entry(name.clone()).or_default().add(value, *mean, *q05, *q95);
            if at >= crate::model::cvsim6::Pressures::LEN + crate::model::cvsim6::FlowsAndVolumes::LEN {
                let row = (name.clone(), *mean, *q05, *q95, value);
                match self.parameters.iter_mut().find(|(n, ..)| n == name) {
                    Some(known) => *known = row,
                    None => self.parameters.push(row),
                }
            }
        }
    }
}
