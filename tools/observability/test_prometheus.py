"""The metrics in a real Prometheus: scraped, shown by the Grafana file, and watched by the alerts."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
import unittest
import urllib.parse
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path.append(str(HERE.parent))

from hemostream_process import (  # noqa: E402
    Process,
    fetch,
    free_port,
    program,
    start_daemon,
    start_dashboard,
    start_replay,
    until,
)

BEDS = ("bed1-1", "bed1-2", "bed1-3")
LAG_ALERT = "HemostreamWindowLag"
LIMIT_S = 0.1
"""Of the lag alert."""
# Easy even for a debug build, and an alarm that no patient of the test raises.
LIGHT = (
    "window.length_s=0.004",
    'alarms=[{ name = "low output", quantity = "cardiac_output", below = 1.0, priority = "high" }]',
)
# More than a core can do: a thousand windows per second and bed, of two thousand members each.
OVERLOAD = ("estimator.members=2000", "window.length_s=0.001", "service.workers=1")


def promtool(*arguments: str, text: str | None = None) -> tuple[int, str]:
    """Exit code of `promtool`, and all that it said."""
    result = subprocess.run(
        [program("promtool"), *arguments],
        input=text,
        stdin=None if text is not None else subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=60,
        cwd=HERE,
    )
    return result.returncode, result.stdout


class Files(unittest.TestCase):
    def test_rules_and_configuration_are_valid(self) -> None:
        for arguments in (("check", "rules", "alerts.yml"), ("check", "config", "prometheus.yml")):
            code, said = promtool(*arguments)
            self.assertEqual(code, 0, said)

    def test_each_alert_fires_when_it_should(self) -> None:
        code, said = promtool("test", "rules", "alerts_test.yml")
        self.assertEqual(code, 0, said)
        tested = set(re.findall(r"alertname: (\w+)", (HERE / "alerts_test.yml").read_text()))
        self.assertEqual(tested, set(re.findall(r"- alert: (\w+)", (HERE / "alerts.yml").read_text())))

    def test_the_grafana_file_is_laid_out_well(self) -> None:
        board = json.loads((HERE / "grafana.json").read_text())
        self.assertEqual([v["name"] for v in board["templating"]["list"]], ["datasource", "bed"])
        panels = board["panels"]
        self.assertEqual(len({panel["id"] for panel in panels}), len(panels))
        taken: dict[tuple[int, int], str] = {}
        for panel in panels:
            place = panel["gridPos"]
            self.assertLessEqual(place["x"] + place["w"], 24, panel["title"])
            for x in range(place["x"], place["x"] + place["w"]):
                for y in range(place["y"], place["y"] + place["h"]):
                    self.assertNotIn((x, y), taken, f"{panel['title']} lies on {taken.get((x, y))}")
                    taken[(x, y)] = panel["title"]
            for target in panel.get("targets", []):
                self.assertEqual(target["datasource"]["uid"], "${datasource}", panel["title"])


class Prometheus:
    """A server of our own: with the files of this folder, but for where it scrapes and how long alerts wait."""

    def __init__(self, folder: Path, target: str) -> None:
        rules = re.sub(r"for: \d+s", "for: 3s", (HERE / "alerts.yml").read_text())
        (folder / "alerts.yml").write_text(rules)
        config = (HERE / "prometheus.yml").read_text().replace("127.0.0.1:8787", target)
        (folder / "prometheus.yml").write_text(config)
        port = free_port()
        self.url = f"http://127.0.0.1:{port}"
        self.process = Process(
            program("prometheus"),
            f"--config.file={folder / 'prometheus.yml'}",
            f"--storage.tsdb.path={folder / 'data'}",
            f"--web.listen-address=127.0.0.1:{port}",
        )

    def get(self, path: str, **parameters: str) -> Any:
        """`data` of an answer of its interface."""
        status, text = fetch(f"{self.url}/api/v1/{path}?{urllib.parse.urlencode(parameters)}")
        if status != 200:
            raise AssertionError(f"{path} {parameters}: {status} {text}")
        return json.loads(text)["data"]

    def query(self, expression: str) -> list[dict[str, Any]]:
        return self.get("query", query=expression)["result"]

    def alerts(self, name: str) -> list[dict[str, Any]]:
        """Those that fire."""
        return [a for a in self.get("alerts")["alerts"] if a["labels"]["alertname"] == name and a["state"] == "firing"]


class Scraped(unittest.TestCase):
    """One story, in order: a daemon that keeps up, one that is gone, one that cannot keep up."""

    @classmethod
    def setUpClass(cls) -> None:
        program("promtool")
        folder = tempfile.TemporaryDirectory(prefix="hemostream-prometheus-")
        cls.addClassCleanup(folder.cleanup)
        cls.port = free_port()
        cls.daemon = start_daemon(cls.port, *LIGHT)
        cls.addClassCleanup(lambda: cls.daemon.stop())
        cls.dashboard, cls.url = start_dashboard(cls.port)
        cls.addClassCleanup(cls.dashboard.stop)
        cls.replay = start_replay(cls.port, "--beds", str(len(BEDS)), "--block-s", "0.04")
        cls.addClassCleanup(lambda: cls.replay.stop())
        cls.prometheus = Prometheus(Path(folder.name), cls.url.removeprefix("http://"))
        cls.addClassCleanup(cls.prometheus.process.stop)
        until(lambda: fetch(f"{cls.prometheus.url}/-/ready")[0] == 200, 30.0, "a Prometheus that is ready")

    def test_1_the_metrics_are_well_formed(self) -> None:
        until(lambda: "hemostream_bed_beat{" in fetch(f"{self.url}/metrics")[1], 20.0, "figures of a beat")
        _, text = fetch(f"{self.url}/metrics")
        self.assertTrue(text.endswith("# EOF\n"))
        code, said = promtool("check", "metrics", text=text)
        # 1 is unreadable, 3 is readable with remarks. promtool reads the older text format, in which the help of a
        # counter stands under another name than in OpenMetrics.
        self.assertIn(code, (0, 3), said)
        known = re.compile(r"\w+_total no help text")
        self.assertEqual([line for line in said.splitlines() if not known.fullmatch(line)], [])

    def test_2_the_series_appear_and_nothing_is_late(self) -> None:
        # Starting is slow; the figure is of the last minute. A machine that is busy with other things may take so long.
        def calm() -> bool:
            lag = self.prometheus.query('hemostream_bed_window_lag_seconds{stat="p99"}')
            return len(lag) == len(BEDS) and all(float(s["value"][1]) < LIMIT_S for s in lag)

        until(calm, 90.0, "lags below the limit")
        self.assertEqual(values(self.prometheus.query('up{job="hemostream"}')), [1.0])
        self.assertEqual(values(self.prometheus.query("hemostream_connected")), [1.0])
        self.assertEqual(values(self.prometheus.query("hemostream_beds")), [float(len(BEDS))])
        alive = self.prometheus.query("hemostream_bed_members_alive")
        self.assertEqual({series["metric"]["bed"] for series in alive}, set(BEDS))
        output = 'hemostream_bed_beat{quantity="cardiac_output", statistic="%s"}'
        low, mean, high = (values(self.prometheus.query(output % s)) for s in ("q05", "mean", "q95"))
        self.assertEqual(len(mean), len(BEDS))
        for row in zip(low, mean, high, strict=True):
            self.assertTrue(2.0 < row[0] < row[1] < row[2] < 10.0, row)

        def flows() -> bool:
            windows = values(self.prometheus.query("rate(hemostream_bed_windows_total[10s])"))
            return len(windows) == len(BEDS) and all(rate > 100.0 for rate in windows)

        # 250 are due; the first scrapes do not fill the ten seconds.
        until(flows, 20.0, "a hundred windows per second and bed")
        # What was late in starting may have been told; the alert ends with its reason.
        until(lambda: calm() and not self.prometheus.alerts(LAG_ALERT), 20.0, "no alert of lag without lag")
        self.assertEqual(self.prometheus.alerts("HemostreamNotConnected"), [])
        self.assertEqual(self.prometheus.alerts("HemostreamDashboardAbsent"), [])

    def test_3_every_expression_of_the_grafana_file_has_data(self) -> None:
        board = json.loads((HERE / "grafana.json").read_text())
        for panel in board["panels"]:
            for target in panel.get("targets", []):
                expression = target["expr"].replace("$__rate_interval", "10s").replace("$bed", "|".join(BEDS))
                with self.subTest(panel=panel["title"], expression=expression):
                    # Where nothing was ever refused there is no such counter; a rate needs two scrapes.
                    if "hemostream_bed_refused_total" in expression:
                        result = self.prometheus.query(expression)
                    else:
                        result = until(lambda e=expression: self.prometheus.query(e), 15.0, "data")
                    # A legend names labels that are there.
                    for label in re.findall(r"{{(\w+)}}", target["legendFormat"]):
                        self.assertTrue(all(label in series["metric"] for series in result), label)
        beds = self.prometheus.get("label/bed/values", **{"match[]": "hemostream_bed_estimate_age_seconds"})
        self.assertEqual(set(beds), set(BEDS))

    def test_4_a_daemon_that_is_gone_is_told(self) -> None:
        self.daemon.kill()
        until(lambda: self.prometheus.alerts("HemostreamNotConnected"), 20.0, "not connected")
        told = until(lambda: self.prometheus.alerts("HemostreamNoEstimate"), 20.0, "no estimate")
        until(lambda: len(self.prometheus.alerts("HemostreamNoEstimate")) == len(BEDS), 10.0, "of all beds")
        self.assertIn("summary", told[0]["annotations"])

    def test_5_lag_and_reduced_members_are_told(self) -> None:
        type(self).daemon = start_daemon(self.port, *OVERLOAD)
        self.replay.stop()
        type(self).replay = start_replay(self.port, "--beds", str(len(BEDS)), "--start-s", "1000")
        until(lambda: self.prometheus.alerts("HemostreamMembersReduced"), 45.0, "members reduced")
        firing = until(lambda: self.prometheus.alerts(LAG_ALERT), 45.0, "late windows")
        self.assertIn(firing[0]["labels"]["bed"], BEDS)
        self.assertGreater(float(firing[0]["value"]), LIMIT_S)
        self.assertEqual(self.prometheus.alerts("HemostreamNotConnected"), [])

    def test_6_an_absent_dashboard_is_told(self) -> None:
        self.dashboard.stop()
        until(lambda: self.prometheus.alerts("HemostreamDashboardAbsent"), 20.0, "absence")


def values(result: list[dict[str, Any]]) -> list[float]:
    """Of an answer, in the order of the beds."""
    return [float(s["value"][1]) for s in sorted(result, key=lambda s: s["metric"].get("bed", ""))]


if __name__ == "__main__":
    unittest.main()
