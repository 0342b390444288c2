//! WFDB out: a header beside one file of samples in format 16, pressures in mmHg.
//!
//! A unit of the ADC is 0.01 mmHg where the range allows it (655 mmHg, wherever it lies), else the finest step of three
//! digits that does; the header says which as `GAIN(BASELINE)/mmHg`. A missing sample is the invalid value of the
//! format, -32768. A record whose first sample is not at event time 0 says when it was in a comment,
//! `# hemostream_start_ns: N`, which [`wfdb`](super::wfdb) reads back; other readers begin at 0.

use std::fmt::Write as _;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use super::error::FileError;
use super::grid::{Grid, MAX_PLACES};
use super::wfdb::START_COMMENT;
use super::whole::WholeFile;

/// ADC units per mmHg where the range allows it.
const FINE_GAIN: f64 = 100.0;
/// Largest value of format 16; the smallest is its negative, as -32768 marks what is missing.
const MAX_ADC: f64 = 32_767.0;
/// Steps between the two, less one for rounding at either end.
const STEPS: f64 = 2.0 * MAX_ADC - 2.0;
/// Stands for a missing sample.
const MISSING: i16 = i16::MIN;

/// A signal before it is written.
#[derive(Debug, Clone, PartialEq)]
pub struct SignalRange {
    /// What the header calls it.
    pub label: String,
    /// Smallest and largest value \[mmHg\]; None if there is none.
    pub range: Option<(f64, f64)>,
}

/// How numbers become integers.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Calibration {
    gain: f64,
    baseline: i32,
}

impl Calibration {
    /// None if no baseline of 32 bits reaches the range.
    fn of(range: Option<(f64, f64)>) -> Option<Self> {
        let (low, high) = range.unwrap_or((0.0, 0.0));
        if low.abs().max(high.abs()) * FINE_GAIN <= MAX_ADC {
            return Some(Self { gain: FINE_GAIN, baseline: 0 });
        }
        // In halves, which do not overflow.
        let (middle, half) = (low / 2.0 + high / 2.0, high / 2.0 - low / 2.0);
        let gain = if half * FINE_GAIN <= STEPS / 2.0 { FINE_GAIN } else { three_digits_down(STEPS / 2.0 / half) };
        let baseline = -(middle * gain).round();
        let fits = gain > 0.0 && baseline.abs() < f64::from(i32::MAX);
        #[allow(clippy::cast_possible_truncation)]
        fits.then_some(Self { gain, baseline: baseline as i32 })
    }

    /// None if the value is out of range.
    #[allow(clippy::cast_possible_truncation)]
    fn adc(self, value: f64) -> Option<i16> {
        let adc = (value * self.gain).round() + f64::from(self.baseline);
        (adc.abs() <= MAX_ADC).then_some(adc as i16)
    }
}

fn three_digits_down(value: f64) -> f64 {
    if !value.is_normal() {
        return 0.0;
    }
    let unit = 10_f64.powf(value.log10().floor() - 2.0);
    // Through text, so that the header and the samples use one number.
    format!("{:.2e}", (value / unit).floor() * unit).parse().unwrap_or(0.0)
}

struct Channel {
    label: String,
    calibration: Calibration,
    first: i16,
    checksum: i16,
}

/// Name of the record whose header this path is, with or without its ending; empty if it has none.
fn name_of(path: &Path) -> String {
    let stem = if path.extension().is_some_and(|e| e == "hea") { path.file_stem() } else { path.file_name() };
    stem.map(|s| s.to_string_lossy().into_owned()).unwrap_or_default()
}

/// Header and file of samples of the record that is written to a path.
pub(super) fn files(path: &Path) -> [PathBuf; 2] {
    let name = name_of(path);
    ["hea", "dat"].map(|ending| path.with_file_name(format!("{name}.{ending}")))
}

/// Writes a record frame by frame. The header has its name last, so that it never stands beside half a file.
pub struct WfdbWriter {
    header: PathBuf,
    name: String,
    samples: BufWriter<WholeFile>,
    channels: Vec<Channel>,
    grid: Grid,
    frames: u64,
}

impl WfdbWriter {
    /// Begins a record; `path` is that of the header, with or without its ending.
    ///
    /// # Errors
    /// When the name is none that WFDB allows, a range is beyond it, or the files cannot be written.
    pub fn create(path: &Path, signals: &[SignalRange], grid: Grid) -> Result<Self, FileError> {
        let name = name_of(path);
        let allowed = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
        if name.is_empty() || !name.chars().all(allowed) {
            let expected = "letters, digits, `_` and `-`, as the name of a WFDB record";
            return Err(FileError::content(path, None, format!("`{name}`"), expected));
        }
        let channel = |signal: &SignalRange| {
            let calibration = Calibration::of(signal.range).ok_or_else(|| {
                let (low, high) = signal.range.unwrap_or_default();
                let found = format!("{} from {low} to {high} mmHg", signal.label);
                FileError::content(path, None, found, "a range that format 16 reaches")
            })?;
            Ok(Channel { label: signal.label.clone(), calibration, first: 0, checksum: 0 })
        };
        let channels = signals.iter().map(channel).collect::<Result<_, _>>()?;
        let [header, samples] = files(path);
        let samples = BufWriter::new(WholeFile::create(&samples)?);
        Ok(Self { header, name, samples, channels, grid, frames: 0 })
    }

