//! Rules of the house that a compiler does not check.

use std::path::{Path, PathBuf};

const LAYERS: [&str; 8] = ["model", "xtfc", "estimate", "runtime", "edge", "report", "reproduce", "validate"];

/// Layers beside each other: the later one does not know the earlier one either.
const SIBLINGS: [(&str, &str); 1] = [("validate", "reproduce")];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn rust_files(folder: &Path) -> Vec<PathBuf> {
    let mut files = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            files.extend(rust_files(&path));
        } else if path.extension().is_some_and(|e| e == "rs") {
            files.push(path);
        }
    }
    files
}

/// Layer of a file under `src`, as a position in [`LAYERS`].
fn layer(file: &Path) -> Option<usize> {
    let first = file.strip_prefix(root().join("src")).unwrap().components().next()?;
    LAYERS.iter().position(|l| first.as_os_str().to_str() == Some(l))
}

#[test]
fn dependencies_point_one_way() {
    for file in rust_files(&root().join("src")) {
        let Some(own) = layer(&file) else { continue };
        for (number, line) in std::fs::read_to_string(&file).unwrap().lines().enumerate() {
            let code = line.split("//").next().unwrap_or_default();
            for (position, name) in LAYERS.iter().enumerate().filter(|(p, _)| *p > own) {
                let found = code.contains(&format!("crate::{name}"));
                assert!(!found, "{}:{}: {} uses {}", file.display(), number + 1, LAYERS[own], LAYERS[position]);
            }
            for (one, other) in SIBLINGS.iter().filter(|(one, _)| *one == LAYERS[own]) {
                let found = code.contains(&format!("crate::{other}"));
                assert!(!found, "{}:{}: {one} uses {other}", file.display(), number + 1);
            }
        }
    }
}

#[test]
fn the_core_knows_no_clock_socket_thread_or_log() {
    let banned =
        ["std::time::", "std::net", "std::thread", "std::fs", "tokio", "zenoh", "tracing", "rayon", "println!"];
    for file in rust_files(&root().join("src")) {
        if layer(&file).is_none_or(|l| l > 2) {
            continue;
        }
        for (number, line) in std::fs::read_to_string(&file).unwrap().lines().enumerate() {
            let code = line.split("//").next().unwrap_or_default();
            for word in banned {
                assert!(!code.contains(word), "{}:{}: `{word}` in the core", file.display(), number + 1);
            }
        }
    }
}

#[test]
fn only_one_file_reads_the_clock() {
    for file in rust_files(&root().join("src")) {
        let text = std::fs::read_to_string(&file).unwrap();
        let reads = text.contains("Instant::now") || text.contains("SystemTime::now");
        assert_eq!(reads, file.ends_with("runtime/clock.rs"), "{}", file.display());
    }
}

#[test]
fn every_file_is_part_of_the_program() {
    let files = rust_files(&root().join("src"));
    for file in &files {
        let stem = file.file_stem().unwrap().to_str().unwrap();
        let (name, folder) = match stem {
            "lib" | "main" => continue,
            "mod" => {
                let folder = file.parent().unwrap();
                (folder.file_name().unwrap().to_str().unwrap(), folder.parent().unwrap())
            }
            stem => (stem, file.parent().unwrap()),
        };
        let parents = ["mod.rs", "lib.rs", "main.rs"].map(|p| folder.join(p));
        let declared = parents.iter().filter_map(|p| std::fs::read_to_string(p).ok()).any(|text| {
            text.lines().any(|l| l.trim_end_matches(';').ends_with(&format!("mod {name}")) && l.contains("mod"))
        });
        assert!(declared, "{} is declared nowhere", file.display());
    }
}
