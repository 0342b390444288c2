//! Wire schema v2: what crosses the bus, in bincode and in JSON.
//!
//! Bincode 2 with fixed-size little-endian integers and no framing, so that `struct` and `numpy.frombuffer` read
//! it: integers and floats are their bytes, a `Vec` or `String` is a `u64` length and its elements, fields follow
//! each other in the order declared here. Every message starts with the schema version.
//!
//! | key under `PREFIX/BED/` | type | |
//! |---|---|---|
//! | `pressure/CHANNEL` | [`PressureBlock`] | in; JSON accepted with encoding `application/json` |
//! | `beat` | [`Beats`] | in: onsets of beats, from an ECG |
//! | `note` | [`Note`] | what an operator says; dashboards and recorders listen, the estimator does not |
//! | `acknowledge` | [`Acknowledge`] | in: an operator has seen an alarm |
//! | `truth` | [`Truth`] | what a synthetic patient really is; published by `replay` |
//! | `estimate/state` | [`StateEstimate`] | |
//! | `estimate/parameters` | [`ParameterEstimate`] | |
//! | `estimate/smoothed` | [`StateEstimate`] | states and parameters, corrected by what came in the smoothing lag |
//! | `estimate/beat` | [`BeatEstimate`] | once per heart beat |
//! | `estimate/members` | [`Members`] | only while someone subscribes |
//! | `status` | [`Status`] | |
//! | `event` | [`Event`] | |
//! | `alarm` | [`Alarms`] | all alarms of the bed, whenever one of them changes, and with every status |
//!
//! Each `out` key has a twin `KEY/json`. The JSON holds the same content, arranged by name (`names` keeps the order);
//! numbers that JSON cannot hold (NaN, infinities) are `null`. The arrays are described in the types.

use serde::{Deserialize, Serialize, de::DeserializeOwned};
use serde_json::{Map, Value, json};

use super::bus::Encoding;

/// Version of everything in this module.
pub const SCHEMA: u16 = 2;

/// Longest payload that is decoded \[bytes\]; also bounds what a corrupt length can allocate.
pub const MAX_PAYLOAD_BYTES: usize = 1 << 20;

/// [`PressureBlock::flags`]: the sender will send no more.
pub const FLAG_LAST_BLOCK: u32 = 1;

/// Statistics per quantity in [`StateEstimate::values`], in order.
pub const STATE_STATISTICS: [&str; 7] = ["mean", "sd", "epistemic_sd", "aleatoric_sd", "model_sd", "q05", "q95"];

/// Statistics per parameter in [`ParameterEstimate::values`], in order.
pub const PARAMETER_STATISTICS: [&str; 7] =
    ["mean", "sd", "q05", "q95", "identifiability", "since_informed_s", "identifiable"];

/// Statistics per quantity in [`BeatEstimate::values`], in order.
pub const BEAT_STATISTICS: [&str; 4] = ["mean", "sd", "q05", "q95"];

/// A block of samples of one channel.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PressureBlock {
    /// [`SCHEMA`].
    pub schema: u16,
    /// Counts the blocks of this channel, so that losses show.
    pub sequence: u64,
    /// Bit set of `FLAG_...`.
    pub flags: u32,
    /// Event time of the first sample \[ns\].
    pub start_ns: i64,
    /// Spacing \[ns\]; 0 if `offsets_ns` tells the times (or there is one sample). Telling both is malformed.
    pub period_ns: i64,
    /// Time of each sample after `start_ns` \[ns\]; empty if `period_ns` tells the times.
    #[serde(default)]
    pub offsets_ns: Vec<i64>,
    /// Samples \[mmHg\].
    pub values: Vec<f64>,
}

/// Onsets of heart beats, told by somebody who knows.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Beats {
    /// [`SCHEMA`].
    pub schema: u16,
    /// Event times at which the ventricles began to contract \[ns\].
    pub onsets_ns: Vec<i64>,
}

