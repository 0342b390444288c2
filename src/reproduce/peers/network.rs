//! The network of both peers, and what it leaves of the equation, of the data and of the start.
//!
//! `x(t) = x0 + b2 + sum_i W2_i tanh(W1_i s(t) + b1_i)`, in single precision. Time enters as `s` from -5 to 5, which
//! for a horizon of 10 is time itself, centred: a unit switches where `W1 s + b1 = 0`, so weights and biases of order
//! one spread the switches over the interval, whereas plain time would crowd them at its start. The output is shifted
//! by the known start so that what is learnt is of order one; that the curve starts there still has to be learnt.
//!
//! Tensors are `[hidden x points]`. Sums over the hidden units are products and sums, not matrix products: at every
//! matrix product `candle` (0.11) asks the operating system for the number of cores, which at this size takes several
//! times as long as the whole network.

use std::ops::Range;

use candle_core::{DType, Device, Tensor, Var};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::{PeerError, Task};

/// Half the range of `s`.
const HALF_SPAN: f64 = 5.0;

/// Where to start, in the order of [`Weights::new`]: standard normal weights and biases of the first layer, normal
/// weights of variance `1 / hidden` of the second, no shift, and the guess of `k`.
///
/// The first layer is wider than usual for one input, and the curve of order one, on purpose: the equation alone is
/// best served by a large `k`, so a network that takes long to find the data loses `k` meanwhile.
pub(super) fn initial(task: &Task<'_>, hidden: usize, rng: &mut ChaCha8Rng) -> Vec<f64> {
    let second_sd = (hidden as f64).recip().sqrt();
    let sds = (0..3 * hidden).map(|i| if i < 2 * hidden { 1.0 } else { second_sd });
    sds.map(|sd| sd * normal(rng)).chain([0.0, task.k_guess]).collect()
}

/// A standard normal draw.
pub(super) fn normal(rng: &mut ChaCha8Rng) -> f64 {
    StandardNormal.sample(rng)
}

/// Weights, biases and the unknown of the equation, all trainable.
#[derive(Debug)]
pub(super) struct Weights {
    /// `W1`, `[hidden x 1]`.
    first: Var,
    /// `b1`, `[hidden x 1]`.
    bias: Var,
    /// `W2`, `[hidden x 1]`.
    second: Var,
    /// `b2`, `[1 x 1]`.
    shift: Var,
    /// `[1 x 1]`
    k: Var,
}

impl Weights {
    /// How many numbers there are.
    pub(super) const fn count(hidden: usize) -> usize {
        3 * hidden + 2
    }

    /// From all numbers, in the order `W1`, `b1`, `W2`, `b2`, `k`.
    pub(super) fn new(values: &[f64]) -> Result<Self, PeerError> {
        let hidden = (values.len() - 2) / 3;
        let var = |range: Range<usize>| {
            let values: Vec<f32> = values[range].iter().map(|&value| value as f32).collect();
            Var::from_vec(values.clone(), (values.len(), 1), &Device::Cpu)
        };
        Ok(Self {
            first: var(0..hidden)?,
            bias: var(hidden..2 * hidden)?,
            second: var(2 * hidden..3 * hidden)?,
            shift: var(3 * hidden..3 * hidden + 1)?,
            k: var(3 * hidden + 1..3 * hidden + 2)?,
        })
    }

    /// In the order of [`Weights::new`], `k` last.
    pub(super) const fn vars(&self) -> [&Var; 5] {
        [&self.first, &self.bias, &self.second, &self.shift, &self.k]
    }

    /// All numbers, in the order of [`Weights::new`].
    pub(super) fn values(&self) -> Result<Vec<f64>, PeerError> {
        Ok(self.vars().into_iter().map(|var| numbers(var)).collect::<Result<Vec<_>, _>>()?.concat())
    }

    /// `k`, as it is now.
    pub(super) fn k(&self) -> Result<f64, PeerError> {
        scalar(&self.k)
    }

