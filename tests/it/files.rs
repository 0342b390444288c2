//! Records in every format: the same samples, whichever way they went.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use hemostream::edge::config::Config;
use hemostream::edge::files::columnar::{Cell, Field, Kind, Reader, UNITS_KEY, Writer};
use hemostream::edge::files::csv::Row;
use hemostream::edge::files::record::Record;

use crate::support::read_table;

fn hemostream(arguments: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_hemostream"));
    for (name, _) in std::env::vars().filter(|(name, _)| name.starts_with("HEMOSTREAM_")) {
        command.env_remove(name);
    }
    command.args(arguments).output().unwrap()
}

fn done(arguments: &[&str]) -> String {
    let output = hemostream(arguments);
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

/// Exit code and what was complained of.
fn refused(arguments: &[&str]) -> (Option<i32>, String) {
    let output = hemostream(arguments);
    (output.status.code(), String::from_utf8(output.stderr).unwrap())
}

fn config() -> Config {
    Config::load_from(None, [], &[]).unwrap().0
}

fn rows(path: &Path) -> (Vec<usize>, Vec<Row>) {
    let mut record = Record::open(path, &config()).unwrap();
    let states = record.states().to_vec();
    let mut rows = Vec::new();
    while let Some(row) = record.next_row().unwrap() {
        rows.push(row);
    }
    (states, rows)
}

struct Folder(tempfile::TempDir);

impl Folder {
    fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    fn text(&self, name: &str) -> String {
        self.path(name).to_str().unwrap().to_owned()
    }

    fn write(&self, name: &str, text: &str) -> String {
        std::fs::write(self.path(name), text).unwrap();
        self.text(name)
    }

    fn names(&self) -> Vec<String> {
        let mut names: Vec<String> = std::fs::read_dir(self.0.path())
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        names
    }
}

/// 360 Hz, times to the nanosecond from 12.3 s on, one missing sample in a column and one missing row's worth in both.
fn observed() -> String {
    let mut text = String::from("time_s,ABP,PAP\n");
    for i in 0..2000_i64 {
        let (time, wave) = (12.3 + i as f64 / 360.0, (i as f64 / 40.0).sin());
        let pulmonary = if i == 17 { String::new() } else { format!("{}", 18.0 + 7.123_456 * wave) };
        let arterial = if i == 1234 { String::new() } else { format!("{}", 90.0 + 31.987_654_321 * wave) };
        let pulmonary = if i == 1234 { String::new() } else { pulmonary };
        text.push_str(&format!("{time:.9},{arterial},{pulmonary}\n"));
    }
    text
}

#[test]
fn csv_to_parquet_to_wfdb_to_csv_keeps_times_gaps_and_values_within_half_a_step() {
    let folder = Folder::new();
    let csv = folder.write("a.csv", &observed());
    let said = done(&["convert", &csv, &folder.text("b.parquet")]);
    assert!(said.contains("2000 rows of p_a, p_pa over 5.553 s, 3997 samples"), "{said}");
    done(&["convert", &folder.text("b.parquet"), &folder.text("c.hea"), "--label", "p_a=ABP"]);
    done(&["convert", &folder.text("c"), &folder.text("d.csv"), "--label", "p_a=ART"]);
    assert_eq!(folder.names(), ["a.csv", "b.parquet", "c.dat", "c.hea", "d.csv"]);

    let header = std::fs::read_to_string(folder.path("c.hea")).unwrap();
    assert!(header.starts_with("c 2 360 2000\nc.dat 16 100(0)/mmHg 16 0 9000 "), "{header}");
    assert!(header.contains(" 0 ABP\n") && header.contains(" 0 p_pa\n"), "{header}");
    assert!(header.ends_with("# hemostream_start_ns: 12300000000\n"), "{header}");
    assert!(std::fs::read_to_string(folder.path("d.csv")).unwrap().starts_with("time_s,ART,p_pa\n"));

    let (states, first) = rows(&folder.path("a.csv"));
    assert_eq!(rows(&folder.path("b.parquet")), (states.clone(), first.clone()), "Parquet holds every bit");
    for name in ["c.hea", "d.csv"] {
        let (read_states, read) = rows(&folder.path(name));
        assert_eq!((&read_states, read.len()), (&states, first.len()));
        for (a, b) in first.iter().zip(&read) {
            assert!(a.time.ns_since(b.time).abs() <= 2, "{name}: {:?} {:?}", a.time, b.time);
            for (a, b) in a.values.iter().zip(&b.values) {
                assert_eq!(a.is_some(), b.is_some());
                assert!((a.unwrap_or(0.0) - b.unwrap_or(0.0)).abs() <= 0.005 + 1e-9, "{name}: {a:?} {b:?}");
            }
        }
    }
}

#[test]
fn irregular_times_need_a_rate_and_get_the_nearest_samples() {
    let folder = Folder::new();
    let csv = folder.write("a.csv", "time_s,p_a\n5,80\n5.011,81\n5.019,82\n5.041,84\n");
    let (code, complaint) = refused(&["convert", &csv, &folder.text("b")]);
    assert_eq!(code, Some(2));
    assert!(complaint.contains("a.csv: found a row at 5.011 s where 5.01366"), "{complaint}");
    assert!(complaint.contains("--rate-hz to put them on a grid"), "{complaint}");
    assert_eq!(folder.names(), ["a.csv"], "nothing half is left");

    done(&["convert", &csv, &folder.text("b"), "--rate-hz", "100"]);
    let (_, read) = rows(&folder.path("b"));
    let read: Vec<(i64, Option<f64>)> = read.iter().map(|r| (r.time.0 / 1_000_000, r.values[0])).collect();
    assert_eq!(read, [(5000, Some(80.0)), (5010, Some(81.0)), (5020, Some(82.0)), (5030, None), (5040, Some(84.0))]);

    let gap = folder.write("gap.csv", "time_s,p_a\n0,80\n0.01,81\n0.02,82\n0.04,84\n");
    assert_eq!(refused(&["convert", &gap, &folder.text("c")]).0, Some(2), "a gap is no constant rate");
    let single = folder.write("single.csv", "time_s,p_a\n0,80\n");
    assert!(refused(&["convert", &single, &folder.text("c")]).1.contains("one row, which has no rate"));
}

#[test]
fn what_cannot_be_converted_is_refused_with_exit_code_2() {
    let folder = Folder::new();
    let csv = folder.write("a.csv", "time_s,p_a\n0,80\n0.01,inf\n");
    let out = folder.text("b.parquet");
    let good = folder.write("good.csv", "time_s,p_a,p_v\n0,80,3\n0.01,81,3\n");
    let parquet = |name: &str, fields: Vec<Field>, row: Vec<Cell>| {
        let mut writer = Writer::create(&folder.path(name), fields, &[]).unwrap();
        writer.row(row.clone()).unwrap();
        writer.row(row).unwrap();
        writer.finish().unwrap();
        folder.text(name)
    };
    let float = |name: &str| Field::new(name, Kind::Float, "");
    let still =
        parquet("still.parquet", vec![float("time_s"), float("p_a")], vec![Cell::Float(1.0), Cell::Float(80.0)]);
    let flow = parquet("flow.parquet", vec![float("time_s"), float("flow")], vec![Cell::Float(1.0), Cell::Float(80.0)]);
    let timeless = parquet("timeless.parquet", vec![float("p_a")], vec![Cell::Float(80.0)]);
    let text = folder.write("text.parquet", "time_s,p_a\n0,80\n");
    let (spaced, nowhere) = (folder.text("a b.hea"), folder.text("none/b.csv"));
    let cases: [(&[&str], &str); 14] = [
        (&[&csv, &out], "a.csv: found p_a of inf at 0.01 s, expected a number"),
        (&["none.csv", &out], "none.csv: No such file"),
        (&[&good, "b.txt"], "b.txt: found another ending, expected .csv, .parquet, or .hea"),
        (&[&good, &good], "found the record that is read, expected another file"),
        (&[&good, &out, "--label", "p_pa=PAP"], "found no p_pa to label"),
        (&[&good, &out, "--label", "p_a=CVP"], "--label p_a=CVP: found a label of p_v"),
        (&[&good, &out, "--label", "p_a=x", "--label", "p_v=x"], "found two columns `x`, expected distinct"),
        (&[&good, &out, "--label", "flow=x"], "found the state `flow`"),
        (&[&good, &spaced], "expected letters, digits"),
        (&[&good, &nowhere], "none/b.csv: No such file"),
        (&[&still, &out], "still.parquet: found time 1 s after 1 s in row 2, expected strictly increasing"),
        (&[&flow, &out], "flow.parquet: found column `flow`, expected numbers of a pressure"),
        (&[&timeless, &out], "timeless.parquet: found columns p_a, expected a column `time_s`"),
        (&[&text, &out], "text.parquet: found no Parquet"),
    ];
    for (arguments, complaint) in cases {
        let all: Vec<&str> = std::iter::once("convert").chain(arguments.iter().copied()).collect();
        let (code, said) = refused(&all);
        assert_eq!(code, Some(2), "{all:?}: {said}");
        assert!(said.contains(complaint), "{all:?}: {said}");
    }
    assert!(!folder.path("b.parquet").exists());
}

#[test]
fn files_of_samples_that_are_read_or_are_somebody_elses_are_not_written_over() {
    let folder = Folder::new();
    let csv = folder.write("a.csv", "time_s,p_a\n0,80\n0.01,81\n0.02,82\n");
    done(&["convert", &csv, &folder.text("r")]);
    done(&["convert", &csv, &folder.text("r.hea")]);
    let samples = std::fs::read(folder.path("r.dat")).unwrap();
    // The same record under another name, and in segments.
    folder.write("other.hea", &std::fs::read_to_string(folder.path("r.hea")).unwrap());
    folder.write("long.hea", "long/2 1 100 6\nr 3\nr 3\n");
    let foreign = folder.write("s.dat", "not ours");
    folder.write("t.dat", "not ours either");
    folder.write("t.hea", "t 1 100 3\nr.dat 16\n");
    let ours = folder.names();
    for (input, output, complaint) in [
        ("r", "r", "r: found the record that is read, expected another file to write to"),
        ("other", "r", "r: found the record that is read"),
        ("long.hea", "r.hea", "r.hea: found the record that is read"),
        ("a.csv", "s", "s.dat: found a file that no header names, expected no such file, or one that"),
        ("a.csv", "t", "t.dat: found a file that no header names"),
    ] {
        let (code, said) = refused(&["convert", &folder.text(input), &folder.text(output)]);
        assert_eq!(code, Some(2), "{input} to {output}: {said}");
        assert!(said.contains(complaint), "{input} to {output}: {said}");
    }
    assert_eq!(folder.names(), ours);
    assert_eq!(std::fs::read(folder.path("r.dat")).unwrap(), samples);
    assert_eq!(std::fs::read(foreign).unwrap(), b"not ours");
}

#[test]
fn a_pressure_in_another_unit_is_ignored_and_said() {
    let folder = Folder::new();
    let csv = folder.write("a.csv", "time_s,p_a,p_pa\n0,80,20\n0.01,81,21\n");
    done(&["convert", &csv, &folder.text("r"), "--label", "p_pa=PAP"]);
    let header = std::fs::read_to_string(folder.path("r.hea")).unwrap();
    // The last line is that of p_pa.
    let (before, last) = header.rsplit_once("/mmHg").unwrap();
    folder.write("r.hea", &format!("{before}/kPa{last}"));
    let output = hemostream(&["convert", &folder.text("r"), &folder.text("b.csv")]);
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.success(), "{said}");
    assert!(said.contains("PAP: a signal of p_pa in kPa, expected mmHg, is ignored"), "{said}");
    assert_eq!(std::fs::read_to_string(folder.path("b.csv")).unwrap(), "time_s,p_a\n0,80\n0.01,81\n");
}

