"""The dashboard in a browser: what a person at the bedside sees, does, and is told when things break."""

from __future__ import annotations

import csv
import io
import json
import statistics
import struct
import sys
import time
import unittest
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).resolve().parent.parent))

from chromium import Chromium, Page, Visitor, account  # noqa: E402
from hemostream_process import (  # noqa: E402
    Process,
    fetch,
    free_port,
    slowness,
    start_daemon,
    start_dashboard,
    start_demo,
    start_replay,
    until,
)

PRESSURES = ("p_a", "p_pa", "p_v", "p_l", "p_r", "p_pv")
CALM_BED = "icu-1"
CRISIS_BED = "icu-3"
CRISIS_S = 15.0
"""When the demo's embolism begins, after the start of its patients."""
# Half the work of the demo as it is: a debug build, a browser and whatever else runs must share a small machine.
LIGHT = ("--set", "window.length_s=0.004")
RATE_HZ = 50
"""Estimates published per second."""
NS_PER_S = 1_000_000_000

chromium: Chromium


def setUpModule() -> None:
    global chromium
    chromium = Chromium()


def tearDownModule() -> None:
    chromium.close()


def tile(page: Page, bed: str) -> Any:
    return page.get_by_test_id(f"tile-{bed}")


def drawn(page: Page) -> dict[str, Any]:
    """What was painted of the six pressures, once all of them are painted with bands."""

    def look() -> dict[str, Any] | None:
        painted = account(page)["drawn"]
        ready = all(painted.get(name, {}).get("bandPoints", 0) > 0 for name in PRESSURES)
        return painted if ready else None

    return until(look, 10.0, "bands of all six pressures")


DIFFERENCE = """() => {
  const canvas = document.querySelector('#strips canvas');
  const pixels = () => canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data;
  const differs = (one, other, i) => [0, 1, 2].some((k) => Math.abs(one[i + k] - other[i + k]) > 24);
  const before = pixels();
  const painted = window.hemostream.drawn;
  const after = pixels();
  const ground = after.subarray(after.length - 4);
  const inked = { painted: 0, differing: 0 };
  for (let i = 0; i < after.length; i += 4) {
    if ([0, 1, 2].some((k) => Math.abs(after[i + k] - ground[k]) > 24)) inked.painted += 1;
    if (differs(before, after, i)) inked.differing += 1;
  }
  return { ...inked, names: Object.keys(painted) };
}"""
"""Pixels of all strips that have something on them, and those that are not what they are when all is painted anew."""


class BrowserCase(unittest.TestCase):
    """A person in front of a dashboard; whatever the test does, the page must not complain nor talk to others."""

    url: str

    def visitor(self, **options: Any) -> Visitor:
        visitor = Visitor(chromium, **options)
        self.addCleanup(visitor.close)
        self.addCleanup(self.check, visitor)
        return visitor

    def check(self, visitor: Visitor) -> None:
        self.assertEqual(visitor.errors, [])
        self.assertLessEqual(visitor.hosts, {self.url.removeprefix("http://")})

    def open(self, place: str = "", **options: Any) -> Page:
        return self.visitor(**options).open(f"{self.url}/{place}")


class DemoCase(BrowserCase):
    """With a demo of its own."""

    demo: Process

    @classmethod
    def setUpClass(cls) -> None:
        cls.demo, cls.url = start_demo(*LIGHT)
        cls.addClassCleanup(cls.demo.stop)
        cls.up_after_s = cls.demo.age_s


