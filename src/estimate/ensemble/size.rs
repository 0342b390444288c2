//! Fewer members for a while, and all of them again.
//!
//! A subset of a hundred members has another mean and covariance than all of them: those that stay are moved so that
//! they have both (where they are draws from one posterior), and those that come back are drawn from what the others
//! make of it by then.

use super::Ensemble;
use crate::estimate::cloud::Cloud;
use crate::estimate::settings::CouplingKind;
use crate::estimate::smoother::Smoother;
use crate::model::Model;
use crate::model::lanes::{Lanes, WIDTH};

impl<M: Model> Ensemble<M> {
    /// Goes on with about this many members, whole batches of them, two at least; all if it is asked for more than there
    /// are. What was remembered of the last moments is forgotten, and with it the beat under way. True if their number
    /// changed.
    pub fn set_members(&mut self, members: usize) -> bool {
        let batches = self.batches_for(members);
        if batches == self.batches.len() {
            return false;
        }
        if batches < self.batches.len() {
            self.rest(batches);
        } else {
            self.wake(batches);
        }
        self.memory.forget();
        self.smoother = Smoother::default();
        if let Some(beats) = &mut self.beats {
            beats.begin_again();
        }
        true
    }

    /// Whether [`Ensemble::set_members`] would change their number.
    pub fn would_resize(&self, members: usize) -> bool {
        self.batches_for(members) != self.batches.len()
    }

    fn batches_for(&self, members: usize) -> usize {
        // The cloud of this filter is a picture of its moments: fewer points would save nothing.
        if self.settings.coupling == CouplingKind::Ukf {
            return self.batches.len();
        }
        let all = self.batches.len() + self.resting.len();
        members.div_ceil(WIDTH).clamp(LEAST_BATCHES.min(all), all)
    }

    fn rest(&mut self, batches: usize) {
        let before = self.cloud();
        // The last rest first, so that they come back in their order.
        let mut resting = self.batches.split_off(batches);
        resting.append(&mut self.resting);
        self.resting = resting;
        if self.settings.coupling.is_bayesian() {
            let now = self.cloud();
            self.place_all(&spread(&before, now.directions(), now.members()), 0);
        }
    }

    fn wake(&mut self, batches: usize) {
        let moments = self.cloud();
        let common = self.theta_of(0);
        let first = self.batches.len();
        let back: Vec<_> = self.resting.drain(..batches - first).collect();
        for mut batch in back {
            // What is the same in all members may have changed while they rested.
            batch.theta.iter_mut().zip(&common).for_each(|(theta, value)| *theta = Lanes::splat(*value));
            self.batches.push(batch);
        }
        let m: usize = self.batches[first..].iter().map(super::Batch::len).sum();
        let mut draws = Vec::new();
        self.normals.draw(moments.len(), m, None, &mut draws);
        self.place_all(&spread(&moments, &draws, m), first);
    }

    /// Between two windows: sets the batches from `first` on, and forgets how they got there.
    fn place_all(&mut self, rows: &[f64], first: usize) {
        self.place_from(first, rows);
        self.batches[first..].iter_mut().for_each(super::Batch::stand_still);
    }
}

/// Batches that stay in any case: an ensemble of fewer says nothing about its spread.
const LEAST_BATCHES: usize = 2;

/// `mean + root z`, `[n x members]`.
fn spread(moments: &Cloud, z: &[f64], members: usize) -> Vec<f64> {
    let mut out = Vec::with_capacity(z.len());
    for (mean, root) in moments.mean().iter().zip(moments.root().chunks_exact(moments.len())) {
        for i in 0..members {
            let terms = root.iter().enumerate().map(|(k, factor)| factor * z[k * members + i]);
            out.push(mean + terms.sum::<f64>());
        }
    }
    out
}
