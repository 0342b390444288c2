//! The estimator of one bed over a record: event time is all the time there is.

use super::workers::Workers;
use crate::estimate::estimator::{Estimator, Input, Output};
use crate::estimate::settings::{EstimatorSettings, SettingsError};
use crate::estimate::time::ArrivalTime;
use crate::model::discrepancy::Circulation;

/// An estimator of the circulation. Not generic: its kernels are compiled once, with the library.
pub struct Offline {
    estimator: Estimator<Circulation>,
}

impl Offline {
    /// An estimator that waits for its first sample.
    ///
    /// # Errors
    /// When the settings do not fit the model.
    pub fn new(model: Circulation, settings: EstimatorSettings) -> Result<Self, SettingsError> {
        Ok(Self { estimator: Estimator::new(model, settings)? })
    }

    /// The estimator.
    #[must_use]
    pub fn estimator(&self) -> &Estimator<Circulation> {
        &self.estimator
    }

    /// Takes the next input; a record has no arrivals, so that `now` is when it was taken.
    pub fn handle(&mut self, input: Input, now: ArrivalTime, workers: &Workers, out: &mut Vec<Output>) {
        self.estimator.handle(input, now, workers, out);
    }
}
