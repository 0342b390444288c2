//! `harmonic-discrepancy`: the truth grows, the model does not, and a network stands for what it lacks.

use super::experiment::{Experiment, Sample, Trace};
use super::harmonic::{HORIZON_S, K, Setup, X0, curve, grid, record, with_data};
use super::{Context, StudyError};
use crate::estimate::settings::{CouplingKind, EstimatorSettings};
use crate::estimate::statistics::Summary;
use crate::model::discrepancy::{Discrepancy, Discrepant, Form};
use crate::model::harmonic::{Harmonic, Law, Parameter};
use crate::report::plot::{Figure, Panel};
use crate::report::{Report, Table, mean, rms, short};

/// Sd of the sensor; x goes up to 27.
const NOISE_SD: f64 = 0.2;
/// Records that the errors are averaged over.
const RECORDS: u64 = 5;
/// The source of uncertainty that the pictures show.
const MODEL: (&str, fn(&Summary) -> f64) = ("model form", |s| s.model_sd);
/// What is believed of delta: hardly anything.
const DELTA_WEIGHT: f64 = 1e-3;

pub(super) fn run(context: &Context<'_>) -> Result<Report, StudyError> {
    let mut report = Report::new("harmonic-discrepancy", "A wrong model, and what it lacks");
    report.text(format!(
        "Truth `dx/dt = x cos(k t)/k`, model `dx/dt = cos(k t)/k + delta(t)` with `k = 1` known, so that exactly \
         `delta = (x - 1) cos(t)`. Data all over [0, 10), noise sd {NOISE_SD} (the paper leaves both open), B = 1, 20 tanh \
         neurons for x and as many for delta, which is free (weight {DELTA_WEIGHT} on delta = 0). Without delta the model \
         is asked to explain the data alone. Errors are averages over {RECORDS} records, pictures \
         show the first. Most of the error of delta is at the ends and in gaps of the record, where a derivative is not known."
    ));
    let truth = Harmonic { law: Law::Growing };
    let exact = |t: f64| truth.exact(t, X0, K);
    let exact_delta = |t: f64| (exact(t) - 1.0) * t.cos();
    let mut table =
        Table::new(["samples", "", "x, rms error", "delta, relative L2 error", "delta, mean model-form sd"]);
    let mut figure = Figure::new("Discrepancy of the harmonic example", 3);
    let mut deltas: Vec<Panel> = Vec::new();
    for (key, coupling, sizes) in
        [("independent", CouplingKind::Independent, &[20, 50, 200][..]), ("coupled", CouplingKind::Coupled, &[50][..])]
    {
        for &size in sizes {
            let (mut errors, mut first) = (Vec::new(), None);
            for seed in 0..context.size(RECORDS, 1) {
                let samples = record(exact, size, HORIZON_S, NOISE_SD, 11 + seed);
                let trace = with_delta(context, coupling, &samples)?;
                errors.push([
                    rms(trace.quantity(0).map(|(t, s)| s.mean - exact(t))),
                    rms(trace.quantity(1).map(|(t, s)| s.mean - exact_delta(t)))
                        / rms(trace.times_s.iter().map(|&t| exact_delta(t))),
                    mean(trace.quantity(1).map(|(_, s)| s.model_sd)),
                ]);
                first.get_or_insert((samples, trace));
            }
            let Some((samples, trace)) = first else { continue };
            let [x_error, delta_error, sd] = [0, 1, 2].map(|i| mean(errors.iter().map(|e| e[i])));
            let path = format!("{key}.n{size}");
            report.figure(&format!("{path}.x_rms_error"), x_error);
            report.figure(&format!("{path}.delta_relative_l2"), delta_error);
            report.figure(&format!("{path}.delta_model_sd"), sd);
            table.row([size.to_string(), key.to_owned(), short(x_error), short(delta_error), short(sd)]);
            if key == "independent" {
                let title = format!("{size} samples");
                let x = curve((&title, "x"), (&trace, 0), MODEL, exact);
                figure = figure.panel(with_data(x, &samples));
                deltas.push(curve((&title, "delta"), (&trace, 1), MODEL, exact_delta).into());
            }
            let rows = trace.times_s.iter().zip(&trace.quantities);
            let rows =
                rows.map(|(&t, q)| vec![t, exact(t), q[0].mean, q[0].sd, exact_delta(t), q[1].mean, q[1].model_sd]);
            let header = ["time_s", "exact", "mean", "sd", "exact_delta", "delta_mean", "delta_model_sd"];
            report.series(&format!("harmonic_discrepancy_{key}_{size}"), header, rows.collect());
        }
    }
    let samples = record(exact, 50, HORIZON_S, NOISE_SD, 11);
    let without = without_delta(context, &samples)?;
    let error = rms(without.quantity(0).map(|(t, s)| s.mean - exact(t)));
    let band = mean(without.quantity(0).map(|(_, s)| s.epistemic_sd));
    report.figure("without.x_rms_error", error);
    report.figure("without.epistemic_sd", band);
    table.row(["50", "without delta", &short(error), "-", "-"]);
    report.table(table);
    figure.panels.extend(deltas);
    report.picture(
        "harmonic_discrepancy",
        figure,
        "Above x, below delta, for three data sizes. Published: delta is recovered, the better the more data.",
    );
    let alone = curve(("50 samples, without delta", "x"), (&without, 0), MODEL, exact);
    report.picture(
        "harmonic_discrepancy_without",
        Figure::new("The wrong model alone", 1).panel(with_data(alone, &samples)),
        "Without delta the estimate is wrong by far more than its band.",
    );
    Ok(report)
}

fn with_delta(context: &Context<'_>, coupling: CouplingKind, samples: &[Sample]) -> Result<Trace, StudyError> {
    let free = Discrepancy { parameter: Parameter::Delta as usize, form: Form::Free };
    let model = Discrepant::new(Harmonic::default(), &[free])?;
    let setup = Setup { coupling, estimate_k: false, noise_sd: NOISE_SD, ..Setup::new(context.size(300, 30), 1) };
    let settings = setup.settings(&model, Some(DELTA_WEIGHT));
    Ok(experiment(model, settings, samples, &grid()).run(context.workers)?)
}

fn without_delta(context: &Context<'_>, samples: &[Sample]) -> Result<Trace, StudyError> {
    let model = Harmonic::default();
    let setup = Setup { estimate_k: false, noise_sd: NOISE_SD, ..Setup::new(context.size(300, 30), 1) };
    let settings = setup.settings(&model, None);
    Ok(experiment(model, settings, samples, &grid()).run(context.workers)?)
}

fn experiment<'a, M>(model: M, settings: EstimatorSettings, samples: &'a [Sample], at: &'a [f64]) -> Experiment<'a, M> {
    Experiment {
        model,
        settings,
        until_s: HORIZON_S,
        samples,
        report_at_s: at,
        members_at_s: &[],
        average_s: (0.0, 0.0),
    }
}