/// What every published message starts with.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Header {
    /// [`SCHEMA`].
    pub schema: u16,
    /// Seed of the ensemble.
    pub seed: u64,
    /// Hash of the effective configuration.
    pub config_hash: u64,
    /// Counts the messages under this key.
    pub sequence: u64,
    /// Event time of the (first) content \[ns\].
    pub time_ns: i64,
}

/// Pressures, flows and volumes with their uncertainty, at one or more times.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StateEstimate {
    /// Common start.
    pub header: Header,
    /// Members that took part.
    pub members: u32,
    /// Event times \[ns\].
    pub times_ns: Vec<i64>,
    /// Seconds since data last entered the estimate, per time; a forecast where it exceeds a sampling interval.
    pub since_data_s: Vec<f64>,
    /// Names of the quantities.
    pub names: Vec<String>,
    /// `[times x names x 7]`, the [`STATE_STATISTICS`] of each. `q05` and `q95` describe the true quantity.
    pub values: Vec<f64>,
}

/// Estimated parameters.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ParameterEstimate {
    /// Common start.
    pub header: Header,
    /// Members that took part.
    pub members: u32,
    /// Names of the parameters.
    pub names: Vec<String>,
    /// `[names x 7]`, the [`PARAMETER_STATISTICS`] of each; `identifiable` is 1 where data rather than settings say what
    /// the value is, else 0.
    pub values: Vec<f64>,
}

/// A heart beat that is over.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct BeatEstimate {
    /// Common start; its time is the onset.
    pub header: Header,
    /// Members that took part.
    pub members: u32,
    /// Event time at which the next beat began \[ns\].
    pub end_ns: i64,
    /// Names of the clinical quantities.
    pub names: Vec<String>,
    /// Their units.
    pub units: Vec<String>,
    /// `[names x 4]`, the [`BEAT_STATISTICS`] of each.
    pub values: Vec<f64>,
}

/// The whole ensemble at one time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Members {
    /// Common start.
    pub header: Header,
    /// Names of the columns: states, then estimated parameters.
    pub names: Vec<String>,
    /// `[members x names]`.
    pub values: Vec<f64>,
}

/// One channel in a [`Status`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ChannelStatus {
    /// State it observes.
    pub name: String,
    /// `live`, `silent` or `never`.
    pub state: String,
    /// Event time of its last sample \[ns\]; 0 if there was none.
    pub last_sample_ns: i64,
    /// Samples that entered the estimate.
    pub samples_used: u64,
    /// Root mean square of the normalised innovations, lately: 1 when model and noise fit.
    pub innovation_rms: f64,
    /// Noise that the sensor is taken to have \[mmHg\].
    pub noise_sd: f64,
    /// Mean square of sums of neighbouring innovations: 1 when the model fits, more when it is off for a while.
    pub whiteness: f64,
    /// Mean square of innovations laid over each other beat by beat: 1 when the model fits.
    pub recurrence: f64,
    /// Whether the model no longer fits this channel.
    pub misfit: bool,
    /// Why the channel is set aside; empty if it is not.
    pub artefact: String,
}

/// Health of a bed, once a second.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Status {
    /// Common start.
    pub header: Header,
    /// Members alive, of those configured.
    pub members_alive: u32,
    /// Members configured.
    pub members: u32,
    /// Windows solved since the start.
    pub windows: u64,
    /// Of these, without a sample: forecasts.
    pub windows_without_data: u64,
    /// From the arrival of the input that closed a window to its estimate, over the last minute or so \[ms\]: median.
    pub lag_p50_ms: f64,
    /// The same: 99th percentile.
    pub lag_p99_ms: f64,
    /// The same: largest.
    pub lag_max_ms: f64,
    /// Mean time to solve a window for all members, lately \[ms\].
    pub solve_ms: f64,
    /// Mean Gauss-Newton iterations per member and window.
    pub iterations: f64,
    /// Member-windows whose iteration did not converge.
    pub not_converged: u64,
    /// Inputs waiting.
    pub queue_depth: u32,
    /// What was refused or lost, by cause; causes with count 0 are left out.
    pub counters: Vec<(String, u64)>,
    /// Channels that are observed or configured to be.
    pub channels: Vec<ChannelStatus>,
    /// How far a second filter is from the estimates, by name, in units of both sd together; empty without one.
    pub disagreement: Vec<(String, f64)>,
}

