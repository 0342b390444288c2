//! The page of an experiment: tables, verdicts and pictures, one chapter per scenario.

use super::experiment::{Results, SHOWN_S, Trace};
use super::scenario::STEP;
use super::score::{Point, Series};
use super::table::{Cell, Overview, compact};
use crate::model::cvsim6::Pressures;
use crate::report::plot::{Chart, Colour, Figure};
use crate::report::{Report, Table};

/// What stands above the chapters.
pub const HEADING: &str = "# Twin experiments\n\n\
    Synthetic patients whose truth is known, watched through noisy sensors at 125 Hz; the estimator starts with the \
    parameters to be found 30 % wrong and pressures 4 % uncertain, and `r_pv` and `c_a` wander by 1 % per square root of a \
    second. The filters of the textbooks (UKF, EnKF) get the same samples, with the constant process noise that suits them \
    best. Errors, widths and CRPS are in per cent of the root mean square of the truth. A closed valve is a sure zero, which counts as within both bands of its flow. The UKF \
    has no members that live through a beat, only a cloud placed anew in every window; its band of the cardiac output comes \
    from that cloud and is no claim of the filter's. Every number is in `scores.csv`, \
    what the estimators had to report in `events.csv`, medians over runs in `summary.json`.\n\n";

/// Colours of the methods, in their order.
const COLOURS: [Colour; 5] = [Colour::Blue, Colour::Orange, Colour::Green, Colour::Purple, Colour::Grey];

/// A statistic: name in the summary, what it is for people, and where it is.
type Statistic = (&'static str, &'static str, fn(&Cell) -> f64);

const STATISTICS: [Statistic; 8] = [
    ("rmse_percent", "RMSE %", |c| c.rmse),
    ("bias_percent", "bias %", |c| c.bias),
    ("coverage_50_percent", "50 % band covers %", |c| c.coverage_50),
    ("coverage_90_percent", "90 % band covers %", |c| c.coverage_90),
    ("width_90_percent", "its width %", |c| c.width_90),
    ("crps_percent", "CRPS %", |c| c.crps),
    ("converged_s", "within 5 % after s", |c| c.converged_s.0),
    ("lag_s", "90 % of the step after s", |c| c.lag_s.0),
];

/// One chapter per scenario.
#[must_use]
pub fn reports(results: &Results) -> Vec<Report> {
    let chapter = |overview: &Overview| {
        let scenario = overview.scenario;
        let mut report = Report::new(scenario.name(), &format!("{}: {}", scenario.name(), scenario.about()));
        report.text(format!(
            "{} runs of {} s, scored from {} s on. Medians over runs of RMSE and CRPS, means of the rest.",
            overview.runs,
            compact(results.seconds),
            compact(results.from_s),
        ));
        write_figures(&mut report, overview);
        let lines = overview.verdicts().into_iter().chain(overview.notices());
        report.text(lines.map(|line| format!("- {line}")).collect::<Vec<_>>().join("\n"));
        report.table(table(overview));
        compare(&mut report, overview);
        let traces: Vec<&Trace> = results.traces.iter().filter(|trace| trace.scenario == scenario).collect();
        parameters(&mut report, &traces, scenario.step_s(results.seconds));
        if let Some(first) = traces.first() {
            pressures(&mut report, first);
        }
        report
    };
    Overview::all(results).iter().map(chapter).collect()
}

fn write_figures(report: &mut Report, overview: &Overview) {
    for (name, cells) in &overview.quantities {
        for (method, cell) in overview.methods.iter().zip(cells) {
            let Some(cell) = cell else { continue };
            for (statistic, _, of) in STATISTICS {
                report.figure(&format!("{name}.{method}.{statistic}"), of(cell));
            }
        }
    }
}

fn table(overview: &Overview) -> Table {
    let mut table = Table::new(["", "method"].into_iter().chain(STATISTICS.iter().map(|(_, label, _)| *label)));
    for (name, cells) in &overview.quantities {
        for (method, cell) in overview.methods.iter().zip(cells) {
            let Some(cell) = cell else { continue };
            let numbers = STATISTICS.iter().map(|(_, _, of)| compact(of(cell)));
            table.row([(*name).to_owned(), (*method).to_owned()].into_iter().chain(numbers));
        }
    }
    table
}