    /// Adds a frame: a value per signal \[mmHg\], where there is one.
    ///
    /// # Errors
    /// When a value is outside the range that was said, or the file cannot be written.
    pub fn frame(&mut self, values: &[Option<f64>]) -> Result<(), FileError> {
        if self.frames >= MAX_PLACES {
            return Err(FileError::content(&self.header, None, "more samples", &format!("at most {MAX_PLACES}")));
        }
        for (channel, value) in self.channels.iter_mut().zip(values) {
            let adc = match value {
                None => MISSING,
                Some(value) => channel.calibration.adc(*value).ok_or_else(|| {
                    let found = format!("{} of {value} mmHg", channel.label);
                    FileError::content(&self.header, None, found, "a value within the range of the record")
                })?,
            };
            if self.frames == 0 {
                channel.first = adc;
            }
            channel.checksum = channel.checksum.wrapping_add(adc);
            self.samples.write_all(&adc.to_le_bytes()).map_err(|e| FileError::file(&self.header, &e))?;
        }
        self.frames += 1;
        Ok(())
    }

    /// Writes the header and gives the files their names.
    ///
    /// # Errors
    /// When they cannot be written.
    pub fn finish(self) -> Result<(), FileError> {
        let header = self.header_text();
        let samples = self.samples.into_inner().map_err(|e| FileError::file(&self.header, &e))?;
        let mut file = WholeFile::create(&self.header)?;
        file.write_all(header.as_bytes()).map_err(|e| FileError::file(&self.header, &e))?;
        samples.finish()?;
        file.finish()?;
        Ok(())
    }

    fn header_text(&self) -> String {
        let Self { name, channels, grid, frames, .. } = self;
        let mut text = format!("{name} {} {} {frames}\n", channels.len(), grid.rate_hz);
        for Channel { label, calibration: Calibration { gain, baseline }, first, checksum } in channels {
            // Writing to a string cannot fail.
            let _ = writeln!(text, "{name}.dat 16 {gain}({baseline})/mmHg 16 0 {first} {checksum} 0 {label}");
        }
        if grid.start.0 != 0 {
            let _ = writeln!(text, "# {START_COMMENT} {}", grid.start.0);
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::edge::files::wfdb::Record;
    use crate::estimate::time::EventTime;

    fn written(range: (f64, f64), values: &[Option<f64>]) -> (String, Vec<f64>, i64) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("some_record.hea");
        let signals = [SignalRange { label: "ABP left".to_owned(), range: Some(range) }];
        let grid = Grid { start: EventTime(-1_500_000_001), rate_hz: 62.5 };
        let mut writer = WfdbWriter::create(&path, &signals, grid).unwrap();
        values.iter().for_each(|value| writer.frame(&[*value]).unwrap());
        writer.finish().unwrap();
        let record = Record::open(&path).unwrap();
        assert_eq!((record.signals[0].name.as_str(), record.signals[0].units.as_str()), ("ABP left", "mmHg"));
        (std::fs::read_to_string(&path).unwrap(), record.samples(0).unwrap(), record.start_ns)
    }

    #[test]
    fn pressures_are_kept_to_a_hundredth_wherever_their_range_lies() {
        for (low, high, gain) in [
            (0.0, 200.0, "100(0)"),
            (-327.67, 327.67, "100(0)"),
            (100.0, 700.0, "100(-40000)"),
            (-20.0, 400.0, "100(-19000)"),
            (-10.0, 990.0, "65.5(-32095)"),
            (0.0, 1e6, "0.0655(-32750)"),
        ] {
            let values: Vec<Option<f64>> = (0..=100).map(|i| Some(low + (high - low) * f64::from(i) / 100.0)).collect();
            let (header, read, _) = written((low, high), &values);
            assert!(header.contains(&format!(" 16 {gain}/mmHg 16 0 ")), "{low} to {high}: {header}");
            let half_step = 0.5 / gain.split('(').next().unwrap().parse::<f64>().unwrap();
            for (value, read) in values.iter().zip(&read) {
                assert!((value.unwrap() - read).abs() <= half_step * 1.000_001, "{value:?} {read}");
            }
        }
        assert_eq!(Calibration::of(Some((1e12, 1e12 + 1.0))), None);
    }

    #[test]
    fn missing_samples_and_the_start_come_back() {
        let (header, read, start_ns) = written((80.0, 80.0), &[None, Some(80.0), None]);
        assert_eq!(
            header,
            "some_record 1 62.5 3\nsome_record.dat 16 100(0)/mmHg 16 0 -32768 8000 0 ABP left\n\
             # hemostream_start_ns: -1500000001\n"
        );
        assert!(read[0].is_nan() && (read[1] - 80.0).abs() < 1e-12 && read[2].is_nan());
        assert_eq!(start_ns, -1_500_000_001);
    }

    #[test]
    fn names_and_values_that_do_not_fit_are_refused_and_leave_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let grid = Grid { start: EventTime(0), rate_hz: 125.0 };
        let signals = [SignalRange { label: "ABP".to_owned(), range: Some((0.0, 1.0)) }];
        for name in ["a b.hea", "ä"] {
            let error = WfdbWriter::create(&folder.path().join(name), &signals, grid).err().unwrap().to_string();
            assert!(error.contains("the name of a WFDB record"), "{error}");
        }
        let mut writer = WfdbWriter::create(&folder.path().join("r"), &signals, grid).unwrap();
        let error = writer.frame(&[Some(400.0)]).unwrap_err().to_string();
        assert!(error.contains("found ABP of 400 mmHg"), "{error}");
        drop(writer);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    }
}