class Watching(DemoCase):
    def test_the_page_is_there_at_once_and_its_own(self) -> None:
        self.assertLess(self.up_after_s, 5.0)
        status, text = fetch(self.url)
        self.assertEqual(status, 200)
        self.assertIn("<title>hemostream</title>", text)

    def test_ward_has_a_tile_per_bed_with_numbers_that_fit(self) -> None:
        page = self.open()
        for width in (1280, 1920, 390):
            page.set_viewport_size({"width": width, "height": 844})
            for bed in ("icu-1", "icu-2", "icu-3"):
                until(lambda bed=bed: tile(page, bed).get_attribute("data-liveness") == "live", 10.0, f"{bed} live")
            self.assertEqual(page.locator(".tile").count(), 3)
            until(lambda: page.locator(".tile .cell-main", has_text="–").count() == 0, 10.0, "figures of a beat")
            cut = page.eval_on_selector_all(
                ".tile .cell-band, .tile .cell-value",
                "nodes => nodes.filter(n => n.scrollWidth > n.clientWidth + 1).map(n => n.textContent)",
            )
            self.assertEqual(cut, [], f"cut off at {width} px")

    def test_waveforms_move(self) -> None:
        page = self.open(f"#bed/{CALM_BED}")
        drawn(page)
        before = account(page)

        def moved() -> bool:
            now = account(page)
            passed_s = (int(now["newest_ns"]) - int(before["newest_ns"])) / NS_PER_S
            return passed_s > 2.0 and now["frames"] - before["frames"] > 20

        until(moved, 10.0, "two seconds and twenty pictures more")
        self.assertGreater(account(page)["drawn"]["p_a"]["right"], before["drawn"]["p_a"]["right"] + 1.0)

    def test_what_is_painted_bit_by_bit_is_what_is_painted_at_once(self) -> None:
        page = self.open(f"#bed/{CALM_BED}")
        for span_s, key in ((10, "3"), (2, "1"), (60, "5")):
            page.keyboard.press(key)
            drawn(page)
            # More than a sweep over the screen, where that is not long.
            time.sleep(min(1.2 * span_s, 12.0))
            found = page.evaluate(DIFFERENCE)
            self.assertEqual(set(found["names"]), set(PRESSURES))
            self.assertLess(found["differing"], 0.02 * found["painted"], f"{span_s} s: {found}")

    def test_bands_are_drawn_and_hold_the_truth(self) -> None:
        # The estimator starts 50 % wrong about two parameters; ten seconds later none of that is in the picture.
        until(lambda: self.demo.age_s > 14.0, 20.0, "the settled part")
        inside: dict[str, float] = {}
        overloaded = False
        for bed in ("icu-1", "icu-2"):
            page = self.open(f"#bed/{bed}")
            until(lambda page=page: drawn(page)["p_a"]["points"] >= 9 * RATE_HZ, 15.0, "ten seconds of estimates")
            painted = drawn(page)
            for name in PRESSURES:
                about = painted[name]
                self.assertGreater(about["q95"], about["q05"], name)
                self.assertGreater(about["bandPoints"], 0.9 * about["points"], name)
                inside[f"{bed} {name}"] = about["truthInside"]
            for name in ("p_a", "p_pa"):
                self.assertGreater(painted[name]["samples"], 0, name)
            for name in ("p_v", "p_l", "p_r", "p_pv"):
                self.assertEqual(painted[name]["samples"], 0, name)
            overloaded |= page.get_by_test_id("event-log").locator("li", has_text="overload").count() > 0
            page.close()
        # 90 % in the long run. Errors last for several beats and go together in all pressures, so that ten seconds of
        # two beds are but a handful of independent looks: 0.75 is what these may come to by chance, far above what
        # bands of half the width would hold (59 %). Where the machine could not keep up the ensemble was smaller and
        # samples were lost, and no such figure holds; yet bands are still about where the truth is.
        least = 0.4 if overloaded else 0.75
        self.assertGreaterEqual(statistics.mean(inside.values()), least, inside)

    def test_a_bed_opens_by_click_and_by_keyboard(self) -> None:
        page = self.open()
        tile(page, CALM_BED).click()
        until(lambda: account(page)["bed"] == CALM_BED, 5.0, "the bed that was clicked")
        self.assertTrue(page.get_by_test_id("bed").is_visible())
        self.assertFalse(page.get_by_test_id("ward").is_visible())
        page.keyboard.press("Escape")
        until(lambda: account(page)["view"] == "ward", 5.0, "the ward after Escape")
        # The focus is where it was left; an arrow goes on from there.
        until(lambda: tile(page, CALM_BED).evaluate("node => node === document.activeElement"), 5.0, "focus")
        page.keyboard.press("ArrowRight")
        page.keyboard.press("Enter")
        until(lambda: account(page)["bed"] == "icu-2", 5.0, "the next bed by keyboard")
        drawn(page)
        page.keyboard.press("Escape")
        until(lambda: page.get_by_test_id("ward").is_visible(), 5.0, "the ward again")

    def test_a_tab_opened_again_shows_the_past_at_once(self) -> None:
        until(lambda: self.demo.age_s > 10.0, 15.0, "a past")
        visitor = self.visitor()
        place = f"{self.url}/#bed/{CALM_BED}"
        first = visitor.open(place)
        drawn(first)
        first.close()
        page = visitor.open(place)
        seen = page.wait_for_function(
            "points => { const p_a = window.hemostream?.drawn.p_a;"
            " if (!(p_a?.bandPoints >= points)) return null;"
            " const [load] = performance.getEntriesByType('navigation');"
            " const now = performance.now();"
            " return { points: p_a.bandPoints, age_s: now / 1000, up_s: (now - load.domInteractive) / 1000 }; }",
            arg=5 * RATE_HZ,
        ).json_value()
        # From when the page is parsed: how fast a browser starts a tab is the machine's affair.
        self.assertLess(seen["up_s"], 2.0 * slowness(), seen)
        self.assertGreater(seen["points"] / RATE_HZ - seen["age_s"], 1.0, "no more than the page itself has seen")

    def test_a_note_is_logged_and_its_markup_stays_text(self) -> None:
        page = self.open(f"#bed/{CALM_BED}")
        note = "<img src=x onerror=\"document.title='!'\"> <b>adrenaline</b> 1 mg & more"
        page.locator("#note-author").fill("<i>RN</i>")
        page.get_by_test_id("note-text").fill(note)
        page.get_by_test_id("note-send").click()
        log = page.get_by_test_id("event-log")
        until(lambda: log.locator("li[data-kind=note]", has_text=note).count(), 10.0, "the note in the log")
        self.assertEqual(log.locator("img, b, i").count(), 0)
        self.assertNotEqual(page.title(), "!")
        page.close()
        # Whoever opens the bed later reads it too.
        other = self.open(f"#bed/{CALM_BED}")
        until(lambda: other.get_by_test_id("event-log").get_by_text(note).count(), 10.0, "the note on another page")

    def test_a_pause_is_said_and_the_menu_closes_by_itself(self) -> None:
        page = self.open(f"#bed/{CALM_BED}")
        drawn(page)
        menu = page.locator("#strip-menu")
        for leave in (lambda: page.keyboard.press("Escape"), lambda: page.locator("#bed-name").click()):
            menu.locator("summary").click()
            self.assertTrue(menu.evaluate("node => node.open"))
            leave()
            self.assertFalse(menu.evaluate("node => node.open"))
        self.assertEqual(account(page)["view"], "bed")
        page.keyboard.press(" ")
        said = page.locator("#bed-paused")
        until(said.is_visible, 5.0, "a word about the pause")
        self.assertIn("PAUSED", said.text_content() or "")
        page.keyboard.press("l")
        until(lambda: not said.is_visible(), 5.0, "live again")

    def test_a_note_that_is_not_taken_stays_and_says_why(self) -> None:
        page = self.open("#bed/nobody")
        until(lambda: page.locator("#bed-unknown").is_visible(), 10.0, "a bed that nobody knows")
        page.get_by_test_id("note-text").fill("adrenaline")
        page.get_by_test_id("note-send").click()
        until(lambda: "nobody" in (page.locator("#note-answer").text_content() or ""), 10.0, "a refusal")
        self.assertIn("failed: bed: found \"nobody\"", page.locator("#note-answer").text_content() or "")
        self.assertEqual(page.get_by_test_id("note-text").input_value(), "adrenaline")
        self.assertTrue(page.get_by_test_id("note-send").is_enabled())

    def test_what_is_shown_downloads_as_csv(self) -> None:
        page = self.open(f"#bed/{CALM_BED}")
        until(lambda: drawn(page)["p_a"]["points"] >= 5 * RATE_HZ, 15.0, "five seconds of estimates")
        rows = download(page)
        times = [int(row["time_ns"]) for row in rows]
        self.assertEqual(times, sorted(set(times)))
        self.assertGreaterEqual((times[-1] - times[0]) / NS_PER_S, 4.9)
        for name in PRESSURES:
            bands = [
                [float(row[f"{name}_{part}"]) for part in ("q05", "mean", "q95")] for row in rows if row[f"{name}_mean"]
            ]
            self.assertGreaterEqual(len(bands), 4 * RATE_HZ, name)
            self.assertTrue(all(low <= mean <= high for low, mean, high in bands), name)
        self.assertTrue(any(row["p_a_sample"] for row in rows) and any(row["p_v_truth"] for row in rows))
        self.assertNotIn("p_v_sample", rows[0])

    def test_what_is_shown_downloads_as_a_picture(self) -> None:
        page = self.open(f"#bed/{CALM_BED}")
        drawn(page)
        plots = page.eval_on_selector_all(".strip-plot", "nodes => nodes.map(n => n.getBoundingClientRect().height)")
        self.assertEqual(len(plots), len(PRESSURES))
        with page.expect_download() as waiting:
            page.locator("#export-png").click()
        picture = Path(waiting.value.path()).read_bytes()
        self.assertTrue(picture.startswith(b"\x89PNG"))
        width, height = struct.unpack(">II", picture[16:24])
        self.assertGreater(width, 400)
        # All of them, and a line above.
        self.assertGreater(height, sum(plots))
        self.assertLess(height, sum(plots) + 100)
        self.assertGreater(len(picture), 20_000, "more than a blank sheet")

    def test_the_ward_downloads_as_csv(self) -> None:
        page = self.open()
        until(lambda: page.locator(".tile").count() == 3, 15.0, "three beds")
        until(lambda: page.locator(".tile .cell-main", has_text="–").count() == 0, 15.0, "figures of a beat")
        rows = download(page)
        self.assertEqual({row["bed"] for row in rows}, {"icu-1", "icu-2", "icu-3"})
        output = next(r for r in rows if (r["bed"], r["quantity"]) == (CALM_BED, "cardiac_output"))
        self.assertLess(float(output["q05"]), float(output["q95"]))


