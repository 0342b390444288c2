//! `ablation`: CVSim-6 with fewer and fewer sensors.

use super::circulation::{Case, CaseRun, Scenario, quantities};
use super::correlation::strength;
use super::{Context, StudyError};
use crate::estimate::statistics::{Summary, mean_and_sd};
use crate::model::Model;
use crate::report::plot::{Chart, Colour, Figure};
use crate::report::{Report, Table, mean, rms, short};

/// Published total coefficients of variation in scenarios 1 to 5 \[%\], "below" where the paper gives a bound.
const PUBLISHED: &[(&str, &str)] = &[
    ("p_l", "6"),
    ("p_a", "3"),
    ("p_v", "3"),
    ("p_r", "6"),
    ("p_pa", "3"),
    ("p_pv", "5"),
    ("q_li", "2.5"),
    ("q_lo", "2.5"),
    ("q_a", "2.5"),
    ("q_ri", "8.5"),
    ("q_ro", "13.5"),
    ("q_pv", "8.5"),
    ("v_l", "< 2"),
    ("v_a", "< 2"),
    ("v_v", "< 2"),
    ("v_r", "< 2"),
    ("v_pa", "< 2"),
    ("v_pv", "2.5"),
];

pub(super) fn run(context: &Context<'_>) -> Result<Report, StudyError> {
    let mut report = Report::new("ablation", "CVSim-6, scenarios 1 to 6");
    report.text(
        "Observed: Sc1 all six pressures; Sc2 without P_pv; Sc3 without P_pv and P_l; Sc4 P_a, P_v, P_pa; Sc5 and Sc6 P_a \
         and P_pa. Unknown: R_pv, in Sc6 C_a too, started at 1.5 times the truth. 100 members, windows of 1 ms, 5 \
         collocation points, 5 neurons. Figures are averages over the last two beats; the coefficient of variation (CoV) \
         is the average total sd over the average.",
    );
    open_settings(&mut report);
    let mut runs = Vec::new();
    for scenario in Scenario::ALL {
        runs.push((Case::independent(scenario), context.case(Case::independent(scenario))?));
    }
    for scenario in Scenario::ALL {
        runs.push((Case::coupled(scenario), context.case(Case::coupled(scenario))?));
    }
    for (case, run) in &runs {
        write_figures(&mut report, *case, run);
    }
    let (independent, coupled) = runs.split_at(Scenario::ALL.len());
    report.text("Total CoV [%] of `independent`, the paper's method:");
    report.table(cov_table(independent, true));
    report.text("Total sd of the pressures [mmHg] (published: P_a 3.0, P_pv 0.5), and its epistemic part:");
    report.table(sd_table(independent));
    report
        .text("Unknown parameters, relative to the truth, mean ± sd of the members' averages over the last two beats:");
    report.table(parameter_table(&runs));
    loose_parameters(&mut report, context)?;
    report.text(
        "The same with `coupled`: the CoV of pressures is now all sensor noise, and that of flows and volumes, which no \
         sensor reads, shows what the data have taught.",
    );
    report.table(cov_table(coupled, false));
    report.text("Epistemic sd and rms error of the mean against the truth [mmHg], `independent` and `coupled`:");
    report.table(error_table(independent, coupled));
    pictures(&mut report, &runs);
    Ok(report)
}