    /// `x` at `times`.
    pub(super) fn predict(&self, task: &Task<'_>, times: &[f64]) -> Result<Vec<f64>, PeerError> {
        let units = self.units(&inputs(times, task.horizon, self.first.dim(0)?)?)?;
        Ok(numbers(&self.rise(&units)?)?.into_iter().map(|rise| task.x0 + rise).collect())
    }

    /// The hidden units.
    fn units(&self, inputs: &Tensor) -> candle_core::Result<Tensor> {
        inputs.broadcast_mul(&self.first)?.broadcast_add(&self.bias)?.tanh()
    }

    /// `x - x0`
    fn rise(&self, units: &Tensor) -> candle_core::Result<Tensor> {
        weighted_sum(units, &self.second)?.broadcast_add(&self.shift)
    }
}

/// What a network leaves, `[1 x points]` each.
#[derive(Debug)]
pub(super) struct Misfits {
    /// `dx/dt - cos(k t) / k` at the collocation points.
    pub(super) residual: Tensor,
    /// Network less data.
    pub(super) data: Tensor,
    /// Network less known start.
    pub(super) start: Tensor,
}

/// The points at which networks are judged: the collocation points, the data and the start.
#[derive(Debug)]
pub(super) struct Points {
    /// `s` of all points, the same for each hidden unit.
    inputs: Tensor,
    /// Of the collocation points.
    times: Tensor,
    /// `x - x0` of the data.
    rises: Tensor,
    /// `ds/dt`
    speed: f64,
}

impl Points {
    /// The data and `n_collocation` points evenly from 0 to the horizon.
    pub(super) fn new(
        task: &Task<'_>,
        data: &[(f64, f64)],
        n_collocation: usize,
        hidden: usize,
    ) -> Result<Self, PeerError> {
        let spacing = task.horizon / (n_collocation - 1) as f64;
        let collocation: Vec<f64> = (0..n_collocation).map(|i| spacing * i as f64).collect();
        let all: Vec<f64> = collocation.iter().copied().chain(data.iter().map(|&(t, _)| t)).chain([0.0]).collect();
        let rises: Vec<f64> = data.iter().map(|&(_, x)| x - task.x0).collect();
        Ok(Self {
            inputs: inputs(&all, task.horizon, hidden)?,
            times: row(&collocation)?,
            rises: row(&rises)?,
            speed: 2.0 * HALF_SPAN / task.horizon,
        })
    }

    /// Of one network. Its slope `sum_i W2_i (1 - tanh^2) W1_i ds/dt` is written out, so that first-order automatic
    /// differentiation is enough.
    pub(super) fn misfits(&self, weights: &Weights) -> Result<Misfits, PeerError> {
        let (n_collocation, n_data) = (self.times.dim(1)?, self.rises.dim(1)?);
        let units = weights.units(&self.inputs)?;
        let steepest = ((&*weights.first * &*weights.second)? * self.speed)?;
        let flattening = weighted_sum(&units.sqr()?, &steepest)?.narrow(1, 0, n_collocation)?;
        let slope = steepest.sum_keepdim(0)?.broadcast_sub(&flattening)?;
        let rise = weights.rise(&units)?;
        Ok(Misfits {
            residual: (slope - self.right_hand_side(&weights.k)?)?,
            data: (rise.narrow(1, n_collocation, n_data)? - &self.rises)?,
            start: rise.narrow(1, n_collocation + n_data, 1)?,
        })
    }

    /// `cos(k t) / k`
    fn right_hand_side(&self, k: &Tensor) -> candle_core::Result<Tensor> {
        self.times.broadcast_mul(k)?.cos()?.broadcast_div(k)
    }
}

/// `s` at `times`, `[hidden x times]`.
fn inputs(times: &[f64], horizon: f64, hidden: usize) -> candle_core::Result<Tensor> {
    let s: Vec<f64> = times.iter().map(|t| HALF_SPAN * (2.0 * t / horizon - 1.0)).collect();
    row(&s)?.broadcast_as((hidden, times.len()))?.contiguous()
}

