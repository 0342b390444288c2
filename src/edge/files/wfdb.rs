//! WFDB: recorded waveforms as PhysioNet keeps them, a header in text beside files of samples.
//!
//! Read are ordinary records and records of several segments, of fixed or variable layout, stored in format 16, 61,
//! 80 or 212 (<https://wfdb.io/spec>, <https://physionet.org/physiotools/wag/header-5.htm>). Every signal comes at its
//! own rate: with `k` samples per frame, sample `j` is at `j / (k * frame rate)`, and nothing is averaged.
//!
//! Where readers differ:
//! - Checksums are verified in every segment; the C library skips them where there are several, the Python package
//!   has none. Like theirs, ours sum what is stored, with the marks of missing samples and what a skew cuts off.
//! - A skew counts samples of its signal, as specified; C rounds it to frames, Python takes it for frames.
//! - A record without signals, a file whose signals are scattered over the header, and names that leave the folder of
//!   the header are refused.
//!
//! Deliberately absent: writing (see [`wfdb_write`](super::wfdb_write)), annotations, differences (format 8), the formats 24, 32, 160, 310, 311 and FLAC (5xx),
//! EDF, search paths and networks. What a name or a unit means is the caller's business.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Component, Path, PathBuf};
use std::sync::Arc;

use super::error::FileError;

/// Longest header \[bytes\]; a segment takes about 20.
const MAX_HEADER_BYTES: u64 = 1 << 20;

/// Most samples of one signal, gaps included: 1 GiB, or 12 days at 125 Hz.
const MAX_SAMPLES: usize = 1 << 27;

/// About how much of a signal file is read at a time.
const BLOCK_BYTES: usize = 1 << 16;

/// Frames per second where a header gives none.
const DEFAULT_RATE_HZ: f64 = 250.0;

/// ADC units per physical unit where a header gives none, or 0.
const DEFAULT_GAIN: f64 = 200.0;

const DEFAULT_UNITS: &str = "mV";

/// Begins the comment in which a header of ours says when the first frame was \[ns\].
pub(super) const START_COMMENT: &str = "hemostream_start_ns:";

/// Name of a segment, or of a signal file, that stores nothing.
const NOTHING_STORED: &str = "~";

/// One signal of a record.
#[derive(Debug, Clone, PartialEq)]
pub struct Signal {
    /// Description in the header, such as `ABP`; empty where there is none.
    pub name: String,
    /// Physical units of the samples, as the header writes them.
    pub units: String,
    /// Samples per second.
    pub rate_hz: f64,
    per_frame: usize,
}

/// A record whose headers have been read; samples are read signal by signal.
#[derive(Debug)]
pub struct Record {
    /// In the order of the header.
    pub signals: Vec<Signal>,
    /// Frames per second; a signal has one or more samples in each.
    pub frame_rate_hz: f64,
    /// Length, gaps included.
    pub frames: usize,
    /// Time and date of the first frame, as the header writes them.
    pub start: Option<String>,
    /// Event time of the first frame \[ns\]: what a header of ours says, else 0.
    pub start_ns: i64,
    path: PathBuf,
    /// Whether segments arrange their signals as they like; else all have those of the record, in that order.
    variable: bool,
    segments: Vec<Segment>,
}

#[derive(Debug)]
struct Segment {
    frames: usize,
    /// None for a gap.
    source: Option<Arc<Ordinary>>,
}

impl Record {
    /// Reads the header, and those of the segments. `path` may end in `.hea` or not.
    ///
    /// # Errors
    /// When a header cannot be read or is malformed, or segments do not fit together.
    pub fn open(path: &Path) -> Result<Self, FileError> {
        let path = match path.extension() {
            Some(extension) if extension == "hea" => path.to_owned(),
            _ => with_suffix(path),
        };
        let header = Header::read(&path)?;
        let record = match header.body {
            Body::Signals(ordinary) => Self::ordinary(header.line, ordinary)?,
            Body::Segments(lines) => Self::segmented(path, header.line, &lines)?,
        };
        Ok(Self { start_ns: header.start_ns, ..record })
    }

    fn ordinary(line: RecordLine, source: Ordinary) -> Result<Self, FileError> {
        let frames = if source.frames == 0 { source.stored_frames()? } else { source.frames };
        let rate_hz = line.rate_hz.unwrap_or(DEFAULT_RATE_HZ);
        Ok(Self {
            signals: source.signals(rate_hz),
            frame_rate_hz: rate_hz,
            frames,
            start: line.start,
            start_ns: 0,
            path: source.path.clone(),
            variable: false,
            segments: vec![Segment { frames, source: Some(Arc::new(source)) }],
        })
    }

    fn segmented(path: PathBuf, line: RecordLine, lines: &[SegmentLine]) -> Result<Self, FileError> {
        let rate_hz = line.rate_hz.unwrap_or(DEFAULT_RATE_HZ);
        // A first segment without samples is the layout: it names the signals and stores none.
        let variable = lines.first().is_some_and(|s| s.frames == 0 && s.name.is_some());
        let mut known: BTreeMap<&str, Arc<Ordinary>> = BTreeMap::new();
        let mut segments = Vec::new();
        for segment in lines {
            let source = match &segment.name {
                None => None,
                Some(name) => Some(match known.get(name.as_str()) {
                    Some(source) => Arc::clone(source),
                    None => {
                        let n_signals = Some(line.n_signals).filter(|_| !variable || segments.is_empty());
                        let source = Arc::new(segment.source(&path, name, n_signals, rate_hz)?);
                        known.insert(name, Arc::clone(&source));
                        source
                    }
                }),
            };
            if let Some(source) = source.as_ref().filter(|s| s.frames != segment.frames) {
                let found = format!("a segment of {} frames", segment.frames);
                let expected = format!("{}, as in {}", source.frames, source.path.display());
                return Err(FileError::content(&path, Some(segment.line), found, &expected));
            }
            segments.push(Segment { frames: segment.frames, source });
        }
        let Some(first) = segments.iter().find_map(|s| s.source.clone()) else {
            return Err(FileError::content(&path, Some(line.line), "gaps only", "a segment with signals"));
        };
        let frames = total_frames(&path, &line, lines)?;
        let signals = first.signals(rate_hz);
        Ok(Self { signals, frame_rate_hz: rate_hz, frames, start: line.start, start_ns: 0, path, variable, segments })
    }

    /// Files that it is read from: headers and files of samples, whether they are there or not.
    #[must_use]
    pub fn files(&self) -> BTreeSet<PathBuf> {
        let sources = self.segments.iter().filter_map(|segment| segment.source.as_deref());
        let own = |source: &Ordinary| {
            let stored = source.channels.iter().filter_map(Channel::file).map(|name| source.path.with_file_name(name));
            stored.chain([source.path.clone()]).collect::<Vec<_>>()
        };
        sources.flat_map(own).chain([self.path.clone()]).collect()
    }

