"""Tests of the files of hemostream with the tools that others read them with: pandas, DuckDB, the package `wfdb`.

They need the program: the environment variable HEMOSTREAM, or `target/debug/hemostream`. Without it they are passed
over, unless HEMOSTREAM_REQUIRED is 1.
"""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import tempfile
import time
import unittest
from pathlib import Path

import duckdb
import numpy as np
import pandas as pd
import plot_recording
import pyarrow.parquet as pq
import wfdb

ROOT = Path(__file__).resolve().parent.parent
PROGRAM = Path(os.environ.get("HEMOSTREAM", ROOT / "target" / "debug" / "hemostream"))
REQUIRED = os.environ.get("HEMOSTREAM_REQUIRED") == "1"

# The rest of what begins so would be settings.
ENVIRONMENT = {name: value for name, value in os.environ.items() if not name.startswith("HEMOSTREAM")}

PATIENCE_S = 60.0
"""Bounds a wait on a process that does not do what it should."""

STALL_S = 3.0
"""A recorder that does nothing for so long misses some of what a daemon publishes, who remembers more than that."""

SETTINGS = [
    "observed=['p_a', 'p_pa']",
    "estimator.members=8",
    "window.length_s=0.005",
    "publish.rate_hz=50",
]


def settings(*more: str) -> list[str]:
    return [word for setting in [*SETTINGS, *more] for word in ("--set", setting)]


