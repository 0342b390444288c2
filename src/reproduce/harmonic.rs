//! `harmonic`: dx/dt = cos(k t) / k with k unknown, data in the first half, prediction in the second.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal, Uniform};

use super::experiment::{Experiment, Sample, Trace};
use super::{Context, StudyError, timed};
use crate::estimate::settings::{
    Adaptation, Belief, ChannelSettings, CouplingKind, Drift, EstimatorSettings, LiveSettings, RowWeights,
    WindowSettings,
};
use crate::estimate::statistics::{Summary, mean_and_sd};
use crate::estimate::time::ns_from_s;
use crate::model::Model;
use crate::model::harmonic::{Harmonic, Parameter};
use crate::report::plot::{Chart, Colour, Figure};
use crate::report::{Report, Table, mean, plus_minus, rms, short};
use crate::xtfc::features::{Activation, FeatureSpec, Nodes, WeightDistribution};
use crate::xtfc::problem::Stopping;

/// Everything the harmonic studies choose. The defaults are the paper's where it
/// says, and those of [`open_settings`] where not.
#[derive(Debug, Clone)]
pub(super) struct Setup {
    pub coupling: CouplingKind,
    pub members: usize,
    /// Subdomains `B` on `[0, horizon_s]`.
    pub subdomains: usize,
    pub neurons: usize,
    pub nodes: usize,
    pub activation: Activation,
    pub weights: WeightDistribution,
    /// `lambda_1`.
    pub physics_weight: f64,
    /// `w_theta` of `independent`.
    pub parameter_weight: f64,
    /// Where `k` starts.
    pub k_guess: f64,
    /// Whether `k` is unknown.
    pub estimate_k: bool,
    /// Sd of the sensor.
    pub noise_sd: f64,
    pub seed: u64,
}

/// Prediction up to here \[s\].
pub(super) const HORIZON_S: f64 = 10.0;
/// Data up to here \[s\].
pub(super) const DATA_UNTIL_S: f64 = 5.0;
/// Known start.
pub(super) const X0: f64 = 10.0;
/// The truth.
pub(super) const K: f64 = 1.0;
/// Sd of the sensor.
pub(super) const NOISE_SD: f64 = 0.2;
/// Where k starts.
pub(super) const K_GUESS: f64 = 1.2;
/// Number of samples.
pub(super) const SAMPLES: usize = 20;
/// Seed of the one record that all harmonic studies with an unknown `k` share.
pub(super) const RECORD_SEED: u64 = 7;
/// `coupled` weighs data by 1/noise; the physics has to bind as strongly.
const COUPLED_PHYSICS_WEIGHT: f64 = 50.0;

impl Setup {
    pub(super) fn new(members: usize, subdomains: usize) -> Self {
        Self {
            coupling: CouplingKind::Independent,
            members,
            subdomains,
            neurons: 20,
            nodes: if subdomains == 1 { 30 } else { 20 },
            activation: Activation::Tanh,
            weights: WeightDistribution::Uniform { low: -1.0, high: 1.0 },
            physics_weight: 1.0,
            parameter_weight: if subdomains == 1 { 1e-3 } else { 1.0 },
            k_guess: K_GUESS,
            estimate_k: true,
            noise_sd: NOISE_SD,
            seed: 1,
        }
    }

