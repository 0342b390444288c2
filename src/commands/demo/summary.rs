//! What the demo says in the terminal.

use std::collections::BTreeMap;

use hemostream::edge::config::Config;
use hemostream::edge::scoreboard::Scoreboard;
use hemostream::edge::wire::STATE_STATISTICS;
use hemostream::model::Model;

use super::super::say;
use super::patients::CRISIS_BED;

/// Pressures in the line of a bed: what is observed, and the most interesting of what is not.
const SHOWN: [&str; 3] = ["p_a", "p_pa", "p_pv"];

/// A demo that is over.
pub(super) struct Run<'a> {
    /// Of the estimator.
    pub(super) config: &'a Config,
    /// By bed.
    pub(super) boards: &'a BTreeMap<String, Scoreboard>,
    /// Length.
    pub(super) seconds: f64,
    /// Samples per second and sensor.
    pub(super) rate_hz: f64,
}

/// A bed now.
#[allow(clippy::cast_precision_loss)]
pub(super) fn line(bed: &str, board: &Scoreboard) -> String {
    let Some(estimate) = &board.latest else { return format!("{bed}  no estimate yet") };
    let rows = estimate.names.iter().zip(estimate.values.chunks_exact(STATE_STATISTICS.len()));
    let pressures: Vec<String> = rows
        .filter(|(name, _)| SHOWN.contains(&name.as_str()))
        .map(|(name, row)| format!("{name} {:.1} [{:.1} {:.1}]", row[0], row[5], row[6]))
        .collect();
    let parameters: Vec<String> = board
        .parameters
        .iter()
        .map(|(name, mean, q05, q95, truth)| format!("{name} {mean:.3} [{q05:.3} {q95:.3}] true {truth:.3}"))
        .collect();
    let time_s = estimate.header.time_ns as f64 * 1e-9;
    format!("{time_s:6.1} s  {bed}  {}  |  {}", pressures.join("  "), parameters.join("  "))
}

/// Estimates beside the truth.
pub(super) fn print(run: &Run<'_>) {
    let Run { config, seconds, rate_hz, .. } = run;
    say(format!(
        "\n{seconds:.0} s of {} synthetic patients, {} observed at {rate_hz:.0} Hz with noise; {} members, {} ms windows",
        run.boards.len(),
        config.observed.join(" and "),
        config.estimator.members,
        config.window.length_s * 1e3,
    ));
    parameters(run);
    if let Some(board) = run.boards.get(CRISIS_BED) {
        quantities(config, board);
    }
    for (bed, board) in run.boards {
        health(bed, board);
    }
}

fn parameters(run: &Run<'_>) {
    say("\nbed     parameter    start guess   estimate  [   5 %     95 %]     truth     off");
    let (model, theta) = (run.config.patient.model(), run.config.patient.theta());
    for (bed, board) in run.boards {
        for (name, mean, q05, q95, truth) in &board.parameters {
            let assumed = model.parameter_index(name).map_or(f64::NAN, |p| theta[p]);
            let guess = run.config.estimator.initial_guess.get(name).copied().unwrap_or(assumed);
            let off = 100.0 * (mean / truth - 1.0);
            say(format!(
                "{bed:<7} {name:<12} {guess:>11.4} {mean:>10.4}  [{q05:.4}  {q95:.4}]  {truth:>8.4}  {off:>+5.1} %"
            ));
        }
    }
}

fn quantities(config: &Config, board: &Scoreboard) {
    say(format!("\n{CRISIS_BED}: quantity        rms error   band width   coverage of the 90 % band"));
    let model = config.patient.model();
    for quantity in model.states().iter().chain(model.derived()) {
        let Some(score) = board.scores.get(quantity.name) else { continue };
        let observed = config.observed.iter().any(|o| o == quantity.name);
        let label = format!("{} [{}]", quantity.name, quantity.unit);
        let note = if observed { "  (observed)" } else { "" };
        let (rmse, width, coverage) = (score.rmse(), score.width(), 100.0 * score.coverage());
        say(format!("{label:<20} {rmse:>11.4} {width:>12.4}   {coverage:>5.1} %{note}"));
    }
    say("");
}

fn health(bed: &str, board: &Scoreboard) {
    let Some(status) = &board.status else { return };
    let lost: Vec<String> = status.counters.iter().map(|(cause, n)| format!("{cause} {n}")).collect();
    say(format!(
        "{bed}: window lag p50 {:.2} ms, p99 {:.2} ms, max {:.2} ms; {} windows, {:.2} ms each; lost or refused: {}",
        status.lag_p50_ms,
        status.lag_p99_ms,
        status.lag_max_ms,
        status.windows,
        status.solve_ms,
        if lost.is_empty() { "nothing".to_owned() } else { lost.join(", ") },
    ));
}
