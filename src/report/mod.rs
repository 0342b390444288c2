//! What a study says: numbers for `summary.json`, tables, series for CSV, pictures, and prose; and the page of them.
//!
//! Invariants: the same report gives the same bytes.
//! Deliberately absent: what is studied. Whoever studies something fills in a [`Report`].

pub mod plot;

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use serde_json::{Map, Value};

use crate::edge::files::csv::TableWriter;
use crate::edge::files::error::FileError;
use plot::{Figure, PlotError};

/// A table of text.
#[derive(Debug, Clone, Default)]
pub(crate) struct Table {
    header: Vec<String>,
    rows: Vec<Vec<String>>,
}

impl Table {
    pub(crate) fn new<T: Into<String>>(header: impl IntoIterator<Item = T>) -> Self {
        Self { header: header.into_iter().map(Into::into).collect(), rows: Vec::new() }
    }

    pub(crate) fn row<T: Into<String>>(&mut self, cells: impl IntoIterator<Item = T>) {
        self.rows.push(cells.into_iter().map(Into::into).collect());
    }

    fn markdown(&self) -> String {
        let line = |cells: &[String]| format!("| {} |\n", cells.join(" | "));
        let rule = vec!["---".to_owned(); self.header.len()];
        [self.header.clone(), rule].iter().chain(&self.rows).map(|cells| line(cells)).collect()
    }
}

enum Block {
    Text(String),
    Table(Table),
    Picture { stem: String, caption: String },
}

/// Columns of numbers under names.
struct Series {
    stem: String,
    header: Vec<String>,
    rows: Vec<Vec<f64>>,
}

/// Everything that one study says.
pub struct Report {
    name: &'static str,
    title: String,
    figures: Map<String, Value>,
    blocks: Vec<Block>,
    pictures: Vec<(String, Figure)>,
    series: Vec<Series>,
}

impl Report {
    pub(crate) fn new(name: &'static str, title: &str) -> Self {
        let title = title.to_owned();
        Self { name, title, figures: Map::new(), blocks: Vec::new(), pictures: Vec::new(), series: Vec::new() }
    }

    /// A number of the summary, by its dotted path within the study. Not finite becomes null.
    pub(crate) fn figure(&mut self, path: &str, value: f64) {
        let mut table = &mut self.figures;
        let mut keys = path.split('.').peekable();
        while let Some(key) = keys.next() {
            if keys.peek().is_none() {
                table.insert(key.to_owned(), Value::from(value));
                return;
            }
            let entry = table.entry(key).or_insert_with(|| Value::Object(Map::new()));
            match entry {
                Value::Object(inner) => table = inner,
                _ => return,
            }
        }
    }

    /// A number by its path, to look it up again.
    #[must_use]
    pub fn number(&self, path: &str) -> Option<f64> {
        let mut keys = path.split('.');
        let first = self.figures.get(keys.next()?)?;
        keys.try_fold(first, |value, key| value.get(key))?.as_f64()
    }

    pub(crate) fn text(&mut self, text: impl Into<String>) {
        self.blocks.push(Block::Text(text.into()));
    }

    pub(crate) fn table(&mut self, table: Table) {
        self.blocks.push(Block::Table(table));
    }

    /// A picture; the caption says what is to be seen.
    pub(crate) fn picture(&mut self, stem: &str, figure: Figure, caption: impl Into<String>) {
        self.blocks.push(Block::Picture { stem: stem.to_owned(), caption: caption.into() });
        self.pictures.push((stem.to_owned(), figure));
    }

    /// The numbers behind a picture.
    pub(crate) fn series<T: Into<String>>(
        &mut self,
        stem: &str,
        header: impl IntoIterator<Item = T>,
        rows: Vec<Vec<f64>>,
    ) {
        let header = header.into_iter().map(Into::into).collect();
        self.series.push(Series { stem: stem.to_owned(), header, rows });
    }

    fn markdown(&self) -> String {
        let mut page = format!("## {}\n\n", self.title);
        for block in &self.blocks {
            // Writing to a string cannot fail.
            let _ = match block {
                Block::Text(text) => writeln!(page, "{text}\n"),
                Block::Table(table) => writeln!(page, "{}", table.markdown()),
                Block::Picture { stem, caption } => {
                    let size = self
                        .pictures
                        .iter()
                        .find(|(s, _)| s == stem)
                        .map_or(840, |(_, f)| 420 * f.columns.clamp(1, f.panels.len().max(1)));
                    let alt = caption.replace(['"', '<', '>'], "");
                    writeln!(page, "<img src=\"{stem}.png\" width=\"{size}\" alt=\"{alt}\">\n\n*{caption}*\n")
                }
            };
        }
        page
    }