    /// Settings for a model whose state is `x`, and a discrepancy if `discrepancy_weight` says how much is believed
    /// of its equation.
    pub(super) fn settings<M: Model>(&self, model: &M, discrepancy_weight: Option<f64>) -> EstimatorSettings {
        let mut theta = model.default_parameters();
        if self.estimate_k {
            theta[Parameter::K as usize] = self.k_guess;
        }
        let with = |x: f64, delta: f64| std::iter::once(x).chain(discrepancy_weight.map(|_| delta)).collect();
        #[allow(clippy::cast_precision_loss)]
        let length_ns = ns_from_s(HORIZON_S / self.subdomains as f64);
        EstimatorSettings {
            coupling: self.coupling,
            estimate: if self.estimate_k { vec![Parameter::K as usize] } else { Vec::new() },
            members: self.members,
            seed: self.seed,
            theta,
            beliefs: Belief::of_all(model, 0.3, 0.0),
            initial_state: with(X0, 0.0),
            initial_state_sd: with(0.0, 0.0),
            features: FeatureSpec {
                activation: self.activation,
                count: self.neurons,
                weights: self.weights,
                biases: self.weights,
                domain: (-1.0, 1.0),
                nodes: self.nodes,
                placement: Nodes::Uniform,
            },
            window: WindowSettings { length_ns, allowed_lateness_ns: 0, forecast_limit_ns: i64::MAX },
            weights: RowWeights {
                physics: std::iter::once(self.physics_weight).chain(discrepancy_weight).collect(),
                data: 1.0,
                parameter: self.parameter_weight,
            },
            drift: Drift { states: with(0.0, 0.0), inflation: 1.0 },
            adaptation: Adaptation::OFF,
            live: LiveSettings::default(),
            stopping: Stopping { max_iterations: 50, tolerance_mmhg: 1e-6 },
            instructions: crate::model::lanes::InstructionSet::default(),
            channels: vec![ChannelSettings {
                state: 0,
                noise_sd_mmhg: self.noise_sd,
                plausible_mmhg: (f64::NEG_INFINITY, f64::INFINITY),
            }],
            aleatoric_sd_mmhg: with(self.noise_sd, 0.0),
            publish_period_ns: length_ns,
        }
    }

    /// Runs the linear model with unknown `k`.
    pub(super) fn run(&self, samples: &[Sample], context: &Context<'_>) -> Result<(Trace, f64), StudyError> {
        let model = Harmonic::default();
        let experiment = Experiment {
            settings: self.settings(&model, None),
            model,
            until_s: HORIZON_S,
            samples,
            report_at_s: &grid(),
            members_at_s: &[],
            average_s: (0.0, if self.subdomains == 1 { HORIZON_S } else { DATA_UNTIL_S }),
        };
        let (trace, wall_s) = timed(|| experiment.run(context.workers));
        Ok((trace?, wall_s))
    }
}

/// Times of the curves \[s\].
pub(super) fn grid() -> Vec<f64> {
    (0..=50).map(|i| HORIZON_S * f64::from(i) / 50.0).collect()
}

/// A noisy record at irregular times in `[0, until_s)`.
pub(super) fn record(exact: impl Fn(f64) -> f64, count: usize, until_s: f64, noise_sd: f64, seed: u64) -> Vec<Sample> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut times: Vec<f64> = match Uniform::new(0.0, until_s) {
        Ok(times) => (0..count).map(|_| times.sample(&mut rng)).collect(),
        Err(_) => Vec::new(),
    };
    times.sort_by(f64::total_cmp);
    let noisy = |time_s: f64| {
        let e: f64 = StandardNormal.sample(&mut rng);
        Sample { time_s, channel: 0, value: exact(time_s) + noise_sd * e }
    };
    times.into_iter().map(noisy).collect()
}

/// The record of the studies with an unknown `k`.
pub(super) fn shared_record() -> Vec<Sample> {
    record(|t| Harmonic::default().exact(t, X0, K), SAMPLES, DATA_UNTIL_S, NOISE_SD, RECORD_SEED)
}

/// Mean and sd over the members of the estimated `k`, averaged over the windows of [`Experiment::average_s`].
pub(super) fn k_of(trace: &Trace) -> (f64, f64) {
    mean_and_sd(&trace.averages[0])
}

/// Mean over `(from, to]` of the error of the mean and of the epistemic sd.
pub(super) fn error_and_band(trace: &Trace, exact: impl Fn(f64) -> f64, from: f64, to: f64) -> (f64, f64) {
    let within = || trace.quantity(0).filter(|(t, _)| *t > from && *t <= to);
    (rms(within().map(|(t, s)| s.mean - exact(t))), mean(within().map(|(_, s)| s.epistemic_sd)))
}