/// Something happened.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Event {
    /// Common start.
    pub header: Header,
    /// `start`, `gap`, `recovered`, `restart`, `rejected`, `overload`, `members_lost`, ...
    pub kind: String,
    /// Channel concerned; empty if none.
    pub channel: String,
    /// For people.
    pub text: String,
}

/// Kind of the event by which a daemon says that it has let a bed go: the last message of the bed.
pub const GONE: &str = "gone";

/// One alarm of a bed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Alarm {
    /// Its name in the configuration.
    pub name: String,
    /// Quantity, parameter or clinical quantity it watches.
    pub quantity: String,
    /// Unit of `limit` and of the band.
    pub unit: String,
    /// `low`, `medium` or `high`.
    pub priority: String,
    /// `normal`, `pending` (beyond the limit, not yet long enough), `active`, or `latched` (it was active and nobody has
    /// acknowledged it).
    pub state: String,
    /// Whether an operator has seen it; false unless it is active.
    pub acknowledged: bool,
    /// `below` or `above`.
    pub side: String,
    /// The limit.
    pub limit: f64,
    /// Event time since which it is in this state \[ns\].
    pub since_ns: i64,
    /// The band when it last changed: mean, 5 and 95 % quantile.
    pub band: [f64; 3],
    /// For people: what is the matter.
    pub text: String,
}

/// What stands against the limits of a bed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Alarms {
    /// Common start.
    pub header: Header,
    /// One per alarm of the configuration, in its order.
    pub alarms: Vec<Alarm>,
}

/// An operator has seen an alarm.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Acknowledge {
    /// [`SCHEMA`].
    pub schema: u16,
    /// Name of the alarm; empty for all of the bed.
    pub alarm: String,
    /// Who; for the record.
    pub author: String,
}

/// What an operator says about a bed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Note {
    /// [`SCHEMA`].
    pub schema: u16,
    /// Event time that it is about \[ns\].
    pub time_ns: i64,
    /// Who.
    pub author: String,
    /// What.
    pub text: String,
}

/// What a synthetic patient really is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Truth {
    /// [`SCHEMA`].
    pub schema: u16,
    /// Event time \[ns\].
    pub time_ns: i64,
    /// Names of the quantities and parameters.
    pub names: Vec<String>,
    /// Their values.
    pub values: Vec<f64>,
}

/// A payload that cannot be understood.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum WireError {
    /// Longer than [`MAX_PAYLOAD_BYTES`].
    #[error("payload of {0} bytes, at most {MAX_PAYLOAD_BYTES} are accepted")]
    TooLong(usize),
    /// Not the bytes of this type.
    #[error("not a valid message: {0}")]
    Malformed(String),
    /// Written by another version.
    #[error("schema version {0}, this build reads {SCHEMA}")]
    Schema(u16),
}

fn bincode_config() -> impl bincode::config::Config {
    bincode::config::standard().with_little_endian().with_fixed_int_encoding().with_limit::<MAX_PAYLOAD_BYTES>()
}

/// Bincode bytes of a message of this module.
///
/// # Errors
/// When the message is longer than [`MAX_PAYLOAD_BYTES`].
pub fn encode<T: Serialize>(message: &T) -> Result<Vec<u8>, WireError> {
    let bytes = bincode::serde::encode_to_vec(message, bincode_config());
    let bytes = bytes.map_err(|e| WireError::Malformed(e.to_string()))?;
    // Bincode's own limit binds readers only.
    if bytes.len() > MAX_PAYLOAD_BYTES { Err(WireError::TooLong(bytes.len())) } else { Ok(bytes) }
}

/// Reads a message of this module; the schema version is looked at before anything else.
///
/// # Errors
/// When the payload is too long, of another schema version, or malformed (trailing bytes included).
pub fn decode<T: DeserializeOwned>(payload: &[u8], encoding: Encoding) -> Result<T, WireError> {
    if payload.len() > MAX_PAYLOAD_BYTES {
        return Err(WireError::TooLong(payload.len()));
    }
    match encoding {
        Encoding::Bincode => decode_bincode(payload),
        Encoding::Json => decode_json(payload),
    }
}

