//! The commands as a user runs them: files, exit codes, messages.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use crate::support::read_table;

fn hemostream(arguments: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_hemostream"));
    // The user's environment must not decide what the tests see.
    for (name, _) in std::env::vars().filter(|(name, _)| name.starts_with("HEMOSTREAM_")) {
        command.env_remove(name);
    }
    command.args(arguments).output().unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

fn path(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// Two seconds of both channels at 200 Hz.
fn record(folder: &Path) -> (PathBuf, PathBuf) {
    let (truth, observed) = (folder.join("truth.csv"), folder.join("observed.csv"));
    let output = hemostream(&[
        "simulate",
        "--seconds",
        "2",
        "--rate-hz",
        "200",
        "--truth",
        path(&truth),
        "--observed",
        path(&observed),
        "--set",
        "observed=[\"p_a\", \"p_pa\"]",
        "--set",
        "patient.script=[{ at_s = 1.0, scale = { r_pv = 2.0 } }]",
    ]);
    assert!(output.status.success(), "{}", text(&output.stderr));
    (truth, observed)
}

const SMALL: [&str; 6] =
    ["--set", "estimator.members=12", "--set", "window.length_s=0.005", "--set", "publish.rate_hz=50"];

#[test]
fn simulate_writes_truth_and_observations() {
    let folder = tempfile::tempdir().unwrap();
    let (truth, observed) = record(folder.path());
    let truth = read_table(&truth);
    let mut expected: Vec<&str> = "time_s p_l p_a p_v p_r p_pa p_pv q_li q_lo q_a q_ri q_ro q_pv".split(' ').collect();
    expected.extend("v_l v_a v_v v_r v_pa v_pv r_pv".split(' '));
    assert_eq!(truth.header, expected);
    assert_eq!(truth.rows.len(), 401);
    let (first, last) = (truth.rows[0][19], truth.rows[400][19]);
    assert!((last / first - 2.0).abs() < 1e-12, "the script doubles r_pv: {first} {last}");
    assert!((truth.rows[200][19] / first - 2.0).abs() < 1e-12, "from the time of the change on");
    let observed = read_table(&observed);
    assert_eq!(observed.header, ["time_s", "p_a", "p_pa"]);
    let noise: Vec<f64> = observed.rows.iter().zip(&truth.rows).map(|(o, t)| o[1] - t[2]).collect();
    let sd = (noise.iter().map(|e| e * e).sum::<f64>() / noise.len() as f64).sqrt();
    assert!((sd / 2.06 - 1.0).abs() < 0.15, "noise of p_a: {sd}");
}

#[test]
fn estimate_is_byte_identical_on_one_and_two_threads() {
    let folder = tempfile::tempdir().unwrap();
    let (_, observed) = record(folder.path());
    let run = |coupling: &str, threads: &str| {
        let out = folder.path().join(format!("{coupling}{threads}.csv"));
        let coupling = format!("estimator.coupling={coupling}");
        let mut arguments = vec!["estimate", path(&observed), "--output", path(&out), "--threads", threads];
        arguments.extend(["--set", &coupling]);
        arguments.extend(SMALL);
        let output = hemostream(&arguments);
        assert!(output.status.success(), "{}", text(&output.stderr));
        std::fs::read(out).unwrap()
    };
    for coupling in ["coupled", "independent"] {
        assert!(run(coupling, "1") == run(coupling, "2"), "{coupling} depends on the number of threads");
    }
    let table = read_table(&folder.path().join("coupled1.csv"));
    assert_eq!(table.rows.len(), 101, "50 Hz from 0 to 2 s");
    assert_eq!(
        table.header[..8],
        ["time_s", "p_l_mean", "p_l_sd", "p_l_q05", "p_l_q95", "p_l_epistemic_sd", "p_l_aleatoric_sd", "p_l_model_sd"]
    );
    assert_eq!(
        table.header[127..],
        ["r_pv_mean", "r_pv_sd", "r_pv_q05", "r_pv_q95", "c_a_mean", "c_a_sd", "c_a_q05", "c_a_q95"]
    );
    assert!(table.rows.iter().flatten().all(|v| v.is_finite()));
}

#[test]
fn a_column_without_data_is_not_observed() {
    let folder = tempfile::tempdir().unwrap();
    let (_, observed) = record(folder.path());
    // The same record with an empty third column.
    let text = std::fs::read_to_string(&observed).unwrap();
    let with_empty: Vec<String> = text
        .lines()
        .enumerate()
        .map(|(i, line)| if i == 0 { format!("{line},CVP") } else { format!("{line},") })
        .collect();
    let padded = folder.path().join("padded.csv");
    std::fs::write(&padded, with_empty.join("\n")).unwrap();
    let run = |input: &Path, out: &str| {
        let out = folder.path().join(out);
        let mut arguments = vec!["estimate", path(input), "--output", path(&out)];
        arguments.extend(SMALL);
        let output = hemostream(&arguments);
        assert!(output.status.success(), "{}", self::text(&output.stderr));
        std::fs::read(out).unwrap()
    };
    assert!(run(&observed, "a.csv") == run(&padded, "b.csv"));
}

#[test]
fn a_wfdb_record_gives_what_the_same_samples_in_a_table_give_with_beats_and_events() {
    let folder = tempfile::tempdir().unwrap();
    let (_, observed) = record(folder.path());
    // 0.05 mmHg per unit, with a baseline; one sample is missing.
    let (gain, baseline) = (20.0, 100);
    let mut stored: Vec<[i16; 2]> = Vec::new();
    let mut table = String::from("time_s,ABP,PAP\n");
    for (i, row) in read_table(&observed).rows.iter().enumerate() {
        let units = [1, 2].map(|c| (row[c] * gain).round() as i16 + baseline);
        let [a, pa] = units.map(|unit| (f64::from(unit - baseline) / gain).to_string());
        let pa = if i == 200 { String::new() } else { pa };
        table.push_str(&format!("{},{a},{pa}\n", row[0]));
        stored.push([units[0], if i == 200 { i16::MIN } else { units[1] }]);
    }
    let bytes: Vec<u8> = stored.iter().flatten().flat_map(|unit| unit.to_le_bytes()).collect();
    let signal = |c: usize, label: &str| {
        let checksum = stored.iter().fold(0_i16, |sum, units| sum.wrapping_add(units[c]));
        format!("wave.dat 16 {gain}({baseline})/mmHg 16 0 {} {checksum} 0 {label}", stored[0][c])
    };
    let header = format!("wave 2 200 {}\n{}\n{}\n", stored.len(), signal(0, "ABP"), signal(1, "PAP"));
    let in_folder = |name: &str| folder.path().join(name);
    std::fs::write(in_folder("wave.dat"), bytes).unwrap();
    std::fs::write(in_folder("wave.hea"), header).unwrap();
    std::fs::write(in_folder("table.csv"), table).unwrap();

    let run = |input: &[&str], name: &str| {
        let outputs = ["estimates", "beats", "events"].map(|what| in_folder(&format!("{name}_{what}.csv")));
        let mut arguments = vec!["estimate"];
        arguments.extend(input);
        arguments.extend(["--output", path(&outputs[0]), "--beats", path(&outputs[1]), "--events", path(&outputs[2])]);
        arguments.extend(SMALL);
        let output = hemostream(&arguments);
        assert!(output.status.success(), "{}", text(&output.stderr));
        outputs.map(|file| std::fs::read_to_string(file).unwrap())
    };
    let of_wave = run(&["--record", path(&in_folder("wave"))], "wave");
    assert_eq!(of_wave, run(&[path(&in_folder("table.csv"))], "table"));
    assert_eq!(of_wave, run(&[path(&in_folder("wave.hea"))], "header"), "a header needs no --record");

    let beats = read_table(&in_folder("wave_beats.csv"));
    assert_eq!(beats.header[..4], ["time_s", "end_s", "heart_rate_mean", "heart_rate_sd"]);
    assert_eq!(beats.rows.len(), 1, "between the onsets that are seen in 2 s");
    assert!(beats.rows.iter().all(|row| (row[2] - 72.0).abs() < 0.5), "{:?}", beats.rows);
    assert!(of_wave[2].starts_with("time_s,kind,channel,text\n0,start,,"), "{}", of_wave[2]);

    let none = hemostream(&["estimate", "--record", path(&in_folder("absent")), "--output", "out.csv"]);
    assert_eq!(none.status.code(), Some(2));
    assert!(text(&none.stderr).contains("absent"), "{}", text(&none.stderr));
}

/// A record that cannot be used: exit code 2, and a message that names file, place, what is there and what should be.
fn check_bad_record(content: &str, expected: &[&str]) {
    let folder = tempfile::tempdir().unwrap();
    let (input, out) = (folder.path().join("bad.csv"), folder.path().join("out.csv"));
    std::fs::write(&input, content).unwrap();
    let output = hemostream(&["estimate", path(&input), "--output", path(&out)]);
    let message = text(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{message}");
    for part in expected.iter().chain(&["bad.csv"]) {
        assert!(message.contains(part), "`{part}` is not in: {message}");
    }
    assert!(!out.exists(), "nothing is written for a record that cannot be used");
}

#[test]
fn bad_records_are_refused_with_reasons() {
    check_bad_record("p_a,p_pa\n80,20\n", &["columns p_a, p_pa", "`time_s`"]);
    check_bad_record("time_s,p_a,p_x\n0,80,1\n", &["column `p_x`", "p_l, p_a"]);
    check_bad_record("time_s,p_a\n0,80\n0.005,high\n", &["bad.csv:3", "`high`", "`p_a`", "a number"]);
    check_bad_record("time_s,p_a\n0,80\n0.01,81\n0.005,82\n", &["bad.csv:4", "0.005", "increasing"]);
    check_bad_record("time_s,p_a\n0,80\n0,81\n", &["bad.csv:3", "increasing"]);
    check_bad_record("", &["empty file"]);
    check_bad_record("time_s,p_a\n", &["at least one sample"]);
    check_bad_record("time_s\n0\n", &["at least one pressure"]);
    check_bad_record("time_s,p_a,ABP\n0,80,80\n", &["column `ABP`", "one column per pressure"]);
    check_bad_record("time_s,p_a\n0,80\n0.005\n", &["bad.csv:3"]);
    check_bad_record("time_s,p_a\nnan,80\n", &["bad.csv:2", "`nan`", "`time_s`"]);
}

#[test]
fn bad_usage_and_bad_settings_exit_with_2() {
    for (arguments, expected) in [
        (vec!["estimate", "no-such.csv", "--output", "x.csv"], "no-such.csv"),
        (vec!["estimate", "x.csv", "--output", "x.xls"], "expected .csv or .parquet"),
        (vec!["record", "--output", "x", "--flush-s", "0"], "expected a number above 0"),
        (vec!["replay", "--recording", "no-such"], "no-such: found no bed, expected a recording"),
        (vec!["replay", "--bed", "a", "--bed", "b"], "--bed: found several"),
        (vec!["config", "--set", "window.lenght_s=1"], "did you mean `window.length_s`"),
        (vec!["config", "--set", "patient.c_a=-1"], "patient.c_a"),
        (vec!["config", "--set", "estimator.members=0"], "estimator.members"),
        (vec!["config", "--set", "estimator.members=\"many\""], "estimator.members"),
        (vec!["config", "--set", "window.length_s=1.0"], "allowed_lateness_s"),
        (vec!["simulate", "--seconds=-1", "--truth", "x.csv"], "above 0"),
        (vec!["simulate"], "--truth"),
        (vec!["watch"], "terminal"),
        (vec!["note", "--bed", "bed1"], "TEXT"),
        (vec!["note", "--bed", "bed1", "text", "--time-s", "nan"], "expected seconds"),
        (vec!["acknowledge"], "--bed"),
        (vec!["validate", "--patient", "helthy"], "expected a TOML file or one of healthy, pulmonary"),
        (vec!["validate", "--patient", "no_such.toml"], "no_such.toml"),
        (vec!["validate", "--scenario", "stepp"], "arterial_line_only"),
        (vec!["validate", "--seconds", "1"], "expected a number from 4 to 600"),
        (vec!["validate", "--observed", "p_x"], "p_x"),
        (vec!["validate", "--set", "patient.r_pv=1"], "--patient"),
        (vec!["validate", "--set", "estimator.coupling=ukf"], "--rival"),
        (vec!["frobnicate"], "frobnicate"),
    ] {
        let output = hemostream(&arguments);
        let message = text(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {message}");
        assert!(message.contains(expected), "{arguments:?}: `{expected}` is not in: {message}");
    }
}

#[test]
fn every_command_has_help_with_an_example() {
    let commands = [
        "demo",
        "serve",
        "replay",
        "watch",
        "dashboard",
        "record",
        "convert",
        "note",
        "acknowledge",
        "simulate",
        "estimate",
        "validate",
        "config",
    ];
    for command in commands {
        let output = hemostream(&[command, "--help"]);
        assert!(output.status.success());
        assert!(text(&output.stdout).contains(&format!("hemostream {command}")), "{command}");
    }
}

#[test]
fn config_prints_settings_with_their_origin() {
    let output = hemostream(&["config", "--set", "estimator.members=33"]);
    let printed = text(&output.stdout);
    assert!(output.status.success());
    let line = printed.lines().find(|l| l.starts_with("members")).unwrap();
    assert!(line.contains("33") && line.contains("--set"), "{line}");
}

/// Everything together over zenoh on loopback, on a port of its own.
#[test]
fn demo_runs_by_itself_and_sums_up() {
    let output = hemostream(&["demo", "--seconds", "3", "--listen", "127.0.0.1:0", "--set", "estimator.members=20"]);
    let printed = text(&output.stdout);
    assert!(output.status.success(), "{printed}{}", text(&output.stderr));
    for expected in [
        "http://127.0.0.1:",
        "icu-1",
        "icu-3",
        "r_pv",
        "c_a",
        "p_pv [mmHg]",
        "coverage",
        "window lag p50",
        "(observed)",
    ] {
        assert!(printed.contains(expected), "`{expected}` is not in: {printed}");
    }
    assert!(printed.contains("lost or refused: nothing"), "{printed}");
}
