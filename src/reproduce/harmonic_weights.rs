//! `harmonic-weights`: the weight of the physics swept over decades.

use super::harmonic::{DATA_UNTIL_S, HORIZON_S, K, Setup, X0, chart, error_and_band, k_of, shared_record};
use super::{Context, StudyError};
use crate::estimate::settings::CouplingKind;
use crate::model::harmonic::Harmonic;
use crate::report::plot::{Chart, Colour, Figure};
use crate::report::{Report, Table, plus_minus, short};

pub(super) fn run(context: &Context<'_>) -> Result<Report, StudyError> {
    let mut report = Report::new("harmonic-weights", "Weight of the physics");
    report.text(
        "The harmonic example with B = 1 and `lambda_1` from 1e-4 to 1e2 (`lambda_2 = 1`): error and epistemic band where \
         there are no data. The less the physics counts, the less binds the network outside the data. `coupled` weighs \
         data by their noise; a small `lambda_1` loosens it in the same way.",
    );
    let samples = shared_record();
    let exact = |t: f64| Harmonic::default().exact(t, X0, K);
    let mut table = Table::new([
        "lambda_1",
        "rms error in [5, 10]",
        "epistemic sd in [5, 10]",
        "k",
        "coupled: rms error",
        "coupled: epistemic sd",
    ]);
    let mut rows = Vec::new();
    let mut figure = Figure::new("Weight of the physics", 2);
    for exponent in [-4, -3, -2, -1, 0, 1, 2] {
        let lambda = 10f64.powi(exponent);
        let mut row = vec![lambda];
        let mut cells = vec![format!("1e{exponent}")];
        for coupling in [CouplingKind::Independent, CouplingKind::Coupled] {
            let members = context.size(300, 50);
            let setup = Setup { coupling, physics_weight: lambda, ..Setup::new(members, 1) };
            let (trace, _) = setup.run(&samples, context)?;
            let (error, band) = error_and_band(&trace, exact, DATA_UNTIL_S, HORIZON_S);
            cells.extend([short(error), short(band)]);
            row.extend([error, band]);
            let key = if coupling == CouplingKind::Coupled { "coupled" } else { "independent" };
            let lambda_key = format!("lambda_1e{exponent}").replace('-', "m");
            report.figure(&format!("{key}.{lambda_key}.rms_error"), error);
            report.figure(&format!("{key}.{lambda_key}.epistemic_sd"), band);
            if coupling == CouplingKind::Independent {
                let (mean, sd) = k_of(&trace);
                cells.push(plus_minus(mean, sd));
                row.extend([mean, sd]);
                if matches!(exponent, -4 | -2 | 0 | 2) {
                    figure = figure.panel(chart(&format!("lambda_1 = 1e{exponent}"), &trace, &samples, exact));
                }
            }
        }
        table.row(cells);
        rows.push(row);
    }
    report.table(table);
    let curve = |column: usize| rows.iter().map(|row| (row[0], row[column])).collect::<Vec<_>>();
    let sweep = Chart::new("", "lambda_1", "x in [5, 10]")
        .log(true, true)
        .line("epistemic sd", curve(2), Colour::Orange)
        .points("", curve(2), Colour::Orange)
        .line("rms error", curve(1), Colour::Blue)
        .points("", curve(1), Colour::Blue)
        .dashed("epistemic sd, coupled", curve(6), Colour::Green);
    report.picture(
        "harmonic_weights",
        Figure::new("Weight of the physics", 1).panel(sweep),
        "Error and band where there are no data. Published: both grow as lambda_1 falls.",
    );
    report.picture("harmonic_weights_curves", figure, "The curves for four of the weights.");
    let header =
        ["lambda_1", "rms_error", "epistemic_sd", "k_mean", "k_sd", "coupled_rms_error", "coupled_epistemic_sd"];
    report.series("harmonic_weights", header, rows);
    Ok(report)
}
