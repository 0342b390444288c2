//! Windows that nothing is learnt from, for eight members at once.
//!
//! Without samples and with as many features as nodes, X-TFC on a window is the collocation equations
//! `beta_i = f(t_i, x_k + sum_j phi_ij beta_j)`, with `beta` the slopes at the nodes. On a window that is short beside the
//! time constants they are a contraction: they are swept through, node by node, each with the newest slopes of the others
//! (Gauss-Seidel), from the slope at the start of the window. The sweeps end when the equations hold as well as the
//! general solver ([`super::collocation`]) is asked for; members for which they do not within [`MAX_SWEEPS`] are left to
//! it.

use super::basis::Basis;
use super::problem::{Account, Solution};
use crate::model::lanes::{InstructionSet, LaneModel, Lanes, WIDTH};

/// Beyond this, a general solve is cheaper.
pub const MAX_SWEEPS: usize = 30;

/// Most nodes of a batch.
const MAX_NODES: usize = 10;

/// The constrained expressions of a batch of members.
#[derive(Debug, Clone)]
pub struct Expressions {
    /// Node positions \[s\].
    times_s: Vec<f64>,
    /// `phi` at the nodes \[s\], `[n_nodes x n_nodes]`.
    values: Vec<Lanes>,
    /// `phi` at the end \[s\], `[n_nodes]`.
    end: Vec<Lanes>,
    length_s: f64,
}

impl Expressions {
    /// Of up to eight members; None if they cannot be treated alike.
    #[must_use]
    pub fn new(bases: &[&Basis]) -> Option<Self> {
        let first = bases.first()?;
        let nodes = first.positions().len();
        let alike = |basis: &&Basis| basis.is_nodal() && basis.positions() == first.positions();
        if !(2..=MAX_NODES).contains(&nodes) || bases.len() > WIDTH || !bases.iter().all(alike) {
            return None;
        }
        // An incomplete batch is filled up with its first member.
        let lanes =
            |of: &dyn Fn(&Basis) -> f64| Lanes(std::array::from_fn(|lane| of(bases.get(lane).unwrap_or(first))));
        Some(Self {
            times_s: first.positions().iter().map(|s| s * first.length_s()).collect(),
            values: (0..nodes * nodes).map(|k| lanes(&|basis| basis.values()[k])).collect(),
            end: (0..nodes).map(|k| lanes(&|basis| basis.end()[k])).collect(),
            length_s: first.length_s(),
        })
    }
}

/// A batch at the start of a window, and its slopes and end after a solve. Reuse it from window to window.
#[derive(Debug, Clone, Default)]
pub struct Batch {
    /// State at the start, `[n_states]`.
    pub start: Vec<Lanes>,
    /// Parameters, `[n_parameters]`.
    pub theta: Vec<Lanes>,
    /// Slopes at the nodes, `[n_nodes x n_states]`.
    slopes: Vec<Lanes>,
    /// State at the end, `[n_states]`.
    end: Vec<Lanes>,
    /// Largest residual of any equation at any node \[mmHg/s\].
    residual: Lanes,
    sweeps: usize,
    limit: f64,
}

impl Batch {
    /// Sweeps through a window until no equation is off by more than `tolerance_mmhg` over its length. False, with
    /// nothing done, where `model` has no equations for these members.
    pub fn solve<M: LaneModel>(
        &mut self,
        model: &M,
        expressions: &Expressions,
        tolerance_mmhg: f64,
        instructions: InstructionSet,
    ) -> bool {
        let Some(fixed) = model.fixed(&self.theta) else { return false };
        let mut moments = [M::Moment::default(); MAX_NODES];
        for (moment, t_s) in moments.iter_mut().zip(&expressions.times_s) {
            *moment = model.moment(*t_s, &self.theta);
        }
        let (n, nodes) = (self.start.len(), expressions.times_s.len());
        self.slopes.resize(nodes * n, Lanes::default());
        self.end.resize(n, Lanes::default());
        self.limit = tolerance_mmhg / expressions.length_s;
        instructions.run(Sweeps::<M> { fixed, moments: &moments, expressions, batch: self });
        true
    }

