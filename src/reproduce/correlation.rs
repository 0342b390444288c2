//! `correlation`: how the errors of the six pressures hang together.

use super::circulation::{Case, CaseRun, Scenario, quantities};
use super::{Context, StudyError};
use crate::estimate::statistics::correlation;
use crate::report::plot::{Figure, HeatMap};
use crate::report::{Report, Table};

const MOMENTS: [&str; 3] = ["start", "diastole", "systole"];

pub(super) fn run(context: &Context<'_>) -> Result<Report, StudyError> {
    let mut report = Report::new("correlation", "Correlation of the errors of the six pressures");
    report.text(
        "Correlation over the members of the six pressures 5 ms after the start, late in the last diastole, and 0.15 s \
         into the last beat. Published: independent at first, strongly correlated later, with P_pa (and P_r in systole) \
         apart; uncorrelated in Sc6. Here one number, the volume of blood that a member started with, moves all pressures of \
         `independent` together, in Sc5 and Sc6 P_pa against the others late in diastole. In Sc6 the table of loose parameters in \
         `ablation` shows what loosens that.",
    );
    let names: Vec<String> = quantities().iter().take(6).map(|q| q.name.to_owned()).collect();
    let mut table = Table::new(["", "start", "diastole", "systole"]);
    let cases = [
        Case::independent(Scenario::Sc1),
        Case::independent(Scenario::Sc5),
        Case::independent(Scenario::Sc6),
        Case::coupled(Scenario::Sc5),
        Case::coupled(Scenario::Sc6),
    ];
    for case in cases {
        let run = context.case(case)?;
        let members = run.config.estimator.members;
        let mut figure = Figure::new(format!("Correlation of the members, {}", case.name()), 3);
        let mut cells = vec![case.name()];
        for ((moment, at_s), values) in MOMENTS.iter().zip(run.moments_s).zip(&run.trace.members) {
            let matrix = correlation(&values[..6 * members], members);
            let strength = strength(values, &run);
            report.figure(&format!("{}.{moment}.mean_absolute", case.key()), strength);
            for (i, a) in names.iter().enumerate() {
                for (j, b) in names.iter().enumerate().skip(i + 1) {
                    report.figure(&format!("{}.{moment}.{a}.{b}", case.key()), matrix[i * 6 + j]);
                }
            }
            cells.push(format!("{strength:.2}"));
            let rows = matrix.chunks_exact(6).map(<[f64]>::to_vec).collect();
            report.series(&format!("correlation_{}_{moment}", case.key()), names.clone(), rows);
            figure = figure.panel(HeatMap {
                title: format!("{moment}, t = {at_s:.3} s"),
                rows: names.clone(),
                columns: names.clone(),
                values: matrix,
            });
        }
        table.row(cells);
        report.picture(
            &format!("correlation_{}", case.key()),
            figure,
            format!("Correlation matrices, {}.", case.name()),
        );
    }
    report.text("Mean absolute correlation of two different pressures:");
    report.table(table);
    Ok(report)
}

/// Mean absolute correlation of two different pressures among all `members` kept at one time.
pub(super) fn strength(members: &[f64], run: &CaseRun) -> f64 {
    let count = run.config.estimator.members;
    let matrix = correlation(&members[..6 * count], count);
    crate::report::mean((0..36).filter(|e| e / 6 != e % 6).map(|e| matrix[e].abs()))
}