/// Errors and coverage of all quantities, method beside method.
#[allow(clippy::cast_precision_loss)]
fn compare(report: &mut Report, overview: &Overview) {
    // The first quantity at the top.
    let names: Vec<String> = overview.quantities.iter().rev().map(|(name, _)| (*name).to_owned()).collect();
    let chart = |title: &str, label: &str, log: bool, of: fn(&Cell) -> f64| {
        let mut chart = Chart::new(title, label, "").log(log, false).y_names(names.clone());
        for (k, method) in overview.methods.iter().enumerate() {
            let cells = overview.quantities.iter().rev().enumerate();
            let dots = cells.filter_map(|(row, (_, cells))| cells[k].as_ref().map(|cell| (of(cell), row as f64)));
            chart = chart.points(method, dots.collect(), COLOURS[k.min(COLOURS.len() - 1)]);
        }
        chart
    };
    let height = overview.quantities.len() as f64 - 0.5;
    let nominal =
        |chart: Chart, share: f64| chart.dashed("nominal", vec![(share, -0.5), (share, height)], Colour::Black);
    let figure = Figure::new(format!("Errors, {}", overview.scenario.name()), 2)
        .panel(chart("Median RMSE", "% of the rms of the truth", true, |c| c.rmse))
        .panel(chart("Median CRPS", "% of the rms of the truth", true, |c| c.crps));
    let stem = overview.scenario.name();
    report.picture(&format!("{stem}_errors"), figure, "RMSE of the mean and CRPS of the distribution, per quantity.");
    let figure = Figure::new(format!("Bands, {}", overview.scenario.name()), 2)
        .panel(nominal(
            chart("Truth within the 90 % band", "% of the times", false, |c| c.coverage_90).x_range(0.0, 100.0),
            90.0,
        ))
        .panel(nominal(
            chart("Truth within the 50 % band", "% of the times", false, |c| c.coverage_50).x_range(0.0, 100.0),
            50.0,
        ));
    report.picture(&format!("{stem}_bands"), figure, "Share of times with the truth in the band, mean over runs.");
}

fn line(series: &Series, of: fn(&Point) -> f64) -> Vec<(f64, f64)> {
    series.points.iter().map(|point| (point.time_s, of(point))).collect()
}

fn band(series: &Series) -> Vec<(f64, f64, f64)> {
    series.points.iter().map(|point| (point.time_s, point.band.0, point.band.1)).collect()
}

/// Every parameter of every patient over time.
fn parameters(report: &mut Report, traces: &[&Trace], step_s: Option<f64>) {
    for trace in traces {
        let Some((_, own, _)) = trace.told.first() else { continue };
        let mut figure = Figure::new(format!("{}, {}", trace.patient, trace.scenario.name()), 2);
        for (k, series) in own.iter().enumerate().filter(|(_, series)| !series.points.is_empty()) {
            let mut chart = Chart::new(series.name, "t [s]", format!("{} [{}]", series.name, series.unit));
            if let (Some(step_s), true) = (step_s, series.name == STEP.0) {
                chart = chart.region("after the step", step_s, f64::INFINITY);
            }
            for (m, (method, parameters, _)) in trace.told.iter().enumerate() {
                let Some(told) = parameters.get(k) else { continue };
                let colour = COLOURS[m.min(COLOURS.len() - 1)];
                // Bands of all would hide each other.
                if m == 0 {
                    chart = chart.band(&format!("{method}, 5-95 %"), band(told), colour);
                }
                chart = chart.line(method, line(told, |p| p.mean), colour);
            }
            figure = figure.panel(chart.dashed("truth", line(series, |p| p.truth), Colour::Black));
        }
        if !figure.panels.is_empty() {
            let stem = format!("{}_{}_parameters", trace.scenario.name(), trace.patient);
            report.picture(&stem, figure, format!("{}: estimated parameters and the truth.", trace.patient));
        }
    }
}

/// What the sensors read of one patient, and what is made of it.
fn pressures(report: &mut Report, trace: &Trace) {
    let Some((method, _, states)) = trace.told.first() else { return };
    let mut figure = Figure::new(format!("Pressures, {}, {}", trace.patient, trace.scenario.name()), 3);
    for (s, series) in states.iter().enumerate() {
        let read: Vec<(f64, f64)> =
            trace.samples.iter().filter(|(state, ..)| *state == s).map(|&(_, t, value)| (t, value)).collect();
        let (seen, label) = if read.is_empty() { ("no sensor", "") } else { ("observed", "samples") };
        let title = format!("{} ({seen})", Pressures::NAMES[s]);
        let chart = Chart::new(title, "t [s]", format!("{} [{}]", series.name, series.unit))
            .points(label, read, Colour::Grey)
            .band(&format!("{method}, 5-95 %"), band(series), Colour::Blue)
            .line(method, line(series, |p| p.mean), Colour::Blue)
            .dashed("truth", line(series, |p| p.truth), Colour::Black);
        figure = figure.panel(chart);
    }
    let stem = format!("{}_pressures", trace.scenario.name());
    report.picture(&stem, figure, format!("{}: the last {SHOWN_S} s.", trace.patient));
}
