//! Windows that nothing is learnt from: all members at once, in lanes.

use super::{Ensemble, Member};
use crate::model::Model;
use crate::model::lanes::{InstructionSet, Lanes, WIDTH};
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

impl<L> Forecaster<L> {
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
}

impl<M: Model> Ensemble<M> {
    /// Solves a window without samples for every member.
    pub(super) fn forecast(&mut self) {
        let Self { model, settings, unknowns, members, forecaster, .. } = self;
        let Some(forecaster) = forecaster else {
            return members.iter_mut().for_each(|member| member.solve_without_samples(model, settings, unknowns));
        };
        let Forecaster { model: lanes, instructions, expressions, batch } = forecaster;
        for (members, expressions) in members.chunks_mut(WIDTH).zip(expressions) {
            gather(members, batch);
            let solved = expressions.as_ref().is_some_and(|expressions| {
                batch.solve(lanes, expressions, settings.stopping.tolerance_mmhg, *instructions)
            });
            for (lane, member) in members.iter_mut().enumerate() {
                member.solved = solved && batch.read(lane, &member.theta, &mut member.solution);
                if !member.solved {
                    member.solve_without_samples(model, settings, unknowns);
                }
            }
        }
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
