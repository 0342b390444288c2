//! Windows that nothing is learnt from: all members at once, in lanes.

use super::{Ensemble, Member, Parallel};
use crate::model::Model;
use crate::model::lanes::{InstructionSet, LaneModel, Lanes, WIDTH};
use crate::xtfc::basis::Basis;
use crate::xtfc::sweeps::{Batch, Expressions};

/// What a model with equations for lanes is forecast with; see [`crate::xtfc::sweeps`].
#[derive(Debug, Clone)]
pub(super) struct Forecaster<L> {
    model: L,
    instructions: InstructionSet,
    /// One per [`WIDTH`] members, in their order; None where they have to be solved one by one.
    expressions: Vec<Option<Expressions>>,
    batch: Batch,
}

impl<L: LaneModel> Forecaster<L> {
    pub(super) fn new(model: L, instructions: InstructionSet, members: &[Member]) -> Self {
        let mut forecaster = Self { model, instructions, expressions: Vec::new(), batch: Batch::default() };
        forecaster.renew(members);
        forecaster
    }

    /// After a member has been given other features.
    pub(super) fn renew(&mut self, members: &[Member]) {
        let expressions = |members: &[Member]| {
            let bases: Option<Vec<&Basis>> = members.iter().map(|member| member.basis.as_ref()).collect();
            bases.and_then(|bases| Expressions::new(&bases))
        };
        self.expressions = members.chunks(WIDTH).map(expressions).collect();
    }

    /// Solves what can be solved in lanes.
    fn sweep(&mut self, members: &mut [Member], tolerance_mmhg: f64) {
        let Self { model, instructions, expressions, batch } = self;
        for (members, expressions) in members.chunks_mut(WIDTH).zip(expressions) {
            let Some(expressions) = expressions else { continue };
            gather(members, batch);
            if batch.solve(model, expressions, tolerance_mmhg, *instructions) {
                for (lane, member) in members.iter_mut().enumerate() {
                    member.solved = batch.read(lane, &member.theta, &mut member.solution);
                }
            }
        }
    }
}

impl<M: Model> Ensemble<M> {
    /// Solves a window without samples for every member: in lanes, and one by one what is left.
    pub(super) fn forecast(&mut self, parallel: &dyn Parallel) {
        let Self { model, settings, unknowns, members, forecaster, .. } = self;
        members.iter_mut().for_each(|member| member.solved = false);
        if let Some(forecaster) = forecaster {
            forecaster.sweep(members, settings.stopping.tolerance_mmhg);
        }
        if members.iter().all(|member| member.solved) {
            return;
        }
        let (model, settings, unknowns) = (&*model, &*settings, &*unknowns);
        parallel.for_each(members, &|_, member| {
            if !member.solved {
                member.solve_without_samples(model, settings, unknowns);
            }
        });
    }
}

/// States and parameters of up to [`WIDTH`] members, the last lanes like the first.
fn gather(members: &[Member], batch: &mut Batch) {
    let lanes =
        |of: &dyn Fn(&Member) -> f64| Lanes(std::array::from_fn(|lane| of(members.get(lane).unwrap_or(&members[0]))));
    let (n, n_p) = (members[0].x.len(), members[0].theta.len());
    batch.start.clear();
    batch.start.extend((0..n).map(|s| lanes(&|member| member.x[s])));
    batch.theta.clear();
    batch.theta.extend((0..n_p).map(|p| lanes(&|member| member.theta[p])));
}
