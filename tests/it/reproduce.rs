//! Studies in their small form: that they run, write what they promise, and find what is true.

use std::path::Path;

use hemostream::edge::config::Config;
use hemostream::report::{self, Report};
use hemostream::reproduce::{Context, STUDIES, paper_config};
use hemostream::runtime::workers::Workers;

fn quick(names: &[&str]) -> Vec<Report> {
    let workers = Workers::start(2).unwrap();
    let context = Context::new(true, &workers, &|_| ());
    let wanted = STUDIES.iter().filter(|study| names.contains(&study.name));
    wanted.map(|study| context.study(study).unwrap()).collect()
}

#[test]
fn the_preset_is_the_paper_of_the_studies() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/paper.toml");
    let mut preset = Config::load_from(Some(&path), [], &[]).unwrap().0;
    let studies = paper_config();
    // Written in decimals in the one, computed in the other.
    let (a, b) = (preset.estimator.initial_guess["r_pv"], studies.estimator.initial_guess["r_pv"]);
    assert!((a - b).abs() < 1e-12 * b, "{a} against {b}");
    preset.estimator.initial_guess.clone_from(&studies.estimator.initial_guess);
    assert_eq!(preset, studies);
}

#[test]
fn the_harmonic_study_finds_k() {
    let reports = quick(&["harmonic"]);
    let number = |path: &str| reports[0].number(path).unwrap();
    assert!((number("b1.k_mean") - 1.0).abs() < 0.03, "{}", number("b1.k_mean"));
    assert!((0.015..0.1).contains(&number("b1.k_sd")), "{}", number("b1.k_sd"));
    assert!((number("coupled_b15.k_mean") - 1.0).abs() < 0.06);
}

#[test]
fn black_and_gray_boxes_are_opened() {
    let reports = quick(&["identification"]);
    for path in [
        "oscillator_black_box.dx_dt",
        "oscillator_black_box.dy_dt",
        "lorenz_black_box.dx_dt",
        "lorenz_black_box.dy_dt",
        "lorenz_black_box.dz_dt",
        "lorenz_gray_box.xz",
    ] {
        let error = reports[0].number(&format!("{path}.relative_l2")).unwrap();
        println!("{path}: {error:.2e}");
        assert!(error < 0.01, "{path}: {error}");
    }
}

#[test]
fn a_report_is_written_with_everything_it_refers_to() {
    let folder = tempfile::tempdir().unwrap();
    let reports = quick(&["harmonic-discrepancy"]);
    let page = report::write(folder.path(), "# Heading\n\n", &reports).unwrap();
    assert!(page.ends_with("report.html"));
    let text = std::fs::read_to_string(folder.path().join("report.md")).unwrap();
    let html = std::fs::read_to_string(page).unwrap();
    assert!(text.starts_with("# Heading") && html.contains("<table>"));
    let pictures: Vec<&str> = text.split("<img src=\"").skip(1).filter_map(|rest| rest.split('"').next()).collect();
    assert_eq!(pictures.len(), 2);
    for picture in pictures {
        let png = std::fs::read(folder.path().join(picture)).unwrap();
        assert!(png.starts_with(b"\x89PNG"), "{picture}");
        let svg = std::fs::read_to_string(folder.path().join(picture.replace(".png", ".svg"))).unwrap();
        assert!(svg.contains("<svg"), "{picture}");
    }
    let summary = std::fs::read_to_string(folder.path().join("summary.json")).unwrap();
    let summary: serde_json::Value = serde_json::from_str(&summary).unwrap();
    let error = &summary["harmonic_discrepancy"]["independent"]["n200"]["delta_relative_l2"];
    assert!(error.as_f64().unwrap() < 0.1, "{error}");
    let table = crate::support::read_table(&folder.path().join("harmonic_discrepancy_independent_50.csv"));
    assert_eq!(table.header[0], "time_s");
    assert_eq!(table.rows.len(), 51);
}