/// Where our figures are not the published ones: what has to be changed to get those.
fn loose_parameters(report: &mut Report, context: &Context<'_>) -> Result<(), StudyError> {
    report.text(
        "Four published figures differ from ours by more than a factor 1.5: the CoV of the pulmonary flows (8.5 %, Q_ro \
         13.5 %), that of V_pv (2.5 %), the spread of P_l and P_r in Sc6 (doubled there, smaller than in Sc5 here), and the correlation of the \
         pressures in Sc6 (none there, nearly complete here). The experiment below (30 members, 6 s) changes one weight at \
         a time. A parameter that may jump from window to window explains some of it. With `w_theta = 1` R_pv jitters, and \
         with it Q_pv = (P_pa - P_pv)/R_pv, to the published size, while its average stays right. With `w_theta = 3` in Sc6 \
         C_a jitters as well: P_a and P_l spread further than in Sc5 and the pressures are less correlated, but C_a comes out \
         twice too large; held at 10 it lets the data act on P_a, which nothing does in Sc1 to Sc5, and \
         is right. P_r and Q_ri do not follow in any run and stay unexplained. Q_ro = (P_r - P_pa)/R_ro is what the smallest resistance of the model \
         makes of a pressure difference: it passes the published size when the data outweigh the physics (`lambda_2 = \
         100`), but then the noise of one window decides R_pv. The paper must have let its parameters move more freely. \
         V_pv is no matter of weights: with its unstressed volume of 490 mL left out the same spread has the CoV below.",
    );
    let case = Case::independent(Scenario::Sc5);
    let stressed = stressed_cov_percent(&*context.case(case)?);
    report.figure("sc5.stressed_cov_percent.v_pv", stressed);
    report.text(format!("CoV of V_pv - 490 mL in Sc5: {stressed:.2} % (published for V_pv: 2.5 %)."));
    let mut table = Table::new([
        "",
        "w_theta",
        "lambda_2",
        "CoV Q_pv [%]",
        "CoV Q_ro [%]",
        "CoV Q_ri [%]",
        "CoV Q_a [%]",
        "epistemic sd P_l",
        "P_a",
        "P_r",
        "R_pv / truth",
        "C_a / truth",
        "mean absolute correlation, late diastole",
    ]);
    let cases = [
        (Scenario::Sc5, 10.0, 1.0),
        (Scenario::Sc5, 1.0, 1.0),
        (Scenario::Sc5, 10.0, 100.0),
        (Scenario::Sc6, 10.0, 1.0),
        (Scenario::Sc6, 3.0, 1.0),
        (Scenario::Sc6, 1.0, 1.0),
    ];
    let position = |name: &str| quantities().iter().position(|q| q.name == name).unwrap_or_default();
    for (scenario, parameter_weight, data_weight) in cases {
        let mut config = Case::independent(scenario).config();
        config.estimator.members = context.size(30, 8);
        config.window.parameter_weight = parameter_weight;
        config.window.data_weight = data_weight;
        let run = CaseRun::new(config, context.size(6.0, 2.5), context)?;
        let key = format!("loose.{}_w{parameter_weight}_d{data_weight}", scenario.key());
        let mut cells = vec![scenario.key().to_owned(), parameter_weight.to_string(), data_weight.to_string()];
        for name in ["q_pv", "q_ro", "q_ri", "q_a"] {
            let cov = cov_percent(&run, position(name));
            report.figure(&format!("{key}.total_cov_percent.{name}"), cov);
            cells.push(format!("{cov:.2}"));
        }
        for name in ["p_l", "p_a", "p_r"] {
            let sd = over(&run, position(name), |s| s.epistemic_sd);
            report.figure(&format!("{key}.epistemic_sd.{name}"), sd);
            cells.push(short(sd));
        }
        for k in 0..2 {
            let known = k < run.config.estimator.estimate.len();
            cells.push(if known { format!("{:.3}", relative(&run, k).1) } else { "-".to_owned() });
        }
        let correlation = run.trace.members.get(1).map_or(f64::NAN, |diastole| strength(diastole, &run));
        report.figure(&format!("{key}.mean_absolute_correlation"), correlation);
        cells.push(format!("{correlation:.2}"));
        table.row(cells);
    }
    report.table(table);
    Ok(())
}

fn open_settings(report: &mut Report) {
    let mut table = Table::new(["the paper leaves open", "here", "the outcome depends on it"]);
    table.row([
        "record",
        "12 s at 500 Hz on every observed channel",
        "only how fast R_pv forgets its guess: the bands are the same at 200 Hz",
    ]);
    table.row([
        "spread of the initial pressures",
        "that of the data: 2 % of the maximum of each pressure",
        "entirely: the bands of Sc1 to Sc5 are proportional to it (total blood volume is conserved, and nothing corrects it)",
    ]);
    table.row([
        "weights",
        "physics 1 (mmHg/s), data 1 (mmHg), parameters w_theta = 10",
        "how fast R_pv moves, and how much it jitters",
    ]);
    table.row(["systolic time", "0.33 s", "the published maxima are only reproduced in seconds"]);
    table.row(["nodes, domain", "Gauss-Legendre, [0, 1]", "not visibly"]);
    report.table(table);
}

fn over<'a>(run: &'a CaseRun, q: usize, of: impl Fn(&Summary) -> f64 + 'a) -> f64 {
    mean(run.last_beats().map(|i| of(&run.trace.quantities[i][q])))
}

fn cov_percent(run: &CaseRun, q: usize) -> f64 {
    100.0 * over(run, q, |s| s.sd) / over(run, q, |s| s.mean)
}

