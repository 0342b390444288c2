//! `resistance`: the truth has a pulmonary resistance that rises with the flow, the model does not.

use std::collections::BTreeMap;

use super::circulation::{Record, paper_config, quantities, record};
use super::experiment::{Experiment, Trace};
use super::{Context, StudyError};
use crate::edge::config::{Config, Coupling, DiscrepancyForm, DiscrepancySettings, InitialSd, PulmonaryLaw};
use crate::model::cvsim6::{Derived, Pressures, State};
use crate::report::plot::{Chart, Colour, Figure};
use crate::report::{Report, Table, mean, rms, short};

/// Position of the pulmonary flow among the true quantities.
const Q_PV: usize = Pressures::LEN + Derived::QPv as usize;

/// Samples per second \[Hz\].
const RATE_HZ: f64 = 500.0;
/// A free function of ten features wants twice as many samples in 10 ms.
const NOISELESS_RATE_HZ: f64 = 2000.0;
/// Without noise the data count far more, and what is believed of delta far less.
const NOISELESS_DATA_WEIGHT: f64 = 100.0;
const NOISELESS_CHANGE: f64 = 1e4;
const NOISELESS_MAGNITUDE: f64 = 3e3;
/// The flow through the inductance grows, and R_pv has to follow.
const INERTIAL_PARAMETER_WEIGHT: f64 = 3.0;

const NOISELESS: &str = "Recovered: free and tracked delta are the flow that the linear law lacks. The inertial one is the \
    affine law that an inductance makes of the linear one, not the difference itself: published, too, as a constraint \
    that keeps the flow positive. The linear model alone bends its physics to the data, which count so much here.";

const NOISY: &str = "Published: delta removes the bias of P_pa; the free one makes the flow negative, the inertial one does \
    not. The free one follows noise of some hundred mL/s from window to window; its spread is what the model-form column \
    shows. Tracked keeps the flow positive without an inductance; what it cannot follow within a beat stays outside its band, as \
    members of `independent` know nothing of each other's misfit. `coupled` with it has the smallest error of P_pa and \
    holds the true flow in its band; that of the free one does so by being 150 mL/s wide on either side.";

/// What the estimator believes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Belief {
    key: &'static str,
    name: &'static str,
    form: Option<DiscrepancyForm>,
    coupled: bool,
}

const LINEAR: Belief = Belief { key: "linear", name: "linear", form: None, coupled: false };
const BELIEFS: [Belief; 4] = [
    LINEAR,
    Belief { key: "free", name: "linear + free delta", form: Some(DiscrepancyForm::Free), coupled: false },
    Belief { key: "inertial", name: "linear + inertial delta", form: Some(DiscrepancyForm::Inertial), coupled: false },
    Belief { key: "tracked", name: "linear + tracked delta", form: Some(DiscrepancyForm::Tracked), coupled: false },
];
const COUPLED: [Belief; 2] = [
    Belief { key: "linear_coupled", name: "linear, coupled", form: None, coupled: true },
    Belief {
        key: "tracked_coupled",
        name: "linear + tracked delta, coupled",
        form: Some(DiscrepancyForm::Tracked),
        coupled: true,
    },
];

/// One run, looked at over the last two beats.
struct Run {
    belief: Belief,
    times_s: Vec<f64>,
    trace: Trace,
    truth: Vec<Vec<f64>>,
    /// Position of the pulmonary flow, of delta.
    q_pv: usize,
    delta: Option<usize>,
    r_pv: f64,
}

pub(super) fn run(context: &Context<'_>) -> Result<Report, StudyError> {
    let mut report = Report::new("resistance", "A wrong law of the pulmonary resistance");
    report.text(
        "Truth: R_pv rises with the flow. Model: constant R_pv, alone and with a discrepancy delta on Q_pv. Windows of 10 ms, \
         10 collocation points, 10 neurons; all six pressures observed. `free` is the paper's network per window, \
         `inertial` its CVSim-7 (L = 10 R_pv), `tracked` a random walk. With delta free or tracked R_pv keeps its nominal \
         value, because both stand for the same thing; otherwise it is estimated. Bias is the average error of the mean \
         over the last two beats.",
    );
    open_settings(&mut report);
    for (key, title, noise) in [("noiseless", "Noiseless data", false), ("noisy", "Noisy data", true)] {
        let mut runs = Vec::new();
        for belief in BELIEFS.iter().chain(COUPLED.iter().filter(|_| noise)) {
            (context.progress)(&format!("resistance, {key}: {}", belief.name));
            runs.push(simulate(context, *belief, noise)?);
        }
        report.text(format!("### {title}"));
        let rows = write_figures(&mut report, key, &runs);
        report.table(table(&rows, &runs));
        report.text(if noise { NOISY } else { NOISELESS });
        pictures(&mut report, key, &runs);
    }
    Ok(report)
}

