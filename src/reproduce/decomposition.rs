//! `decomposition`: uncertainty by source over a beat.

use super::circulation::{Case, CaseRun, Scenario, quantities};
use super::{Context, StudyError};
use crate::estimate::statistics::Summary;
use crate::report::plot::{Chart, Colour, Figure};
use crate::report::{Report, Table, mean, short};

/// What is shown, in the order of the model.
const SHOWN: [&str; 4] = ["p_l", "p_a", "q_li", "q_lo"];

pub(super) fn run(context: &Context<'_>) -> Result<Report, StudyError> {
    let mut report = Report::new("decomposition", "Uncertainty by source over a beat");
    report.text(
        "Aleatoric: what the sensor adds (2 % of the maximum; nothing for flows). Epistemic: the spread of the members. \
         Published: the epistemic part dominates except in diastole. Flows of closed valves are zero for certain.",
    );
    let mut table = Table::new([
        "",
        "quantity",
        "systole: epistemic",
        "aleatoric",
        "total",
        "diastole: epistemic",
        "aleatoric",
        "total",
    ]);
    for case in [Case::independent(Scenario::Sc1), Case::independent(Scenario::Sc5), Case::coupled(Scenario::Sc5)] {
        let run = context.case(case)?;
        let mut figure = Figure::new(format!("Standard deviation by source, {}", case.name()), 2);
        let (start, end) = last_beat(&run);
        let mut rows: Vec<Vec<f64>> = Vec::new();
        for (q, quantity) in quantities().iter().enumerate() {
            if !SHOWN.contains(&quantity.name) {
                continue;
            }
            let at = |of: fn(&Summary) -> f64| -> Vec<(f64, f64)> {
                run.within(start, end)
                    .map(|i| (run.trace.times_s[i] - start, of(&run.trace.quantities[i][q])))
                    .collect()
            };
            let chart = Chart::new("", "time in the beat [s]", format!("sd of {} [{}]", quantity.name, quantity.unit))
                .line("total", at(|s| s.sd), Colour::Black)
                .line("epistemic", at(|s| s.epistemic_sd), Colour::Orange)
                .line("aleatoric", at(|s| s.aleatoric_sd), Colour::Blue);
            figure = figure.panel(chart);
            let phase = |from: f64, to: f64, of: fn(&Summary) -> f64| {
                mean(run.within(start + from, start + to).map(|i| of(&run.trace.quantities[i][q])))
            };
            let sources: [fn(&Summary) -> f64; 3] = [|s| s.epistemic_sd, |s| s.aleatoric_sd, |s| s.sd];
            let mut cells = vec![case.name(), quantity.name.to_owned()];
            for (name, from, to) in [("systole", 0.05, 0.33), ("diastole", 0.5, end - start)] {
                for (source, of) in ["epistemic_sd", "aleatoric_sd", "total_sd"].iter().zip(sources) {
                    let value = phase(from, to, of);
                    report.figure(&format!("{}.{}.{name}.{source}", case.key(), quantity.name), value);
                    cells.push(short(value));
                }
            }
            table.row(cells);
            let columns = run.within(start, end).map(|i| sources.map(|of| of(&run.trace.quantities[i][q])));
            if rows.is_empty() {
                rows = run.within(start, end).map(|i| vec![run.trace.times_s[i] - start]).collect();
            }
            rows.iter_mut().zip(columns).for_each(|(row, sds)| row.extend(sds));
        }
        let header = ["time_s".to_owned()]
            .into_iter()
            .chain(SHOWN.iter().flat_map(|n| ["epistemic_sd", "aleatoric_sd", "total_sd"].map(|s| format!("{n}_{s}"))));
        report.series(&format!("decomposition_{}", case.key()), header, rows);
        report.picture(&format!("decomposition_{}", case.key()), figure, format!("By source, {}.", case.name()));
    }
    report.table(table);
    Ok(report)
}

/// Start and end of the last whole beat \[s\].
fn last_beat(run: &CaseRun) -> (f64, f64) {
    let (from, to) = run.last_beats_s;
    (0.5 * (from + to), to)
}