    /// All samples of the signal at this place in [`Self::signals`], in its units; NaN where one is missing.
    ///
    /// # Errors
    /// When there is no such signal, its files are missing, too short or damaged, its segments do not fit together,
    /// or it is too long to be held.
    pub fn samples(&self, index: usize) -> Result<Vec<f64>, FileError> {
        let Some(signal) = self.signals.get(index) else {
            let found = format!("no signal at place {index}");
            return Err(FileError::content(&self.path, None, found, &format!("a place below {}", self.signals.len())));
        };
        let n_samples = self.frames.saturating_mul(signal.per_frame);
        if n_samples > MAX_SAMPLES {
            let found = format!("{n_samples} samples of `{}`", signal.name);
            return Err(FileError::content(&self.path, None, found, &format!("at most {MAX_SAMPLES}")));
        }
        let mut values = Vec::new();
        for segment in &self.segments {
            match self.channel(segment, index)? {
                Some((source, channel)) => source.read(channel, segment.frames, &mut values)?,
                None => values.resize(values.len() + segment.frames * signal.per_frame, f64::NAN),
            }
        }
        Ok(values)
    }

    /// Where a segment stores a signal; None for a gap.
    fn channel<'a>(
        &self,
        segment: &'a Segment,
        index: usize,
    ) -> Result<Option<(&'a Ordinary, &'a Channel)>, FileError> {
        let Some(source) = &segment.source else { return Ok(None) };
        let signal = &self.signals[index];
        let same_name = |c: &&Channel| c.name == signal.name;
        let channel = if self.variable {
            let mut channels = source.channels.iter().filter(same_name);
            let (first, second) = (channels.next(), channels.next());
            if let Some(second) = second {
                let found = format!("a second signal `{}`", signal.name);
                let expected = "distinct names where segments differ in their signals";
                return Err(FileError::content(&source.path, Some(second.line), found, expected));
            }
            first
        } else {
            source.channels.get(index)
        };
        let Some(channel) = channel else { return Ok(None) };
        let same_units = channel.units.eq_ignore_ascii_case(&signal.units);
        if !same_name(&channel) || !same_units || channel.per_frame != signal.per_frame {
            let describe =
                |name: &str, units: &str, k: usize| format!("signal `{name}` [{units}], samples per frame: {k}");
            let found = describe(&channel.name, &channel.units, channel.per_frame);
            let expected = describe(&signal.name, &signal.units, signal.per_frame);
            return Err(FileError::content(&source.path, Some(channel.line), found, &format!("{expected}, as before")));
        }
        Ok(Some((source, channel)))
    }
}

/// Sum of the segments, which the record line has to confirm if it gives a length.
fn total_frames(path: &Path, line: &RecordLine, segments: &[SegmentLine]) -> Result<usize, FileError> {
    let sum = segments.iter().try_fold(0_usize, |sum, s| sum.checked_add(s.frames));
    match sum {
        Some(sum) if sum > 0 && (line.frames == 0 || line.frames == sum) => Ok(sum),
        _ => {
            let found = sum.map_or_else(|| "too many frames".to_owned(), |sum| format!("segments of {sum} frames"));
            let expected =
                if line.frames == 0 { "at least one".to_owned() } else { format!("{} in total", line.frames) };
            Err(FileError::content(path, Some(line.line), found, &expected))
        }
    }
}

/// A record of one segment: its signals and where they are stored.
#[derive(Debug)]
struct Ordinary {
    path: PathBuf,
    /// 0: the header does not say.
    frames: usize,
    channels: Vec<Channel>,
}

/// A signal as one segment stores it.
#[derive(Debug)]
struct Channel {
    line: u64,
    name: String,
    units: String,
    /// None where nothing is stored.
    stored: Option<Stored>,
    per_frame: usize,
    /// Samples stored before the first frame.
    skew: usize,
    gain: f64,
    baseline: i64,
    checksum: Option<i64>,
}

impl Channel {
    fn file(&self) -> Option<&str> {
        self.stored.as_ref().map(|s| s.file.as_str())
    }
}

/// Where and how the samples of a signal are stored.
#[derive(Debug)]
struct Stored {
    file: String,
    format: Format,
    /// Bytes before the first frame.
    offset: usize,
    /// Samples of all signals of the file in a frame.
    width: usize,
    /// Samples of the signals before this one in a frame.
    first: usize,
}

impl Ordinary {
    #[allow(clippy::cast_precision_loss)]
    fn signals(&self, frame_rate_hz: f64) -> Vec<Signal> {
        let signal = |c: &Channel| Signal {
            name: c.name.clone(),
            units: c.units.clone(),
            rate_hz: frame_rate_hz * c.per_frame as f64,
            per_frame: c.per_frame,
        };
        self.channels.iter().map(signal).collect()
    }

    /// How many whole frames there are in every file.
    fn stored_frames(&self) -> Result<usize, FileError> {
        let mut shortest: Option<usize> = None;
        for channel in &self.channels {
            let Some(stored) = &channel.stored else { continue };
            let (_, bytes) = self.open(channel, stored)?;
            let frames = stored.format.samples(bytes.saturating_sub(stored.offset)) / stored.width;
            shortest = Some(shortest.map_or(frames, |s| s.min(frames)));
        }
        match shortest {
            Some(frames) if frames > 0 => Ok(frames),
            _ => Err(FileError::content(
                &self.path,
                None,
                "neither a number of samples nor a stored frame",
                "one of them",
            )),
        }
    }

    fn open(&self, channel: &Channel, stored: &Stored) -> Result<(File, usize), FileError> {
        let path = self.path.with_file_name(&stored.file);
        let opened = File::open(path).and_then(|file| file.metadata().map(|data| (file, data.len())));
        let (file, bytes) = opened.map_err(|error| {
            let found = format!("signal file `{}`: {error}", stored.file);
            FileError::content(&self.path, Some(channel.line), found, "a readable file beside the header")
        })?;
        Ok((file, usize::try_from(bytes).unwrap_or(usize::MAX)))
    }

    /// Appends a signal in physical units.
    fn read(&self, channel: &Channel, frames: usize, values: &mut Vec<f64>) -> Result<(), FileError> {
        let start = values.len();
        let end = start + frames * channel.per_frame;
        if let Some(stored) = channel.stored.as_ref().filter(|_| frames > 0) {
            let sum = self.decode(channel, stored, frames, values)?;
            self.verify(channel, stored, sum)?;
            values.drain(start..start + channel.skew.min(end - start));
        }
        values.resize(end, f64::NAN);
        Ok(())
    }

