//! Ranges, ticks and their labels.

/// Values beyond are as good as infinite; keeps differences finite.
const HUGE: f64 = 1e300;

/// A range of values laid out from 0 to 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Axis {
    /// Ends; of the decimal logarithm on a log axis.
    low: f64,
    high: f64,
    log: bool,
}

/// A mark on an axis.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Tick {
    /// Between 0 and 1.
    pub(super) at: f64,
    /// Empty between the main ticks of a log axis.
    pub(super) label: String,
}

impl Axis {
    /// Covers `given`, or else `values` and `margin` (a fraction of their span) on both sides.
    pub(super) fn fit(values: &[f64], given: Option<(f64, f64)>, log: bool, margin: f64) -> Self {
        let unit = Self { low: 0.0, high: 1.0, log };
        if let Some((low, high)) = given.map(|(low, high)| (unit.scaled(low), unit.scaled(high)))
            && high - low > 0.0
        {
            return Self { low, high, log };
        }
        let usable = values.iter().map(|&v| unit.scaled(v)).filter(|v| v.is_finite());
        let (low, high) = usable.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
        if low > high {
            return unit;
        }
        let size = low.abs().max(high.abs());
        let pad = match high - low {
            span if span > 1e-12 * size && span > 1e-290 => margin * span,
            _ if log || size < 1e-290 => 0.5,
            _ => 0.1 * size,
        };
        Self { low: low - pad, high: high + pad, log }
    }

    fn scaled(&self, value: f64) -> f64 {
        match value {
            v if v.is_nan() || v.abs() > HUGE || (self.log && v <= 0.0) => f64::NAN,
            v if self.log => v.log10(),
            v => v,
        }
    }

    /// Where `value` lies: 0 at the low end, 1 at the high end, NaN if it cannot be shown.
    pub(super) fn place(&self, value: f64) -> f64 {
        // Far outside nothing is seen, but the geometry must stay in range.
        ((self.scaled(value) - self.low) / (self.high - self.low)).clamp(-1e3, 1e3)
    }

    /// About `most` labelled ticks or fewer.
    pub(super) fn ticks(&self, most: usize) -> Vec<Tick> {
        if !self.log {
            return self.linear_ticks(self.low, self.high, most);
        }
        let ticks = self.log_ticks(most);
        if ticks.iter().filter(|tick| !tick.label.is_empty()).count() >= 2 {
            return ticks;
        }
        self.linear_ticks(10f64.powf(self.low), 10f64.powf(self.high), most)
    }

    /// Multiples of 1, 2 or 5 times a power of ten between two values.
    fn linear_ticks(&self, low: f64, high: f64, most: usize) -> Vec<Tick> {
        let least = (high - low) / most.max(1) as f64;
        let power = least.log10().floor() as i32;
        let steps = [(1, power), (2, power), (5, power), (1, power + 1)];
        let size = |(digit, power): (i32, i32)| f64::from(digit) * 10f64.powi(power);
        let chosen = steps.into_iter().find(|&step| size(step) >= least * (1.0 - 1e-9)).unwrap_or(steps[3]);
        let (step, power) = (size(chosen), chosen.1);
        let largest = low.abs().max(high.abs());
        let (first, last) = ((low / step - 1e-9).ceil(), (high / step + 1e-9).floor());
        let count = (last - first).clamp(-1.0, 2.0 * most as f64) as i64;
        (0..=count)
            .map(|i| (first + i as f64) * step)
            .map(|v| Tick { at: self.place(v), label: number(v, power, largest) })
            .filter(|tick| (-0.001..=1.001).contains(&tick.at))
            .collect()
    }

    /// Powers of ten, and 2 and 5 times those if there is room; the rest without label.
    fn log_ticks(&self, most: usize) -> Vec<Tick> {
        let (first, last) = (self.low.floor() as i32, self.high.ceil() as i32);
        let stride = ((self.high - self.low) / most.max(1) as f64).ceil().max(1.0) as i32;
        let few = self.high - self.low < 2.0;
        let plain = self.low > -3.5 && self.high < 4.5;
        let digits: &[i32] = if self.high - self.low > 5.0 { &[1] } else { &[1, 2, 3, 4, 5, 6, 7, 8, 9] };
        let candidates = (first..=last).flat_map(|power| digits.iter().map(move |&digit| (digit, power)));
        candidates
            .map(|(digit, power)| {
                let labelled = if digit == 1 { power % stride == 0 } else { few && (digit == 2 || digit == 5) };
                let value = f64::from(digit) * 10f64.powi(power);
                let at = (f64::from(digit).log10() + f64::from(power) - self.low) / (self.high - self.low);
                let label = match digit {
                    _ if !labelled => String::new(),
                    _ if plain => decimal(value, usize::try_from(-power).unwrap_or(0)),
                    1 => format!("10{}", superscript(power)),
                    _ => format!("{digit}×10{}", superscript(power)),
                };
                Tick { at, label }
            })
            .filter(|tick| (-0.001..=1.001).contains(&tick.at))
            .collect()
    }
}

/// `value`, a multiple of `10^power`, on an axis that reaches `largest`.
fn number(value: f64, power: i32, largest: f64) -> String {
    let scale = largest.log10().floor() as i32;
    // Large numbers that differ in the last digits only are shorter in full.
    if (-3..=5).contains(&scale) || (scale > 5 && scale - power > 4) {
        return decimal(value, usize::try_from(-power).unwrap_or(0));
    }
    let mantissa = decimal(value / 10f64.powi(scale), usize::try_from(scale - power).unwrap_or(0));
    if value.abs() < 0.5 * 10f64.powi(power) { "0".to_owned() } else { format!("{mantissa}×10{}", superscript(scale)) }
}

/// With a true minus sign, and none before zero.
pub(super) fn decimal(value: f64, digits: usize) -> String {
    let text = format!("{value:.digits$}");
    match text.strip_prefix('-') {
        Some(zero) if zero.chars().all(|c| c == '0' || c == '.') => zero.to_owned(),
        Some(positive) => format!("−{positive}"),
        None => text,
    }
}

fn superscript(power: i32) -> String {
    let raised = ['⁰', '¹', '²', '³', '⁴', '⁵', '⁶', '⁷', '⁸', '⁹'];
    power.to_string().chars().map(|c| c.to_digit(10).map_or('⁻', |digit| raised[digit as usize])).collect()
}