    /// Takes the solution of one member out; false if the sweeps did not end for it.
    #[allow(clippy::cast_precision_loss)]
    pub fn read(&self, lane: usize, theta: &[f64], out: &mut Solution) -> bool {
        let residual = self.residual.0[lane];
        if residual > self.limit || residual.is_nan() {
            return false;
        }
        let of = |lanes: &Lanes| lanes.0[lane];
        let n = self.start.len();
        let nodes = self.slopes.len() / n;
        out.beta.clear();
        out.beta.extend(
            (0..n).flat_map(|i| (0..nodes).map(move |node| (i, node))).map(|(i, node)| of(&self.slopes[node * n + i])),
        );
        out.start.clear();
        out.start.extend(self.start.iter().map(of));
        out.end.clear();
        out.end.extend(self.end.iter().map(of));
        out.theta.clear();
        out.theta.extend_from_slice(theta);
        out.innovations.clear();
        out.account = Account {
            iterations: self.sweeps,
            physics_rms: of(&self.residual),
            data_rms: 0.0,
            condition: 1.0,
            converged: true,
        };
        out.is_finite()
    }
}

/// What runs in code for an instruction set.
struct Sweeps<'a, M: LaneModel> {
    fixed: M::Fixed,
    moments: &'a [M::Moment; MAX_NODES],
    expressions: &'a Expressions,
    batch: &'a mut Batch,
}

#[allow(clippy::inline_always)]
impl<M: LaneModel> pulp::NullaryFnOnce for Sweeps<'_, M> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        // The number of nodes is known to the compiler, which keeps the slopes of short windows in registers.
        match self.expressions.times_s.len() {
            2 => self.sweep::<2>(),
            3 => self.sweep::<3>(),
            4 => self.sweep::<4>(),
            5 => self.sweep::<5>(),
            6 => self.sweep::<6>(),
            7 => self.sweep::<7>(),
            8 => self.sweep::<8>(),
            9 => self.sweep::<9>(),
            _ => self.sweep::<MAX_NODES>(),
        }
    }
}

#[allow(clippy::inline_always)]
impl<M: LaneModel> Sweeps<'_, M> {
    #[inline(always)]
    fn sweep<const NODES: usize>(self) {
        let Self { fixed, moments, expressions, batch } = self;
        let (Some(values), Some(at_end)) = (expressions.values.get(..NODES * NODES), expressions.end.get(..NODES))
        else {
            return;
        };
        let mut start = M::State::default();
        start.as_mut().copy_from_slice(&batch.start);
        let mut slopes = [M::rhs(&fixed, &moments[0], &start); NODES];
        for sweep in 1..=MAX_SWEEPS {
            let mut residual = Lanes::splat(0.0);
            for node in 0..NODES {
                let x = moved::<M>(start, &values[node * NODES..(node + 1) * NODES], &slopes);
                let slope = M::rhs(&fixed, &moments[node], &x);
                for (new, old) in slope.as_ref().iter().zip(slopes[node].as_ref()) {
                    residual = (*new - *old).abs().larger(residual);
                }
                slopes[node] = slope;
            }
            (batch.residual, batch.sweeps) = (residual, sweep);
            if residual.all_within(batch.limit) {
                break;
            }
        }
        batch.end.copy_from_slice(moved::<M>(start, at_end, &slopes).as_ref());
        for (out, slopes) in batch.slopes.chunks_exact_mut(batch.start.len()).zip(&slopes) {
            out.copy_from_slice(slopes.as_ref());
        }
    }
}

/// `x + sum phi_j slope_j`
#[allow(clippy::inline_always)]
#[inline(always)]
fn moved<M: LaneModel>(mut x: M::State, phi: &[Lanes], slopes: &[M::State]) -> M::State {
    for (phi, slope) in phi.iter().zip(slopes) {
        for (x, slope) in x.as_mut().iter_mut().zip(slope.as_ref()) {
            *x = *x + *phi * *slope;
        }
    }
    x
}