    /// Appends all that is stored of a signal; the sum of its samples.
    #[allow(clippy::cast_precision_loss)]
    fn decode(
        &self,
        channel: &Channel,
        stored: &Stored,
        frames: usize,
        values: &mut Vec<f64>,
    ) -> Result<i64, FileError> {
        let Stored { format, offset, width, first, .. } = *stored;
        let (mut file, bytes) = self.open(channel, stored)?;
        let needed = offset.saturating_add(format.bytes(frames.saturating_mul(width)));
        if bytes < needed {
            let found = format!("signal file `{}` of {bytes} bytes", stored.file);
            let expected = format!("at least {needed}: {frames} frames of {width} samples in format {}", format.code());
            return Err(FileError::content(&self.path, Some(channel.line), found, &expected));
        }
        // From here on every number of the header is bounded by the size of the file.
        let failed = |error| FileError::file(&self.path.with_file_name(&stored.file), &error);
        file.seek(SeekFrom::Start(offset as u64)).map_err(failed)?;
        values.reserve(frames * channel.per_frame);
        // Two frames always fill whole bytes.
        let block_frames = 2 * (BLOCK_BYTES / format.bytes(2 * width)).max(1);
        let mut block = vec![0; format.bytes(block_frames.min(frames) * width)];
        let (baseline, mut sum) = (channel.baseline as f64, 0);
        for begin in (0..frames).step_by(block_frames) {
            let n_frames = block_frames.min(frames - begin);
            let bytes = &mut block[..format.bytes(n_frames * width)];
            file.read_exact(bytes).map_err(failed)?;
            for sample in (0..n_frames).flat_map(|f| f * width + first..f * width + first + channel.per_frame) {
                let adc = i64::from(format.sample(bytes, sample));
                sum += adc;
                let missing = adc == format.missing();
                values.push(if missing { f64::NAN } else { (adc as f64 - baseline) / channel.gain });
            }
        }
        Ok(sum)
    }

    /// Compares the sum of the samples with the header. Without a length there, that sum is of something else.
    fn verify(&self, channel: &Channel, stored: &Stored, sum: i64) -> Result<(), FileError> {
        let Some(expected) = channel.checksum.filter(|_| self.frames > 0).map(low_16_bits) else { return Ok(()) };
        let sum = low_16_bits(sum);
        if sum == expected {
            return Ok(());
        }
        let found = format!("checksum {sum} of `{}` in `{}`", channel.name, stored.file);
        let expected = format!("{expected}: the file is damaged or not the one of this header");
        Err(FileError::content(&self.path, Some(channel.line), found, &expected))
    }
}

#[allow(clippy::cast_possible_truncation)]
fn low_16_bits(sum: i64) -> i16 {
    sum as i16
}

/// How samples are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Format {
    /// Two bytes, the low one first.
    F16,
    /// Two bytes, the high one first.
    F61,
    /// A byte, less 128.
    F80,
    /// Two samples of 12 bits in three bytes: low 8 bits, both high 4 bits (the second's above), low 8 bits.
    F212,
}

impl Format {
    const ALL: [Self; 4] = [Self::F16, Self::F61, Self::F80, Self::F212];

    fn code(self) -> usize {
        match self {
            Self::F16 => 16,
            Self::F61 => 61,
            Self::F80 => 80,
            Self::F212 => 212,
        }
    }

    /// Bytes that hold so many samples; saturates.
    fn bytes(self, samples: usize) -> usize {
        match self {
            Self::F16 | Self::F61 => samples.saturating_mul(2),
            Self::F80 => samples,
            Self::F212 => samples.saturating_add(samples.div_ceil(2)),
        }
    }

    /// Samples that so many bytes hold.
    fn samples(self, bytes: usize) -> usize {
        match self {
            Self::F16 | Self::F61 => bytes / 2,
            Self::F80 => bytes,
            Self::F212 => bytes / 3 * 2 + bytes % 3 / 2,
        }
    }

    fn sample(self, bytes: &[u8], index: usize) -> i16 {
        match self {
            Self::F16 => i16::from_le_bytes([bytes[2 * index], bytes[2 * index + 1]]),
            Self::F61 => i16::from_be_bytes([bytes[2 * index], bytes[2 * index + 1]]),
            Self::F80 => i16::from(bytes[index]) - 128,
            Self::F212 => {
                let middle = index / 2 * 3 + 1;
                let (low, high) = match index % 2 {
                    0 => (bytes[middle - 1], bytes[middle] & 0xf),
                    _ => (bytes[middle + 1], bytes[middle] >> 4),
                };
                // Up by four bits and back: the sign comes along.
                i16::from_be_bytes([high << 4 | low >> 4, low << 4]) >> 4
            }
        }
    }

    /// The lowest value stands for a missing sample.
    fn missing(self) -> i64 {
        match self {
            Self::F16 | Self::F61 => -0x8000,
            Self::F80 => -0x80,
            Self::F212 => -0x800,
        }
    }
}

struct Header {
    line: RecordLine,
    body: Body,
    start_ns: i64,
}

enum Body {
    Signals(Ordinary),
    Segments(Vec<SegmentLine>),
}

impl Header {
    fn read(path: &Path) -> Result<Self, FileError> {
        let mut bytes = Vec::new();
        let opened = File::open(path).and_then(|f| f.take(MAX_HEADER_BYTES + 1).read_to_end(&mut bytes));
        opened.map_err(|error| FileError::file(path, &error))?;
        if bytes.len() as u64 > MAX_HEADER_BYTES {
            return Err(FileError::content(
                path,
                None,
                "a longer file",
                &format!("a header of at most {MAX_HEADER_BYTES} bytes"),
            ));
        }
        Self::parse(path, &String::from_utf8_lossy(&bytes))
    }

    fn parse(path: &Path, text: &str) -> Result<Self, FileError> {
        let lines = text.lines().zip(1..).map(|(text, number)| Line { path, number, text: text.trim() });
        let start_ns = start_comment(lines.clone())?;
        let mut lines = lines.filter(|line| !line.text.is_empty() && !line.text.starts_with('#'));
        let Some(first) = lines.next() else {
            return Err(FileError::content(path, None, "no line but comments", "a record line"));
        };
        let line = RecordLine::parse(&first)?;
        let n_lines = line.n_segments.unwrap_or(line.n_signals);
        // What follows is ignored, as specified.
        let lines: Vec<_> = lines.take(n_lines).collect();
        if lines.len() < n_lines {
            let what = if line.n_segments.is_some() { "segments" } else { "signals" };
            return Err(first.fail(format!("{n_lines} {what}"), &format!("as many lines, not {}", lines.len())));
        }
        let body = if line.n_segments.is_some() {
            Body::Segments(lines.iter().map(SegmentLine::parse).collect::<Result<_, _>>()?)
        } else {
            let mut channels = lines.iter().map(channel).collect::<Result<Vec<_>, _>>()?;
            group(path, &mut channels)?;
            Body::Signals(Ordinary { path: path.to_owned(), frames: line.frames, channels })
        };
        Ok(Self { line, body, start_ns })
    }
}

