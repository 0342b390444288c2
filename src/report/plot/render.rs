//! An SVG document under the pen, the widths of its texts, and its pixels.

use kurbo::Rect;
use resvg::tiny_skia::{self, Paint, Pixmap, Transform};
use resvg::usvg::{Options, Tree};
use skrifa::instance::{LocationRef, Size};
use skrifa::{FontRef, MetadataProvider};

use super::geometry::Xy;
use super::{Colour, PlotError};

/// Pixels of the PNG per px of the SVG.
const PNG_SCALE: f32 = 2.0;

/// Verdana has the same widths, should a viewer lack the font.
const FAMILIES: &str = "DejaVu Sans, Verdana, sans-serif";

/// Long texts are made smaller down to this share of their size before they are cut.
const SHRINK: f64 = 0.75;

/// Longer dashed lines \[px\] come out solid; too many dashes would not be drawn at all.
const LONGEST_DASHED: f64 = 1e6;

pub(super) const LINE_WIDTH: f64 = 1.5;
pub(super) const DOT_RADIUS: f64 = 2.4;
pub(super) const BAND_OPACITY: f64 = 0.25;

/// How a text is set.
#[derive(Debug, Clone, Copy)]
pub(super) struct Font {
    /// Of one em \[px\].
    pub(super) size: f64,
    pub(super) bold: bool,
    /// Reads upwards.
    pub(super) upright: bool,
    pub(super) colour: &'static str,
}

/// An SVG document, and the faces to measure its texts.
pub(super) struct Canvas {
    pub(super) svg: String,
    regular: FontRef<'static>,
    bold: FontRef<'static>,
}

/// Where something has been drawn.
pub(super) struct Ink(Pixmap);

impl Canvas {
    /// A white sheet.
    pub(super) fn new(width: f64, height: f64) -> Result<Self, PlotError> {
        let face = |bytes| FontRef::new(bytes).map_err(failed);
        let svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" \
             viewBox=\"0 0 {width} {height}\" font-family=\"{FAMILIES}\" fill=\"none\" stroke-linejoin=\"round\">\n"
        );
        let (regular, bold) = (face(dejavu::sans::regular())?, face(dejavu::sans::bold())?);
        let mut canvas = Self { svg, regular, bold };
        canvas.fill(&Rect::new(0.0, 0.0, width, height), "#fff", 1.0);
        Ok(canvas)
    }

    /// Where something was drawn since the document had a length of `start`.
    pub(super) fn ink(&self, start: usize) -> Result<Ink, PlotError> {
        let head = self.svg.lines().next().unwrap_or_default();
        let svg = format!("{head}{}</svg>", &self.svg[start..]);
        Ok(Ink(pixels(&svg, &Options::default(), 1.0)?))
    }

    pub(super) fn fill(&mut self, area: &Rect, colour: &str, opacity: f64) {
        let (Rect { x0, y0, .. }, width, height) = (area, area.width(), area.height());
        self.svg += &format!(
            "<rect x=\"{x0:.2}\" y=\"{y0:.2}\" width=\"{width:.2}\" height=\"{height:.2}\" \
             fill=\"{colour}\" fill-opacity=\"{opacity}\"/>\n"
        );
    }

    /// Shows what `draw` draws as far as it lies in `area`.
    pub(super) fn clipped(&mut self, area: &Rect, draw: impl FnOnce(&mut Self)) {
        let (Rect { x0, y0, .. }, width, height) = (area, area.width(), area.height());
        // An inner document clips without an id, which could clash where several pictures share a page.
        self.svg += &format!(
            "<svg x=\"{x0}\" y=\"{y0}\" width=\"{width}\" height=\"{height}\" viewBox=\"{x0} {y0} {width} {height}\">\n"
        );
        draw(self);
        self.svg += "</svg>\n";
    }

    pub(super) fn polygon(&mut self, corners: &[Xy], colour: &str, opacity: f64) {
        let corners = list(corners);
        self.svg += &format!("<polygon points=\"{corners}\" fill=\"{colour}\" fill-opacity=\"{opacity}\"/>\n");
    }

    pub(super) fn polyline(&mut self, points: &[Xy], dashed: bool, colour: &str) {
        let length: f64 = points.windows(2).map(|pair| (pair[1].0 - pair[0].0).hypot(pair[1].1 - pair[0].1)).sum();
        let (dashes, points) = (if dashed && length < LONGEST_DASHED { "5 3" } else { "none" }, list(points));
        self.svg += &format!(
            "<polyline points=\"{points}\" stroke=\"{colour}\" stroke-width=\"{LINE_WIDTH}\" \
             stroke-dasharray=\"{dashes}\"/>\n"
        );
    }

    /// A segment 1 px wide.
    pub(super) fn rule(&mut self, (x1, y1): Xy, (x2, y2): Xy, colour: &str) {
        self.svg +=
            &format!("<line x1=\"{x1:.2}\" y1=\"{y1:.2}\" x2=\"{x2:.2}\" y2=\"{y2:.2}\" stroke=\"{colour}\"/>\n");
    }

    pub(super) fn dot(&mut self, (x, y): Xy, radius: f64, colour: &str) {
        self.svg += &format!("<circle cx=\"{x:.2}\" cy=\"{y:.2}\" r=\"{radius}\" fill=\"{colour}\"/>\n");
    }

    /// Writes a line of text whose `anchor` (`start`, `middle` or `end`), at half the height of its capitals, is at
    /// `(x, y)`. It is made smaller and, if need be, cut to fit in `room`.
    pub(super) fn text(&mut self, text: &str, (x, y): Xy, font: Font, anchor: &str, room: f64) {
        let size = font.size * (room / self.width(text, font)).clamp(SHRINK, 1.0);
        let font = Font { size, ..font };
        let cut = (0..text.chars().count()).rev().map(|n| text.chars().take(n).chain(['…']).collect());
        let fits = |text: &String| self.width(text, font) <= room + 0.01;
        let Some(text) = std::iter::once(text.to_owned()).chain(cut).find(fits) else { return };
        let text = text.replace(char::is_control, " ").replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;");
        let (turn, weight) = (if font.upright { -90 } else { 0 }, if font.bold { "bold" } else { "normal" });
        self.svg += &format!(
            "<text transform=\"translate({x:.2} {y:.2}) rotate({turn})\" dy=\"0.365em\" font-size=\"{size:.2}\" \
             font-weight=\"{weight}\" text-anchor=\"{anchor}\" fill=\"{}\">{text}</text>\n",
            font.colour
        );
    }

    /// Width of a text \[px\].
    pub(super) fn width(&self, text: &str, font: Font) -> f64 {
        let face = if font.bold { &self.bold } else { &self.regular };
        let metrics = face.glyph_metrics(Size::new(font.size as f32), LocationRef::default());
        let glyphs = face.charmap();
        let widths = text.chars().filter_map(|c| metrics.advance_width(glyphs.map(c).unwrap_or_default()));
        widths.map(f64::from).sum()
    }
}

