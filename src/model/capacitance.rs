//! Time-varying capacitance of a ventricle, with every derivative the solver needs.
//!
//! Elastance `E = 1/C` over a beat (Davis 1991), `tr` the time since the beat began, `Ts` the systolic time:
//!
//! ```text
//! E = 1/C_dia + (1/C_sys - 1/C_dia)/2 * a(tr)
//! a = 1 - cos(pi tr/Ts)              0 < tr <= Ts
//!     1 + cos(2 pi (tr - Ts)/Ts)    Ts < tr <= 1.5 Ts
//!     0                              otherwise
//! ```

use std::f64::consts::PI;

/// Activation `a(tr, Ts)` and its partial derivatives.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Activation {
    /// `a`, between 0 and 2.
    pub value: f64,
    /// `da/dtr`.
    pub d_t: f64,
    /// `d2a/dtr2`.
    pub d_tt: f64,
    /// `da/dTs`.
    pub d_ts: f64,
    /// `d2a/(dtr dTs)`.
    pub d_t_ts: f64,
}

impl Activation {
    /// Evaluates the activation at `time_in_beat_s` for a systolic time of `systole_s`.
    #[must_use]
    pub fn at(time_in_beat_s: f64, systole_s: f64) -> Self {
        let (tr, ts) = (time_in_beat_s, systole_s);
        if tr <= 0.0 || tr > 1.5 * ts {
            return Self { value: 0.0, d_t: 0.0, d_tt: 0.0, d_ts: 0.0, d_t_ts: 0.0 };
        }
        // Both branches are 1 -+ cos(u) with u = k tr + const, k proportional to 1/Ts.
        let (sign, k) = if tr <= ts { (-1.0, PI / ts) } else { (1.0, 2.0 * PI / ts) };
        let u = k * tr - if tr <= ts { 0.0 } else { 2.0 * PI };
        let (sin, cos) = u.sin_cos();
        let u_ts = -k * tr / ts;
        let k_ts = -k / ts;
        Self {
            value: 1.0 + sign * cos,
            d_t: -sign * k * sin,
            d_tt: -sign * k * k * cos,
            d_ts: -sign * u_ts * sin,
            d_t_ts: -sign * (k_ts * sin + k * u_ts * cos),
        }
    }
}

/// A value and its time derivative.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ValueAndRate {
    /// The value \[mL/mmHg\] or its partial derivative.
    pub value: f64,
    /// Its derivative in time.
    pub rate: f64,
}

/// Capacitance `C(t)` of one ventricle from its activation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Capacitance {
    activation: Activation,
    diastolic: f64,
    systolic: f64,
    elastance: f64,
    elastance_rate: f64,
}

impl Capacitance {
    /// Capacitance between `diastolic` and `systolic` \[mL/mmHg\].
    #[must_use]
    pub fn new(activation: Activation, diastolic: f64, systolic: f64) -> Self {
        let half_swing = 0.5 * (1.0 / systolic - 1.0 / diastolic);
        Self {
            activation,
            diastolic,
            systolic,
            elastance: 1.0 / diastolic + half_swing * activation.value,
            elastance_rate: half_swing * activation.d_t,
        }
    }

    /// `C` \[mL/mmHg\] and `dC/dt` \[mL/(mmHg s)\].
    #[must_use]
    pub fn value_and_rate(&self) -> ValueAndRate {
        let value = 1.0 / self.elastance;
        ValueAndRate { value, rate: -self.elastance_rate * value * value }
    }

    /// Partial derivatives of `C` and `dC/dt` by the diastolic capacitance.
    #[must_use]
    pub fn by_diastolic(&self) -> ValueAndRate {
        let s = 1.0 / (self.diastolic * self.diastolic);
        self.chain(-s * (1.0 - 0.5 * self.activation.value), 0.5 * s * self.activation.d_t)
    }

    /// Partial derivatives of `C` and `dC/dt` by the systolic capacitance.
    #[must_use]
    pub fn by_systolic(&self) -> ValueAndRate {
        let s = 1.0 / (self.systolic * self.systolic);
        self.chain(-0.5 * s * self.activation.value, -0.5 * s * self.activation.d_t)
    }

    /// Partial derivatives of `C` and `dC/dt` by the time in the beat.
    #[must_use]
    pub fn by_time(&self) -> ValueAndRate {
        let half_swing = 0.5 * (1.0 / self.systolic - 1.0 / self.diastolic);
        self.chain(half_swing * self.activation.d_t, half_swing * self.activation.d_tt)
    }

    /// Partial derivatives of `C` and `dC/dt` by the systolic time.
    #[must_use]
    pub fn by_systolic_time(&self) -> ValueAndRate {
        let half_swing = 0.5 * (1.0 / self.systolic - 1.0 / self.diastolic);
        self.chain(half_swing * self.activation.d_ts, half_swing * self.activation.d_t_ts)
    }

    /// From `(dE/dp, d2E/(dt dp))` to `(dC/dp, d2C/(dt dp))` with `C = 1/E`, `dC/dt = -E'/E^2`.
    fn chain(&self, e_p: f64, e_tp: f64) -> ValueAndRate {
        let c = 1.0 / self.elastance;
        ValueAndRate { value: -e_p * c * c, rate: -e_tp * c * c + 2.0 * self.elastance_rate * e_p * c * c * c }
    }
}
