//! The members as rows of numbers, and back: states, then coordinates of what is estimated, `[n_u x n_members]`.

use super::{Ensemble, Parallel};
use crate::estimate::batch::{Batch, Tools};
use crate::estimate::cloud::{Cloud, degrees};
use crate::estimate::random::Normals;
use crate::model::lanes::{Lanes, WIDTH};
use crate::model::{Model, Transform};

impl<M: Model> Ensemble<M> {
    /// States and parameter coordinates of the members now, into `rows`.
    pub(in crate::estimate) fn read_rows(&self, rows: &mut Vec<f64>) {
        self.read_rows_of(&self.batches, rows);
    }

    pub(in crate::estimate) fn read_rows_of(&self, batches: &[Batch], rows: &mut Vec<f64>) {
        let members: usize = batches.iter().map(Batch::len).sum();
        // All of them are written.
        rows.resize((self.model.n_states() + self.estimated.len()) * members, 0.0);
        let (estimated, transforms) = (&self.estimated, &self.transforms);
        self.settings.instructions.run(ReadRows { batches, members, estimated, transforms, rows });
    }

    /// The same as a cloud.
    pub(in crate::estimate) fn cloud(&self) -> Cloud {
        let mut rows = Vec::new();
        self.read_rows(&mut rows);
        Cloud::of(&rows, self.len(), self.settings.instructions)
    }

    /// Sets states and parameter coordinates of the batches from `first` on, by rows over their members.
    pub(in crate::estimate) fn place_from(&mut self, first: usize, rows: &[f64]) {
        let members: usize = self.batches[first..].iter().map(Batch::len).sum();
        for (k, row) in rows.chunks_exact(members).enumerate() {
            self.place_row(first, k, row);
        }
    }

    /// One of the rows, over the members of the batches from `first` on.
    pub(super) fn place_row(&mut self, first: usize, row: usize, values: &[f64]) {
        let (n, batches) = (self.model.n_states(), &mut self.batches[first..]);
        let Some(k) = row.checked_sub(n) else {
            for (batch, values) in batches.iter_mut().zip(values.chunks(WIDTH)) {
                batch.x[row].0[..values.len()].copy_from_slice(values);
                batch.fill_up();
            }
            return;
        };
        let (parameter, transform) = (self.estimated[k], self.transforms[k]);
        let bounds = self.settings.beliefs[parameter].bounds;
        self.settings.instructions.run(PlaceParameter { batches, parameter, transform, bounds, values });
    }

    /// Standard normals over the members, orthogonal to their deviations now.
    pub(in crate::estimate) fn draw(&mut self, count: usize) -> Vec<f64> {
        let mut draws = Vec::new();
        let cloud = self.cloud();
        self.normals.draw(count, cloud.members(), Some(&cloud), &mut draws);
        draws
    }

    /// Mean and standard deviation of every estimated coordinate.
    pub(in crate::estimate) fn coordinates(&self) -> Vec<(f64, f64)> {
        (0..self.estimated.len()).map(|k| self.coordinate(k)).collect()
    }

    /// Mean and standard deviation over the members of an estimated coordinate.
    pub(super) fn coordinate(&self, k: usize) -> (f64, f64) {
        let (parameter, transform) = (self.estimated[k], self.transforms[k]);
        let members = self.len();
        self.settings.instructions.run(Moments { batches: &self.batches, members, parameter, transform })
    }

