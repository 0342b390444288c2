#!/usr/bin/env python3
"""Pictures of the dashboard: ward and bed of the demo in its crisis, light and dark, at three sizes.

    HEMOSTREAM=target/debug/hemostream python tools/browser/screenshots.py OUT_DIR
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parent.parent))

from chromium import Chromium, Visitor  # noqa: E402
from hemostream_process import start_demo  # noqa: E402

SIZES = {"1280": (1280, 800), "1920": (1920, 1080), "phone": (390, 844)}
THEMES = ("light", "dark")
BED = "icu-3"
# Half the work of the demo as it is, so that a small machine has time for the pictures.
LIGHT = ("--set", "window.length_s=0.004")
CRISIS_S = 32.0
"""After the start: the embolism is 17 s old and its alarms are on; the treatment follows at 75 s."""
SETTLE_S = 2.5
"""Charts follow a new size about two seconds later."""
CHARTS_ARE_DRAWN = """() => [...document.querySelectorAll(".trend-plot, .loop")].every((node) => {
  const { top, bottom, width } = node.getBoundingClientRect();
  return width === 0 || bottom < 0 || top > innerHeight || node.querySelector(".main-svg");
})"""


def take(visitor: Visitor, url: str, theme: str, out: Path, whole: bool) -> None:
    """The pictures of one theme."""
    for view, place in (("ward", "#ward"), ("bed", f"#bed/{BED}")):
        page = visitor.open(f"{url}/{place}")
        for size, (width, height) in SIZES.items():
            page.set_viewport_size({"width": width, "height": height})
            page.wait_for_function(CHARTS_ARE_DRAWN)
            time.sleep(SETTLE_S)
            file = out / f"{view}-{theme}-{size}.png"
            # An alarm that nobody has seen flashes; the picture is of its bright half.
            page.screenshot(path=file, full_page=whole, animations="disabled")
            print(file)
        page.close()
    for error in visitor.errors:
        print(f"error in the page: {error}", file=sys.stderr)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, metavar="OUT_DIR")
    parser.add_argument("--whole", action="store_true", help="the whole page rather than what fits the window")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    demo, url = start_demo(*LIGHT)
    try:
        chromium = Chromium()
        time.sleep(max(CRISIS_S - demo.age_s, 0.0))
        for theme in THEMES:
            visitor = Visitor(chromium, color_scheme=theme)
            take(visitor, url, theme, arguments.out, arguments.whole)
            visitor.close()
        chromium.close()
    finally:
        demo.stop()


if __name__ == "__main__":
    main()