/// The CoV of the pulmonary venous volume beyond its unstressed part.
fn stressed_cov_percent(run: &CaseRun) -> f64 {
    let v_pv = quantities().len() - 1;
    100.0 * over(run, v_pv, |s| s.sd) / (over(run, v_pv, |s| s.mean) - run.config.patient.v0_pv)
}

fn error(run: &CaseRun, q: usize) -> f64 {
    rms(run.last_beats().map(|i| run.trace.quantities[i][q].mean - run.truth[i][q]))
}

/// Estimate over truth of an unknown parameter: mean and sd of the members' averages.
fn relative(run: &CaseRun, k: usize) -> (&str, f64, f64) {
    let name = run.config.estimator.estimate[k].as_str();
    let truth = truth(run, name);
    let (mean, sd) = mean_and_sd(&run.trace.averages[k]);
    (name, mean / truth, sd / truth)
}

/// The true value of a parameter.
fn truth(run: &CaseRun, name: &str) -> f64 {
    run.config.patient.model().parameter_index(name).map_or(f64::NAN, |p| run.config.patient.theta()[p])
}

fn write_figures(report: &mut Report, case: Case, run: &CaseRun) {
    let key = case.key();
    for (q, quantity) in quantities().iter().enumerate() {
        let name = quantity.name;
        report.figure(&format!("{key}.total_cov_percent.{name}"), cov_percent(run, q));
        report.figure(&format!("{key}.total_sd.{name}"), over(run, q, |s| s.sd));
        report.figure(&format!("{key}.epistemic_sd.{name}"), over(run, q, |s| s.epistemic_sd));
        report.figure(&format!("{key}.rms_error.{name}"), error(run, q));
    }
    for k in 0..run.config.estimator.estimate.len() {
        let (name, mean, sd) = relative(run, k);
        report.figure(&format!("{key}.relative_mean.{name}"), mean);
        report.figure(&format!("{key}.relative_sd.{name}"), sd);
        report.figure(&format!("{key}.relative_error_percent.{name}"), 100.0 * (mean - 1.0));
    }
    report.figure(&format!("{key}.wall_s"), run.wall_s);
    #[allow(clippy::cast_precision_loss)]
    report.figure(&format!("{key}.wall_s_per_member"), run.wall_s / run.config.estimator.members as f64);
}

fn header(first: &str, runs: &[(Case, std::rc::Rc<CaseRun>)]) -> Vec<String> {
    std::iter::once(first.to_owned()).chain(runs.iter().map(|(case, _)| case.scenario.key().to_owned())).collect()
}

fn cov_table(runs: &[(Case, std::rc::Rc<CaseRun>)], published: bool) -> Table {
    let mut columns = header("", runs);
    if published {
        columns.push("paper, Sc1-5".to_owned());
    }
    let mut table = Table::new(columns);
    for (q, quantity) in quantities().iter().enumerate() {
        let mut row = vec![quantity.name.to_owned()];
        row.extend(runs.iter().map(|(_, run)| format!("{:.2}", cov_percent(run, q))));
        if published {
            let paper = PUBLISHED.iter().find(|(name, _)| *name == quantity.name);
            row.push(paper.map_or("-", |(_, value)| value).to_owned());
        }
        table.row(row);
    }
    table
}

fn sd_table(runs: &[(Case, std::rc::Rc<CaseRun>)]) -> Table {
    let mut table = Table::new(header("", runs));
    for (q, quantity) in quantities().iter().enumerate().take(6) {
        let cell =
            |run: &CaseRun| format!("{} ({})", short(over(run, q, |s| s.sd)), short(over(run, q, |s| s.epistemic_sd)));
        let cells = runs.iter().map(|(_, run)| cell(run));
        table.row(std::iter::once(quantity.name.to_owned()).chain(cells));
    }
    table
}

fn parameter_table(runs: &[(Case, std::rc::Rc<CaseRun>)]) -> Table {
    let mut table = Table::new(["", "r_pv", "c_a", "wall [s] (paper: about 600)", "seconds per member (paper: 6)"]);
    for (case, run) in runs {
        let cell = |k: usize| {
            let known = k < run.config.estimator.estimate.len();
            if known { relative(run, k) } else { ("", f64::NAN, f64::NAN) }
        };
        let text = |(_, mean, sd): (&str, f64, f64)| {
            if mean.is_nan() { "-".to_owned() } else { format!("{mean:.4} ± {sd:.4}") }
        };
        #[allow(clippy::cast_precision_loss)]
        let each = run.wall_s / run.config.estimator.members as f64;
        table.row([case.name(), text(cell(0)), text(cell(1)), format!("{:.1}", run.wall_s), short(each)]);
    }
    table
}