fn decode_bincode<T: DeserializeOwned>(payload: &[u8]) -> Result<T, WireError> {
    let Some(version) = payload.first_chunk::<2>() else {
        return Err(WireError::Malformed(format!("{} bytes", payload.len())));
    };
    check_schema(u64::from(u16::from_le_bytes(*version)))?;
    let (message, used) = bincode::serde::decode_from_slice(payload, bincode_config())
        .map_err(|e| WireError::Malformed(e.to_string()))?;
    if used != payload.len() {
        return Err(WireError::Malformed(format!("{} bytes left over", payload.len() - used)));
    }
    Ok(message)
}

fn decode_json<T: DeserializeOwned>(payload: &[u8]) -> Result<T, WireError> {
    let malformed = |e: serde_json::Error| WireError::Malformed(e.to_string());
    let value: Value = serde_json::from_slice(payload).map_err(malformed)?;
    let Some(version) = value.get("schema").and_then(Value::as_u64) else {
        return Err(WireError::Malformed("no `schema`".to_owned()));
    };
    check_schema(version)?;
    serde_json::from_value(value).map_err(malformed)
}

fn check_schema(version: u64) -> Result<(), WireError> {
    if version == u64::from(SCHEMA) {
        Ok(())
    } else {
        Err(WireError::Schema(u16::try_from(version).unwrap_or(u16::MAX)))
    }
}

/// Sequence number of a message under a topic of a bed, without reading the rest of it where it is bincode. None where
/// messages carry none, or it is too short or of another schema.
#[must_use]
pub fn sequence(topic: &str, payload: &[u8], encoding: Encoding) -> Option<u64> {
    if topic.starts_with("pressure/") {
        return match encoding {
            Encoding::Bincode => number_at(payload, BLOCK_SEQUENCE),
            Encoding::Json => decode_json::<Numbered>(payload).ok().map(|numbered| numbered.sequence),
        };
    }
    let is_counted = topic.starts_with("estimate/") || topic == "status";
    (is_counted && encoding == Encoding::Bincode).then(|| number_at(payload, HEADER_SEQUENCE)).flatten()
}

/// Where the sequence number is in a [`PressureBlock`], and in a message that begins with a [`Header`] \[bytes\].
const BLOCK_SEQUENCE: usize = 2;
const HEADER_SEQUENCE: usize = 18;

/// What is needed of a block to count it.
#[derive(Deserialize)]
struct Numbered {
    sequence: u64,
}

fn number_at(payload: &[u8], at: usize) -> Option<u64> {
    check_schema(u64::from(u16::from_le_bytes(*payload.first_chunk()?))).ok()?;
    Some(u64::from_le_bytes(*payload.get(at..)?.first_chunk()?))
}

/// The JSON twin of a published message.
pub trait ToJson: Serialize {
    /// The same content, arranged by name.
    fn to_json(&self) -> Value;
}

fn with_header(header: &Header, body: Value) -> Value {
    let mut map = Map::new();
    map.insert("schema".into(), json!(header.schema));
    map.insert("seed".into(), json!(header.seed));
    // Beyond 2^53: JavaScript would round it.
    map.insert("config_hash".into(), json!(format!("{:016x}", header.config_hash)));
    map.insert("sequence".into(), json!(header.sequence));
    map.insert("time_ns".into(), json!(header.time_ns));
    if let Value::Object(body) = body {
        map.extend(body);
    }
    Value::Object(map)
}

impl ToJson for StateEstimate {
    fn to_json(&self) -> Value {
        let (n, k) = (self.names.len(), STATE_STATISTICS.len());
        let quantity = |q: usize| -> Value {
            let value = |t: usize, s: usize| self.values.get((t * n + q) * k + s).copied().unwrap_or(f64::NAN);
            let series = |s: usize| (0..self.times_ns.len()).map(|t| value(t, s)).collect();
            STATE_STATISTICS.iter().enumerate().map(|(s, name)| (*name, series(s))).collect::<Series>().into()
        };
        let quantities: Map<String, Value> =
            self.names.iter().enumerate().map(|(q, name)| (name.clone(), quantity(q))).collect();
        with_header(
            &self.header,
            json!({
                "members": self.members, "times_ns": self.times_ns, "since_data_s": self.since_data_s,
                "names": self.names, "quantities": quantities,
            }),
        )
    }
}

