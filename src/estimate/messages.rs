//! What an estimator can be told, and what it says.

use super::alarm::AlarmReport;
use super::beat::BeatEstimate;
use super::ensemble::{ParameterSummary, WindowReport};
use super::signal::quality::Artefact;
use super::statistics::Summary;
use super::time::{ArrivalTime, EventTime};
use super::window::{Liveness, RawSample, Refusal};

/// What an estimator can be told.
#[derive(Debug, Clone, PartialEq)]
pub enum Input {
    /// Samples of one channel, by its index in the settings.
    Samples {
        /// Index of the channel.
        channel: usize,
        /// In any order.
        samples: Vec<RawSample>,
    },
    /// Time has passed.
    Tick,
    /// No more samples will come: close what was delivered.
    End,
    /// Beats began at these times, says somebody who knows (an ECG).
    Beats(Vec<EventTime>),
    /// Whether the whole ensemble is to be put out with every estimate.
    WantMembers(bool),
    /// How many members to go on with, because the machine cannot keep up with more, or can again.
    Members(usize),
    /// An operator has seen an alarm.
    Acknowledge {
        /// Its name; None for all.
        alarm: Option<String>,
        /// Who; empty if that is not said.
        author: String,
    },
}

/// What an estimator says.
#[derive(Debug, Clone, PartialEq)]
pub enum Output {
    /// An estimate at a published time.
    Estimate(Estimate),
    /// An estimate at a published time, corrected by what came in the smoothing lag after it.
    Smoothed(Estimate),
    /// A heart beat is over.
    Beat(BeatEstimate),
    /// A window was solved.
    Window(WindowDone),
    /// Something happened.
    Notice(Notice),
    /// An alarm has changed, or the bed begins.
    Alarms(AlarmsNow),
}

/// States, derived quantities and parameters at one time.
#[derive(Debug, Clone, PartialEq)]
pub struct Estimate {
    /// When.
    pub time: EventTime,
    /// Since the last sample that entered the estimate \[ns\].
    pub since_data_ns: i64,
    /// Members that took part.
    pub members: usize,
    /// States, then derived quantities.
    pub quantities: Vec<Summary>,
    /// Estimated parameters, and the time since a window last said something about each \[ns\].
    pub parameters: Vec<(ParameterSummary, i64)>,
    /// `[n_members x (n_states + n_estimated)]` at the end of the window, if wanted.
    pub ensemble: Option<Vec<f64>>,
}

/// How all alarms stand.
#[derive(Debug, Clone, PartialEq)]
pub struct AlarmsNow {
    /// Event time of the bed.
    pub time: EventTime,
    /// One per alarm of the settings, in their order.
    pub alarms: Vec<AlarmReport>,
}

/// A solved window.
#[derive(Debug, Clone, PartialEq)]
pub struct WindowDone {
    /// Its end.
    pub end: EventTime,
    /// When the input came that closed it.
    pub closed_at: ArrivalTime,
    /// Number of samples in it.
    pub samples: usize,
    /// How it went.
    pub report: WindowReport,
}

/// Something that people may want to know.
#[derive(Debug, Clone, PartialEq)]
pub struct Notice {
    /// Event time of the bed when it happened.
    pub time: EventTime,
    /// What.
    pub kind: NoticeKind,
    /// Index of the channel concerned.
    pub channel: Option<usize>,
    /// For people, where the kind alone does not say it.
    pub text: Option<String>,
}

/// What can happen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NoticeKind {
    /// The first window of this bed.
    Start,
    /// A channel went silent; windows no longer wait for it.
    Gap,
    /// A silent channel is back.
    Recovered,
    /// Samples were refused (reported once in a while; the counters have all).
    Rejected(Refusal, usize),
    /// Messages that could not be understood (reported once in a while; the counters have all).
    NotUnderstood(&'static str),
    /// Started anew after a silence too long to bridge or a jump of the sender's clock.
    Restart,
    /// Members that lost their numbers were replaced by copies of others.
    MembersReplaced(usize),
    /// No member of a window could be solved; the ensemble stays where it was.
    WindowFailed,
    /// The machine cannot keep up: the ensemble goes on with this many of its members.
    Overload(usize),
    /// All members take part again.
    OverloadOver,
    /// A sensor is disturbed and set aside.
    Artefact(Artefact),
    /// A sensor is taken back.
    ArtefactOver,
    /// What a channel reads is no longer what the model says, beat after beat.
    Misfit,
    /// The model fits a channel again.
    FitsAgain,
    /// An estimated parameter, by its index in the model, has begun to move.
    ParameterShift(usize),
    /// The beat was found.
    BeatFound,
    /// No beat came when one was due.
    BeatMissed,
    /// A beat came at an unexpected time.
    BeatUnexpected,
    /// An alarm, by its place in the settings, was raised.
    Alarm(usize),
    /// The condition of an alarm is over.
    AlarmOver(usize),
    /// Somebody has seen an alarm.
    AlarmAcknowledged,
}