fn open_settings(report: &mut Report) {
    let mut table = Table::new(["the paper leaves open", "here", "the outcome depends on it"]);
    table.row([
        "record",
        "noiseless 4 s at 2 kHz, noisy 12 s at 500 Hz",
        "a free delta of ten features wants two samples per feature: at 500 Hz its error is 40 %; tracked does with any",
    ]);
    table.row([
        "weight of the data",
        "noiseless 100, noisy 1",
        "with 1 and no noise delta is damped; with 10 and noise all forms follow the noise",
    ]);
    table.row([
        "what is believed of delta",
        "free: below 300 mL/s (noiseless 3000); tracked: 100 mL/s per square root of a second (noiseless 1e4)",
        "the noise that delta follows",
    ]);
    table.row([
        "w_theta of R_pv with inertial delta",
        "3 (elsewhere 10), started at its nominal value",
        "the flow through the inductance grows all the time and R_pv has to follow; with 10 it is late, and P_pa 0.4 mmHg off",
    ]);
    report.table(table);
}

fn config(belief: Belief, noise: bool) -> Config {
    let mut config = paper_config();
    config.window.length_s = 0.01;
    config.window.collocation_points = 10;
    config.window.neurons = 10;
    config.window.domain = [-1.0, 1.0];
    config.estimator.coupling = if belief.coupled { Coupling::Coupled } else { Coupling::Independent };
    if !noise {
        let channels = &mut config.channels;
        for channel in [
            &mut channels.p_l,
            &mut channels.p_a,
            &mut channels.p_v,
            &mut channels.p_r,
            &mut channels.p_pa,
            &mut channels.p_pv,
        ] {
            channel.noise_sd = 1e-6;
        }
        config.patient.initial_sd = InitialSd::Relative(0.0);
        config.window.data_weight = NOISELESS_DATA_WEIGHT;
    }
    if let Some(form) = belief.form {
        let loose = |value| (!noise).then_some(value);
        let settings = DiscrepancySettings {
            form,
            change: loose(NOISELESS_CHANGE),
            magnitude: loose(NOISELESS_MAGNITUDE),
            inertance: None,
            initial_sd: None,
        };
        config.discrepancy = BTreeMap::from([("q_pv".to_owned(), settings)]);
        config.estimator.initial_guess.clear();
        if form == DiscrepancyForm::Inertial {
            config.window.parameter_weight = INERTIAL_PARAMETER_WEIGHT;
        } else {
            // delta and R_pv stand for the same thing.
            config.estimator.estimate.clear();
        }
    }
    config
}

fn simulate(context: &Context<'_>, belief: Belief, noise: bool) -> Result<Run, StudyError> {
    let mut config = config(belief, noise);
    config.estimator.members = context.size(if noise { 100 } else { 20 }, 10);
    let until_s = context.size(if noise { 12.0 } else { 4.0 }, 2.0);
    let mut patient = config.clone();
    patient.patient.pulmonary_resistance = PulmonaryLaw::Nonlinear;
    let rate_hz = if noise { RATE_HZ } else { NOISELESS_RATE_HZ };
    let Record { samples, times_s, truth } = record(&patient, until_s, rate_hz, f64::from(u8::from(noise)), 1)?;
    let from = until_s - 120.0 / config.patient.heart_rate;
    let first = times_s.partition_point(|t| *t <= from);
    let (times_s, truth) = (times_s[first..].to_vec(), truth[first..].to_vec());
    let model = config.circulation()?;
    let discrepancies = model.discrepancies().len();
    let trace = Experiment {
        model,
        settings: config.estimator_settings()?,
        until_s,
        samples: &samples,
        report_at_s: &times_s,
        members_at_s: &[],
        average_s: (from, until_s),
    }
    .run(context.workers)?;
    let r_pv = trace.averages.first().map_or(config.patient.r_pv, |members| mean(members.iter().copied()));
    let delta = (discrepancies > 0).then_some(Pressures::LEN);
    Ok(Run { belief, times_s, trace, truth, q_pv: Q_PV + discrepancies, delta, r_pv })
}

impl Run {
    fn bias(&self, q: usize, truth: usize) -> f64 {
        mean(self.trace.quantities.iter().zip(&self.truth).map(|(s, t)| s[q].mean - t[truth]))
    }

    fn error(&self, q: usize, truth: usize) -> f64 {
        rms(self.trace.quantities.iter().zip(&self.truth).map(|(s, t)| s[q].mean - t[truth]))
    }

    /// What the true flow has beyond the linear law with the resistance of this run.
    fn true_delta(&self, i: usize) -> f64 {
        let truth = &self.truth[i];
        truth[Q_PV] - (truth[State::Pa as usize] - truth[State::Pv as usize]) / self.r_pv
    }

    fn delta_error(&self) -> f64 {
        let Some(delta) = self.delta else { return f64::NAN };
        let all = 0..self.times_s.len();
        rms(all.clone().map(|i| self.trace.quantities[i][delta].mean - self.true_delta(i)))
            / rms(all.map(|i| self.true_delta(i)))
    }