/// Named rows of numbers on their way to JSON.
#[derive(Default)]
struct Series(Map<String, Value>);

impl<'a> FromIterator<(&'a str, Vec<f64>)> for Series {
    fn from_iter<I: IntoIterator<Item = (&'a str, Vec<f64>)>>(rows: I) -> Self {
        Self(rows.into_iter().map(|(name, row)| (name.to_owned(), json!(row))).collect())
    }
}

impl From<Series> for Value {
    fn from(series: Series) -> Self {
        Self::Object(series.0)
    }
}

impl ToJson for ParameterEstimate {
    fn to_json(&self) -> Value {
        let k = PARAMETER_STATISTICS.len();
        let parameter = |p: usize| -> Map<String, Value> {
            let value = |s: usize| self.values.get(p * k + s).copied().unwrap_or(f64::NAN);
            let entry = |(s, name): (usize, &&str)| {
                let value = if *name == "identifiable" { json!(value(s) > 0.5) } else { json!(value(s)) };
                ((*name).to_owned(), value)
            };
            PARAMETER_STATISTICS.iter().enumerate().map(entry).collect()
        };
        let parameters: Map<String, Value> =
            self.names.iter().enumerate().map(|(p, name)| (name.clone(), Value::Object(parameter(p)))).collect();
        with_header(&self.header, json!({ "members": self.members, "names": self.names, "parameters": parameters }))
    }
}

impl ToJson for BeatEstimate {
    fn to_json(&self) -> Value {
        let k = BEAT_STATISTICS.len();
        let quantity = |q: usize| -> Map<String, Value> {
            let value = |s: usize| self.values.get(q * k + s).copied().unwrap_or(f64::NAN);
            let statistics = BEAT_STATISTICS.iter().enumerate().map(|(s, name)| ((*name).to_owned(), json!(value(s))));
            statistics.chain([("unit".to_owned(), json!(self.units.get(q)))]).collect()
        };
        let quantities: Map<String, Value> =
            self.names.iter().enumerate().map(|(q, name)| (name.clone(), Value::Object(quantity(q)))).collect();
        with_header(
            &self.header,
            json!({ "members": self.members, "end_ns": self.end_ns, "names": self.names, "quantities": quantities }),
        )
    }
}

impl ToJson for Members {
    fn to_json(&self) -> Value {
        let members: Vec<&[f64]> = self.values.chunks(self.names.len().max(1)).collect();
        with_header(&self.header, json!({ "names": self.names, "members": members }))
    }
}

impl ToJson for Status {
    fn to_json(&self) -> Value {
        let mut body = serde_json::to_value(self).unwrap_or(Value::Null);
        if let Value::Object(map) = &mut body {
            map.remove("header");
            map.insert("counters".into(), self.counters.iter().cloned().map(|(k, v)| (k, json!(v))).collect());
            map.insert("disagreement".into(), self.disagreement.iter().cloned().map(|(k, v)| (k, json!(v))).collect());
        }
        with_header(&self.header, body)
    }
}

impl ToJson for Event {
    fn to_json(&self) -> Value {
        with_header(&self.header, json!({ "kind": self.kind, "channel": self.channel, "text": self.text }))
    }
}

impl ToJson for Alarms {
    fn to_json(&self) -> Value {
        with_header(&self.header, json!({ "alarms": self.alarms }))
    }
}

impl ToJson for Truth {
    fn to_json(&self) -> Value {
        let values: Map<String, Value> =
            self.names.iter().zip(&self.values).map(|(name, value)| (name.clone(), json!(value))).collect();
        json!({ "schema": self.schema, "time_ns": self.time_ns, "names": self.names, "values": values })
    }
}