class WithProgram(unittest.TestCase):
    folder: Path

    def setUp(self) -> None:
        if not PROGRAM.is_file():
            reason = f"{PROGRAM} is not there: `cargo build`, or set HEMOSTREAM"
            if REQUIRED:
                self.fail(reason)
            self.skipTest(reason)
        temporary = tempfile.TemporaryDirectory()
        self.addCleanup(temporary.cleanup)
        self.folder = Path(temporary.name)

    def run_program(self, *arguments: str) -> str:
        done = subprocess.run(
            [PROGRAM, *arguments], env=ENVIRONMENT, cwd=self.folder, capture_output=True, text=True, timeout=PATIENCE_S
        )
        self.assertEqual(done.returncode, 0, done.stderr)
        return done.stdout

    def start(self, *arguments: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [PROGRAM, *arguments],
            env=ENVIRONMENT,
            cwd=self.folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

        def end() -> None:
            if process.poll() is None:
                process.kill()
            process.communicate()

        self.addCleanup(end)
        return process

    def stop(self, process: subprocess.Popen[str]) -> str:
        process.send_signal(signal.SIGINT)
        said, _ = process.communicate(timeout=PATIENCE_S)
        self.assertEqual(process.returncode, 0, said)
        return said


class Records(WithProgram):
    def test_csv_to_parquet_to_wfdb_to_csv(self) -> None:
        rng = np.random.default_rng(5)
        n, rate = 3000, 250
        # Times are kept to the nanosecond.
        times = np.round(7.5 + np.arange(n) / rate, 9)
        values = np.column_stack([rng.uniform(-20, 240, n), rng.uniform(100, 1200, n)])
        values[rng.integers(0, n, 40), rng.integers(0, 2, 40)] = np.nan
        frame = pd.DataFrame({"time_s": times, "ABP": values[:, 0], "PAP": values[:, 1]})
        frame.to_csv(self.folder / "a.csv", index=False)
        self.run_program("convert", "a.csv", "b.parquet")
        self.run_program("convert", "b.parquet", "c.hea", "--label", "p_a=ABP", "--label", "p_pa=PAP")
        self.run_program("convert", "c.hea", "d.csv")

        parquet = pd.read_parquet(self.folder / "b.parquet")
        np.testing.assert_array_equal(parquet.to_numpy(), np.column_stack([times, values]))
        metadata = pq.read_metadata(self.folder / "b.parquet").metadata
        self.assertEqual(metadata[b"hemostream.schema"], b"1")
        self.assertEqual(json.loads(metadata[b"hemostream.units"]), {"time_s": "s", "p_a": "mmHg", "p_pa": "mmHg"})
        counted = duckdb.sql(f"select min(time_s), count(p_a) from '{self.folder / 'b.parquet'}'").fetchall()
        self.assertEqual(counted, [(7.5, int(np.isfinite(values[:, 0]).sum()))])

        record = wfdb.rdrecord(str(self.folder / "c"))
        self.assertEqual((record.fs, record.sig_name, record.units), (rate, ["ABP", "PAP"], ["mmHg", "mmHg"]))
        self.assertEqual((record.adc_gain[0], record.baseline[0]), (100.0, 0))
        self.assertLess(record.adc_gain[1], 100.0)
        self.assertIn("hemostream_start_ns: 7500000000", record.comments)
        steps = 1 / np.asarray(record.adc_gain)
        np.testing.assert_array_equal(np.isnan(record.p_signal), np.isnan(values))
        self.assertTrue(np.all(np.nan_to_num(np.abs(record.p_signal - values)) <= 0.5 * steps * (1 + 1e-9)))

        back = pd.read_csv(self.folder / "d.csv")
        self.assertEqual(list(back.columns), ["time_s", "p_a", "p_pa"])
        np.testing.assert_allclose(back["time_s"], times, rtol=0, atol=2e-9)
        np.testing.assert_allclose(back.to_numpy()[:, 1:], record.p_signal, rtol=0, atol=1e-9)

    def test_parquet_of_pandas_and_duckdb_is_read(self) -> None:
        frame = pd.DataFrame({"time_s": np.arange(100) / 125, "ABP": 80 + np.arange(100) / 7})
        frame.to_parquet(self.folder / "pandas.parquet")
        duckdb.sql(f"copy frame to '{self.folder / 'duckdb.parquet'}' (format parquet)")
        for name in ("pandas", "duckdb"):
            with self.subTest(name=name):
                self.run_program("convert", f"{name}.parquet", f"{name}.csv")
                back = pd.read_csv(self.folder / f"{name}.csv")
                np.testing.assert_array_equal(back.to_numpy(), frame.to_numpy())


def free_port() -> int:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return int(taken.getsockname()[1])


class RecordingCase(WithProgram):
    """With a daemon to be recorded."""

    daemon_settings: tuple[str, ...] = ()

    def setUp(self) -> None:
        super().setUp()
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.recording = self.folder / "recording"
        self.daemon = self.start("serve", *settings(f"zenoh.listen=['{self.endpoint}']", *self.daemon_settings))
        self.wait_for_daemon()

    def wait_for_daemon(self) -> None:
        address, port = self.endpoint.removeprefix("tcp/").split(":")
        until = time.monotonic() + PATIENCE_S
        while time.monotonic() < until:
            try:
                socket.create_connection((address, int(port)), timeout=1).close()
                return
            except OSError:
                time.sleep(0.05)
        self.fail("the daemon does not listen")

    def record(self, flush_s: float = 0.3) -> subprocess.Popen[str]:
        recorder = self.start(
            "record", "--output", "recording", "--connect", self.endpoint, "--flush-s", str(flush_s), *settings()
        )
        until = time.monotonic() + PATIENCE_S
        while not (self.recording / ".lock").exists():
            self.assertLess(time.monotonic(), until, "the recorder does not begin")
            time.sleep(0.02)
        # The subscription takes a moment to get to the daemon and on to the publisher.
        time.sleep(0.5)
        return recorder

    def replay(self, *arguments: str) -> str:
        return self.run_program("replay", "--connect", self.endpoint, *arguments, *settings())

    def rows(self, table: str) -> int:
        folder = self.recording / table
        until = time.monotonic() + PATIENCE_S
        while folder.is_dir():
            # A merge may remove a file between the listing of a folder and its reading.
            try:
                return len(pd.read_parquet(folder))
            except FileNotFoundError:
                self.assertLess(time.monotonic(), until, f"{table} cannot be read")
        return 0

    def wait_for(self, table: str, rows: int) -> None:
        until = time.monotonic() + PATIENCE_S
        found = 0
        while found < rows:
            self.assertLess(time.monotonic(), until, f"{found} rows in {table}, expected {rows}")
            time.sleep(0.1)
            found = self.rows(table)

    def count(self, of: str, said: str) -> int:
        """A number that the recorder said; 0 where it said nothing of the kind."""
        return int(match.group(1)) if (match := re.search(rf"{of}: (\d+)", said)) else 0


class Recordings(RecordingCase):
    def test_pandas_and_duckdb_read_what_is_recorded_and_plotted(self) -> None:
        recorder = self.record()
        self.replay("--seconds", "3", "--speed", "2", "--beds", "2", "--bed", "icu")
        self.wait_for("estimates", 2 * 140)
        said = self.stop(recorder)
        self.assertIn("beds: 2", said)
        self.assertIn("messages dropped: 0", said)

        samples = pd.read_parquet(self.recording / "samples")
        self.assertEqual(set(samples["bed"].unique()), {"icu-1", "icu-2"})
        self.assertEqual(str(samples["arrival"].dtype), "datetime64[ns, UTC]")
        self.assertLess(abs(time.time() - samples["arrival"].max().timestamp()), PATIENCE_S)
        # What the daemon never got is missing, and the recorder says so.
        lost = self.count("never came, by their sequence numbers", said)
        missing = 0
        for _, block in samples.groupby(["bed", "channel"], observed=True):
            blocks = block["sequence"].nunique()
            missing += int(block["sequence"].max()) - int(block["sequence"].min()) + 1 - blocks
            self.assertGreater(blocks, 200)
        self.assertLessEqual(missing, lost)
        names = "arrival, channel, sequence, flags, time_ns, value, bed, hour".split(", ")
        self.assertEqual(list(samples.columns), names)

        pattern = self.recording / "estimates" / "**" / "*.parquet"
        query = "select bed, count(*), min(time_ns), bool_and(p_l_q05 <= p_l_mean), min(typeof(sequence)) from "
        query += f"read_parquet('{pattern}', hive_partitioning = true) group by bed order by bed"
        for bed, count, first, ordered, kind in duckdb.sql(query).fetchall():
            self.assertIn(bed, ("icu-1", "icu-2"))
            self.assertGreaterEqual(count, 140)
            self.assertEqual((first, ordered, kind), (0, True, "UBIGINT"))
        events = pd.read_parquet(self.recording / "events")
        self.assertIn("start", set(events["kind"]))
        status = pd.read_parquet(self.recording / "status")
        channels = json.loads(status["channels"].iloc[-1])
        self.assertEqual([channel["name"] for channel in channels], ["p_a", "p_pa"])

        picture = self.folder / "p.png"
        arguments = [str(self.recording), "--bed", "icu-2", "--output", str(picture)]
        self.assertEqual(plot_recording.main([*arguments, "p_a", "p_l", "r_pv"]), plot_recording.OK)
        self.assertTrue(picture.read_bytes().startswith(b"\x89PNG"))
        self.assertEqual(plot_recording.main([*arguments, "nothing"]), plot_recording.USAGE)

    def test_what_is_on_the_disk_outlives_a_kill_and_recording_goes_on(self) -> None:
        recorder = self.record()
        publisher = self.start("replay", "--connect", self.endpoint, "--seconds", "60", *settings())
        self.wait_for("samples", 100)
        # Past a merge, and in the middle of whatever is done then.
        time.sleep(12.0)
        recorder.kill()
        killed = time.time()
        recorder.wait(PATIENCE_S)
        before = pd.read_parquet(self.recording / "samples")
        newest = before["arrival"].max().timestamp()
        self.assertLess(killed - newest, 3.0)
        for table in ("estimates", "parameters", "status", "events"):
            self.assertGreater(self.rows(table), 0, table)
        recorder = self.record()
        self.wait_for("samples", len(before) + 100)
        publisher.kill()
        self.stop(recorder)
        after = pd.read_parquet(self.recording / "samples")
        keys = ["arrival", "channel", "time_ns"]
        self.assertFalse(after.duplicated(keys).any(), "nothing twice")
        kept = after.merge(before[keys].drop_duplicates(), on=keys)
        self.assertEqual(len(kept), len(before.drop_duplicates(keys)), "nothing lost")
        self.assertEqual(list(self.recording.rglob("*.tmp")), [])

    def test_a_recording_is_played_back(self) -> None:
        recorder = self.record()
        self.replay("--seconds", "2", "--speed", "2")
        self.wait_for("estimates", 90)
        self.stop(recorder)
        said = self.replay("--recording", "recording", "--speed", "4")
        self.assertIn("playing bed1 under hemostream/", said)
        blocks = pd.read_parquet(self.recording / "samples")["arrival"].nunique()
        truths = pd.read_parquet(self.recording / "truth")["arrival"].nunique()
        self.assertIn(f"published {blocks + truths} messages of ", said)

    def restart_daemon(self, *more: str) -> None:
        self.stop(self.daemon)
        self.daemon = self.start("serve", *settings(*more, f"zenoh.listen=['{self.endpoint}']"))
        self.wait_for_daemon()

    def recorded(self, *arguments: str, stall_s: float) -> tuple[str, dict[str, pd.DataFrame]]:
        """What a recorder says that is stopped for a while during a replay, and its tables in the order of sequence."""
        recorder = self.record()
        publisher = self.start("replay", "--connect", self.endpoint, *arguments, *settings())
        self.wait_for("samples", 1000)
        if stall_s > 0:
            recorder.send_signal(signal.SIGSTOP)
            time.sleep(stall_s)
            recorder.send_signal(signal.SIGCONT)
        said, _ = publisher.communicate(timeout=PATIENCE_S)
        self.assertEqual(publisher.returncode, 0, said)
        before, rows = -1, self.rows("estimates")
        while before < rows:
            # A part of the recording has been written by then, if there is more.
            time.sleep(4.0)
            before, rows = rows, self.rows("estimates")
        said = self.stop(recorder)
        tables = {}
        for table in ("samples", "estimates", "parameters", "beats"):
            frame = pd.read_parquet(self.recording / table).drop(columns=["arrival", "hour"])
            keys = [key for key in ("bed", "channel", "sequence", "time_ns") if key in frame]
            tables[table] = frame.sort_values(keys, ignore_index=True)
        return said, tables

    def test_what_a_recorder_missed_it_gets_from_the_daemon_and_a_replay_gives_the_same(self) -> None:
        # Windows wait for their samples however late a busy machine delivers them.
        more = ("window.allowed_lateness_s=600", "publish.rate_hz=200")
        self.restart_daemon(*more)
        said, first = self.recorded("--seconds", "10", "--beds", "6", "--bed", "icu", stall_s=STALL_S)
        recovered, lost = self.count("the daemon gave again", said), self.count("never came, by their sequence numbers", said)
        self.assertGreater(recovered, 0, said)
        if lost > 0:
            # A machine that is busy with other things may take longer for an answer than a recorder waits.
            self.assertLess(lost, 0.01 * recovered, said)
            return
        self.recording.rename(self.folder / "first")
        self.restart_daemon(*more)
        said, second = self.recorded("--recording", "first", stall_s=0.0)
        self.assertEqual(self.count("never came, by their sequence numbers", said), 0, said)
        for table in first:
            with self.subTest(table=table):
                pd.testing.assert_frame_equal(first[table], second[table], check_exact=True)


class LongRecording(RecordingCase):
    RATE_HZ = 5
    daemon_settings = (f"publish.rate_hz={RATE_HZ}", "window.length_s=0.02")
    # At so many times the pace of the patients, with an unoptimised build: fewer and bigger blocks and files.
    SPEED, BLOCK_S, FLUSH_S = "15", "0.4", 6.0

    def test_ten_beds_for_ten_minutes_are_read_by_pandas_and_duckdb(self) -> None:
        beds, minutes, rate_hz = 10, 10, 50
        recorder = self.record(self.FLUSH_S)
        publisher = self.start(
            *("replay", "--connect", self.endpoint, "--beds", str(beds), "--bed", "icu", "--speed", self.SPEED),
            *("--seconds", str(60 * minutes), "--rate-hz", str(rate_hz), "--block-s", self.BLOCK_S),
            *("--truth-hz", "1", *settings()),
        )
        publisher.wait(3 * PATIENCE_S)
        self.wait_for("estimates", beds * (60 * minutes - 1) * self.RATE_HZ)
        said = self.stop(recorder)
        self.assertIn("messages dropped: 0", said)

        samples = pd.read_parquet(self.recording / "samples")
        # The end of a record is a row without a value.
        samples = samples[samples["value"].notna()]
        self.assertEqual(samples.groupby(["bed", "channel"], observed=True).ngroups, 2 * beds)
        for (bed, channel), rows in samples.groupby(["bed", "channel"], observed=True):
            times = np.sort(rows["time_ns"].to_numpy())
            # None is missing and none is there twice; the last block may reach beyond the end.
            self.assertEqual(set(np.diff(times)), {1_000_000_000 // rate_hz}, f"{bed} {channel}")
            self.assertGreaterEqual(len(times), 60 * minutes * rate_hz, f"{bed} {channel}")
        # One a second, as asked; what the network drops of it nobody gives again.
        truths = pd.read_parquet(self.recording / "truth").groupby("bed", observed=True)
        self.assertEqual(truths.ngroups, beds)
        for bed, rows in truths:
            self.assertGreaterEqual(np.diff(np.sort(rows["time_ns"].to_numpy())).min(), 1_000_000_000, bed)
            self.assertGreater(len(rows), 60 * minutes / 2, bed)
        pattern = self.recording / "estimates" / "**" / "*.parquet"
        query = "select bed, count(distinct time_ns), (max(time_ns) - min(time_ns)) / 1e9, avg(p_a_q95 - p_a_q05) from "
        query += f"read_parquet('{pattern}', hive_partitioning = true) group by bed"
        found = duckdb.sql(query).fetchall()
        self.assertEqual(len(found), beds)
        for bed, count, span_s, width in found:
            self.assertGreaterEqual(count, (60 * minutes - 1) * self.RATE_HZ, bed)
            self.assertGreater(span_s, 60 * minutes - 1.5, bed)
            self.assertGreater(width, 0.0, bed)


if __name__ == "__main__":
    unittest.main()
