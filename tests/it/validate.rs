//! Twin experiments in their small form: the same on any number of threads, and everything written that is promised.

use std::path::Path;

use hemostream::edge::config::Config;
use hemostream::report;
use hemostream::runtime::workers::Workers;
use hemostream::validate::experiment::{Plan, Results};
use hemostream::validate::scenario::{Rival, Scenario};
use hemostream::validate::table::{self, EVENT_COLUMNS, Overview, SCORE_COLUMNS};
use hemostream::validate::{PRESET, patients, pictures};

/// A healthy patient for 4 s.
fn small(scenarios: &[Scenario], rivals: &[Rival], threads: usize, sets: &[&str]) -> Results {
    let sets: Vec<String> = [&["estimator.members=12"], sets].concat().into_iter().map(str::to_owned).collect();
    let plan = Plan {
        patients: vec![patients::find("healthy").unwrap()],
        scenarios: scenarios.to_vec(),
        seeds: 1,
        seconds: 4.0,
        ensemble: Config::load_over(PRESET, None, &sets).unwrap().0,
        rivals: rivals.to_vec(),
    };
    plan.run(&Workers::start(threads).unwrap(), &|| ()).unwrap()
}

fn rmse(results: &Results, method: &str, quantity: &str) -> f64 {
    let row = results.rows.iter().find(|row| row.method == method).unwrap();
    row.scores.iter().find(|score| score.quantity == quantity).unwrap().score.rmse
}

fn text(path: &Path) -> String {
    std::fs::read_to_string(path).unwrap()
}

#[test]
fn numbers_do_not_depend_on_threads_and_all_files_are_there() {
    let folder = tempfile::tempdir().unwrap();
    let (one, three) = (folder.path().join("one"), folder.path().join("three"));
    for (directory, threads) in [(&one, 1), (&three, 3)] {
        std::fs::create_dir(directory).unwrap();
        let results = small(&[Scenario::Step], &Rival::ALL, threads, &[]);
        table::write(directory, &results).unwrap();
        report::write(directory, pictures::HEADING, &pictures::reports(&results)).unwrap();
    }
    for file in ["scores.csv", "events.csv", "summary.json", "report.md", "report.html"] {
        assert!(text(&one.join(file)) == text(&three.join(file)), "{file} depends on the number of threads");
    }
    let scores = text(&one.join("scores.csv"));
    let mut lines = scores.lines();
    assert_eq!(lines.next().unwrap(), SCORE_COLUMNS.join(","));
    // 18 quantities, 2 parameters and the cardiac output by 3 methods.
    assert_eq!(lines.count(), 63, "{scores}");
    for expected in ["step,healthy,0,coupled,p_l,mmHg,", "step,healthy,0,enkf,cardiac_output,L/min,"] {
        assert!(scores.contains(expected), "`{expected}` is not in {scores}");
    }
    let events = text(&one.join("events.csv"));
    assert!(events.starts_with(&EVENT_COLUMNS.join(",")) && events.contains("coupled,start,"), "{events}");
    let summary: serde_json::Value = serde_json::from_str(&text(&one.join("summary.json"))).unwrap();
    assert!(summary["step"]["p_a"]["ukf"]["crps_percent"].as_f64().unwrap() > 0.0);
    let page = text(&one.join("report.md"));
    let pictures: Vec<&str> = page.split("<img src=\"").skip(1).filter_map(|rest| rest.split('"').next()).collect();
    let expected = ["step_errors.png", "step_bands.png", "step_healthy_parameters.png", "step_pressures.png"];
    assert_eq!(pictures, expected);
    for picture in pictures {
        assert!(std::fs::read(one.join(picture)).unwrap().starts_with(b"\x89PNG"), "{picture}");
        assert!(one.join(picture.replace(".png", ".svg")).exists(), "{picture}");
    }
}

#[test]
fn pressures_are_found_and_a_wrong_belief_is_seen_in_the_scores() {
    let results = small(&[Scenario::Steady], &[Rival::Ukf], 2, &[]);
    for method in ["coupled", "ukf"] {
        for quantity in ["p_a", "p_pa", "p_pv", "cardiac_output"] {
            let rmse = rmse(&results, method, quantity);
            assert!(rmse < 5.0, "{method} {quantity}: {rmse} %");
        }
    }
    let wrong = small(&[Scenario::WrongSystole], &[], 2, &[]);
    assert!(rmse(&wrong, "coupled", "p_l") > 3.0 * rmse(&results, "coupled", "p_l"));
    assert_eq!(wrong.rows.len(), 1, "no rival, one row");
}

#[test]
fn what_the_estimator_is_told_does_not_change_the_truth() {
    let rms =
        |results: &Results| -> Vec<f64> { results.rows[0].scores.iter().map(|score| score.score.truth_rms).collect() };
    let told = ["estimator.parameter_drift=0.1", "channels.p_a.noise_sd=5.0"];
    let (as_it_is, otherwise) = (small(&[Scenario::Steady], &[], 2, &[]), small(&[Scenario::Steady], &[], 2, &told));
    assert_eq!(rms(&as_it_is), rms(&otherwise));
    assert!((rmse(&as_it_is, "coupled", "p_a") - rmse(&otherwise, "coupled", "p_a")).abs() > 0.0);
}

/// A law of which the parameter is no number: everything else is scored.
#[test]
fn what_has_no_truth_is_not_scored() {
    let results = small(&[Scenario::NonlinearResistance, Scenario::ArterialLineOnly], &[], 2, &[]);
    let overviews = Overview::all(&results);
    let names = |k: usize| overviews[k].quantities.iter().map(|(name, _)| *name).collect::<Vec<_>>();
    assert!(!names(0).contains(&"r_pv") && names(0).contains(&"c_a") && names(0).contains(&"q_pv"), "{:?}", names(0));
    assert!(names(1).contains(&"r_pv"));
}

/// What a model may lack is nothing that the patient has; what follows it is still found by its name.
#[test]
fn a_discrepancy_is_passed_over() {
    let with = small(&[Scenario::Steady], &[], 2, &["discrepancy={ q_pv = { form = \"tracked\", change = 20.0 } }"]);
    let scores = &with.rows[0].scores;
    assert_eq!(scores.len(), 21);
    for quantity in ["q_li", "v_pv", "c_a", "cardiac_output"] {
        assert!(rmse(&with, "coupled", quantity) < 15.0, "{quantity}: {}", rmse(&with, "coupled", quantity));
    }
}