#[test]
fn csv_is_whole_or_not_there() {
    let folder = Folder::new();
    let csv = folder.write("a.csv", "time_s,p_a\n0,80\n1000,81\n");
    let out = folder.write("b.csv", "what was there");
    let (code, said) = refused(&["convert", &csv, &out, "--rate-hz", "1000000"]);
    assert_eq!(code, Some(2), "{said}");
    assert!(said.contains("places at 1000000 Hz"), "{said}");
    assert_eq!((std::fs::read_to_string(&out).unwrap().as_str(), folder.names().len()), ("what was there", 2));
    done(&["convert", &csv, &out]);
    assert_eq!(std::fs::read_to_string(&out).unwrap(), "time_s,p_a\n0,80\n1000,81\n");
    assert_eq!(folder.names(), ["a.csv", "b.csv"]);
}

#[cfg(unix)]
#[test]
fn csv_goes_through_a_pipe_with_a_name() {
    let folder = Folder::new();
    let csv = folder.write("a.csv", "time_s,p_a\n0,80\n1,81\n");
    let pipe = folder.text("pipe.csv");
    assert!(Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    let path = folder.path("pipe.csv");
    let reader = std::thread::spawn(move || std::fs::read_to_string(path).unwrap());
    done(&["convert", &csv, &pipe]);
    assert_eq!(reader.join().unwrap(), "time_s,p_a\n0,80\n1,81\n");
    assert_eq!(folder.names(), ["a.csv", "pipe.csv"]);
}

#[test]
fn a_parquet_record_may_tell_time_in_integers() {
    let folder = Folder::new();
    let fields = vec![
        Field::new("CVP", Kind::Int, "mmHg").optional(),
        Field::new("time_ns", Kind::Int, "ns"),
        Field::new("p_a", Kind::Float, "mmHg"),
    ];
    let mut writer = Writer::create(&folder.path("r.parquet"), fields, &[]).unwrap();
    let start = 1_767_225_600_123_456_789_i64;
    writer.row([Cell::Int(4), Cell::Int(start), Cell::Float(80.25)]).unwrap();
    writer.row([Cell::Missing, Cell::Int(start + 1), Cell::Float(f64::NAN)]).unwrap();
    writer.finish().unwrap();
    let (states, read) = rows(&folder.path("r.parquet"));
    assert_eq!(states, [2, 1]);
    assert_eq!((read[0].time.0, &read[0].values), (start, &vec![Some(4.0), Some(80.25)]));
    assert_eq!((read[1].time.0, &read[1].values), (start + 1, &vec![None, None]));
}

/// All numbers of a Parquet file, NaN where missing, and its columns.
fn numbers(path: &Path) -> (Vec<String>, Vec<Vec<f64>>) {
    let mut reader = Reader::open(path).unwrap();
    let names: Vec<String> = reader.fields().iter().map(|f| f.name.clone()).collect();
    let mut rows = Vec::new();
    while let Some(batch) = reader.next_batch(1000).unwrap() {
        for row in 0..batch.rows() {
            rows.push((0..names.len()).map(|c| batch.float(row, c).unwrap_or(f64::NAN)).collect());
        }
    }
    (names, rows)
}

fn bits(rows: &[Vec<f64>]) -> Vec<u64> {
    rows.iter().flatten().map(|v| if v.is_nan() { 0 } else { v.to_bits() }).collect()
}

#[test]
fn simulate_and_estimate_write_the_same_numbers_in_both_formats() {
    let folder = Folder::new();
    let run = |ending: &str| {
        let path = |name: &str| folder.text(&format!("{name}.{ending}"));
        let (truth, observed) = (path("truth"), path("observed"));
        let both = ["--set", "observed=[\"p_a\", \"p_pa\"]"];
        let mut simulate = vec!["simulate", "--seconds", "2", "--rate-hz", "200", "--truth", &truth];
        simulate.extend(["--observed", &observed]);
        done(&[&simulate[..], &both].concat());
        let (out, beats, events) = (path("estimates"), path("beats"), path("events"));
        let mut estimate = vec!["estimate", &observed, "--output", &out, "--beats", &beats, "--events", &events];
        estimate.extend(["--set", "estimator.members=12", "--set", "window.length_s=0.005"]);
        done(&[&estimate[..], &both].concat());
    };
    run("csv");
    run("parquet");
    for table in ["truth", "observed", "estimates", "beats"] {
        let csv = read_table(&folder.path(&format!("{table}.csv")));
        let (names, rows) = numbers(&folder.path(&format!("{table}.parquet")));
        assert_eq!(names, csv.header, "{table}");
        assert!(!rows.is_empty(), "{table}");
        assert!(bits(&rows) == bits(&csv.rows), "{table}");
    }
    let reader = Reader::open(&folder.path("estimates.parquet")).unwrap();
    let units: serde_json::Value = serde_json::from_str(reader.metadata(UNITS_KEY).unwrap()).unwrap();
    assert_eq!((units["time_s"].as_str(), units["q_li_q95"].as_str()), (Some("s"), Some("mL/s")));
    let mut events = Reader::open(&folder.path("events.parquet")).unwrap();
    let csv = std::fs::read_to_string(folder.path("events.csv")).unwrap();
    assert_eq!(events.rows() + 1, csv.lines().count() as u64);
    let batch = events.next_batch(10).unwrap().unwrap();
    assert_eq!(batch.text(0, 1), csv.lines().nth(1).unwrap().split(',').nth(1).unwrap());
    let (code, said) = refused(&["simulate", "--truth", "truth.txt"]);
    assert_eq!(code, Some(2), "{said}");
    assert!(said.contains("truth.txt: found another ending, expected .csv or .parquet"), "{said}");
}