/// `[1 x values]`
fn row(values: &[f64]) -> candle_core::Result<Tensor> {
    Tensor::from_slice(values, (1, values.len()), &Device::Cpu)?.to_dtype(DType::F32)
}

/// Sum over the hidden units.
fn weighted_sum(units: &Tensor, weights: &Tensor) -> candle_core::Result<Tensor> {
    units.broadcast_mul(weights)?.sum_keepdim(0)
}

/// All numbers of a tensor.
pub(super) fn numbers(tensor: &Tensor) -> Result<Vec<f64>, PeerError> {
    Ok(tensor.to_dtype(DType::F64)?.flatten_all()?.to_vec1()?)
}

/// The only number of a tensor.
pub(super) fn scalar(tensor: &Tensor) -> Result<f64, PeerError> {
    Ok(f64::from(tensor.flatten_all()?.squeeze(0)?.to_scalar::<f32>()?))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reproduce::peers::tests::{exact_data, task};

    const HIDDEN: usize = 3;

    fn values() -> Vec<f64> {
        vec![0.4, -0.7, 1.1, 0.2, 0.5, -0.3, 0.9, -0.6, 0.3, 0.1, 1.2]
    }

    #[test]
    fn misfits_are_those_of_the_prediction() {
        let data = exact_data();
        let task = task(&data, &[]);
        let weights = Weights::new(&values()).unwrap();
        let misfits = Points::new(&task, &data, 5, HIDDEN).unwrap().misfits(&weights).unwrap();
        let step = 1e-2;
        for (i, residual) in numbers(&misfits.residual).unwrap().into_iter().enumerate() {
            let t = 2.5 * i as f64;
            let around = weights.predict(&task, &[t - step, t + step]).unwrap();
            let slope = (around[1] - around[0]) / (2.0 * step);
            assert!((residual - (slope - (1.2 * t).cos() / 1.2)).abs() < 1e-3, "at {t}: {residual}");
        }
        let times: Vec<f64> = data.iter().map(|d| d.0).collect();
        let predicted = weights.predict(&task, &times).unwrap();
        for (misfit, (x, datum)) in numbers(&misfits.data).unwrap().iter().zip(predicted.iter().zip(&data)) {
            assert!((misfit - (x - datum.1)).abs() < 1e-5);
        }
        assert!((scalar(&misfits.start).unwrap() - (predicted[0] - 10.0)).abs() < 1e-5);
    }

    #[test]
    fn gradients_are_those_of_differences() {
        let data = exact_data();
        let points = Points::new(&task(&data, &[]), &data, 5, HIDDEN).unwrap();
        let loss = |values: &[f64]| {
            let weights = Weights::new(values).unwrap();
            let misfits = points.misfits(&weights).unwrap();
            let sum = (misfits.residual.sqr().unwrap().sum_all().unwrap()
                + misfits.data.sqr().unwrap().sum_all().unwrap())
            .unwrap();
            (weights, sum)
        };
        let (weights, sum) = loss(&values());
        let gradients = sum.backward().unwrap();
        let gradient: Vec<f64> =
            weights.vars().iter().flat_map(|var| numbers(gradients.get(var).unwrap()).unwrap()).collect();
        assert_eq!(gradient.len(), Weights::count(HIDDEN));
        let step = 1e-2;
        for (i, derivative) in gradient.into_iter().enumerate() {
            let at = |delta: f64| {
                let mut moved = values();
                moved[i] += delta;
                scalar(&loss(&moved).1).unwrap()
            };
            let difference = (at(step) - at(-step)) / (2.0 * step);
            assert!(
                (derivative - difference).abs() < 1e-2 * (1.0 + difference.abs()),
                "{i}: {derivative} {difference}"
            );
        }
    }
}
