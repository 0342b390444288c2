//! Scores of many twins in one table, and what they come to.

use std::path::Path;

use super::ValidateError;
use super::experiment::{Results, Row};
use super::scenario::{STEP, Scenario};
use super::score::{Score, mean_of_numbers, median};

/// A share of times in a 90 % band that one run after the other can have by chance \[%\].
const HONEST: std::ops::RangeInclusive<f64> = 80.0..=98.0;

/// Exceptions that are named in a line.
const NAMED: usize = 6;

/// Columns of a terminal, and those of the names.
const TERMINAL: usize = 120;
const NAME: usize = 15;
/// Columns of a number, where there is room.
const CELL: usize = 8;

/// One quantity over all runs of one method in one scenario; see [`Score`] for the units.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Cell {
    /// Median.
    pub rmse: f64,
    /// Mean.
    pub bias: f64,
    /// Mean.
    pub coverage_50: f64,
    /// Mean.
    pub coverage_90: f64,
    /// Mean.
    pub width_90: f64,
    /// Median.
    pub crps: f64,
    /// Median of the runs that converged, and their number.
    pub converged_s: (f64, usize),
    /// Median of the runs that saw the step, and their number.
    pub lag_s: (f64, usize),
}

/// All quantities of one scenario.
#[derive(Debug, Clone, PartialEq)]
pub struct Overview {
    /// Which.
    pub scenario: Scenario,
    /// The ensemble first.
    pub methods: Vec<&'static str>,
    /// Patients times seeds.
    pub runs: usize,
    /// Name, and a cell per method, if it told anything of the quantity.
    pub quantities: Vec<(&'static str, Vec<Option<Cell>>)>,
    /// Per method.
    pub events: Vec<(&'static str, Vec<Happened>)>,
}

/// An event over all runs of one method in one scenario.
#[derive(Debug, Clone, PartialEq)]
pub struct Happened {
    /// Kind and channel.
    pub what: String,
    /// Number of runs in which it happened.
    pub runs: usize,
    /// Median of its first time \[s\].
    pub first_s: f64,
}

/// Something to be read off a cell.
type Reading = fn(&Cell) -> f64;

/// Appends what is new, in the order of first sight.
fn note<T: PartialEq>(all: &mut Vec<T>, one: T) {
    if !all.contains(&one) {
        all.push(one);
    }
}

impl Overview {
    /// One per scenario, in the order of the results.
    #[must_use]
    pub fn all(results: &Results) -> Vec<Self> {
        let mut scenarios = Vec::new();
        results.rows.iter().for_each(|row| note(&mut scenarios, row.scenario));
        let of = |scenario| Self::new(scenario, results.rows.iter().filter(|row| row.scenario == scenario).collect());
        scenarios.into_iter().map(of).collect()
    }

    fn new(scenario: Scenario, rows: Vec<&Row>) -> Self {
        let (mut methods, mut names, mut runs) = (Vec::new(), Vec::new(), Vec::new());
        for row in &rows {
            note(&mut methods, row.method);
            note(&mut runs, (&row.patient, row.seed));
            row.scores.iter().for_each(|score| note(&mut names, score.quantity));
        }
        let runs = runs.len();
        let cell = |name: &str, method: &str| {
            let told = rows.iter().filter(|row| row.method == method).flat_map(|row| &row.scores);
            let scores: Vec<Score> = told.filter(|score| score.quantity == name).map(|score| score.score).collect();
            (!scores.is_empty()).then(|| Cell::new(&scores))
        };
        let quantities =
            names.into_iter().map(|name| (name, methods.iter().map(|method| cell(name, method)).collect())).collect();
        let events = methods.iter().map(|&method| (method, events(&rows, method))).collect();
        Self { scenario, methods, runs, quantities, events }
    }

    /// For the terminal.
    #[must_use]
    pub fn lines(&self) -> Vec<String> {
        let groups: [(&str, Reading); 4] = [
            ("RMSE %", |c| c.rmse),
            ("90 % band covers %", |c| c.coverage_90),
            ("its width %", |c| c.width_90),
            ("CRPS %", |c| c.crps),
        ];
        let room = (TERMINAL - NAME) / groups.len() - 1;
        let cell = CELL.min(room / self.methods.len().max(1));
        let width = cell * self.methods.len();
        let heads: String = groups.iter().map(|(head, _)| format!(" {head:^width$}")).collect();
        let names: String = self.methods.iter().map(|method| format!("{:>cell$}", abbreviated(method, cell))).collect();
        let mut lines = vec![
            format!("{}: {} ({} runs)", self.scenario.name(), self.scenario.about(), self.runs),
            format!("{:NAME$}{heads}", "").trim_end().to_owned(),
            format!("{:NAME$}{}", "", format!(" {names}").repeat(groups.len())),
        ];
        for (name, cells) in &self.quantities {
            let number = |told: &Option<Cell>, of: Reading| {
                let number = told.as_ref().map_or_else(String::new, |told| compact(of(told)));
                format!("{number:>cell$}")
            };
            let group = |of| cells.iter().map(|told| number(told, of)).collect::<String>();
            let row: String = groups.iter().map(|(_, of)| format!(" {}", group(*of))).collect();
            lines.push(format!("{name:NAME$}{row}"));
        }
        lines
    }

    /// What the numbers come to, one claim per line.
    #[must_use]
    pub fn verdicts(&self) -> Vec<String> {
        let mut lines = Vec::new();
        let Some(own) = self.methods.first() else { return lines };
        for (k, other) in self.methods.iter().enumerate().skip(1) {
            let pairs: Vec<(&str, &Cell, &Cell)> = self
                .quantities
                .iter()
                .filter_map(|(name, cells)| Some((*name, cells[0].as_ref()?, cells[k].as_ref()?)))
                .collect();
            let at_or_below = |of: Reading| {
                // Not below: also what is no number.
                let above = pairs.iter().filter(|(_, a, b)| !matches!(of(a).partial_cmp(&of(b)), Some(o) if o.is_le()));
                above.map(|(name, ..)| *name).collect::<Vec<_>>()
            };
            let count = |above: &[&str]| {
                let except = match above {
                    [] => String::new(),
                    few if few.len() <= NAMED => format!(" (not {})", few.join(", ")),
                    many => format!(" (not {} and {} more)", many[..NAMED].join(", "), many.len() - NAMED),
                };
                format!("{} of {} quantities{except}", pairs.len() - above.len(), pairs.len())
            };
            lines.push(format!("RMSE of {own} at or below {other}: {}", count(&at_or_below(|c| c.rmse))));
            lines.push(format!("CRPS of {own} at or below {other}: {}", count(&at_or_below(|c| c.crps))));
        }
        for (k, method) in self.methods.iter().enumerate() {
            let cells: Vec<&Cell> = self.quantities.iter().filter_map(|(_, cells)| cells[k].as_ref()).collect();
            let honest = cells.iter().filter(|cell| HONEST.contains(&cell.coverage_90)).count();
            lines.push(format!(
                "bands of {method}: the 90 % band covers {} % on average, the 50 % band {} %; {honest} of {} quantities \
                 between {} and {} %",
                compact(mean_of_numbers(cells.iter().map(|cell| cell.coverage_90))),
                compact(mean_of_numbers(cells.iter().map(|cell| cell.coverage_50))),
                cells.len(),
                HONEST.start(),
                HONEST.end(),
            ));
        }
        lines.extend(self.speeds());
        lines
    }

    /// How fast parameters are found, and found again.
    fn speeds(&self) -> Vec<String> {
        let mut lines = Vec::new();
        for (name, cells) in &self.quantities {
            let per_method = |of: fn(&Cell) -> (f64, usize)| {
                let told = self.methods.iter().zip(cells).filter_map(|(method, cell)| {
                    let (seconds, runs) = of(cell.as_ref()?);
                    let time = if runs > 0 { format!("{} s ", compact(seconds)) } else { String::new() };
                    Some(format!("{method} {time}({runs} of {})", self.runs))
                });
                told.collect::<Vec<_>>().join(", ")
            };
            let is_parameter = crate::model::cvsim6::PARAMETERS.iter().any(|info| info.name == *name);
            if is_parameter {
                lines.push(format!("{name} within 5 % of the truth for good after: {}", per_method(|c| c.converged_s)));
            }
            if is_parameter && self.scenario == Scenario::Step && *name == STEP.0 {
                lines.push(format!("{name} 90 % of the way after the step: {}", per_method(|c| c.lag_s)));
            }
        }
        lines
    }

    /// What the methods had to say, beyond that they started.
    #[must_use]
    pub fn notices(&self) -> Vec<String> {
        let mut lines = Vec::new();
        for (method, events) in &self.events {
            let told = events.iter().filter(|event| event.what != "start");
            let told: Vec<String> = told
                .map(|event| format!("{} in {} runs, first at {} s", event.what, event.runs, compact(event.first_s)))
                .collect();
            if !told.is_empty() {
                lines.push(format!("events of {method}: {}", told.join("; ")));
            }
        }
        lines
    }
}

impl Cell {
    fn new(scores: &[Score]) -> Self {
        let all = |of: fn(&Score) -> f64| scores.iter().map(of);
        let times = |of: fn(&Score) -> f64| (median(all(of)), all(of).filter(|time| time.is_finite()).count());
        Self {
            rmse: median(all(|s| s.rmse)),
            bias: mean_of_numbers(all(|s| s.bias)),
            coverage_50: mean_of_numbers(all(|s| s.coverage_50)),
            coverage_90: mean_of_numbers(all(|s| s.coverage_90)),
            width_90: mean_of_numbers(all(|s| s.width_90)),
            crps: median(all(|s| s.crps)),
            converged_s: times(|s| s.converged_s),
            lag_s: times(|s| s.lag_s),
        }
    }
}

fn events(rows: &[&Row], method: &str) -> Vec<Happened> {
    let name = |kind: &str, channel: Option<&str>| channel.map_or(kind.to_owned(), |c| format!("{kind} ({c})"));
    let told: Vec<(String, f64)> = rows
        .iter()
        .filter(|row| row.method == method)
        .flat_map(|row| row.events.iter().map(|event| (name(event.kind, event.channel), event.first_s)))
        .collect();
    let mut names = Vec::new();
    told.iter().for_each(|(name, _)| note(&mut names, name.clone()));
    let sum = |what: String| {
        let times: Vec<f64> = told.iter().filter(|(other, _)| *other == what).map(|(_, time)| *time).collect();
        Happened { what, runs: times.len(), first_s: median(times.into_iter()) }
    };
    names.into_iter().map(sum).collect()
}

/// Fits a column: what is looked back at is named by the option that asks for it.
fn abbreviated(method: &str, width: usize) -> &str {
    let short = if method.ends_with("_smoothed") { "lag" } else { method };
    short.get(..width - 1).unwrap_or(short)
}

/// Three digits that count.
pub(super) fn compact(value: f64) -> String {
    match value.abs() {
        _ if !value.is_finite() => "-".to_owned(),
        size if size >= 99.95 => format!("{value:.0}"),
        size if size >= 9.995 => format!("{value:.1}"),
        size if size >= 0.9995 => format!("{value:.2}"),
        _ => format!("{value:.3}"),
    }
}

/// Columns of the table of scores.
pub const SCORE_COLUMNS: [&str; 16] = [
    "scenario",
    "patient",
    "seed",
    "method",
    "quantity",
    "unit",
    "count",
    "truth_rms",
    "rmse_percent",
    "bias_percent",
    "coverage_50_percent",
    "coverage_90_percent",
    "width_90_percent",
    "crps_percent",
    "converged_s",
    "lag_s",
];

/// Columns of the table of events.
pub const EVENT_COLUMNS: [&str; 8] = ["scenario", "patient", "seed", "method", "kind", "channel", "count", "first_s"];

/// Writes `scores.csv` and `events.csv`, one row per run, method and quantity or kind; an empty cell is no number.
///
/// # Errors
/// When a file cannot be written.
pub fn write(directory: &Path, results: &Results) -> Result<(), ValidateError> {
    let run =
        |row: &Row| [row.scenario.name().to_owned(), row.patient.clone(), row.seed.to_string(), row.method.to_owned()];
    let number = |value: f64| if value.is_finite() { value.to_string() } else { String::new() };
    let scores = results.rows.iter().flat_map(|row| row.scores.iter().map(move |score| (row, score)));
    let scores = scores.map(|(row, told)| {
        let s = &told.score;
        let names = [told.quantity.to_owned(), told.unit.to_owned(), s.count.to_string()];
        let numbers =
            [s.truth_rms, s.rmse, s.bias, s.coverage_50, s.coverage_90, s.width_90, s.crps, s.converged_s, s.lag_s];
        run(row).into_iter().chain(names).chain(numbers.map(number)).collect()
    });
    write_table(&directory.join("scores.csv"), &SCORE_COLUMNS, scores)?;
    let events = results.rows.iter().flat_map(|row| row.events.iter().map(move |event| (row, event)));
    let events = events.map(|(row, event)| {
        let channel = event.channel.unwrap_or_default().to_owned();
        let own = [event.kind.to_owned(), channel, event.count.to_string(), number(event.first_s)];
        run(row).into_iter().chain(own).collect()
    });
    write_table(&directory.join("events.csv"), &EVENT_COLUMNS, events)
}

fn write_table(path: &Path, header: &[&str], rows: impl Iterator<Item = Vec<String>>) -> Result<(), ValidateError> {
    let failed = |error: csv::Error| ValidateError::File { path: path.to_owned(), reason: error.to_string() };
    let mut table = csv::Writer::from_path(path).map_err(failed)?;
    table.write_record(header).map_err(failed)?;
    for row in rows {
        table.write_record(&row).map_err(failed)?;
    }
    table.flush().map_err(|error| failed(error.into()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::validate::twin::{Event, QuantityScore};

    fn row(method: &'static str, patient: &str, rmse: f64) -> Row {
        let score = Score {
            count: 1,
            truth_rms: 1.0,
            rmse,
            bias: 0.0,
            coverage_50: 50.0,
            coverage_90: 90.0,
            width_90: 3.0,
            crps: 0.5 * rmse,
            converged_s: f64::NAN,
            lag_s: f64::NAN,
        };
        let (scenario, patient) = (Scenario::Steady, patient.to_owned());
        let scores = ["p_a", "r_pv"].map(|quantity| QuantityScore { quantity, unit: "", score }).to_vec();
        let events = vec![Event { kind: "gap", channel: Some("p_a"), count: 3, first_s: rmse }];
        Row { scenario, patient, seed: 0, method, scores, events }
    }

    #[test]
    fn an_overview_takes_the_median_over_runs() {
        let rows =
            [("coupled", "a", 1.0), ("ukf", "a", 2.0), ("coupled", "b", 2.0), ("coupled", "c", 9.0), ("ukf", "b", 1.5)];
        let rows = rows.map(|(method, patient, rmse)| row(method, patient, rmse)).to_vec();
        let results = Results { rows, ..Results::default() };
        let overview = &Overview::all(&results)[0];
        assert_eq!((overview.runs, overview.methods.as_slice()), (3, ["coupled", "ukf"].as_slice()));
        let cells = &overview.quantities[0].1;
        assert!((cells[0].unwrap().rmse - 2.0).abs() < 1e-12 && (cells[1].unwrap().rmse - 1.75).abs() < 1e-12);
        let verdicts = overview.verdicts().join("\n");
        assert!(verdicts.contains("RMSE of coupled at or below ukf: 0 of 2 quantities (not p_a, r_pv)"), "{verdicts}");
        assert!(verdicts.contains("r_pv within 5 % of the truth for good after: coupled (0 of 3)"), "{verdicts}");
        assert!(overview.notices()[0].contains("gap (p_a) in 3 runs, first at 2.00 s"), "{:?}", overview.notices());
    }

    #[test]
    fn the_table_fits_a_terminal() {
        let methods = ["coupled", "coupled_smoothed", "ukf", "enkf"];
        let results = Results { rows: methods.map(|method| row(method, "a", 123.456)).to_vec(), ..Results::default() };
        for line in Overview::all(&results)[0].lines() {
            assert!(line.chars().count() <= 120, "{}: {line}", line.chars().count());
        }
    }

    #[test]
    fn numbers_are_short() {
        let short = [0.012_34, 1.0, 9.99, 12.345, 123.4, f64::NAN].map(compact);
        assert_eq!(short, ["0.012", "1.00", "9.99", "12.3", "123", "-"]);
    }
}
