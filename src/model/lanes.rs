//! Eight members side by side: numbers in lanes, the instruction set that works on them, and equations written for them.
//!
//! Arithmetic is written out for arrays of eight, which the compiler turns into vector instructions where
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

    /// `yes` where this is positive, else `no`.
    #[must_use]
    #[inline(always)]
    pub fn choose(self, yes: Self, no: Self) -> Self {
        let mut out = no;
        for ((out, yes), value) in out.0.iter_mut().zip(&yes.0).zip(&self.0) {
            *out = if *value > 0.0 { *yes } else { *out };
        }
        out
    }

    /// The nearest whole number, for numbers below 2^51.
    #[must_use]
    #[inline(always)]
    fn rounded(self) -> Self {
        // Where doubles are spaced by 1, addition rounds; unlike `f64::round`, in every instruction set.
        let big = Self::splat(6_755_399_441_055_744.0);
        (self + big) - big
    }

    /// The largest whole number that is not above, for numbers below 2^51.
    #[must_use]
    #[inline(always)]
    pub fn floor(self) -> Self {
        let near = self.rounded();
        near - (near - self).choose(Self::splat(1.0), Self::splat(0.0))
    }

    /// Square root.
    #[must_use]
    #[inline(always)]
    pub fn sqrt(self) -> Self {
        let mut out = self;
        for value in &mut out.0 {
            *value = value.sqrt();
        }
        out
    }

    /// `c[0] + self c[1] + self^2 c[2] + ...`
    #[inline(always)]
    fn polynomial<const N: usize>(self, c: [f64; N]) -> Self {
        // Even and odd powers apart: two chains of half the length, side by side.
        let square = self * self;
        let mut sums = [Self::splat(0.0); 2];
        for k in (0..N).rev() {
            sums[k % 2] = sums[k % 2] * square + Self::splat(c[k]);
        }
        sums[0] + sums[1] * self
    }

    /// Sine and cosine, within an ulp or two for arguments up to a few hundred (coefficients: fdlibm).
    #[must_use]
    #[inline(always)]
    pub fn sin_cos(self) -> (Self, Self) {
        let quarters = (self * Self::splat(std::f64::consts::FRAC_2_PI)).rounded();
        // pi/2 in two parts, the first with zeros at its end, so that the product with a small number is exact.
        let r =
            self - quarters * Self::splat(1.570_796_326_734_125_6) - quarters * Self::splat(6.077_100_506_506_192e-11);
        let z = r * r;
        let sin = r + r
            * z
            * z.polynomial([
                -1.666_666_666_666_663_2e-1,
                8.333_333_333_322_49e-3,
                -1.984_126_982_985_795e-4,
                2.755_731_370_707_006_8e-6,
                -2.505_076_025_340_686_3e-8,
                1.589_690_995_211_55e-10,
            ]);
        let cos = Self::splat(1.0) - z * Self::splat(0.5)
            + z * z
                * z.polynomial([
                    4.166_666_666_666_66e-2,
                    -1.388_888_888_887_411e-3,
                    2.480_158_728_947_673e-5,
                    -2.755_731_435_139_066_3e-7,
                    2.087_572_321_298_175e-9,
                    -1.135_964_755_778_819_5e-11,
                ]);
        // quarters modulo 4: 0 (sin, cos), 1 (cos, -sin), 2 (-sin, -cos), 3 (-cos, sin).
        let quarter = quarters - (quarters * Self::splat(0.25)).floor() * Self::splat(4.0);
        let half = (quarter * Self::splat(0.5)).floor();
        let odd = quarter - half * Self::splat(2.0);
        let (s, c) = (odd.choose(cos, sin), odd.choose(sin, cos));
        let turned = half.choose(Self::splat(-1.0), Self::splat(1.0));
        let against = (odd - half).abs().choose(Self::splat(-1.0), Self::splat(1.0));
        (turned * s, against * c)
    }

    /// `e^x`, within two ulps for arguments between -700 and 700.
    #[must_use]
    #[inline(always)]
    pub fn exp(self) -> Self {
        let doublings = (self * Self::splat(std::f64::consts::LOG2_E)).rounded();
        let r = self
            - doublings * Self::splat(6.931_471_803_691_238e-1)
            - doublings * Self::splat(1.908_214_929_270_587_7e-10);
        let series = r.polynomial([
            1.0,
            1.0,
            1.0 / 2.0,
            1.0 / 6.0,
            1.0 / 24.0,
            1.0 / 120.0,
            1.0 / 720.0,
            1.0 / 5_040.0,
            1.0 / 40_320.0,
            1.0 / 362_880.0,
            1.0 / 3_628_800.0,
            1.0 / 39_916_800.0,
            1.0 / 479_001_600.0,
            1.0 / 6_227_020_800.0,
        ]);
        // 2^k by its bits: added to this number, k + 1023 ends up in the lowest ones.
        let big = Self::splat(6_755_399_441_055_744.0 + 1023.0);
        let mut power = doublings + big;
        for value in &mut power.0 {
            *value = f64::from_bits(value.to_bits() << 52);
        }
        series * power
    }

    /// Natural logarithm of positive normal numbers, within two ulps.
    #[must_use]
    #[inline(always)]
    pub fn ln(self) -> Self {
        const HIDDEN: u64 = 0x000f_ffff_ffff_ffff;
        // x = 2^k m with m in [sqrt(1/2), sqrt(2)).
        let (mut above, mut exponent) = (self, self);
        for (above, exponent) in above.0.iter_mut().zip(&mut exponent.0) {
            let bits = above.to_bits();
            *above = f64::from_bits((bits & HIDDEN) | 1.0_f64.to_bits());
            *exponent = f64::from_bits((bits >> 52) | 4_503_599_627_370_496.0_f64.to_bits());
        }
        let large = above - Self::splat(std::f64::consts::SQRT_2);
        let m = large.choose(above * Self::splat(0.5), above);
        let k =
            exponent - Self::splat(4_503_599_627_370_496.0 + 1023.0) + large.choose(Self::splat(1.0), Self::splat(0.0));
        // ln m = 2 artanh(s), s = (m - 1)/(m + 1); coefficients and order of summation of fdlibm.
        let f = m - Self::splat(1.0);
        let s = f / (Self::splat(2.0) + f);
        let z = s * s;
        let rest = z * z.polynomial([
            6.666_666_666_666_735e-1,
            3.999_999_999_940_942e-1,
            2.857_142_874_366_239e-1,
            2.222_219_843_214_978_4e-1,
            1.818_357_216_161_805e-1,
            1.531_383_769_920_937_3e-1,
            1.479_819_860_511_658_6e-1,
        ]);
        let half_square = f * f * Self::splat(0.5);
        k * Self::splat(6.931_471_803_691_238e-1)
            - ((half_square - (s * (half_square + rest) + k * Self::splat(1.908_214_929_270_587_7e-10))) - f)
    }

    /// Without its sign.
    #[must_use]
    #[inline(always)]
    pub fn abs(self) -> Self {
        let mut out = self;
        for value in &mut out.0 {
            *value = value.abs();
        }
        out
    }

    /// The larger of two, lane by lane; `other` where `self` is no number.
    #[must_use]
    #[inline(always)]
    pub fn larger(self, other: Self) -> Self {
        let mut out = self;
        for (value, other) in out.0.iter_mut().zip(&other.0) {
            *value = if *value > *other { *value } else { *other };
        }
        out
    }

    /// Whether no lane is above a limit; false where one is no number.
    #[must_use]
    #[inline(always)]
    pub fn all_within(self, limit: f64) -> bool {
        self.0.iter().fold(true, |all, v| all & (*v <= limit))
    }
}