    /// One batch after the other or side by side.
    pub(in crate::estimate) fn each(
        &mut self,
        parallel: &dyn Parallel,
        job: impl Fn(&Tools<'_, M>, &mut Batch) + Sync,
    ) {
        let (tools, batches, _) = self.take_apart();
        parallel.for_each(batches, &|batch| job(&tools, batch));
    }

    /// The same, and what the next window needs of random numbers.
    pub(super) fn each_and_draw_ahead(
        &mut self,
        parallel: &dyn Parallel,
        job: impl Fn(&Tools<'_, M>, &mut Batch) + Sync,
    ) {
        let count = (self.model.n_states() + self.estimated.len() + self.settings.channels.len()) * self.len();
        let (tools, batches, normals) = self.take_apart();
        parallel.for_each_beside(batches, &|batch| job(&tools, batch), &mut || normals.draw_ahead(count));
    }

    pub(super) fn take_apart(&mut self) -> (Tools<'_, M>, &mut [Batch], &mut Normals) {
        let look = self.next_look();
        let Self { model, shared, settings, unknowns, estimated, varying, batches, normals, .. } = self;
        (Tools { model, shared: shared.as_ref(), settings, unknowns, estimated, varying, look }, batches, normals)
    }

    /// Before the first look at a window.
    pub(super) fn begin_window(&mut self) {
        let (Some(shared), Some(first)) = (&mut self.shared, self.batches.first()) else { return };
        if let Some(expressions) = &first.expressions {
            shared.begin(&first.theta, &self.varying, expressions, self.settings.instructions);
        }
    }
}

/// The coordinates of parameters.
#[allow(clippy::inline_always)]
#[inline(always)]
pub(super) fn coordinates(theta: Lanes, transform: Transform) -> Lanes {
    match transform {
        Transform::Log => theta.ln(),
        Transform::Linear { scale } => theta / Lanes::splat(scale),
    }
}

// What runs in code for an instruction set.

struct ReadRows<'a> {
    batches: &'a [Batch],
    members: usize,
    estimated: &'a [usize],
    transforms: &'a [Transform],
    rows: &'a mut [f64],
}

#[allow(clippy::inline_always)]
impl pulp::NullaryFnOnce for ReadRows<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let Self { batches, members, estimated, transforms, rows } = self;
        let mut at = 0;
        for batch in batches {
            let count = batch.len();
            let (mut k, mut first) = (0, at);
            for x in &batch.x {
                rows[first..first + count].copy_from_slice(&x.0[..count]);
                first += members;
            }
            for p in estimated {
                let u = coordinates(batch.theta[*p], transforms[k]);
                rows[first..first + count].copy_from_slice(&u.0[..count]);
                first += members;
                k += 1;
            }
            at += count;
        }
    }
}

struct PlaceParameter<'a> {
    batches: &'a mut [Batch],
    parameter: usize,
    transform: Transform,
    bounds: (f64, f64),
    values: &'a [f64],
}

#[allow(clippy::inline_always)]
impl pulp::NullaryFnOnce for PlaceParameter<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let Self { batches, parameter, transform, bounds: (low, high), values } = self;
        for (batch, values) in batches.iter_mut().zip(values.chunks(WIDTH)) {
            let mut u = Lanes::splat(values[0]);
            u.0[..values.len()].copy_from_slice(values);
            let mut value = match transform {
                Transform::Log => u.exp(),
                Transform::Linear { scale } => u * Lanes::splat(scale),
            };
            for value in &mut value.0 {
                *value = if *value < low { low } else { *value };
                *value = if *value > high { high } else { *value };
            }
            batch.theta[parameter] = value;
        }
    }
}

struct Moments<'a> {
    batches: &'a [Batch],
    members: usize,
    parameter: usize,
    transform: Transform,
}

#[allow(clippy::inline_always)]
impl pulp::NullaryFnOnce for Moments<'_> {
    type Output = (f64, f64);

    #[allow(clippy::cast_precision_loss)]
    #[inline(always)]
    fn call(self) -> (f64, f64) {
        let Self { batches, members, parameter, transform } = self;
        // Those of the first member are about as large as the mean: little is lost to cancellation.
        let about = batches.first().map_or(0.0, |batch| coordinates(batch.theta[parameter], transform).0[0]);
        let (mut sum, mut squares) = (Lanes::default(), Lanes::default());
        for batch in batches {
            let mut off = coordinates(batch.theta[parameter], transform) - Lanes::splat(about);
            for off in &mut off.0[batch.len()..] {
                *off = 0.0;
            }
            sum = sum + off;
            squares = squares + off * off;
        }
        let (sum, squares) = (sum.0.iter().sum::<f64>(), squares.0.iter().sum::<f64>());
        let (count, mean) = (members as f64, sum / members as f64);
        let variance = if members < 2 { 0.0 } else { (squares - count * mean * mean) / degrees(members) };
        (about + mean, variance.max(0.0).sqrt())
    }
}