    fn write_files(&self, directory: &Path) -> Result<(), ReportError> {
        for (stem, figure) in &self.pictures {
            figure.write(directory, stem)?;
        }
        for Series { stem, header, rows } in &self.series {
            let mut table = TableWriter::create(&directory.join(format!("{stem}.csv")), header)?;
            rows.iter().try_for_each(|row| table.row(row))?;
            table.finish()?;
        }
        Ok(())
    }
}

/// The report could not be written.
#[derive(Debug, thiserror::Error)]
pub enum ReportError {
    /// A file.
    #[error("{}: {reason}", path.display())]
    File {
        /// Which.
        path: PathBuf,
        /// Why.
        reason: String,
    },
    /// A table.
    #[error(transparent)]
    Table(#[from] FileError),
    /// A picture.
    #[error(transparent)]
    Plot(#[from] PlotError),
}

/// Writes `summary.json`, `report.md`, `report.html`, pictures (PNG, SVG) and series (CSV); returns the page.
///
/// # Errors
/// When a file cannot be written.
pub fn write(directory: &Path, heading: &str, reports: &[Report]) -> Result<PathBuf, ReportError> {
    let file = |path: &Path, text: &str| {
        std::fs::write(path, text).map_err(|e| ReportError::File { path: path.to_owned(), reason: e.to_string() })
    };
    for report in reports {
        report.write_files(directory)?;
    }
    let figures = reports.iter().map(|r| (r.name.replace('-', "_"), Value::Object(r.figures.clone())));
    let summary = serde_json::to_string_pretty(&Value::Object(figures.collect())).unwrap_or_default();
    file(&directory.join("summary.json"), &(summary + "\n"))?;

    let mut page = heading.to_owned();
    reports.iter().for_each(|report| page.push_str(&report.markdown()));
    file(&directory.join("report.md"), &page)?;
    let path = directory.join("report.html");
    file(&path, &html(&page))?;
    Ok(path)
}

fn html(markdown: &str) -> String {
    let options = pulldown_cmark::Options::ENABLE_TABLES;
    let mut body = String::new();
    pulldown_cmark::html::push_html(&mut body, pulldown_cmark::Parser::new_ext(markdown, options));
    let title = markdown.lines().find_map(|line| line.strip_prefix("# ")).unwrap_or("report");
    format!(
        "<!doctype html><html lang=\"en\"><head><meta charset=\"utf-8\"><title>hemostream: {title}</title>{HEAD}{body}</body></html>\n"
    )
}

const HEAD: &str = "<style>body{font:16px/1.5 system-ui,sans-serif;max-width:80rem;margin:2rem auto;padding:0 1rem;color:#1a1a1a;\
background:#fff}table{border-collapse:collapse;margin:1rem 0;font-variant-numeric:tabular-nums}th,td{border:1px solid \
#d0d0d0;padding:.25rem .6rem;text-align:left}th{background:#f3f3f3}img{max-width:100%;height:auto}code{background:#f3f3f3;\
padding:0 .2em}h2{margin-top:3rem;border-bottom:1px solid #d0d0d0}</style></head><body>";

/// A number with a sensible count of digits.
pub(crate) fn short(value: f64) -> String {
    if !value.is_finite() {
        return "-".to_owned();
    }
    let size = value.abs();
    if size >= 1e5 || (size < 1e-3 && size > 0.0) {
        format!("{value:.2e}")
    } else if size >= 100.0 {
        format!("{value:.1}")
    } else if size >= 1.0 {
        format!("{value:.3}")
    } else {
        format!("{value:.4}")
    }
}

/// `mean +- sd`.
pub(crate) fn plus_minus(mean: f64, sd: f64) -> String {
    format!("{mean:.4} ± {sd:.4}")
}

/// Mean of what there is; NaN of nothing.
#[allow(clippy::cast_precision_loss)]
pub(crate) fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, n) = values.fold((0.0, 0_usize), |(sum, n), v| (sum + v, n + 1));
    sum / n as f64
}

/// Root mean square; NaN of nothing.
pub(crate) fn rms(values: impl Iterator<Item = f64>) -> f64 {
    mean(values.map(|v| v * v)).sqrt()
}