// Written out: kernels would hold thousands of loops, and unrolling them is what the compiler would spend most of a build
// on. What chooses stays a loop: there it finds better vector instructions.
macro_rules! arithmetic {
    ($($trait:ident $function:ident $operator:tt),+) => {
        $(
            #[allow(clippy::inline_always)]
            impl $trait for Lanes {
                type Output = Self;
                #[inline(always)]
                fn $function(self, Self(b): Self) -> Self {
                    let Self(a) = self;
                    Self([
                        a[0] $operator b[0],
                        a[1] $operator b[1],
                        a[2] $operator b[2],
                        a[3] $operator b[3],
                        a[4] $operator b[4],
                        a[5] $operator b[5],
                        a[6] $operator b[6],
                        a[7] $operator b[7],
                    ])
                }
            }
        )+
    };
}
arithmetic!(Add add +, Sub sub -, Mul mul *, Div div /);

/// The equations of a model for a batch of members, in the form that a kernel can repeat quickly: what does not change
/// over a window, and what belongs to a moment of it, are worked out once.
///
/// Functions without `self` are called within loops and have to be `#[inline(always)]`.
pub trait LaneModel: Copy + fmt::Debug + Send + Sync {
    /// A state of every member, `[Lanes; n_states]`.
    type State: Copy + AsRef<[Lanes]> + AsMut<[Lanes]> + Default;
    /// What does not change over a window.
    type Fixed: Copy + Send + Sync;
    /// What depends on the time only.
    type Moment: Copy + Default + Send + Sync;
    /// What a moment comes from.
    type Instant: Copy + Default;
    /// What `df/dx` depends on beside the time.
    type Tangent: Copy + Default;
    /// See [`LaneModel::relaxation`].
    type Relaxation: Copy + Default;

    /// From the parameters of every member, `[n_parameters]`; None where these equations are not those of the model.
    fn fixed(&self, theta: &[Lanes]) -> Option<Self::Fixed>;

    /// After one of the parameters has changed.
    fn change(&self, fixed: &mut Self::Fixed, theta: &[Lanes], parameter: usize);

    /// At `t_s` after the start of the window.
    fn instant(fixed: &Self::Fixed, t_s: f64) -> Self::Instant;

    /// What equations need of it.
    fn moment(fixed: &Self::Fixed, instant: &Self::Instant) -> Self::Moment;

