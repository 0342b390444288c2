//! Pictures for reports: charts and matrices in panels, written as SVG and PNG.
//!
//! Declarative: fill in a [`Figure`] and write it. The same figure gives the same bytes; the font is embedded, so
//! nothing depends on what the machine has installed.

mod axis;
mod chart;
mod draw;
mod geometry;
mod legend;
mod render;

use std::path::{Path, PathBuf};

/// A figure could not be drawn or written.
#[derive(Debug, thiserror::Error)]
pub enum PlotError {
    /// A directory or file could not be written.
    #[error("cannot write {}: {source}", path.display())]
    Write {
        /// What was to be written.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The picture cannot be drawn, such as when it is too large.
    #[error("cannot draw: {0}")]
    Draw(String),
}

/// A picture of panels in rows of `columns`.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Figure {
    /// Heading above all panels; may be empty.
    pub title: String,
    /// Panels per row; 0 counts as 1.
    pub columns: usize,
    /// Row by row.
    pub panels: Vec<Panel>,
}

/// One cell of a figure.
#[derive(Debug, Clone, PartialEq)]
pub enum Panel {
    /// Curves over an axis.
    Chart(Chart),
    /// A matrix.
    Heat(HeatMap),
}

/// Curves, bands and points over common axes. What is not finite, or not positive on a log axis, is left out.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Chart {
    /// Heading; may be empty.
    pub title: String,
    /// Name and unit of the horizontal axis; may be empty.
    pub x_label: String,
    /// Name and unit of the vertical axis; may be empty.
    pub y_label: String,
    /// Logarithmic horizontal axis.
    pub log_x: bool,
    /// Logarithmic vertical axis.
    pub log_y: bool,
    /// Lowest and highest x shown; from the items if absent or unusable.
    pub x_range: Option<(f64, f64)>,
    /// Lowest and highest y shown; from the items if absent or unusable.
    pub y_range: Option<(f64, f64)>,
    /// What stands at 0, 1, 2 and so on of the vertical axis, instead of numbers; from the bottom up.
    pub y_names: Vec<String>,
    /// Drawn by kind: regions, bands, lines, error bars, points; within a kind in this order.
    pub items: Vec<Item>,
}

/// Something drawn in a chart, in units of its axes. Items of one label share an entry of the legend.
#[derive(Debug, Clone, PartialEq)]
pub enum Item {
    /// A polyline, broken at points that are not finite.
    Line {
        /// Name in the legend.
        label: Option<String>,
        /// `(x, y)`.
        points: Vec<(f64, f64)>,
        /// Of the stroke.
        colour: Colour,
        /// Dashes instead of a solid stroke.
        dashed: bool,
    },
    /// A translucent area between two curves, broken at edges that are not finite.
    Band {
        /// Name in the legend.
        label: Option<String>,
        /// `(x, low, high)`.
        edges: Vec<(f64, f64, f64)>,
        /// Of the area.
        colour: Colour,
    },
    /// Dots.
    Points {
        /// Name in the legend.
        label: Option<String>,
        /// `(x, y)`.
        points: Vec<(f64, f64)>,
        /// Of the dots.
        colour: Colour,
    },
    /// Dots with a bar from `mean - half_width` to `mean + half_width`.
    ErrorBars {
        /// Name in the legend.
        label: Option<String>,
        /// `(x, mean, half_width)`.
        points: Vec<(f64, f64, f64)>,
        /// Of dots and bars.
        colour: Colour,
    },
    /// A shaded vertical stripe; an infinite end reaches to the border.
    Region {
        /// Left end, x.
        from: f64,
        /// Right end, x.
        to: f64,
        /// Written into the stripe.
        label: Option<String>,
    },
}

/// Colours that the colour-blind can tell apart (Okabe and Ito), and a grey.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs, reason = "the names say it")]
pub enum Colour {
    Black,
    Orange,
    SkyBlue,
    Green,
    Yellow,
    Blue,
    Vermilion,
    Purple,
    Grey,
}

/// A matrix with its numbers written into the cells, colours diverging around 0 for a range \[-1, 1\].
#[derive(Debug, Clone, Default, PartialEq)]
pub struct HeatMap {
    /// Heading; may be empty.
    pub title: String,
    /// Names of the rows, top to bottom.
    pub rows: Vec<String>,
    /// Names of the columns, left to right.
    pub columns: Vec<String>,
    /// Row-major; a value that is missing or not finite leaves its cell grey.
    pub values: Vec<f64>,
}