def download(page: Page) -> list[dict[str, str]]:
    with page.expect_download() as waiting:
        page.get_by_test_id("export-csv").click()
    text = Path(waiting.value.path()).read_text()
    return list(csv.DictReader(io.StringIO(text)))


class Crisis(DemoCase):
    def test_the_embolism_raises_an_alarm_that_somebody_acknowledges(self) -> None:
        page = self.open()
        # Half a minute for the embolism to show, to be believed for 5 s, and for a busy machine.
        left_s = CRISIS_S + 30.0 - self.demo.age_s
        alarmed = tile(page, CRISIS_BED)
        until(lambda: alarmed.get_attribute("data-alarm") == "high", left_s, "an alarm on the tile")
        self.assertGreater(self.demo.age_s, CRISIS_S, "before there was a reason")
        for calm in ("icu-1", "icu-2"):
            self.assertNotEqual(tile(page, calm).get_attribute("data-alarm"), "high")
        self.assertGreaterEqual(int(page.locator("#count-high b").text_content() or 0), 1)

        alarmed.click()
        name = "high pulmonary pressure"
        item = page.get_by_test_id("alarm-list").locator("li", has=page.get_by_text(name, exact=True))
        until(lambda: item.get_attribute("data-state") == "active", 10.0, "the alarm in the list")
        self.assertEqual(item.get_attribute("data-priority"), "high")
        self.assertEqual(item.get_attribute("data-acknowledged"), "false")
        page.keyboard.press("a")
        focused = page.evaluate("document.activeElement.getAttribute('aria-label')")
        self.assertRegex(focused or "", "^Acknowledge ")
        item.get_by_role("button").press("Enter")
        until(lambda: item.get_attribute("data-acknowledged") == "true", 10.0, "the acknowledged alarm")
        self.assertEqual(item.get_attribute("data-state"), "active")
        self.assertEqual(item.get_by_role("button").count(), 0)
        log = page.get_by_test_id("event-log")
        until(lambda: log.locator("li", has_text="alarm seen").count(), 10.0, "the acknowledgement in the log")