/// Mean, total band, the band of one source, and truth of one quantity.
pub(super) fn curve(
    (title, y): (&str, &str),
    (trace, q): (&Trace, usize),
    (source, sd): (&str, fn(&Summary) -> f64),
    exact: impl Fn(f64) -> f64,
) -> Chart {
    let edges = |half: fn(&Summary) -> f64| -> Vec<(f64, f64, f64)> {
        trace.quantity(q).map(|(t, s)| (t, s.mean - 2.0 * half(s), s.mean + 2.0 * half(s))).collect()
    };
    Chart::new(title, "t [s]", y)
        .band("total, 2 sd", edges(|s| s.sd), Colour::SkyBlue)
        .band(&format!("{source}, 2 sd"), edges(sd), Colour::Orange)
        .line("mean", trace.quantity(q).map(|(t, s)| (t, s.mean)).collect(), Colour::Blue)
        .dashed("exact", trace.times_s.iter().map(|&t| (t, exact(t))).collect(), Colour::Black)
}

/// The same with the data of a record.
pub(super) fn with_data(chart: Chart, samples: &[Sample]) -> Chart {
    chart.points("data", samples.iter().map(|s| (s.time_s, s.value)).collect(), Colour::Vermilion)
}

/// Curve with bands, data in the first half, and truth.
pub(super) fn chart(title: &str, trace: &Trace, samples: &[Sample], exact: impl Fn(f64) -> f64) -> Chart {
    let curve = curve((title, "x"), (trace, 0), ("epistemic", |s| s.epistemic_sd), exact);
    with_data(curve.region("no data", DATA_UNTIL_S, HORIZON_S), samples)
}

/// The settings that the paper leaves open, for the report.
pub(super) fn open_settings(report: &mut Report) {
    let mut table = Table::new(["the paper leaves open", "here", "the outcome depends on it"]);
    table.row([
        "data".to_owned(),
        format!("{SAMPLES} samples at uniformly random times in [0, {DATA_UNTIL_S}), noise sd {NOISE_SD}"),
        "the sd of k is proportional to noise / sqrt(samples)".to_owned(),
    ]);
    table.row([
        "noise of the members",
        "one noisy record; every member adds noise of the same sd to it",
        "the mean of k carries the error of that record, about one sd of k",
    ]);
    table.row([
        "lambda_1, lambda_2".to_owned(),
        format!("1 and 1 (`coupled`: {COUPLED_PHYSICS_WEIGHT} and 1/noise)"),
        "`harmonic-weights` sweeps lambda_1".to_owned(),
    ]);
    table.row([
        "collocation points, domain",
        "30 (B = 1) or 20 (B = 15), equally spaced; [-1, 1]",
        "hardly, as long as there are more points than directions (about 12 of 20 neurons are independent)",
    ]);
    table.row([
        "k between windows",
        "B = 1: free; B = 15: tied to its last value by w_theta = 1; k averaged over the windows that end before t = 5",
        "w_theta trades the spread of k against the number of windows it takes to forget the guess",
    ]);
    table.row([
        "start of k".to_owned(),
        K_GUESS.to_string(),
        "not at all for B = 1; for B = 15 the first windows still carry it".to_owned(),
    ]);
    report.table(table);
}