/// When the first frame was, if a comment of ours says so.
fn start_comment<'a>(lines: impl Iterator<Item = Line<'a>>) -> Result<i64, FileError> {
    for line in lines {
        let said = line.text.strip_prefix('#').and_then(|comment| comment.trim_start().strip_prefix(START_COMMENT));
        if let Some(said) = said {
            return line.integer(Some(said.trim()), START_COMMENT).map(Option::unwrap_or_default);
        }
    }
    Ok(0)
}

/// `NAME[/SEGMENTS] SIGNALS [RATE[/COUNTER[(BASE)]] [SAMPLES [TIME [DATE]]]]`
struct RecordLine {
    line: u64,
    /// None for an ordinary record.
    n_segments: Option<usize>,
    n_signals: usize,
    rate_hz: Option<f64>,
    /// 0 where there is none.
    frames: usize,
    start: Option<String>,
}

impl RecordLine {
    fn parse(line: &Line) -> Result<Self, FileError> {
        let mut fields = Fields(line.text);
        let n_segments = match fields.take().and_then(|name| name.split_once('/')) {
            Some((_, n)) => Some(line.count(n, "number of segments", 1)?),
            None => None,
        };
        let n_signals = line.count(fields.take().unwrap_or_default(), "number of signals", 1)?;
        let rate_hz = match fields.take().map(|field| field.split('/').next().unwrap_or_default()) {
            Some(field) => {
                let rate = line.number(field, "sampling frequency")?;
                if rate <= 0.0 {
                    return Err(line.fail(format!("sampling frequency `{field}`"), "more than 0"));
                }
                Some(rate)
            }
            None => None,
        };
        let frames = fields.take().map_or(Ok(0), |n| line.count(n, "number of samples", 0))?;
        let start = Some(fields.0.trim()).filter(|rest| !rest.is_empty()).map(str::to_owned);
        Ok(Self { line: line.number, n_segments, n_signals, rate_hz, frames, start })
    }
}

/// `NAME SAMPLES`
struct SegmentLine {
    line: u64,
    /// None for a gap.
    name: Option<String>,
    frames: usize,
}

impl SegmentLine {
    fn parse(line: &Line) -> Result<Self, FileError> {
        let mut fields = Fields(line.text);
        let name = line.stored_name(fields.take().unwrap_or_default(), "segment")?;
        let frames = line.count(fields.take().unwrap_or_default(), "length of the segment", 0)?;
        Ok(Self { line: line.number, name, frames })
    }

    /// The record that is this segment, if it has so many signals and this rate.
    fn source(&self, path: &Path, name: &str, n_signals: Option<usize>, rate_hz: f64) -> Result<Ordinary, FileError> {
        let own_path = with_suffix(&path.with_file_name(name));
        let fail = |found: String, expected: &str| FileError::content(path, Some(self.line), found, expected);
        let header = Header::read(&own_path).map_err(|error| match error {
            FileError::File { path, reason } => {
                fail(format!("segment `{name}`: {}: {reason}", path.display()), "a readable header beside this one")
            }
            content @ FileError::Content { .. } => content,
        })?;
        let Body::Signals(source) = header.body else {
            return Err(fail(format!("segment `{name}` with segments of its own"), "an ordinary record"));
        };
        let fail = |found: String, expected: String| {
            FileError::content(
                &own_path,
                Some(header.line.line),
                found,
                &format!("{expected}, as in {}", path.display()),
            )
        };
        if let Some(n_signals) = n_signals.filter(|n| *n != source.channels.len()) {
            return Err(fail(format!("signals: {}", source.channels.len()), n_signals.to_string()));
        }
        if let Some(rate) = header.line.rate_hz.filter(|rate| (rate - rate_hz).abs() > 1e-9 * rate_hz) {
            return Err(fail(format!("{rate} Hz"), rate_hz.to_string()));
        }
        Ok(source)
    }
}

/// A signal line; its place in the file is found by [`group`].
///
/// `FILE FORMAT[xPER_FRAME][:SKEW][+OFFSET] [GAIN[(BASELINE)][/UNITS] [RESOLUTION [ZERO [INITIAL [CHECKSUM [BLOCK
/// [DESCRIPTION]]]]]]]`
fn channel(line: &Line) -> Result<Channel, FileError> {
    let mut fields = Fields(line.text);
    let file = line.stored_name(fields.take().unwrap_or_default(), "signal file")?;
    let (code, modifiers) = split_before(fields.take().unwrap_or_default(), is_modifier);
    let code = line.count(code, "format", 0)?;
    let (per_frame, skew, offset) = format_modifiers(line, modifiers)?;
    let stored = match file {
        None => None,
        Some(file) => match Format::ALL.into_iter().find(|f| f.code() == code) {
            Some(format) => Some(Stored { file, format, offset, width: 0, first: 0 }),
            None => return Err(line.fail(format!("format {code}"), "16, 61, 80 or 212")),
        },
    };
    let (gain, baseline, units) = calibration(line, fields.take().unwrap_or_default())?;
    line.integer(fields.take(), "ADC resolution")?;
    let zero = line.integer(fields.take(), "ADC zero")?.unwrap_or(0);
    line.integer(fields.take(), "initial value")?;
    let checksum = line.integer(fields.take(), "checksum")?;
    line.integer(fields.take(), "block size")?;
    Ok(Channel {
        line: line.number,
        name: fields.0.trim().to_owned(),
        units,
        stored,
        per_frame,
        skew,
        gain,
        baseline: baseline.unwrap_or(zero),
        checksum,
    })
}

fn is_modifier(mark: char) -> bool {
    matches!(mark, 'x' | ':' | '+')
}

/// Samples per frame, skew and byte offset, in any order.
fn format_modifiers(line: &Line, mut rest: &str) -> Result<(usize, usize, usize), FileError> {
    let (mut per_frame, mut skew, mut offset) = (1, 0, 0);
    while let Some(mark) = rest.chars().next() {
        let (number, next) = split_before(&rest[mark.len_utf8()..], is_modifier);
        match mark {
            'x' => per_frame = line.count(number, "samples per frame", 1)?,
            ':' => skew = line.count(number, "skew", 0)?,
            _ => offset = line.count(number, "byte offset", 0)?,
        }
        rest = next;
    }
    Ok((per_frame, skew, offset))
}

/// Gain, baseline and units: `GAIN[(BASELINE)][/UNITS]`.
fn calibration(line: &Line, field: &str) -> Result<(f64, Option<i64>, String), FileError> {
    let (gain, rest) = split_before(field, |c| c == '(' || c == '/');
    let gain = if gain.is_empty() { 0.0 } else { line.number(gain, "ADC gain")? };
    let (baseline, rest) = match rest.strip_prefix('(') {
        Some(inside) => {
            let Some((baseline, rest)) = inside.split_once(')') else {
                return Err(line.fail(format!("`{field}`"), "a baseline in parentheses"));
            };
            (line.integer(Some(baseline), "baseline")?, rest)
        }
        None => (None, rest),
    };
    let units = match rest.strip_prefix('/') {
        Some(units) if !units.is_empty() => units,
        _ if rest.is_empty() || rest == "/" => DEFAULT_UNITS,
        _ => return Err(line.fail(format!("`{field}`"), "GAIN(BASELINE)/UNITS")),
    };
    // 0 stands for uncalibrated.
    let gain = if gain.abs() > 0.0 { gain } else { DEFAULT_GAIN };
    Ok((gain, baseline, units.to_owned()))
}

