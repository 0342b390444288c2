//! `harmonic-ablation`: members, neurons, activations and initial distributions, one at a time.

use super::harmonic::{DATA_UNTIL_S, HORIZON_S, K, Setup, X0, error_and_band, k_of, shared_record};
use super::{Context, StudyError};
use crate::model::harmonic::Harmonic;
use crate::report::plot::{Chart, Colour, Figure};
use crate::report::{Report, Table, plus_minus, short};
use crate::xtfc::features::{Activation, WeightDistribution};

/// What is changed, as it is written in the table and in the summary.
struct Variant {
    group: &'static str,
    label: String,
    key: String,
    setup: Setup,
}

/// A panel of the picture.
struct Group {
    name: &'static str,
    /// Position in the table, mean, two standard deviations.
    bars: Vec<(f64, f64, f64)>,
}

pub(super) fn run(context: &Context<'_>) -> Result<Report, StudyError> {
    let mut report = Report::new("harmonic-ablation", "Members, neurons, activations, initial distributions");
    report.text(
        "The harmonic example with B = 1, one setting changed at a time. Published: the estimate of k is consistent \
         throughout, and the band where data are missing is wider with a larger scale of the initial distribution.",
    );
    let samples = shared_record();
    let exact = |t: f64| Harmonic::default().exact(t, X0, K);
    let mut table = Table::new(["", "", "k", "rms error in [5, 10]", "epistemic sd in [5, 10]", "not converged"]);
    let mut groups: Vec<Group> = Vec::new();
    for variant in variants(context) {
        let (trace, _) = variant.setup.run(&samples, context)?;
        let (mean, sd) = k_of(&trace);
        let (error, band) = error_and_band(&trace, exact, DATA_UNTIL_S, HORIZON_S);
        let path = format!("{}.{}", variant.group, variant.key);
        for (name, value) in [("k_mean", mean), ("k_sd", sd), ("rms_error", error), ("epistemic_sd", band)] {
            report.figure(&format!("{path}.{name}"), value);
        }
        let not_converged = trace.not_converged.to_string();
        table.row([
            variant.group.to_owned(),
            variant.label,
            plus_minus(mean, sd),
            short(error),
            short(band),
            not_converged,
        ]);
        if groups.last().is_none_or(|group| group.name != variant.group) {
            groups.push(Group { name: variant.group, bars: Vec::new() });
        }
        if let Some(Group { bars, .. }) = groups.last_mut() {
            #[allow(clippy::cast_precision_loss)]
            bars.push((bars.len() as f64 + 1.0, mean, 2.0 * sd));
        }
    }
    report.table(table);
    let mut figure = Figure::new("k with two standard deviations", 2);
    for Group { name, bars } in groups {
        #[allow(clippy::cast_precision_loss)]
        let last = bars.len() as f64 + 0.5;
        let chart = Chart::new(name, "row of the table", "k")
            .x_range(0.5, last)
            .dashed("truth", vec![(0.5, K), (last, K)], Colour::Black)
            .error_bars("", bars, Colour::Blue);
        figure = figure.panel(chart);
    }
    report.picture("harmonic_ablation", figure, "Estimated k by group, in the order of the table.");
    Ok(report)
}

fn variants(context: &Context<'_>) -> Vec<Variant> {
    let members = context.size(300, 50);
    let base = Setup::new(members, 1);
    let mut all = Vec::new();
    let mut add = |group, label: &str, setup| {
        let key = label.to_lowercase().replace(|c: char| !c.is_ascii_alphanumeric(), "_");
        all.push(Variant { group, label: label.to_owned(), key: key.trim_matches('_').to_owned(), setup });
    };
    for members in [10, 30, 100, 300, 1000] {
        let setup = Setup { members: members.min(context.size(1000, 50)), ..base.clone() };
        add("members", &members.to_string(), setup);
    }
    for neurons in [5, 10, 20, 50, 100] {
        add("neurons", &neurons.to_string(), Setup { neurons, ..base.clone() });
    }
    for (label, activation) in [
        ("tanh", Activation::Tanh),
        ("logistic", Activation::Logistic),
        ("sine", Activation::Sine),
        ("arctan", Activation::Arctan),
        ("softplus", Activation::Softplus),
        ("swish", Activation::Swish),
    ] {
        add("activations", label, Setup { activation, ..base.clone() });
    }
    let uniform = |low, high| WeightDistribution::Uniform { low, high };
    let normal = |sd| WeightDistribution::Normal { mean: 0.0, sd };
    for (label, weights) in [
        ("U[-1, 1]", uniform(-1.0, 1.0)),
        ("U[-1, 0]", uniform(-1.0, 0.0)),
        ("U[-10, 0]", uniform(-10.0, 0.0)),
        ("N(0, 1)", normal(1.0)),
        ("N(0, 100)", normal(10.0)),
        ("Exp(2)", WeightDistribution::Exponential { mean: 2.0 }),
    ] {
        add("distributions", label, Setup { weights, ..base.clone() });
    }
    all
}
