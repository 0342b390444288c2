use super::axis::Axis;
use super::geometry::thin;
use super::*;

/// The SVG of a figure, after both files were written.
fn svg(figure: &Figure) -> String {
    let directory = tempfile::tempdir().unwrap();
    figure.write(&directory.path().join("new"), "figure").unwrap();
    let png = std::fs::read(directory.path().join("new/figure.png")).unwrap();
    assert_eq!(&png[..4], b"\x89PNG");
    std::fs::read_to_string(directory.path().join("new/figure.svg")).unwrap()
}

fn labels(axis: &Axis, most: usize) -> Vec<String> {
    axis.ticks(most).into_iter().map(|tick| tick.label).filter(|label| !label.is_empty()).collect()
}

fn fit(low: f64, high: f64, log: bool) -> Axis {
    Axis::fit(&[], Some((low, high)), log, 0.0)
}

#[test]
fn nothing_to_draw_is_no_error() {
    svg(&Figure::default());
    svg(&Figure::new("title", 0).panel(Chart::default()).panel(HeatMap::default()));
    let empty =
        Chart::new("t", "x", "y").log(true, true).line("a", vec![], Colour::Black).band("b", vec![], Colour::Grey);
    let lost = Chart::new("t", "x", "y").points("a", vec![(f64::NAN, 1.0), (0.0, f64::INFINITY)], Colour::Black);
    let ranges = Chart::default().x_range(1.0, 1.0).y_range(f64::NAN, 0.0).region("r", f64::NEG_INFINITY, f64::NAN);
    svg(&Figure::new("", 2).panel(empty).panel(lost).panel(ranges));
}

#[test]
fn constant_and_extreme_data_are_drawn() {
    for value in [0.0, 5.0, -3e-5, 1e-310, 1e299, f64::MAX] {
        let points = vec![(value, value), (value, value)];
        for log in [false, true] {
            let chart = Chart::default().log(log, log).line("l", points.clone(), Colour::Blue).dashed(
                "d",
                points.clone(),
                Colour::Vermilion,
            );
            svg(&Figure::new("", 1).panel(chart.error_bars("e", vec![(value, value, value)], Colour::Orange)));
        }
    }
    assert_eq!(labels(&Axis::fit(&[5.0, 5.0], None, false, 0.1), 5), ["4.6", "4.8", "5.0", "5.2", "5.4"]);
}

#[test]
fn a_log_axis_breaks_lines_at_zeros() {
    let points = vec![(1.0, 1.0), (2.0, 10.0), (3.0, 0.0), (4.0, -1.0), (5.0, 10.0), (6.0, 1.0)];
    let drawn =
        |log| svg(&Figure::new("", 1).panel(Chart::default().log(false, log).line("", points.clone(), Colour::Blue)));
    assert_eq!(drawn(true).matches("<polyline").count(), 2);
    assert_eq!(drawn(false).matches("<polyline").count(), 1);
}

#[test]
fn tick_labels_are_short() {
    assert_eq!(labels(&fit(0.0, 0.5, false), 5), ["0.0", "0.1", "0.2", "0.3", "0.4", "0.5"]);
    assert_eq!(labels(&fit(-1.0, 1.0, false), 4), ["−1.0", "−0.5", "0.0", "0.5", "1.0"]);
    assert_eq!(labels(&fit(0.0, 3e-5, false), 3), ["0", "1×10⁻⁵", "2×10⁻⁵", "3×10⁻⁵"]);
    assert_eq!(labels(&fit(0.0, 20_000.0, false), 2), ["0", "10000", "20000"]);
    assert_eq!(labels(&fit(0.1, 100.0, true), 6), ["0.1", "1", "10", "100"]);
    assert_eq!(labels(&fit(1e-9, 1.0, true), 4), ["10⁻⁹", "10⁻⁶", "10⁻³", "10⁰"]);
    assert_eq!(labels(&fit(0.2, 2.0, true), 6), ["0.2", "0.5", "1", "2"]);
}

#[test]
fn long_lines_keep_their_peaks() {
    let points: Vec<_> =
        (0..100_000).map(|i| (f64::from(i) * 0.0035, if i == 777 { 9.0 } else { f64::from(i % 3) })).collect();
    let area = |right| kurbo::Rect::new(0.0, 0.0, right, 10.0);
    let thinned = thin(&points, &area(350.0));
    assert!(thinned.len() < 2000);
    assert!(thinned.iter().any(|point| point.1 > 8.0));
    assert!(thin(&points, &area(35.0)).len() < 200);
}

#[test]
fn what_leaves_the_axes_is_cut() {
    let (steep, blue) = (vec![(0.0, -700.0), (1.0, 800.0), (2.0, -900.0)], Colour::Blue);
    let chart = Chart::default().x_range(0.5, 1.5).y_range(0.0, 1.0).points("", steep.clone(), blue);
    let chart = chart.line("", steep.clone(), blue).dashed("", steep, blue);
    let chart = chart.band("", vec![(0.0, 0.0, 70.0), (9.0, 1.0, 80.0)], blue);
    let chart = chart.error_bars("", vec![(1.0, 0.5, 90.0), (1.2, 90.0, 1.0)], blue);
    let png = render::png(&draw::figure(&Figure::new("", 1).panel(chart)).unwrap()).unwrap();
    let picture = resvg::tiny_skia::Pixmap::decode_png(&png).unwrap();
    let colourful = |x, y| picture.pixel(x, y).is_some_and(|p| p.blue().abs_diff(p.red()) > 20);
    let (width, height) = (picture.width(), picture.height());
    assert!((0..width).any(|x| colourful(x, height / 2)));
    assert!(!(0..width).any(|x| colourful(x, 40) || colourful(x, height - 40)));
    assert!(!(0..height).any(|y| colourful(40, y) || colourful(width - 10, y)));
}

#[test]
fn the_same_figure_gives_the_same_picture() {
    let points: Vec<_> = (0..50).map(|i| (f64::from(i), f64::from(i).sin())).collect();
    let chart =
        Chart::new("a < b", "x", "y").line("sine", points.clone(), Colour::Green).points("sine", points, Colour::Green);
    let figure = Figure::new("twice", 1).panel(chart);
    assert_eq!(svg(&figure), svg(&figure));
    assert_eq!(svg(&figure).matches("sine").count(), 1);
}

#[test]
fn a_failed_write_names_the_file() {
    let directory = tempfile::tempdir().unwrap();
    let png = directory.path().join("figure.png");
    std::fs::create_dir(&png).unwrap();
    let error = Figure::default().write(directory.path(), "figure").unwrap_err();
    assert!(matches!(error, PlotError::Write { path, .. } if path == png));
}