impl NoticeKind {
    /// Name in topics.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Start => "start",
            Self::Gap => "gap",
            Self::Recovered => "recovered",
            Self::Rejected(..) | Self::NotUnderstood(_) => "rejected",
            Self::Restart => "restart",
            Self::MembersReplaced(_) => "members_lost",
            Self::WindowFailed => "window_failed",
            Self::Overload(_) => "overload",
            Self::OverloadOver => "overload_over",
            Self::Artefact(_) => "artefact",
            Self::ArtefactOver => "artefact_over",
            Self::Misfit => "model_misfit",
            Self::FitsAgain => "model_fits",
            Self::ParameterShift(_) => "parameter_shift",
            Self::BeatFound => "beat_found",
            Self::BeatMissed => "beat_missed",
            Self::BeatUnexpected => "beat_unexpected",
            Self::Alarm(_) => "alarm",
            Self::AlarmOver(_) => "alarm_over",
            Self::AlarmAcknowledged => "alarm_acknowledged",
        }
    }

    /// For people.
    #[must_use]
    pub fn text(self) -> String {
        match self {
            Self::Start => "first window".to_owned(),
            Self::Gap => "no samples within the allowed lateness; its windows are forecasts".to_owned(),
            Self::Recovered => "samples again".to_owned(),
            Self::Rejected(cause, n) => format!("{n} samples refused: {}", cause.name()),
            Self::NotUnderstood(cause) => format!("a message was not understood: {cause}"),
            Self::Restart => "started anew: silence too long to bridge, or the sender's clock jumped".to_owned(),
            Self::MembersReplaced(n) => format!("{n} members lost their numbers and were replaced by others"),
            Self::WindowFailed => "no member could be solved".to_owned(),
            Self::Overload(n) => format!("the machine cannot keep up; the ensemble goes on with {n} members"),
            Self::OverloadOver => "all members take part again".to_owned(),
            Self::Artefact(artefact) => format!("set aside ({}): {}", artefact.name(), artefact.text()),
            Self::ArtefactOver => "undisturbed again and taken back".to_owned(),
            Self::Misfit => "the model no longer says what this sensor reads, beat after beat; bands widen".to_owned(),
            Self::FitsAgain => "the model says again what this sensor reads".to_owned(),
            Self::ParameterShift(_) => "a parameter has begun to move".to_owned(),
            Self::BeatFound => "the beat was found".to_owned(),
            Self::BeatMissed => "no beat came when one was due; the clock waits".to_owned(),
            Self::BeatUnexpected => "a beat came at an unexpected time; the clock was set".to_owned(),
            Self::Alarm(_) => "an alarm was raised".to_owned(),
            Self::AlarmOver(_) => "the condition of an alarm is over".to_owned(),
            Self::AlarmAcknowledged => "an alarm was acknowledged".to_owned(),
        }
    }
}

/// A channel, as a status tells it.
#[derive(Debug, Clone, PartialEq)]
pub struct ChannelHealth {
    /// State it observes.
    pub state: usize,
    /// Whether it delivers.
    pub liveness: Liveness,
    /// Its latest sample.
    pub last_sample: Option<EventTime>,
    /// Samples that entered the estimate.
    pub samples_used: u64,
    /// Root mean square of its normalised innovations, lately; NaN before any.
    pub innovation_rms: f64,
    /// Noise that it is taken to have \[mmHg\].
    pub noise_sd_mmhg: f64,
    /// See [`ChannelFit::whiteness`](super::adapt::fit::ChannelFit::whiteness).
    pub whiteness: f64,
    /// See [`ChannelFit::recurrence`](super::adapt::fit::ChannelFit::recurrence).
    pub recurrence: f64,
    /// Why it is set aside, if it is.
    pub artefact: Option<Artefact>,
    /// Whether the model no longer fits it.
    pub misfit: bool,
}

/// How far a second filter is from the ensemble.
#[derive(Debug, Clone, PartialEq)]
pub struct Disagreement {
    /// Per state: difference of the means, in units of both sd together.
    pub states: Vec<f64>,
    /// Per estimated parameter the same.
    pub parameters: Vec<f64>,
}