impl Figure {
    /// A figure without panels, `columns` per row.
    #[must_use]
    pub fn new(title: impl Into<String>, columns: usize) -> Self {
        Self { title: title.into(), columns, panels: Vec::new() }
    }

    /// Adds a panel.
    #[must_use]
    pub fn panel(mut self, panel: impl Into<Panel>) -> Self {
        self.panels.push(panel.into());
        self
    }

    /// Writes `STEM.svg` and `STEM.png` (two pixels per unit of the SVG) into `directory`, created if missing.
    ///
    /// # Errors
    /// The directory or a file cannot be written, or the picture is too large.
    pub fn write(&self, directory: &Path, stem: &str) -> Result<(), PlotError> {
        let svg = draw::figure(self)?;
        let png = render::png(&svg)?;
        let failed = |path, source| PlotError::Write { path, source };
        std::fs::create_dir_all(directory).map_err(|source| failed(directory.to_path_buf(), source))?;
        for (kind, bytes) in [("svg", svg.as_bytes()), ("png", &png)] {
            let path = directory.join(format!("{stem}.{kind}"));
            std::fs::write(&path, bytes).map_err(|source| failed(path, source))?;
        }
        Ok(())
    }
}

impl From<Chart> for Panel {
    fn from(chart: Chart) -> Self {
        Self::Chart(chart)
    }
}

impl From<HeatMap> for Panel {
    fn from(map: HeatMap) -> Self {
        Self::Heat(map)
    }
}

impl Chart {
    /// An empty chart with linear axes.
    #[must_use]
    pub fn new(title: impl Into<String>, x_label: impl Into<String>, y_label: impl Into<String>) -> Self {
        Self { title: title.into(), x_label: x_label.into(), y_label: y_label.into(), ..Self::default() }
    }

    /// Makes the axes logarithmic, each for itself.
    #[must_use]
    pub fn log(mut self, x: bool, y: bool) -> Self {
        (self.log_x, self.log_y) = (x, y);
        self
    }

    /// Fixes the lowest and highest x shown.
    #[must_use]
    pub fn x_range(mut self, low: f64, high: f64) -> Self {
        self.x_range = Some((low, high));
        self
    }

    /// Fixes the lowest and highest y shown.
    #[must_use]
    pub fn y_range(mut self, low: f64, high: f64) -> Self {
        self.y_range = Some((low, high));
        self
    }

    /// Names the places 0, 1, 2 and so on of the vertical axis, from the bottom up, and shows just those.
    #[must_use]
    pub fn y_names(mut self, names: Vec<String>) -> Self {
        self.y_range = Some((-0.7, names.len() as f64 - 0.3));
        self.y_names = names;
        self
    }

    /// Adds an item.
    #[must_use]
    pub fn item(mut self, item: Item) -> Self {
        self.items.push(item);
        self
    }

    /// Adds a solid line; an empty label keeps it out of the legend, here and below.
    #[must_use]
    pub fn line(self, label: &str, points: Vec<(f64, f64)>, colour: Colour) -> Self {
        self.item(Item::Line { label: named(label), points, colour, dashed: false })
    }

    /// Adds a dashed line.
    #[must_use]
    pub fn dashed(self, label: &str, points: Vec<(f64, f64)>, colour: Colour) -> Self {
        self.item(Item::Line { label: named(label), points, colour, dashed: true })
    }

    /// Adds a band, `(x, low, high)`.
    #[must_use]
    pub fn band(self, label: &str, edges: Vec<(f64, f64, f64)>, colour: Colour) -> Self {
        self.item(Item::Band { label: named(label), edges, colour })
    }

    /// Adds dots.
    #[must_use]
    pub fn points(self, label: &str, points: Vec<(f64, f64)>, colour: Colour) -> Self {
        self.item(Item::Points { label: named(label), points, colour })
    }

    /// Adds dots with error bars, `(x, mean, half_width)`.
    #[must_use]
    pub fn error_bars(self, label: &str, points: Vec<(f64, f64, f64)>, colour: Colour) -> Self {
        self.item(Item::ErrorBars { label: named(label), points, colour })
    }

    /// Adds a shaded stripe.
    #[must_use]
    pub fn region(self, label: &str, from: f64, to: f64) -> Self {
        self.item(Item::Region { from, to, label: named(label) })
    }
}

fn named(label: &str) -> Option<String> {
    (!label.is_empty()).then(|| label.to_owned())
}

#[cfg(test)]
mod tests;
