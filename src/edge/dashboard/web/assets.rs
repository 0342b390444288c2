//! The page, carried by the binary: nothing is built and nothing is fetched.

use std::sync::OnceLock;

/// A file of the page.
pub(super) struct Asset {
    /// Where it is asked for.
    pub(super) path: &'static str,
    pub(super) content_type: &'static str,
    pub(super) text: &'static str,
}

const HTML: &str = "text/html; charset=utf-8";
const CSS: &str = "text/css; charset=utf-8";
pub(super) const JAVASCRIPT: &str = "text/javascript; charset=utf-8";

/// The modules of the page by name.
macro_rules! modules {
    ($($name:literal)*) => {
        [$(Asset {
            path: concat!("/", $name),
            content_type: JAVASCRIPT,
            text: include_str!(concat!("page/", $name)),
        }),*]
    };
}

/// The page's document and its looks.
pub(super) const DOCUMENT: [Asset; 2] = [
    Asset { path: "/", content_type: HTML, text: include_str!("page/index.html") },
    Asset { path: "/style.css", content_type: CSS, text: include_str!("page/style.css") },
];

/// What the document loads, but for the plotting library.
#[rustfmt::skip]
pub(super) const MODULES: &[Asset] = &modules![
    "alarmlist.js" "alarms.js" "app.js" "bed.js" "charts.js" "commands.js" "connection.js" "dom.js" "eventlog.js"
    "export.js" "frame.js" "health.js" "history.js" "liveness.js" "loops.js" "markers.js" "menu.js" "meter.js" "names.js"
    "numbers.js" "numerics.js" "outline.js" "pace.js" "paint.js" "palette.js" "readings.js" "runs.js" "scale.js"
    "series.js" "sheet.js" "sight.js" "sources.js" "strip.js" "strips.js" "theme.js" "tile.js" "time.js" "timeline.js"
    "trendfigure.js" "trends.js" "truth.js" "viewport.js" "ward.js"
];

/// plotly.js, as the crate `plotly` carries it; empty if it no longer carries it so.
pub(super) fn plotly_js() -> &'static str {
    static SOURCE: OnceLock<String> = OnceLock::new();
    SOURCE.get_or_init(|| {
        let scripts = plotly::Plot::offline_js_sources();
        let script = scripts.split("<script").find(|script| script.contains("plotly.js v"));
        let body = script.and_then(|script| script.split_once('>')).map(|(_, body)| body);
        body.map(|body| body.trim_end().trim_end_matches("</script>").to_owned()).unwrap_or_default()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_plotting_library_is_whole() {
        let source = plotly_js();
        assert!(source.len() > 3_000_000, "{} bytes", source.len());
        assert!(!source.contains("</script>") && source.contains("newPlot"));
    }

    #[test]
    fn every_file_of_the_page_is_served_and_asked_for() {
        let served: Vec<&str> = DOCUMENT.iter().chain(MODULES).map(|a| a.path).collect();
        let texts = DOCUMENT.iter().chain(MODULES).flat_map(|a| a.text.split(['"', '\'', '`']));
        let names = texts.filter(|t| !t.contains([' ', '\n']) && (t.ends_with(".js") || t.ends_with(".css")));
        let asked: Vec<String> =
            names.map(|t| format!("/{}", t.trim_start_matches("./").trim_start_matches('/'))).collect();
        for path in &asked {
            assert!(path == "/plotly.js" || served.contains(&path.as_str()), "{path} is not served");
        }
        for path in served.iter().filter(|path| **path != "/") {
            assert!(asked.iter().any(|a| a == path), "{path} is asked for by nobody");
        }
    }
}
