//! `identification`: right-hand sides of which nothing is known, and one in which a term is missing.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::experiment::{Experiment, Sample, Trace};
use super::{Context, StudyError};
use crate::estimate::settings::{
    Adaptation, Belief, ChannelSettings, CouplingKind, Drift, EstimatorSettings, LiveSettings, RowWeights,
    WindowSettings,
};
use crate::estimate::time::{NS_PER_S, ns_from_s};
use crate::model::Model;
use crate::model::discrepancy::{Discrepancy, Discrepant, Form};
use crate::model::lorenz::{self, Lorenz};
use crate::model::oscillator::{self, Oscillator};
use crate::model::truth::Simulator;
use crate::report::plot::{Chart, Colour, Figure};
use crate::report::{Report, Table, mean, rms, short};
use crate::xtfc::features::{FeatureSpec, Nodes};
use crate::xtfc::problem::Stopping;

/// Perturbation of the data that stands for none.
const NOISELESS_SD: f64 = 1e-9;
/// Data rows count more than physics rows: they are exact.
const DATA_WEIGHT: f64 = 1e3;
/// What is believed of an unknown right-hand side.
const UNKNOWN_WEIGHT: f64 = 1e-6;

/// One identification.
struct Task<'a, M> {
    key: &'static str,
    title: &'static str,
    /// What is known.
    model: M,
    /// Parameters that stand for what is not.
    unknown: &'a [usize],
    /// The truth at a state, one per unknown.
    truth: &'a dyn Fn(&[f64]) -> Vec<f64>,
    names: &'a [&'static str],
    window_s: f64,
    rate_hz: f64,
    until_s: f64,
    noise_sd: f64,
}

pub(super) fn run(context: &Context<'_>) -> Result<Report, StudyError> {
    let mut report = Report::new("identification", "Black box and gray box");
    report.text(
        "Every unknown right-hand side is a network of its own, a free function of time in every window, fitted to \
         samples of all states together with the network of the state. Black box: nothing of the equations is known. Gray \
         box: one term is missing. Noiseless samples, and the same with noise of about 0.1 % of the range for comparison: a \
         derivative within a short window amplifies noise, which is what a free function has to pay. `coupled` has \
         nothing to share here: a free function carries nothing from window to window.",
    );
    let mut page = Page {
        report,
        table: Table::new(["", "unknown", "relative L2 error, noiseless", "with noise"]),
        figure: Figure::new("Recovered right-hand sides", 3),
    };

    let everything = Oscillator::default();
    let theta = everything.default_parameters();
    let truth = |x: &[f64]| right_hand_side(&everything, &theta, x);
    let black = Oscillator { known: oscillator::Known::Nothing };
    let unknown = [oscillator::Parameter::DeltaX as usize, oscillator::Parameter::DeltaY as usize];
    let task = |noise_sd| Task {
        key: "oscillator_black_box",
        title: "Oscillator, black box",
        model: black,
        unknown: &unknown,
        truth: &truth,
        names: &["dx/dt", "dy/dt"],
        window_s: 0.5,
        rate_hz: 100.0,
        until_s: context.size(10.0, 2.0),
        noise_sd,
    };
    page.compare(context, (&everything, &[1.0, 0.0]), &task(NOISELESS_SD), &task(2e-3))?;

    let everything = Lorenz::default();
    let theta = everything.default_parameters();
    let truth = |x: &[f64]| right_hand_side(&everything, &theta, x);
    let missing_term = |x: &[f64]| vec![-x[0] * x[2]];
    let start = [-8.0, 7.0, 27.0];
    let deltas = [lorenz::Parameter::DeltaX, lorenz::Parameter::DeltaY, lorenz::Parameter::DeltaZ].map(|p| p as usize);
    let black = |noise_sd| Task {
        key: "lorenz_black_box",
        title: "Lorenz 63, black box",
        model: Lorenz { known: lorenz::Known::Nothing },
        unknown: &deltas,
        truth: &truth,
        names: &["dx/dt", "dy/dt", "dz/dt"],
        window_s: 0.05,
        rate_hz: 400.0,
        until_s: context.size(10.0, 2.0),
        noise_sd,
    };
    let gray = |noise_sd| Task {
        key: "lorenz_gray_box",
        title: "Lorenz 63, gray box",
        model: Lorenz { known: lorenz::Known::AllButXz },
        unknown: &deltas[1..2],
        truth: &missing_term,
        names: &["-x z"],
        ..black(noise_sd)
    };
    page.compare(context, (&everything, &start), &black(NOISELESS_SD), &black(0.04))?;
    page.compare(context, (&everything, &start), &gray(NOISELESS_SD), &gray(0.04))?;
    let Page { mut report, table, figure } = page;
    report.table(table);
    report.picture("identification", figure, "Noiseless: what was recovered (colour) on the truth (dashed).");
    Ok(report)
}

fn right_hand_side<M: Model>(model: &M, theta: &[f64], x: &[f64]) -> Vec<f64> {
    let mut dx = vec![0.0; x.len()];
    model.rhs(0.0, x, theta, &mut dx);
    dx
}

/// What the study writes.
struct Page {
    report: Report,
    table: Table,
    figure: Figure,
}