impl Ink {
    /// How much there is in `area`: about px², where translucent areas count little.
    pub(super) fn under(&self, area: &Rect) -> f64 {
        let (rows, columns) = (area.y0 as u32..area.y1 as u32, area.x0 as u32..area.x1 as u32);
        let places = rows.flat_map(|y| columns.clone().map(move |x| (x, y)));
        places.filter_map(|(x, y)| self.0.pixel(x, y)).map(|pixel| (f64::from(pixel.alpha()) / 255.0).powi(2)).sum()
    }

    pub(super) fn add(&mut self, area: &Rect) {
        let [left, top, right, bottom] = [area.x0, area.y0, area.x1, area.y1].map(|length| length as f32);
        if let Some(area) = tiny_skia::Rect::from_ltrb(left, top, right, bottom) {
            self.0.fill_rect(area, &Paint::default(), Transform::identity(), None);
        }
    }
}

/// The picture of an SVG document, whatever fonts the machine has.
pub(super) fn png(svg: &str) -> Result<Vec<u8>, PlotError> {
    let mut options = Options::default();
    let fonts = options.fontdb_mut();
    fonts.load_font_data(dejavu::sans::regular().to_vec());
    fonts.load_font_data(dejavu::sans::bold().to_vec());
    fonts.set_sans_serif_family("DejaVu Sans");
    pixels(svg, &options, PNG_SCALE)?.encode_png().map_err(failed)
}

fn pixels(svg: &str, options: &Options, scale: f32) -> Result<Pixmap, PlotError> {
    let tree = Tree::from_str(svg, options).map_err(failed)?;
    let size = tree.size().to_int_size().scale_by(scale);
    let pixels = size.and_then(|size| Pixmap::new(size.width(), size.height()));
    let mut pixels = pixels.ok_or_else(|| failed("the figure is too large"))?;
    resvg::render(&tree, Transform::from_scale(scale, scale), &mut pixels.as_mut());
    Ok(pixels)
}

fn failed(error: impl std::fmt::Display) -> PlotError {
    PlotError::Draw(error.to_string())
}

fn list(points: &[Xy]) -> String {
    points.iter().map(|(x, y)| format!("{x:.2},{y:.2}")).collect::<Vec<_>>().join(" ")
}

impl Colour {
    pub(super) fn hex(self) -> &'static str {
        match self {
            Self::Black => "#000000",
            Self::Orange => "#e69f00",
            Self::SkyBlue => "#56b4e9",
            Self::Green => "#009e73",
            Self::Yellow => "#f0e442",
            Self::Blue => "#0072b2",
            Self::Vermilion => "#d55e00",
            Self::Purple => "#cc79a7",
            Self::Grey => "#7f7f7f",
        }
    }
}