    /// Derivative of [`LaneModel::moment`] by a parameter for which [`LaneModel::is_timed`].
    fn moment_by(
        &self,
        fixed: &Self::Fixed,
        at: (f64, &Self::Instant),
        theta: &[Lanes],
        parameter: usize,
    ) -> Self::Moment;

    /// Whether moments depend on a parameter.
    fn is_timed(parameter: usize) -> bool;

    /// Whether [`LaneModel::push`] knows what a parameter does.
    fn knows(&self, parameter: usize) -> bool;

    /// `f(t, x, theta)`, and where the derivative is taken.
    fn linearise(fixed: &Self::Fixed, moment: &Self::Moment, x: &Self::State) -> (Self::State, Self::Tangent);

    /// `(df/dx)^T dual`
    fn pull(fixed: &Self::Fixed, moment: &Self::Moment, tangent: &Self::Tangent, dual: &Self::State) -> Self::State;

    /// An approximation of `(I - phi df/dx)^-1`: the better, the faster sweeps converge; their result does not depend on
    /// it. Into a place, since it is too large to be moved about.
    fn relaxation(
        fixed: &Self::Fixed,
        moment: &Self::Moment,
        tangent: &Self::Tangent,
        phi: Lanes,
        out: &mut Self::Relaxation,
    );

    /// The relaxation, or its transpose, times a residual.
    fn relax(relaxation: &Self::Relaxation, residual: &Self::State, transposed: bool) -> Self::State;

    /// Whether one relaxation does for both.
    fn is_alike(a: &Self::Tangent, b: &Self::Tangent) -> bool;

    /// `dual^T df/dtheta_p`, from a moment and its derivative if it has one.
    fn push(
        fixed: &Self::Fixed,
        moment: (&Self::Moment, Option<&Self::Moment>),
        x: &Self::State,
        dual: &Self::State,
        parameter: usize,
    ) -> Lanes;

    /// Derived quantities at a moment, `[n_derived]`.
    fn derive(at: (&Self::Fixed, &Self::Moment), x: &Self::State, theta: &[Lanes], out: &mut [Lanes]);

    /// [`super::Model::advance`], by each lane's own time.
    fn advance(&self, dt_s: f64, theta: &mut [Lanes]);
}

/// Of models that have no equations for lanes.
#[derive(Debug, Clone, Copy)]
pub struct NoLanes;

impl LaneModel for NoLanes {
    type State = [Lanes; 0];
    type Fixed = ();
    type Moment = ();
    type Instant = ();
    type Tangent = ();
    type Relaxation = ();

    fn fixed(&self, _: &[Lanes]) -> Option<()> {
        None
    }

    fn change(&self, (): &mut (), _: &[Lanes], _: usize) {}

    fn instant((): &(), _: f64) {}

    fn moment((): &(), (): &()) {}

    fn moment_by(&self, (): &(), _: (f64, &()), _: &[Lanes], _: usize) {}

    fn is_timed(_: usize) -> bool {
        false
    }

    fn knows(&self, _: usize) -> bool {
        false
    }

    fn linearise((): &(), (): &(), x: &Self::State) -> (Self::State, ()) {
        (*x, ())
    }

    fn pull((): &(), (): &(), (): &(), dual: &Self::State) -> Self::State {
        *dual
    }

    fn relaxation((): &(), (): &(), (): &(), _: Lanes, (): &mut ()) {}

    fn relax((): &(), residual: &Self::State, _: bool) -> Self::State {
        *residual
    }

    fn is_alike((): &(), (): &()) -> bool {
        true
    }

    fn push((): &(), _: (&(), Option<&()>), _: &Self::State, _: &Self::State, _: usize) -> Lanes {
        Lanes::default()
    }

    fn derive(_: (&(), &()), _: &Self::State, _: &[Lanes], _: &mut [Lanes]) {}

    fn advance(&self, _: f64, _: &mut [Lanes]) {}
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
    fn functions_agree_with_those_of_the_library() {
        let close = |found: Lanes, expected: Lanes, ulps: f64| {
            for (a, b) in found.0.iter().zip(expected.0) {
                assert!((a - b).abs() <= ulps * f64::EPSILON * b.abs().max(1e-3), "{a} {b}");
            }
        };
        for step in -40_000..40_000_i32 {
            let x = Lanes(std::array::from_fn(|lane| f64::from(step) * 1e-3 + 1.3e-4 * lane as f64));
            let (sin, cos) = x.sin_cos();
            close(sin, x.map(f64::sin), 4.0);
            close(cos, x.map(f64::cos), 4.0);
            close(x.exp(), x.map(f64::exp), 4.0);
            close(x.exp().ln(), x.exp().map(f64::ln), 2.0);
            assert_eq!(x.floor(), x.map(f64::floor));
        }
        for x in [1.0, 2.0, 0.5, 1e-300, 1e300, std::f64::consts::SQRT_2, 0.999_999_999, 1.000_000_001] {
            close(Lanes::splat(x).ln(), Lanes::splat(f64::ln(x)), 2.0);
        }
    }

    #[test]
    fn portable_is_always_there() {
        assert!(InstructionSet::Portable.is_available());
        assert!(InstructionSet::best().is_available());
    }
}