impl Page {
    /// Runs a task without and with noise, and writes both down; the truth is a model and where it starts.
    fn compare<T: Model, M: Model>(
        &mut self,
        context: &Context<'_>,
        (everything, start): (&T, &[f64]),
        clean: &Task<'_, M>,
        noisy: &Task<'_, M>,
    ) -> Result<(), StudyError> {
        let (trace, exact) = clean.run(context, everything, start)?;
        let (noisy_trace, _) = noisy.run(context, everything, start)?;
        let first = start.len();
        let mut rows: Vec<Vec<f64>> = trace.times_s.iter().map(|t| vec![*t]).collect();
        let mut header = vec!["time_s".to_owned()];
        for (k, name) in clean.names.iter().enumerate() {
            let error = |trace: &Trace| {
                let off = trace.quantity(first + k).zip(&exact).map(|((_, s), e)| s.mean - e[k]);
                rms(off) / rms(exact.iter().map(|e| e[k]))
            };
            let (without, with) = (error(&trace), error(&noisy_trace));
            let key = name.replace(['-', ' '], "").replace('/', "_");
            self.report.figure(&format!("{}.{key}.relative_l2", clean.key), without);
            self.report.figure(&format!("{}.{key}.relative_l2_noisy", clean.key), with);
            self.table.row([clean.title.to_owned(), (*name).to_owned(), percent(without), percent(with)]);
            let colour = [Colour::Blue, Colour::Orange, Colour::Green][k % 3];
            let curve = trace.quantity(first + k).map(|(t, s)| (t, s.mean)).collect();
            let truth = trace.times_s.iter().zip(&exact).map(|(t, e)| (*t, e[k])).collect();
            let chart = Chart::new(format!("{}: {name}", clean.title), "t [s]", *name)
                .line("recovered", curve, colour)
                .dashed("truth", truth, Colour::Black);
            self.figure.panels.push(chart.into());
            header.extend([key.clone(), format!("{key}_exact")]);
            for ((row, (_, s)), e) in rows.iter_mut().zip(trace.quantity(first + k)).zip(&exact) {
                row.extend([s.mean, e[k]]);
            }
        }
        self.report.figure(&format!("{}.mean_sd", clean.key), mean(trace.quantity(first).map(|(_, s)| s.model_sd)));
        self.report.series(clean.key, header, rows);
        Ok(())
    }
}

fn percent(share: f64) -> String {
    format!("{} %", short(100.0 * share))
}

impl<M: Model> Task<'_, M> {
    /// The trace, and the truth at its times.
    #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, clippy::cast_precision_loss)]
    fn run<T: Model>(
        &self,
        context: &Context<'_>,
        everything: &T,
        start: &[f64],
    ) -> Result<(Trace, Vec<Vec<f64>>), StudyError> {
        let mut simulator = Simulator::new(everything.clone(), start.to_vec(), everything.default_parameters(), vec![]);
        let (mut samples, mut times, mut exact) = (Vec::new(), Vec::new(), Vec::new());
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let count = (self.until_s * self.rate_hz).round() as usize;
        for i in 1..=count {
            let time_s = i as f64 / self.rate_hz;
            simulator.advance_to(time_s)?;
            let x = simulator.state();
            for (channel, value) in x.iter().enumerate() {
                let e: f64 = StandardNormal.sample(&mut rng);
                samples.push(Sample { time_s, channel, value: value + self.noise_sd * e });
            }
            times.push(time_s);
            exact.push((self.truth)(x));
        }
        let free = |&parameter: &usize| Discrepancy { parameter, form: Form::Free };
        let model = Discrepant::new(self.model.clone(), &self.unknown.iter().map(free).collect::<Vec<_>>())?;
        let experiment = Experiment {
            settings: self.settings(&model, start, context.size(20, 5)),
            model,
            until_s: self.until_s,
            samples: &samples,
            report_at_s: &times,
            members_at_s: &[],
            average_s: (0.0, 0.0),
        };
        Ok((experiment.run(context.workers)?, exact))
    }

    fn settings(&self, model: &Discrepant<M>, start: &[f64], members: usize) -> EstimatorSettings {
        let (n, unknowns) = (start.len(), self.unknown.len());
        let padded = |own: Vec<f64>, unknown: f64| own.into_iter().chain(vec![unknown; unknowns]).collect::<Vec<_>>();
        let channel = |state| ChannelSettings {
            state,
            noise_sd_mmhg: self.noise_sd,
            plausible_mmhg: (f64::NEG_INFINITY, f64::INFINITY),
        };
        EstimatorSettings {
            coupling: CouplingKind::Independent,
            estimate: Vec::new(),
            members,
            seed: 1,
            theta: model.default_parameters(),
            beliefs: Belief::of_all(model, 0.1, 0.0),
            initial_state: padded(start.to_vec(), 0.0),
            initial_state_sd: padded(vec![0.0; n], 0.0),
            features: FeatureSpec {
                count: 10,
                domain: (-1.0, 1.0),
                nodes: 20,
                placement: Nodes::Legendre,
                ..FeatureSpec::default()
            },
            window: WindowSettings {
                length_ns: ns_from_s(self.window_s),
                allowed_lateness_ns: 0,
                forecast_limit_ns: i64::MAX,
            },
            weights: RowWeights { physics: padded(vec![1.0; n], UNKNOWN_WEIGHT), data: DATA_WEIGHT, parameter: 1.0 },
            drift: Drift { states: padded(vec![0.0; n], 0.0), inflation: 1.0 },
            adaptation: Adaptation::OFF,
            live: LiveSettings::default(),
            stopping: Stopping { max_iterations: 50, tolerance_mmhg: 1e-8 },
            instructions: crate::model::lanes::InstructionSet::default(),
            channels: (0..n).map(channel).collect(),
            aleatoric_sd_mmhg: padded(vec![self.noise_sd; n], 0.0),
            publish_period_ns: NS_PER_S,
        }
    }
}