    fn least_flow(&self) -> f64 {
        self.trace.quantities.iter().map(|s| s[self.q_pv].mean).fold(f64::INFINITY, f64::min)
    }
}

fn write_figures(report: &mut Report, key: &str, runs: &[Run]) -> Vec<Vec<f64>> {
    let mut rows = Vec::new();
    for run in runs {
        let pa = State::Pa as usize;
        let values = [
            ("p_pa_bias", run.bias(pa, pa)),
            ("p_pa_rms_error", run.error(pa, pa)),
            ("q_pv_rms_error", run.error(run.q_pv, Q_PV)),
            ("q_pv_least", run.least_flow()),
            ("delta_relative_l2", run.delta_error()),
            ("p_pa_model_sd", mean(run.trace.quantities.iter().map(|s| s[pa].model_sd))),
            ("q_pv_model_sd", mean(run.trace.quantities.iter().map(|s| s[run.q_pv].model_sd))),
            ("r_pv", run.r_pv),
        ];
        for (name, value) in values {
            report.figure(&format!("{key}.{}.{name}", run.belief.key), value);
        }
        if run.belief.key == "free" {
            report.figure(&format!("{key}.delta_relative_l2"), run.delta_error());
        }
        rows.push(values.map(|(_, value)| value).to_vec());
    }
    rows
}

fn table(rows: &[Vec<f64>], runs: &[Run]) -> Table {
    let mut table = Table::new([
        "",
        "P_pa, bias [mmHg]",
        "P_pa, rms error",
        "Q_pv, rms error [mL/s]",
        "Q_pv, least mean",
        "delta, relative L2 error",
        "P_pa, model-form sd",
        "Q_pv, model-form sd",
        "R_pv",
    ]);
    for (run, row) in runs.iter().zip(rows) {
        table.row(std::iter::once(run.belief.name.to_owned()).chain(row.iter().map(|v| short(*v))));
    }
    table
}

fn pictures(report: &mut Report, key: &str, runs: &[Run]) {
    let names = quantities();
    for (stem, unit, of) in [("p_pa", "P_pa [mmHg]", State::Pa as usize), ("q_pv", "Q_pv [mL/s]", Q_PV)] {
        let mut figure = Figure::new(format!("{unit}, {key}"), 2);
        for run in runs {
            let q = if of == Q_PV { run.q_pv } else { of };
            let at =
                |f: &dyn Fn(usize) -> f64| (0..run.times_s.len()).map(|i| (run.times_s[i], f(i))).collect::<Vec<_>>();
            let band = run.times_s.iter().zip(&run.trace.quantities).map(|(t, s)| (*t, s[q].q05, s[q].q95)).collect();
            let chart = Chart::new(run.belief.name, "t [s]", unit)
                .band("5-95 %", band, Colour::Blue)
                .line("mean", at(&|i| run.trace.quantities[i][q].mean), Colour::Blue)
                .dashed("truth", at(&|i| run.truth[i][of]), Colour::Black);
            figure = figure.panel(chart);
        }
        report.picture(
            &format!("resistance_{key}_{stem}"),
            figure,
            format!("{} over the last two beats.", names[of].name),
        );
    }
    let mut figure = Figure::new(format!("delta, {key}"), 2);
    for run in runs.iter().filter(|run| run.delta.is_some()) {
        let Some(delta) = run.delta else { continue };
        let at = |f: &dyn Fn(usize) -> f64| (0..run.times_s.len()).map(|i| (run.times_s[i], f(i))).collect::<Vec<_>>();
        let chart = Chart::new(run.belief.name, "t [s]", "delta [mL/s]")
            .line("mean", at(&|i| run.trace.quantities[i][delta].mean), Colour::Blue)
            .dashed("truth", at(&|i| run.true_delta(i)), Colour::Black);
        figure = figure.panel(chart);
    }
    report.picture(
        &format!("resistance_{key}_delta"),
        figure,
        "What the linear law lacks, with the resistance of each run.",
    );
    for run in runs {
        let rows = (0..run.times_s.len()).map(|i| {
            let s = &run.trace.quantities[i];
            let (pa, q) = (&s[State::Pa as usize], &s[run.q_pv]);
            let delta = run.delta.map_or(f64::NAN, |d| s[d].mean);
            vec![
                run.times_s[i],
                pa.mean,
                pa.q05,
                pa.q95,
                run.truth[i][State::Pa as usize],
                q.mean,
                q.q05,
                q.q95,
                run.truth[i][Q_PV],
                delta,
                run.true_delta(i),
            ]
        });
        let header = [
            "time_s",
            "p_pa_mean",
            "p_pa_q05",
            "p_pa_q95",
            "p_pa_truth",
            "q_pv_mean",
            "q_pv_q05",
            "q_pv_q95",
            "q_pv_truth",
            "delta_mean",
            "delta_truth",
        ];
        report.series(&format!("resistance_{key}_{}", run.belief.key), header, rows.collect());
    }
}