/// Finds the place of each signal in the frames of its file.
fn group(path: &Path, channels: &mut [Channel]) -> Result<(), FileError> {
    let mut seen = BTreeSet::new();
    for channels in channels.chunk_by_mut(|a, b| a.file() == b.file()) {
        let width = channels.iter().fold(0_usize, |sum, c| sum.saturating_add(c.per_frame));
        let mut first = 0_usize;
        let mut common = None;
        for channel in channels {
            let Some(stored) = &mut channel.stored else { continue };
            let this = (stored.format, stored.offset);
            let (format, offset) = *common.get_or_insert(this);
            if first == 0 && !seen.insert(stored.file.clone()) {
                let found = format!("signal file `{}` again, after another one", stored.file);
                return Err(FileError::content(
                    path,
                    Some(channel.line),
                    found,
                    "the signals of a file one after another",
                ));
            }
            if this != (format, offset) {
                let found = format!("format {} and byte offset {}", stored.format.code(), stored.offset);
                let expected = format!("{} and {offset}, as before in `{}`", format.code(), stored.file);
                return Err(FileError::content(path, Some(channel.line), found, &expected));
            }
            (stored.width, stored.first) = (width, first);
            first = first.saturating_add(channel.per_frame);
        }
    }
    Ok(())
}

/// A line of a header.
struct Line<'a> {
    path: &'a Path,
    number: u64,
    text: &'a str,
}

impl Line<'_> {
    fn fail(&self, found: impl Into<String>, expected: &str) -> FileError {
        FileError::content(self.path, Some(self.number), found, expected)
    }

    fn count(&self, text: &str, what: &str, least: usize) -> Result<usize, FileError> {
        let count = text.parse().ok().filter(|n| *n >= least);
        count.ok_or_else(|| self.fail(format!("{what} `{text}`"), &format!("a whole number from {least}")))
    }

    fn integer(&self, text: Option<&str>, what: &str) -> Result<Option<i64>, FileError> {
        let parse = |t: &str| t.parse().map_err(|_| self.fail(format!("{what} `{t}`"), "an integer"));
        text.map(parse).transpose()
    }

    fn number(&self, text: &str, what: &str) -> Result<f64, FileError> {
        let number = text.parse().ok().filter(|n: &f64| n.is_finite());
        number.ok_or_else(|| self.fail(format!("{what} `{text}`"), "a number"))
    }

    /// A name that stays in the folder of the header; None where nothing is stored.
    fn stored_name(&self, name: &str, what: &str) -> Result<Option<String>, FileError> {
        if name == NOTHING_STORED {
            return Ok(None);
        }
        let mut parts = Path::new(name).components();
        let plain = matches!((parts.next(), parts.next()), (Some(Component::Normal(part)), None) if part == name);
        if plain && !name.contains(['\\', '\0']) {
            return Ok(Some(name.to_owned()));
        }
        Err(self.fail(format!("{what} `{name}`"), "a name without a folder"))
    }
}

/// The fields of a line that are still to be read.
struct Fields<'a>(&'a str);

impl<'a> Fields<'a> {
    fn take(&mut self) -> Option<&'a str> {
        let (field, rest) = split_before(self.0.trim_start(), char::is_whitespace);
        self.0 = rest;
        Some(field).filter(|f| !f.is_empty())
    }
}

/// Splits before the first of some characters, or at the end.
fn split_before(text: &str, mut stop: impl FnMut(char) -> bool) -> (&str, &str) {
    text.split_at(text.find(&mut stop).unwrap_or(text.len()))
}

