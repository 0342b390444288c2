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

/// All files of the page, but for the plotting library.
pub(super) const ASSETS: &[Asset] = &[
    Asset { path: "/", content_type: HTML, text: include_str!("page/index.html") },
    Asset { path: "/style.css", content_type: CSS, text: include_str!("page/style.css") },
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
    fn every_module_that_the_page_imports_is_served() {
        let served: Vec<&str> = ASSETS.iter().map(|a| a.path).chain(["/plotly.js"]).collect();
        let mut seen = 0;
        for asset in ASSETS {
            for part in asset.text.split(['"', '\'']).filter(|p| p.ends_with(".js") || p.ends_with(".css")) {
                let path = format!("/{}", part.trim_start_matches("./").trim_start_matches('/'));
                assert!(served.contains(&path.as_str()), "{}: {part}", asset.path);
                seen += 1;
            }
        }
        assert!(seen > 1, "the page imports nothing");
    }
}