fn error_table(independent: &[(Case, std::rc::Rc<CaseRun>)], coupled: &[(Case, std::rc::Rc<CaseRun>)]) -> Table {
    let mut table = Table::new(["", "", "p_l", "p_a", "p_v", "p_r", "p_pa", "p_pv"]);
    for runs in [independent, coupled] {
        for (case, run) in runs {
            let cells =
                (0..6).map(|q| format!("{} / {}", short(over(run, q, |s| s.epistemic_sd)), short(error(run, q))));
            let kind = if case.coupled { "coupled" } else { "independent" };
            table.row([case.scenario.key().to_owned(), kind.to_owned()].into_iter().chain(cells));
        }
    }
    table
}

fn pictures(report: &mut Report, runs: &[(Case, std::rc::Rc<CaseRun>)]) {
    let names = quantities();
    for (case, run) in
        runs.iter().filter(|(case, _)| matches!(case.scenario, Scenario::Sc1 | Scenario::Sc5 | Scenario::Sc6))
    {
        let key = case.key();
        for (stem, kind, from) in [("pressures", "Pressures", 0), ("flows", "Flows", 6), ("volumes", "Volumes", 12)] {
            if stem != "pressures" && case.scenario != Scenario::Sc5 {
                continue;
            }
            let title = format!("{kind}, {}", case.name());
            let mut figure = Figure::new(title, 3);
            for (q, quantity) in names.iter().enumerate().skip(from).take(6) {
                figure = figure.panel(waveform(run, q, &format!("{} [{}]", quantity.name, quantity.unit)));
            }
            let caption = format!("{kind} over the last two beats, {}: 90 % epistemic band, mean, truth.", case.name());
            report.picture(&format!("ablation_{key}_{stem}"), figure, caption);
        }
        let header = ["time_s".to_owned()].into_iter().chain(
            names.iter().flat_map(|q| ["mean", "sd", "epistemic_sd", "truth"].map(|s| format!("{}_{s}", q.name))),
        );
        let row = |i: usize| -> Vec<f64> {
            let quantities = run.trace.quantities[i].iter().zip(&run.truth[i]);
            std::iter::once(run.trace.times_s[i])
                .chain(quantities.flat_map(|(s, truth)| [s.mean, s.sd, s.epistemic_sd, *truth]))
                .collect()
        };
        report.series(&format!("ablation_{key}"), header, run.last_beats().map(row).collect());
    }
    let mut figure = Figure::new("Unknown parameters over time, relative to the truth", 3);
    for (case, run) in runs {
        let mut chart = Chart::new(case.name(), "t [s]", "estimate / truth").y_range(0.8, 1.6);
        for (k, colour) in (0..run.config.estimator.estimate.len()).zip([Colour::Blue, Colour::Orange]) {
            let name = run.config.estimator.estimate[k].clone();
            let truth = truth(run, &name);
            let band = run.trace.parameter(k).map(|(t, s)| (t, s.q05 / truth, s.q95 / truth)).collect();
            let line = run.trace.parameter(k).map(|(t, s)| (t, s.mean / truth)).collect();
            chart = chart.band("", band, colour).line(&name, line, colour);
        }
        figure = figure.panel(chart);
    }
    report.picture("ablation_parameters", figure, "Unknown parameters: mean and 90 % band of the members.");
}

fn waveform(run: &CaseRun, q: usize, label: &str) -> Chart {
    let at = |of: &dyn Fn(usize) -> f64| -> Vec<(f64, f64)> {
        run.last_beats().map(|i| (run.trace.times_s[i], of(i))).collect()
    };
    let band = run.last_beats().map(|i| {
        let s = &run.trace.quantities[i][q];
        (run.trace.times_s[i], s.q05, s.q95)
    });
    let mut chart = Chart::new("", "t [s]", label)
        .band("90 %", band.collect(), Colour::Blue)
        .line("mean", at(&|i| run.trace.quantities[i][q].mean), Colour::Blue)
        .dashed("truth", at(&|i| run.truth[i][q]), Colour::Black);
    let channel = run.config.observed.iter().position(|name| quantities().get(q).is_some_and(|q| q.name == name));
    if let Some(channel) = channel {
        let (from, to) = run.last_beats_s;
        let seen = run.samples.iter().filter(|s| s.channel == channel && s.time_s > from && s.time_s <= to).step_by(10);
        chart = chart.points("every tenth sample", seen.map(|s| (s.time_s, s.value)).collect(), Colour::Grey);
    }
    chart
}