/// The header of a record.
fn with_suffix(record: &Path) -> PathBuf {
    let mut name = record.as_os_str().to_owned();
    name.push(".hea");
    name.into()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A folder of records that the test writes.
    struct Folder(tempfile::TempDir);

    impl Folder {
        fn new() -> Self {
            Self(tempfile::tempdir().unwrap())
        }

        fn write(&self, name: &str, bytes: impl AsRef<[u8]>) -> &Self {
            std::fs::write(self.0.path().join(name), bytes).unwrap();
            self
        }

        fn open(&self, name: &str) -> Result<Record, FileError> {
            Record::open(&self.0.path().join(name))
        }

        fn samples(&self, name: &str) -> Vec<Vec<f64>> {
            let record = self.open(name).unwrap();
            (0..record.signals.len()).map(|i| record.samples(i).unwrap()).collect()
        }

        /// What reading the record, or else its first signal, complains of; without the folder.
        fn complaint(&self, name: &str) -> String {
            let error = self.open(name).and_then(|record| record.samples(0)).unwrap_err();
            error.to_string().replace(&format!("{}/", self.0.path().display()), "")
        }
    }

    fn encode(format: Format, samples: &[i16]) -> Vec<u8> {
        match format {
            Format::F16 => samples.iter().flat_map(|s| s.to_le_bytes()).collect(),
            Format::F61 => samples.iter().flat_map(|s| s.to_be_bytes()).collect(),
            Format::F80 => samples.iter().map(|s| u8::try_from(s + 128).unwrap()).collect(),
            Format::F212 => samples.chunks(2).flat_map(encode_pair).collect(),
        }
    }

    fn encode_pair(pair: &[i16]) -> Vec<u8> {
        let [low, high] = (pair[0] & 0xfff).to_le_bytes();
        let Some(second) = pair.get(1) else { return vec![low, high] };
        let [second_low, second_high] = (second & 0xfff).to_le_bytes();
        vec![low, high | second_high << 4, second_low]
    }

    fn same(left: &[f64], right: &[f64]) -> bool {
        left.len() == right.len() && left.iter().zip(right).all(|(a, b)| a.to_bits() == b.to_bits())
    }

    const NAN: f64 = f64::NAN;

    #[test]
    fn every_format_keeps_its_range_at_even_and_odd_lengths() {
        for format in Format::ALL {
            let lowest = i16::try_from(format.missing()).unwrap();
            let all = [lowest + 1, -1, 0, 1, lowest, !lowest, 100];
            for n in 1..=all.len() {
                let bytes = encode(format, &all[..n]);
                assert_eq!(bytes.len(), format.bytes(n), "{format:?}, {n} samples");
                assert_eq!(format.samples(bytes.len()), n, "{format:?}");
                let folder = Folder::new();
                let code = format.code();
                folder.write("r.hea", format!("r 1 125 {n}\nr.dat {code} 1\n")).write("r.dat", bytes);
                let expected: Vec<_> =
                    all[..n].iter().map(|s| if *s == lowest { NAN } else { f64::from(*s) }).collect();
                assert!(same(&folder.samples("r")[0], &expected), "{format:?}, {n} samples");
            }
        }
    }

    #[test]
    fn signals_and_samples_per_frame_are_interleaved() {
        // Three samples of a file in a frame: frames begin within a pair. The longer ones cross blocks.
        for (format, n_frames) in Format::ALL.into_iter().flat_map(|f| [(f, 3), (f, 30_001), (f, 50_000)]) {
            let value = |frame: usize, place: usize| i16::try_from((frame * 4 + place) % 255).unwrap() - 127;
            let of = |places: std::ops::Range<usize>| -> Vec<i16> {
                (0..n_frames).flat_map(|f| places.clone().map(move |p| value(f, p))).collect()
            };
            let code = format.code();
            let header = format!("r 3 125 {n_frames}\na.dat {code}+7 1\na.dat {code}+7x2 1\nb.dat 80 1\n");
            let mut a = vec![0xff; 7];
            a.extend(encode(format, &of(0..3)));
            let folder = Folder::new();
            folder.write("r.hea", header).write("a.dat", a).write("b.dat", encode(Format::F80, &of(3..4)));
            let expected = |places| of(places).into_iter().map(f64::from).collect::<Vec<_>>();
            for (read, places) in folder.samples("r.hea").iter().zip([0..1, 1..3, 3..4]) {
                assert!(same(read, &expected(places)), "{format:?}, {n_frames} frames");
            }
            let rates: Vec<_> = folder.open("r").unwrap().signals.iter().map(|s| s.rate_hz).collect();
            assert!(same(&rates, &[125.0, 250.0, 125.0]));
        }
    }

    #[test]
    fn the_record_line_has_optional_fields() {
        let folder = Folder::new();
        folder.write("r.dat", encode(Format::F16, &[1, 2, 3]));
        for (line, rate_hz, start) in [
            ("r 1", 250.0, None),
            ("r 1 62.5", 62.5, None),
            ("r 1 3.6e2/25.5(-3) 3", 360.0, None),
            ("r 1\t125/1   0", 125.0, None),
            ("r 1 125 3 8:26:04 26/10/1994", 125.0, Some("8:26:04 26/10/1994")),
        ] {
            folder.write("r.hea", format!("#wfdb 10.7\r\n\r\n {line}\r\n # c\r\nr.dat 16\r\n# info\r\n"));
            let record = folder.open("r").unwrap();
            assert_eq!((record.frames, record.start.as_deref()), (3, start), "{line}");
            assert!((record.frame_rate_hz - rate_hz).abs() < 1e-12, "{line}");
        }
    }

    #[test]
    fn gain_baseline_and_units_have_the_defaults_of_the_specification() {
        let folder = Folder::new();
        folder.write("r.dat", encode(Format::F16, &[40]));
        for (fields, name, units, value) in [
            ("", "", "mV", 0.2),
            ("0", "", "mV", 0.2),
            ("20", "", "mV", 2.0),
            ("20/mmHg", "", "mmHg", 2.0),
            ("20(-1600)/mmHg", "", "mmHg", 82.0),
            ("20(+20)", "", "mV", 1.0),
            ("-2e1 12 10", "", "mV", -1.5),
            ("20(0)/mm/Hg 12 10 0 40 0 ABP  line 2 ", "ABP  line 2", "mm/Hg", 2.0),
            ("20 12 10 40 40 0 ABP", "ABP", "mV", 1.5),
            ("1(-9223372036854775808)", "", "mV", 9_223_372_036_854_775_808.0),
        ] {
            folder.write("r.hea", format!("r 1 125 1\nr.dat 16 {fields}\n"));
            let record = folder.open("r").unwrap();
            assert_eq!((record.signals[0].name.as_str(), record.signals[0].units.as_str()), (name, units), "{fields}");
            assert!((record.samples(0).unwrap()[0] - value).abs() < 1e-12, "{fields}");
        }
    }

    #[test]
    fn a_skew_counts_samples_of_its_signal() {
        let folder = Folder::new();
        folder.write("r.dat", encode(Format::F16, &[1, 10, 11, 2, 20, 21, 3, 30, 31]));
        // The checksum includes what the skew cuts off.
        folder.write("r.hea", "r 2 125 3\nr.dat 16:1 1 16 0 1 6 0 A\nr.dat 16x2:3 1 16 0 10 123 0 B\n");
        let read = folder.samples("r");
        assert!(same(&read[0], &[2.0, 3.0, NAN]));
        assert!(same(&read[1], &[21.0, 30.0, 31.0, NAN, NAN, NAN]));
        folder.write("r.hea", "r 1 125 3\nr.dat 16:99999999999 1\n");
        assert!(same(&folder.samples("r")[0], &[NAN; 3]));
    }

    #[test]
    fn an_unstated_length_is_that_of_the_shortest_file() {
        let folder = Folder::new();
        folder.write("a.dat", encode(Format::F212, &[1, 2, 3, 4, 5])).write("b.dat", encode(Format::F80, &[1, 2, 3]));
        // Without a length a checksum is a placeholder.
        folder.write("r.hea", "r 3\na.dat 212 1 12 0 0 9 0 A\na.dat 212 1\nb.dat 80+1 1\n");
        let read = folder.samples("r");
        assert!(same(&read[0], &[1.0, 3.0]) && same(&read[1], &[2.0, 4.0]) && same(&read[2], &[2.0, 3.0]));
    }

    #[test]
    fn segments_of_a_fixed_layout_follow_each_other() {
        let folder = Folder::new();
        folder.write("m.hea", "m/4 2 125 6\nm1 2\n~ 1\nm2 1\nm1 2\n");
        folder.write("m1.hea", "m1 2 125 2\nm1.dat 16 1/mmHg 16 0 1 3 0 P\nm1.dat 16x2 1 16 0 3 18 0 E\n");
        folder.write("m1.dat", encode(Format::F16, &[1, 3, 4, 2, 5, 6]));
        folder.write("m2.hea", "m2 2 125.0 1\nm2.dat 212 2(1)/mmHg 12 0 7 7 0 P\nm2.dat 212x2 1 12 0 8 17 0 E\n");
        folder.write("m2.dat", encode(Format::F212, &[7, 8, 9]));
        let read = folder.samples("m");
        assert!(same(&read[0], &[1.0, 2.0, NAN, 3.0, 1.0, 2.0]));
        assert!(same(&read[1], &[3.0, 4.0, 5.0, 6.0, NAN, NAN, 8.0, 9.0, 3.0, 4.0, 5.0, 6.0]));
    }

    #[test]
    fn all_files_of_a_record_are_known() {
        let folder = Folder::new();
        folder.write("a.hea", "a 3 125 2\na.dat 80\na.dat 80\nb.dat 80\n").write("m.hea", "m/3 3 125\na 2\n~ 5\na 2\n");
        let names = |record: &str| {
            let files = folder.open(record).unwrap().files();
            files.iter().map(|path| path.file_name().unwrap().to_str().unwrap().to_owned()).collect::<Vec<_>>()
        };
        assert_eq!(names("a"), ["a.dat", "a.hea", "b.dat"]);
        assert_eq!(names("m.hea"), ["a.dat", "a.hea", "b.dat", "m.hea"]);
    }

    #[test]
    fn segments_of_a_variable_layout_are_matched_by_name() {
        let folder = Folder::new();
        folder.write("m.hea", "m/4 2 125 5\nm_layout 0\nm1 2\n~ 1\nm2 2\n");
        folder.write("m_layout.hea", "m_layout 2 125 0\n~ 0 1/mmHg 0 0 0 0 0 ABP\n~ 0x2 1/mmHg 0 0 0 0 0 CVP\n");
        folder.write("m1.hea", "m1 1 125 2\nm1.dat 16 2(1)/mmHg 16 0 1 6 0 ABP\n").write("m1.dat", [1, 0, 5, 0]);
        // -128 marks a missing sample, and counts in the checksum.
        let m2 = "m2.dat 80 1 8 0 1 1 0 X\nm2.dat 80x2 1/mmhg 8 0 1 -126 0 CVP\n~ 0 1 0 0 0 0 0 Y\n";
        folder.write("m2.hea", format!("m2 3 125 2\n{m2}"));
        folder.write("m2.dat", encode(Format::F80, &[0, -128, 1, 1, 0, 1]));
        let read = folder.samples("m");
        assert!(same(&read[0], &[0.0, 2.0, NAN, NAN, NAN]));
        assert!(same(&read[1], &[NAN, NAN, NAN, NAN, NAN, NAN, NAN, 1.0, 0.0, 1.0]));
    }

    #[test]
    fn malformed_ordinary_records_are_refused() {
        for (header, complaint) in [
            ("", "r.hea: found no line but comments, expected a record line"),
            ("# r 1\n", "r.hea: found no line but comments, expected a record line"),
            ("r", "r.hea:1: found number of signals ``, expected a whole number from 1"),
            ("r 0", "r.hea:1: found number of signals `0`, expected a whole number from 1"),
            ("#\nr -1", "r.hea:2: found number of signals `-1`, expected a whole number from 1"),
            ("r 99999999999999999999", "r.hea:1: found number of signals `99999999999999999999`, expected a whole"),
            ("r 18446744073709551615", "r.hea:1: found 18446744073709551615 signals, expected as many lines, not 0"),
            ("r 2 125 2\nr.dat 80", "r.hea:1: found 2 signals, expected as many lines, not 1"),
            ("r 1 0 2", "r.hea:1: found sampling frequency `0`, expected more than 0"),
            ("r 1 -5 2", "r.hea:1: found sampling frequency `-5`, expected more than 0"),
            ("r 1 inf 2", "r.hea:1: found sampling frequency `inf`, expected a number"),
            ("r 1 125 -2", "r.hea:1: found number of samples `-2`, expected a whole number from 0"),
            ("r 1 125 2\nr.dat", "r.hea:2: found format ``, expected a whole number from 0"),
            ("r 1 125 2\nr.dat 516", "r.hea:2: found format 516, expected 16, 61, 80 or 212"),
            ("r 1 125 2\nr.dat 80x0", "r.hea:2: found samples per frame `0`, expected a whole number from 1"),
            ("r 1 125 2\nr.dat 80:-1", "r.hea:2: found skew `-1`, expected a whole number from 0"),
            ("r 1 125 2\nr.dat 80x2+", "r.hea:2: found byte offset ``, expected a whole number from 0"),
            ("r 1 125 2\nr.dat 80 much", "r.hea:2: found ADC gain `much`, expected a number"),
            ("r 1 125 2\nr.dat 80 20(1.5)", "r.hea:2: found baseline `1.5`, expected an integer"),
            ("r 1 125 2\nr.dat 80 20(15/mV", "r.hea:2: found `20(15/mV`, expected a baseline in parentheses"),
            ("r 1 125 2\nr.dat 80 20(15)mV", "r.hea:2: found `20(15)mV`, expected GAIN(BASELINE)/UNITS"),
            ("r 1 125 2\nr.dat 80 20 ABP", "r.hea:2: found ADC resolution `ABP`, expected an integer"),
            ("r 1 125 2\nr.dat 80 20 8 0 0 x", "r.hea:2: found checksum `x`, expected an integer"),
            ("r 1 125 2\n../r.dat 80", "r.hea:2: found signal file `../r.dat`, expected a name without a folder"),
            ("r 1 125 2\n/etc/passwd 80", "r.hea:2: found signal file `/etc/passwd`, expected a name without a folder"),
            ("r 1 125 2\n.. 80", "r.hea:2: found signal file `..`, expected a name without a folder"),
            ("r 1 125 2\nr.dat/ 80", "r.hea:2: found signal file `r.dat/`, expected a name without a folder"),
            ("r 1 125 2\n..\\r.dat 80", "r.hea:2: found signal file `..\\r.dat`, expected a name without a folder"),
            ("r 1 125 2\nno.dat 80", "r.hea:2: found signal file `no.dat`: No such file"),
            ("r 1\nno.dat 80", "r.hea:2: found signal file `no.dat`: No such file"),
            (
                "r 1 125 3\nr.dat 80x2",
                "r.hea:2: found signal file `r.dat` of 4 bytes, expected at least 6: 3 frames of 2 samples",
            ),
            ("r 1 125 3\nr.dat 212", "r.hea:2: found signal file `r.dat` of 4 bytes, expected at least 5: 3 frames"),
            ("r 1 125 2\nr.dat 80+3", "r.hea:2: found signal file `r.dat` of 4 bytes, expected at least 5: 2 frames"),
            (
                "r 1 125 134217728\nr.dat 80",
                "r.hea:2: found signal file `r.dat` of 4 bytes, expected at least 134217728",
            ),
            ("r 1 125 134217729\nr.dat 80", "r.hea: found 134217729 samples of ``, expected at most 134217728"),
            (
                "r 1 125 2\nr.dat 80x18446744073709551615",
                "r.hea: found 18446744073709551615 samples of ``, expected at most",
            ),
            (
                "r 2 125 2\nr.dat 80\nr.dat 80x18446744073709551615",
                "r.hea:2: found signal file `r.dat` of 4 bytes, expected at least 18446744073709551615: 2 frames",
            ),
            ("r 1 125 2\nr.dat 80+18446744073709551615", "r.hea:2: found signal file `r.dat` of 4 bytes, expected at"),
            ("r 1\nr.dat 80+9", "r.hea: found neither a number of samples nor a stored frame, expected one of them"),
            ("r 1\n~ 0", "r.hea: found neither a number of samples nor a stored frame, expected one of them"),
            (
                "r 2 125 1\nr.dat 80\nr.dat 16",
                "r.hea:3: found format 16 and byte offset 0, expected 80 and 0, as before in `r.dat`",
            ),
            (
                "r 2 125 1\nr.dat 80\nr.dat 80+1",
                "r.hea:3: found format 80 and byte offset 1, expected 80 and 0, as before",
            ),
            (
                "r 3 125 1\nr.dat 80\ns.dat 80\nr.dat 80",
                "r.hea:4: found signal file `r.dat` again, after another one, expected the signals of a file one after",
            ),
            (
                "r 1 125 2\nr.dat 80 1 8 0 1 4 0 P",
                "r.hea:2: found checksum 3 of `P` in `r.dat`, expected 4: the file is damaged",
            ),
        ] {
            let folder = Folder::new();
            folder.write("r.hea", header).write("r.dat", encode(Format::F80, &[1, 2, 3, 4]));
            let found = folder.complaint("r");
            assert!(found.starts_with(complaint), "{header:?}\n found    {found}\n expected {complaint}");
        }
        let folder = Folder::new();
        assert!(folder.complaint("r").starts_with("r.hea: No such file"));
        folder.write("r.hea", vec![b'#'; 1 + (1 << 20)]);
        assert_eq!(folder.complaint("r"), "r.hea: found a longer file, expected a header of at most 1048576 bytes");
        folder.write("r.hea", "r 1\nr.dat 80\n").write("r.dat", [1]);
        let found = folder.open("r").unwrap().samples(1).unwrap_err().to_string();
        assert!(found.ends_with("r.hea: found no signal at place 1, expected a place below 1"), "{found}");
    }

    #[test]
    fn segments_that_do_not_fit_are_refused() {
        for (header, complaint) in [
            ("m/0 1 125 4", "m.hea:1: found number of segments `0`, expected a whole number from 1"),
            ("m/2 1 125 4\na 2", "m.hea:1: found 2 segments, expected as many lines, not 1"),
            ("m/1 1 125 2\n../a 2", "m.hea:2: found segment `../a`, expected a name without a folder"),
            ("m/1 1 125 2\na", "m.hea:2: found length of the segment ``, expected a whole number from 0"),
            ("m/1 1 125 2\nno 2", "m.hea:2: found segment `no`: no.hea: No such file"),
            ("m/1 1 125 2\nm 2", "m.hea:2: found segment `m` with segments of its own, expected an ordinary record"),
            ("m/1 1 125 3\na 3", "m.hea:2: found a segment of 3 frames, expected 2, as in a.hea"),
            ("m/2 1 125 5\na 2\na 2", "m.hea:1: found segments of 4 frames, expected 5 in total"),
            ("m/1 1\n~ 2", "m.hea:1: found gaps only, expected a segment with signals"),
            ("m/1 1 125\nlayout 0", "m.hea:1: found segments of 0 frames, expected at least one"),
            ("m/2 1 125\na 2\n~ 134217727", "m.hea: found 134217729 samples of `P`, expected at most 134217728"),
            ("m/3 1 125\na 2\n~ 18446744073709551615\na 2", "m.hea:1: found too many frames, expected at least one"),
            ("m/1 1\na 2", "a.hea:1: found 125 Hz, expected 250, as in m.hea"),
            ("m/1 2 125\na 2", "a.hea:1: found signals: 1, expected 2, as in m.hea"),
            ("m/2 2 125\nlayout 0\na 2", "layout.hea:1: found signals: 1, expected 2, as in m.hea"),
            (
                "m/2 1 125\na 2\nunits 2",
                "units.hea:2: found signal `P` [mV], samples per frame: 1, expected signal `P` [mmHg], samples per \
                 frame: 1, as before",
            ),
            (
                "m/2 1 125\na 2\nname 2",
                "name.hea:2: found signal `Q` [mmHg], samples per frame: 1, expected signal `P`",
            ),
            ("m/2 1 125\nlayout 0\nrate 2", "rate.hea:2: found signal `P` [mmHg], samples per frame: 2, expected"),
            (
                "m/2 1 125\nlayout 0\ntwice 2",
                "twice.hea:3: found a second signal `P`, expected distinct names where segments differ",
            ),
            ("m/2 1 125\na 2\nsum 2", "sum.hea:2: found checksum 3 of `P` in `a.dat`, expected 4: the file is damaged"),
        ] {
            let folder = Folder::new();
            folder.write("a.dat", encode(Format::F80, &[1, 2, 3, 4])).write("m.hea", header);
            folder.write("a.hea", "a 1 125 2\na.dat 80 1/mmHg 8 0 1 3 0 P");
            folder.write("layout.hea", "layout 1 125 0\n~ 0 1/mmHg 8 0 0 0 0 P");
            folder.write("units.hea", "units 1 125 2\na.dat 80 1/mV 8 0 1 3 0 P");
            folder.write("name.hea", "name 1 125 2\na.dat 80 1/mmHg 8 0 1 3 0 Q");
            folder.write("rate.hea", "rate 1 125 2\na.dat 80x2 1/mmHg 8 0 1 10 0 P");
            folder.write("twice.hea", "twice 2 125 2\na.dat 80 1/mmHg 8 0 1 4 0 P\na.dat 80 1/mmHg 8 0 1 6 0 P");
            folder.write("sum.hea", "sum 1 125 2\na.dat 80 1/mmHg 8 0 1 4 0 P");
            let found = folder.complaint("m");
            assert!(found.starts_with(complaint), "{header:?}\n found    {found}\n expected {complaint}");
        }
    }

    #[test]
    fn a_damaged_header_never_panics() {
        let header = "m/2 2 125/1(0) 2\na.dat 212x2:1+3 20(-16)/mmHg 12 0 1 3 0 P\n~ 0 1/mV 8 0 0 0 0 Q\na 2\n~ 1\n";
        let folder = Folder::new();
        folder.write("a.dat", vec![0x55; 40]).write("a.hea", "a 2 125 2\na.dat 80 1 8 0 1\na.dat 80 1\n");
        for start in ["m/2", "m"] {
            let header = header.replacen("m/2", start, 1);
            for place in 0..header.len() {
                for byte in [b'\0', b' ', b'\n', b'-', b'0', b'9', b'/', b'(', b')', b'x', b'#', b'~', 0xff] {
                    let mut damaged = header.clone().into_bytes();
                    damaged[place] = byte;
                    folder.write("m.hea", damaged);
                    let Ok(record) = folder.open("m") else { continue };
                    for index in 0..record.signals.len() {
                        let _ = record.samples(index);
                    }
                }
            }
        }
    }
}
