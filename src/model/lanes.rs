//! Eight members side by side: numbers in lanes, the instruction set that works on them, and equations written for them.
//!
//! Arithmetic is plain loops over arrays of eight, which the compiler turns into vector instructions where
//! [`InstructionSet::run`] has told it that they exist. There is no fused multiply-add: every instruction set rounds
//! alike, so that the same input gives the same bits on every machine.

use std::fmt;
use std::ops::{Add, Div, Mul, Sub};

/// Members in a batch.
pub const WIDTH: usize = 8;

/// One number of each member of a batch.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[repr(align(64))]
pub struct Lanes(pub [f64; WIDTH]);

// All of these are a few instructions, and have to end up in the function that was compiled for the instruction set.
#[allow(clippy::inline_always)]
impl Lanes {
    /// The same for all.
    #[must_use]
    #[inline(always)]
    pub const fn splat(value: f64) -> Self {
        Self([value; WIDTH])
    }

    /// Lane by lane.
    #[must_use]
    #[inline(always)]
    pub fn map(self, f: impl Fn(f64) -> f64) -> Self {
        let mut out = self;
        for value in &mut out.0 {
            *value = f(*value);
        }
        out
    }

    #[inline(always)]
    fn zip(self, other: Self, f: impl Fn(f64, f64) -> f64) -> Self {
        let mut out = self;
        for (value, other) in out.0.iter_mut().zip(&other.0) {
            *value = f(*value, *other);
        }
        out
    }

    /// The value where it is positive, else 0; so a number that is none becomes 0.
    #[must_use]
    #[inline(always)]
    pub fn positive_part(self) -> Self {
        self.map(|v| if v > 0.0 { v } else { 0.0 })
    }

    /// Without its sign.
    #[must_use]
    #[inline(always)]
    pub fn abs(self) -> Self {
        self.map(f64::abs)
    }

    /// The larger of two, lane by lane; `other` where `self` is no number.
    #[must_use]
    #[inline(always)]
    pub fn larger(self, other: Self) -> Self {
        self.zip(other, |a, b| if a > b { a } else { b })
    }

    /// Whether no lane is above a limit; false where one is no number.
    #[must_use]
    #[inline(always)]
    pub fn all_within(self, limit: f64) -> bool {
        self.0.iter().fold(true, |all, v| all & (*v <= limit))
    }
}

macro_rules! arithmetic {
    ($($trait:ident $function:ident $operator:tt),+) => {
        $(
            #[allow(clippy::inline_always)]
            impl $trait for Lanes {
                type Output = Self;
                #[inline(always)]
                fn $function(self, other: Self) -> Self {
                    self.zip(other, |a, b| a $operator b)
                }
            }
        )+
    };
}
arithmetic!(Add add +, Sub sub -, Mul mul *, Div div /);

/// The equations of a model for a batch of members, in the form that a kernel can repeat quickly: what does not change
/// over a window, and what belongs to a moment of it, are worked out once.
#[allow(clippy::inline_always)]
pub trait LaneModel: Copy + fmt::Debug + Send + Sync {
    /// A state of every member, `[Lanes; n_states]`.
    type State: Copy + AsRef<[Lanes]> + AsMut<[Lanes]> + Default;
    /// What does not change over a window.
    type Fixed: Copy;
    /// What depends on the time only.
    type Moment: Copy + Default;

    /// From the parameters of every member, `[n_parameters]`; None where these equations are not those of the model.
    fn fixed(&self, theta: &[Lanes]) -> Option<Self::Fixed>;

    /// At `t_s` after the start of the window.
    fn moment(&self, t_s: f64, theta: &[Lanes]) -> Self::Moment;

    /// `f(t, x, theta)`; has to be `#[inline(always)]`.
    fn rhs(fixed: &Self::Fixed, moment: &Self::Moment, x: &Self::State) -> Self::State;
}

/// Of models that have no equations for lanes.
#[derive(Debug, Clone, Copy)]
pub struct NoLanes;

impl LaneModel for NoLanes {
    type State = [Lanes; 0];
    type Fixed = ();
    type Moment = ();

    fn fixed(&self, _: &[Lanes]) -> Option<()> {
        None
    }

    fn moment(&self, _: f64, _: &[Lanes]) {}

    fn rhs((): &(), (): &(), x: &Self::State) -> Self::State {
        *x
    }
}

/// Vector instructions of a processor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum InstructionSet {
    /// Those that every processor has.
    #[default]
    Portable,
    /// Four numbers at a time.
    Avx2,
    /// Eight numbers at a time.
    Avx512,
}

impl InstructionSet {
    /// All, the best last.
    pub const ALL: [Self; 3] = [Self::Portable, Self::Avx2, Self::Avx512];

    /// Name in settings and reports.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Portable => "portable",
            Self::Avx2 => "avx2",
            Self::Avx512 => "avx512",
        }
    }

    /// Whether this processor has it.
    #[must_use]
    pub fn is_available(self) -> bool {
        match self {
            Self::Portable => true,
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => pulp::x86::V3::try_new().is_some(),
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => pulp::x86::V4::try_new().is_some(),
            #[cfg(not(target_arch = "x86_64"))]
            Self::Avx2 | Self::Avx512 => false,
        }
    }

    /// The best of this processor.
    #[must_use]
    pub fn best() -> Self {
        Self::ALL.into_iter().rfind(|set| set.is_available()).unwrap_or_default()
    }

    /// Does a job in code that was compiled for this instruction set; portably if the processor does not have it.
    #[allow(clippy::inline_always)]
    #[inline(always)]
    pub fn run<F: pulp::NullaryFnOnce>(self, job: F) -> F::Output {
        #[cfg(target_arch = "x86_64")]
        match self {
            Self::Avx512 => {
                if let Some(simd) = pulp::x86::V4::try_new() {
                    return simd.vectorize(job);
                }
            }
            Self::Avx2 => {
                if let Some(simd) = pulp::x86::V3::try_new() {
                    return simd.vectorize(job);
                }
            }
            Self::Portable => {}
        }
        job.call()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_that_are_none_are_not_within_anything() {
        let mut lanes = Lanes::splat(1.0);
        assert!(lanes.all_within(1.0) && !lanes.all_within(0.5));
        lanes.0[3] = f64::NAN;
        assert!(!lanes.all_within(f64::INFINITY));
        assert!(!Lanes::splat(0.0).larger(lanes).all_within(1.0), "and stay none in a maximum");
    }

    #[test]
    fn portable_is_always_there() {
        assert!(InstructionSet::Portable.is_available());
        assert!(InstructionSet::best().is_available());
    }
}