pub(super) fn run(context: &Context<'_>) -> Result<Report, StudyError> {
    let mut report = Report::new("harmonic", "Harmonic example: an unknown parameter, data in the first half");
    report.text(
        "`dx/dt = cos(k t)/k`, `x(0) = 10`, `k = 1` unknown, noisy irregular data only in [0, 5), prediction to 10; \
         20 tanh neurons, 1,000 members.",
    );
    open_settings(&mut report);
    let exact = |t: f64| Harmonic::default().exact(t, X0, K);
    let samples = shared_record();
    let members = context.size(1000, 100);
    let mut table = Table::new([
        "",
        "k, paper",
        "k, here",
        "wall, paper [s]",
        "wall, here [s]",
        "x, rms error in [5, 10]",
        "not converged",
    ]);
    let mut figure = Figure::new("Harmonic example", 3);
    let cases = [
        ("b1", "B = 1", CouplingKind::Independent, 1, "0.9840 ± 0.0536", "17.12"),
        ("b15", "B = 15", CouplingKind::Independent, 15, "0.9765 ± 0.0747", "5.42"),
        ("coupled_b15", "B = 15, coupled", CouplingKind::Coupled, 15, "-", "-"),
    ];
    for (key, name, coupling, subdomains, k_paper, wall_paper) in cases {
        let mut setup = Setup { coupling, ..Setup::new(members, subdomains) };
        if coupling == CouplingKind::Coupled {
            setup.physics_weight = COUPLED_PHYSICS_WEIGHT;
        }
        let (trace, wall_s) = setup.run(&samples, context)?;
        let (k_mean, k_sd) = if coupling == CouplingKind::Coupled {
            // What all data together say is what the last window with data says.
            trace.parameters.last().map_or((f64::NAN, f64::NAN), |p| (p[0].mean, p[0].sd))
        } else {
            k_of(&trace)
        };
        let (error, band) = error_and_band(&trace, exact, DATA_UNTIL_S, HORIZON_S);
        let figures = [
            ("k_mean", k_mean),
            ("k_sd", k_sd),
            ("wall_s", wall_s),
            ("extrapolation_rms_error", error),
            ("extrapolation_epistemic_sd", band),
        ];
        figures.iter().for_each(|(path, value)| report.figure(&format!("{key}.{path}"), *value));
        table.row([
            name.to_owned(),
            k_paper.to_owned(),
            plus_minus(k_mean, k_sd),
            wall_paper.to_owned(),
            short(wall_s),
            short(error),
            trace.not_converged.to_string(),
        ]);
        figure = figure.panel(chart(name, &trace, &samples, exact));
        let rows = trace.quantity(0).map(|(t, s)| vec![t, exact(t), s.mean, s.sd, s.epistemic_sd, s.q05, s.q95]);
        let header = ["time_s", "exact", "mean", "sd", "epistemic_sd", "q05", "q95"];
        report.series(&format!("harmonic_{key}"), header, rows.collect());
    }
    report.table(table);
    report.picture("harmonic", figure, "Mean and bands of x; the stripe has no data. Published: figures 2 and 3.");
    records(&mut report, context)?;
    Ok(report)
}

/// How far k scatters from record to record: a single record cannot tell a bias from bad luck.
fn records(report: &mut Report, context: &Context<'_>) -> Result<(), StudyError> {
    let count = context.size(40, 5);
    let mut table =
        Table::new(["", "mean of k over records", "sd over records", "mean sd of the members", "truth within 2 sd"]);
    for (key, subdomains) in [("b1", 1), ("b15", 15)] {
        let mut found = Vec::new();
        for seed in 0..count {
            let exact = |t: f64| Harmonic::default().exact(t, X0, K);
            let samples = record(exact, SAMPLES, DATA_UNTIL_S, NOISE_SD, 1000 + seed);
            let (trace, _) = Setup { seed, ..Setup::new(100, subdomains) }.run(&samples, context)?;
            found.push(k_of(&trace));
        }
        let (means, sds): (Vec<f64>, Vec<f64>) = found.iter().copied().unzip();
        let ((mean, sd), (typical, _)) = (mean_and_sd(&means), mean_and_sd(&sds));
        #[allow(clippy::cast_precision_loss)]
        let covered = found.iter().filter(|(m, s)| (m - K).abs() <= 2.0 * s).count() as f64 / found.len() as f64;
        let label = format!("B = {subdomains}, {count} records");
        table.row([label, short(mean), short(sd), short(typical), format!("{:.0} %", 100.0 * covered)]);
        for (path, value) in [("mean", mean), ("sd", sd), ("members_sd", typical), ("covered_2sd", covered)] {
            report.figure(&format!("{key}.records.{path}"), value);
        }
    }
    report.text("Over other records of the same kind:");
    report.table(table);
    Ok(())
}
