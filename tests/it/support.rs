//! What several test modules share.

use std::path::Path;

/// A numeric table with a header.
pub struct Table {
    pub header: Vec<String>,
    pub rows: Vec<Vec<f64>>,
}

/// Reads a CSV of numbers.
pub fn read_table(path: &Path) -> Table {
    let mut reader = csv::Reader::from_path(path).unwrap();
    let header = reader.headers().unwrap().iter().map(str::to_owned).collect();
    let rows = reader
        .records()
        .map(|record| record.unwrap().iter().map(|cell| cell.parse().unwrap_or(f64::NAN)).collect())
        .collect();
    Table { header, rows }
}

/// A trajectory of the independent stiff solver, where it lies beside the project.
pub fn reference(file: &str) -> Option<Table> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/reference").join(file);
    path.exists().then(|| read_table(&path))
}