class Outage(BrowserCase):
    """Daemon, patient and dashboard as processes of their own."""

    BED = "bed1"

    @classmethod
    def setUpClass(cls) -> None:
        cls.port = free_port()
        cls.dashboard, cls.url = start_dashboard(cls.port)
        cls.addClassCleanup(cls.dashboard.stop)

    def setUp(self) -> None:
        self.daemon = start_daemon(self.port)
        self.addCleanup(lambda: self.daemon.stop())
        replay = start_replay(self.port, "--bed", self.BED)
        self.addCleanup(replay.stop)
        until(lambda: fetch(f"{self.url}/readyz")[0] == 200, 20.0, "a dashboard that is ready")

    def test_a_killed_daemon_is_seen_and_comes_back_by_itself(self) -> None:
        page = self.open()
        lives = tile(page, self.BED)
        until(lambda: lives.count() and lives.get_attribute("data-liveness") == "live", 20.0, "a live bed")
        bed_page = self.open(f"#bed/{self.BED}")
        drawn(bed_page)

        self.daemon.kill()
        until(lambda: lives.get_attribute("data-liveness") == "stale", 5.0, "a stale tile")
        self.assertRegex(lives.locator(".liveness").text_content() or "", r"STALE \d+\.\d s")
        self.assertRegex(lives.locator(".tile-stale").text_content() or "", r"NO NEW DATA for \d+\.\d s")
        # A number that is no longer true must not look like one.
        self.assertEqual(set(lives.locator(".cell-main").all_text_contents()), {"–"})
        bed_view = bed_page.get_by_test_id("bed")
        until(lambda: bed_view.get_attribute("data-liveness") == "stale", 5.0, "a stale bed")
        until(lambda: "NO NEW DATA" in (bed_page.locator("#strips-stale").text_content() or ""), 5.0, "its age")
        until(lambda: fetch(f"{self.url}/readyz")[0] == 503, 5.0, "not ready without a daemon")
        until(lambda: page.locator("#bus").is_visible(), 5.0, "the banner of the bus")
        self.assertEqual(fetch(f"{self.url}/healthz"), (200, "ok\n"))

        self.daemon = start_daemon(self.port)
        # Dashboard and patient try again after 1, 2, 4 s.
        until(lambda: lives.get_attribute("data-liveness") == "live", 30.0, "live again")
        until(lambda: bed_view.get_attribute("data-liveness") == "live", 5.0, "the bed too")
        until(lambda: fetch(f"{self.url}/readyz")[0] == 200, 5.0, "ready again")
        until(lambda: not page.locator("#bus").is_visible(), 5.0, "no banner")
        before = int(account(bed_page)["newest_ns"])
        until(lambda: int(account(bed_page)["newest_ns"]) > before, 5.0, "time that goes on")

    def test_the_snapshot_has_everything_of_a_bed(self) -> None:
        def settled() -> dict[str, Any] | None:
            status, text = fetch(f"{self.url}/api/beds")
            self.assertEqual(status, 200)
            beds = [bed for bed in json.loads(text)["beds"] if bed["bed"] == self.BED]
            ready = beds and beds[0]["liveness"] == "live" and beds[0]["beat"] and beds[0]["health"]
            return beds[0] if ready else None

        bed = until(settled, 20.0, "a bed with everything")
        self.assertEqual(len(bed["quantities"]), 18)
        for name, about in (bed["quantities"] | bed["parameters"]).items():
            # A valve that is shut passes nothing, for certain; no pressure and no parameter is known like that.
            if name.startswith("q_"):
                self.assertLessEqual(about["q05"], about["q95"], name)
            else:
                self.assertLess(about["q05"], about["q95"], name)
            self.assertLessEqual(about["q05"], about["mean"], name)
            self.assertGreaterEqual(about["q95"], about["mean"], name)
        self.assertEqual(bed["quantities"]["p_a"]["origin"], "observed")
        self.assertEqual(bed["quantities"]["p_v"]["origin"], "inferred")
        self.assertTrue(bed["parameters"])
        self.assertEqual(bed["beat"]["heart_rate"]["unit"], "bpm")
        self.assertGreater(bed["health"]["members_alive"], 0)
        self.assertEqual({channel["name"] for channel in bed["health"]["channels"]}, {"p_a", "p_pa"})


class WithoutDaemon(unittest.TestCase):
    def test_a_dashboard_without_a_daemon_is_up_but_not_ready(self) -> None:
        dashboard, url = start_dashboard(free_port())
        self.addCleanup(dashboard.stop)
        self.assertEqual(fetch(f"{url}/healthz"), (200, "ok\n"))
        self.assertEqual(fetch(f"{url}/readyz")[0], 503)
        self.assertEqual(json.loads(fetch(f"{url}/api/beds")[1])["beds"], [])


if __name__ == "__main__":
    unittest.main()
