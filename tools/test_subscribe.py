"""Tests of the subscriber: joining of rows, pairing of twins, and the whole over loopback."""

from __future__ import annotations

import contextlib
import io
import json
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
import unittest
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from hemostream_rows import MAX_WAITING, ColumnsChanged, RowFile
from hemostream_twins import MAX_WAITING as MAX_TWINS_WAITING
from hemostream_twins import TwinCheck
from hemostream_wire import (
    BEAT_STATISTICS,
    PARAMETER_STATISTICS,
    SMOOTHED_KEY,
    STATE_STATISTICS,
    Alarms,
    BeatEstimate,
    Event,
    Note,
    ParameterEstimate,
    StateEstimate,
    Status,
    decode,
    from_json,
)
from test_hemostream_wire import f64, floats, text, texts, u64

try:
    import subscribe
    import zenoh
except SystemExit as missing:
    raise unittest.SkipTest(str(missing)) from missing

QUANTITY_NAMES = ("p_l", "p_a", "p_v", "p_pa")
PARAMETER_NAMES = ("r_pv",)
PATIENCE_S = 30.0
"""Bounds a wait on a process that does not do what it should."""


def header(sequence: int, time_ns: int) -> bytes:
    return struct.pack("<HQQQq", 2, 42, 0xAB, sequence, time_ns)


def header_json(sequence: int, time_ns: int) -> dict[str, Any]:
    return {"schema": 2, "seed": 42, "config_hash": f"{0xAB:016x}", "sequence": sequence, "time_ns": time_ns}


def state_values(time_ns: int) -> list[float]:
    """Numbers with long decimal forms, all different: `[4 x 7]`."""
    return [(time_ns / 1e9 + i) / 3 for i in range(28)]


def parameter_values(time_ns: int) -> list[float]:
    """Numbers with long decimal forms, all different, and `identifiable`: `[7]`."""
    return [(time_ns / 1e9 + i) / 7 for i in range(6)] + [1.0]


def state_bytes(sequence: int, *times_ns: int) -> bytes:
    body = struct.pack("<I", 100) + u64(len(times_ns)) + struct.pack(f"<{len(times_ns)}q", *times_ns)
    values = [value for time_ns in times_ns for value in state_values(time_ns)]
    start_ns = times_ns[0]
    return header(sequence, start_ns) + body + floats(*[0.0] * len(times_ns)) + texts(*QUANTITY_NAMES) + floats(*values)


def state_json(sequence: int, time_ns: int) -> dict[str, Any]:
    values = state_values(time_ns)
    quantities = {
        name: {s: [values[7 * q + i]] for i, s in enumerate(STATE_STATISTICS)} for q, name in enumerate(QUANTITY_NAMES)
    }
    body = {"members": 100, "times_ns": [time_ns], "since_data_s": [0.0]}
    body |= {"names": list(QUANTITY_NAMES), "quantities": quantities}
    return header_json(sequence, time_ns) | body


def parameter_bytes(sequence: int, time_ns: int, names: tuple[str, ...] = PARAMETER_NAMES) -> bytes:
    values = parameter_values(time_ns) * len(names)
    return header(sequence, time_ns) + struct.pack("<I", 100) + texts(*names) + floats(*values)


def parameter_json(sequence: int, time_ns: int) -> dict[str, Any]:
    values: dict[str, Any] = dict(zip(PARAMETER_STATISTICS, parameter_values(time_ns), strict=True))
    values["identifiable"] = True
    return header_json(sequence, time_ns) | {"members": 100, "names": ["r_pv"], "parameters": {"r_pv": values}}


def smoothed_bytes(sequence: int, time_ns: int) -> bytes:
    body = struct.pack("<I", 100) + u64(1) + struct.pack("<q", time_ns) + floats(0.0)
    values = [*state_values(time_ns), *map(float, range(7))]
    return header(sequence, time_ns) + body + texts(*QUANTITY_NAMES, *PARAMETER_NAMES) + floats(*values)


def smoothed_json(sequence: int, time_ns: int) -> dict[str, Any]:
    body = state_json(sequence, time_ns)
    parameter = {s: [float(i)] for i, s in enumerate(STATE_STATISTICS)}
    body["names"] = [*QUANTITY_NAMES, *PARAMETER_NAMES]
    body["quantities"] |= {"r_pv": parameter}
    return body


BEAT_MEANS = {
    "heart_rate": (80.0, "bpm"),
    "stroke_volume": (62.5, "mL"),
    "cardiac_output": (5.0, "L/min"),
    "ejection_fraction": (0.6, ""),
    "svr": (1.0, "mmHg s/mL"),
    "pvr": (0.0625, "mmHg s/mL"),
    "p_l_systolic": (119.0, "mmHg"),
    "p_a_systolic": (118.0, "mmHg"),
    "p_a_diastolic": (76.0, "mmHg"),
    "p_a_mean": (92.0, "mmHg"),
}
BEAT_LINE = (
    "bed1  1.000 s  BEAT  HR 80.0 [76.0, 84.0] bpm  SV 62.5 [59.4, 65.6] mL  CO 5.00 [4.75, 5.25] L/min"
    "  EF 0.600 [0.570, 0.630]  SVR 1.000 [0.950, 1.050] mmHg s/mL  PVR 0.0625 [0.0594, 0.0656] mmHg s/mL"
    "  P_a 118/76 mean 92.0 [87.4, 96.6] mmHg"
)


def beat_values(mean: float) -> list[float]:
    return [mean, 0.03 * mean, 0.95 * mean, 1.05 * mean]


def beat_bytes(sequence: int, time_ns: int, names: tuple[str, ...] = tuple(BEAT_MEANS)) -> bytes:
    units = texts(*(BEAT_MEANS[name][1] for name in names))
    values = [value for name in names for value in beat_values(BEAT_MEANS[name][0])]
    head = header(sequence, time_ns) + struct.pack("<Iq", 100, time_ns + 750_000_000)
    return head + texts(*names) + units + floats(*values)


def beat_json(sequence: int, time_ns: int) -> dict[str, Any]:
    quantities = {
        name: dict(zip(BEAT_STATISTICS, beat_values(mean), strict=True)) | {"unit": unit}
        for name, (mean, unit) in BEAT_MEANS.items()
    }
    body = {"members": 100, "end_ns": time_ns + 750_000_000, "names": list(BEAT_MEANS), "quantities": quantities}
    return header_json(sequence, time_ns) | body


def event_bytes(sequence: int, time_ns: int, words: str) -> bytes:
    return header(sequence, time_ns) + text("gap") + text("p_a") + text(words)


def event_json(sequence: int, time_ns: int, words: str) -> dict[str, Any]:
    return header_json(sequence, time_ns) | {"kind": "gap", "channel": "p_a", "text": words}


def alarm_json(sequence: int, time_ns: int, state: str) -> dict[str, Any]:
    alarm = {"name": "low output", "quantity": "cardiac_output", "unit": "L/min", "priority": "high", "state": state}
    alarm |= {"acknowledged": False, "side": "below", "limit": 4.0, "since_ns": time_ns, "band": [3.2, 2.9, 3.5]}
    return header_json(sequence, time_ns) | {"alarms": [alarm | {"text": "too little"}]}


def alarm_bytes(sequence: int, time_ns: int, state: str) -> bytes:
    words = [text(word) for word in ("low output", "cardiac_output", "L/min", "high", state)]
    band = f64(4.0) + struct.pack("<q", time_ns) + f64(3.2, 2.9, 3.5)
    return header(sequence, time_ns) + u64(1) + b"".join(words) + b"\0" + text("below") + band + text("too little")


def status_bytes(sequence: int, time_ns: int) -> bytes:
    lags = f64(0.5, 3.25, 9.0, 0.75, 2.5)
    return header(sequence, time_ns) + struct.pack("<IIQQ", 100, 100, 5, 0) + lags + bytes(8 + 4 + 8 + 8 + 8)


def status_json(sequence: int, time_ns: int) -> dict[str, Any]:
    counts = ("windows_without_data", "not_converged", "queue_depth")
    lags = {"lag_p50_ms": 0.5, "lag_p99_ms": 3.25, "lag_max_ms": 9.0, "solve_ms": 0.75, "iterations": 2.5}
    rest: dict[str, Any] = {"members_alive": 100, "members": 100, "windows": 5, "counters": {}, "channels": []}
    rest["disagreement"] = {}
    return header_json(sequence, time_ns) | dict.fromkeys(counts, 0) | lags | rest


def state(sequence: int, *times_ns: int) -> StateEstimate:
    return decode(StateEstimate, state_bytes(sequence, *times_ns))


def parameters(sequence: int, time_ns: int, names: tuple[str, ...] = PARAMETER_NAMES) -> ParameterEstimate:
    return decode(ParameterEstimate, parameter_bytes(sequence, time_ns, names))


def expected_row(time_ns: int, with_parameters: bool = True) -> str:
    v, p = state_values(time_ns), parameter_values(time_ns)
    cells = [repr(time_ns / 10**9)]
    for q in range(len(QUANTITY_NAMES)):
        mean, sd, epistemic, aleatoric, model, q05, q95 = v[7 * q : 7 * q + 7]
        cells += map(repr, (mean, sd, q05, q95, epistemic, aleatoric, model))
    cells += map(repr, p[:4]) if with_parameters else [""] * 4
    return ",".join(cells)


HEADER_ROW = ",".join(
    ["time_s"]
    + [
        f"{name}_{column}"
        for name in QUANTITY_NAMES
        for column in ("mean", "sd", "q05", "q95", "epistemic_sd", "aleatoric_sd", "model_sd")
    ]
    + [f"r_pv_{column}" for column in ("mean", "sd", "q05", "q95")]
)


class InDirectory(unittest.TestCase):
    def setUp(self) -> None:
        directory = tempfile.TemporaryDirectory()
        self.addCleanup(directory.cleanup)
        self.csv = Path(directory.name) / "out.csv"

    def lines(self) -> list[str]:
        return self.csv.read_text(encoding="utf-8").splitlines()


class Rows(InDirectory):
    def written(self, *messages: StateEstimate | ParameterEstimate) -> list[str]:
        rows = RowFile(self.csv)
        try:
            for message in messages:
                if isinstance(message, StateEstimate):
                    rows.add_state(message)
                else:
                    rows.add_parameters(message)
        finally:
            rows.close()
        return self.lines()

    def test_joined_by_event_time_whichever_comes_first(self) -> None:
        lines = self.written(state(1, 10), parameters(1, 10), parameters(2, 20), state(2, 20))
        self.assertEqual(lines, [HEADER_ROW, expected_row(10), expected_row(20)])

    def test_lost_parameters_leave_cells_empty(self) -> None:
        lines = self.written(state(1, 10), state(2, 20), parameters(2, 20), state(3, 30))
        rows = [expected_row(10, False), expected_row(20), expected_row(30, False)]
        self.assertEqual(lines, [HEADER_ROW, *rows])

    def test_lost_state_leaves_no_row(self) -> None:
        lines = self.written(parameters(1, 10), parameters(2, 20), state(2, 20))
        self.assertEqual(lines, [HEADER_ROW, expected_row(20)])

    def test_several_times_in_one_message(self) -> None:
        lines = self.written(state(1, 10, 11, 12), parameters(1, 10), state(2, 20), parameters(2, 20))
        rows = [expected_row(10), expected_row(11, False), expected_row(12, False), expected_row(20)]
        self.assertEqual(lines, [HEADER_ROW, *rows])

    def test_nothing_estimated(self) -> None:
        lines = self.written(state(1, 10), state(2, 20))
        self.assertEqual(lines[0], HEADER_ROW.partition(",r_pv")[0])
        self.assertEqual(lines[1:], [expected_row(t, False).removesuffix(",,,,") for t in (10, 20)])

    def test_nothing_at_all(self) -> None:
        self.assertEqual(self.written(), [])

    def test_time_that_goes_back(self) -> None:
        rows = [expected_row(100), expected_row(110, False), expected_row(10), expected_row(20)]
        old = (state(1, 100), parameters(1, 100), state(2, 110))
        for new in (
            (state(3, 10), state(4, 20), parameters(3, 10), parameters(4, 20)),
            (parameters(3, 10), parameters(4, 20), state(3, 10), state(4, 20)),
            (parameters(3, 10), state(3, 10), state(4, 20), parameters(4, 20)),
        ):
            self.assertEqual(self.written(*old, *new), [HEADER_ROW, *rows])

    def test_parameters_of_the_old_run_do_not_outlive_it(self) -> None:
        old = (state(1, 100), parameters(1, 100), parameters(2, 110))
        lines = self.written(*old, state(2, 10), parameters(3, 10))
        self.assertEqual(lines, [HEADER_ROW, expected_row(100), expected_row(10)])

    def test_waiting_is_bounded(self) -> None:
        rows = RowFile(self.csv)
        self.addCleanup(rows.close)
        for i in range(MAX_WAITING + 3):
            rows.add_state(state(i, i))
        self.assertEqual((rows.rows, rows.rows_without_parameters), (3, 3))

    def test_parameters_beyond_the_bound_are_forgotten(self) -> None:
        many = [parameters(i, i) for i in range(MAX_WAITING + 1)]
        self.assertEqual(self.written(*many, state(1, 0), state(2, 1))[1:], [expected_row(0, False), expected_row(1)])

    def test_changed_columns_are_an_error(self) -> None:
        with self.assertRaisesRegex(ColumnsChanged, "parameters changed"):
            self.written(state(1, 10), parameters(1, 10), parameters(2, 20, ("c_a",)))
        self.assertEqual(self.lines(), [HEADER_ROW, expected_row(10)])


class Twins(unittest.TestCase):
    def add(self, twins: TwinCheck, message: Event, is_json: bool) -> list[str]:
        return twins.add("bed1", "event", is_json, message.header, message)

    def pair(self, sequence: int, words: str = "x") -> tuple[Event, Event]:
        twin = from_json(Event, json.dumps(event_json(sequence, sequence, words)))
        return decode(Event, event_bytes(sequence, sequence, "x")), twin

    def test_pairs_in_any_order(self) -> None:
        twins = TwinCheck()
        (a, a_json), (b, b_json) = self.pair(1), self.pair(2)
        for message, is_json in ((a, False), (b_json, True), (b, False), (a_json, True)):
            self.assertEqual(self.add(twins, message, is_json), [])
        twins.finish()
        self.assertEqual((twins.compared.total(), twins.mismatches, twins.unpaired.total()), (2, 0, 0))

    def test_mismatch_names_both_sides_in_order(self) -> None:
        for json_first in (False, True):
            twins = TwinCheck()
            message, twin = self.pair(1, "y")
            self.assertEqual(self.add(twins, twin if json_first else message, json_first), [])
            found = self.add(twins, message if json_first else twin, not json_first)
            self.assertEqual(found, ["text: 'x' against 'y'"])
            self.assertEqual(twins.mismatches, 1)

    def test_without_twin(self) -> None:
        twins = TwinCheck()
        for i in range(MAX_TWINS_WAITING + 2):
            self.add(twins, self.pair(i)[0], False)
        self.assertEqual(twins.unpaired.total(), 2)
        twins.finish()
        # The newest might have had its twin on the way.
        self.assertEqual(twins.unpaired.total(), MAX_TWINS_WAITING + 1)
        self.assertEqual(twins.never_compared(), ["event"])


class Parts(unittest.TestCase):
    def test_keys(self) -> None:
        self.assertEqual(subscribe.split_key("a/b", "a/b/bed/estimate/state"), ("bed", "estimate/state", False))
        self.assertEqual(subscribe.split_key("a/b", "a/b/bed/status/json"), ("bed", "status", True))

    def test_queue_that_is_full_drops_and_counts(self) -> None:
        intake = subscribe.Intake(capacity=2)
        for i in range(5):
            intake.offer(subscribe.Received(str(i), b"", False))
        self.assertEqual(intake.dropped, 3)
        taken = [intake.take(0) for _ in range(3)]
        self.assertEqual([r.key if r else None for r in taken], ["0", "1", None])

    def test_sequences(self) -> None:
        sequences = subscribe.Sequences()
        offered = [(5, 50, True), (5, 50, False), (6, 60, False), (9, 90, False), (8, 80, True), (0, 95, False)]
        taken = [sequences.is_new("k", state(n, t).header, stored) for n, t, stored in offered]
        self.assertEqual(taken, [True, False, True, True, False, True])
        self.assertEqual(sequences.lost, 2)

    def test_event_times(self) -> None:
        self.assertEqual(subscribe.event_time(12_340_000_000), "12.340 s")
        self.assertEqual(subscribe.event_time(1_700_000_000_123_999_999), "2023-11-14 22:13:20.123Z")

    def test_network_cannot_steer_the_terminal(self) -> None:
        event = decode(Event, event_bytes(1, 0, "\x1b[2Jgone\n"))
        self.assertEqual(subscribe.event_line("bed1", event), "bed1  0.000 s  EVENT gap p_a: ?[2Jgone?")

    def test_alarm_lines(self) -> None:
        lines = {state: from_json(Alarms, json.dumps(alarm_json(0, 0, state))) for state in ("normal", "latched")}
        self.assertEqual(subscribe.alarm_lines("bed1", lines["normal"]), ["bed1  0.000 s  ALARM none of 1"])
        latched = ["bed1  0.000 s  ALARM high low output: latched: too little"]
        self.assertEqual(subscribe.alarm_lines("bed1", lines["latched"]), latched)
        bed = subscribe.Bed(alarms=lines["latched"])
        self.assertEqual(bed.line("bed1", 0.0), "bed1  no state yet  lag p99 -  ALARM low output (over)")
        bed.take(lines["normal"], 0.0)
        self.assertNotIn("ALARM", bed.line("bed1", 0.0))

    def test_note_line(self) -> None:
        self.assertEqual(subscribe.note_line("bed1", Note(0, "", "a\x1bb")), "bed1  0.000 s  NOTE: a?b")

    def test_live_line(self) -> None:
        bed = subscribe.Bed()
        self.assertEqual(bed.line("bed1", 0.0), "bed1  no state yet  lag p99 -")
        bed.take(state(1, 1_000_000_000), 10.0)
        bed.take(parameters(1, 1_000_000_000), 10.0)
        bed.take(decode(Status, status_bytes(1, 0)), 10.0)
        expected = (
            "bed1  1.000 s  P_a 2.7 [4.3, 4.7]  P_pa 7.3 [9.0, 9.3]  P_l 0.3 [2.0, 2.3]  P_v 5.0 [6.7, 7.0]"
            "  r_pv 0.1429 [0.4286, 0.5714]  lag p99 3.2 ms"
        )
        self.assertEqual(bed.line("bed1", 10.5), expected)
        self.assertEqual(bed.line("bed1", 17.0), expected + "  SILENT for 7 s")

    def test_parameter_that_is_not_identifiable_is_marked(self) -> None:
        bed = subscribe.Bed()
        values = floats(*parameter_values(1_000_000_000)[:6], 1, *parameter_values(1_000_000_000)[:6], 0)
        payload = header(1, 1_000_000_000) + struct.pack("<I", 100) + texts("r_pv", "c_a") + values
        bed.take(decode(ParameterEstimate, payload), 10.0)
        figures = "0.1429 [0.4286, 0.5714]"
        expected = f"bed1  no state yet  r_pv {figures}  c_a {figures} (not identifiable)  lag p99 -"
        self.assertEqual(bed.line("bed1", 10.5), expected)

    def test_beat_line(self) -> None:
        beat = decode(BeatEstimate, beat_bytes(1, 1_000_000_000))
        self.assertEqual(subscribe.beat_line("bed1", beat), BEAT_LINE)
        # Another model may have fewer.
        beat = decode(BeatEstimate, beat_bytes(1, 1_000_000_000, ("p_a_mean", "heart_rate")))
        self.assertEqual(subscribe.beat_line("bed1", beat), BEAT_LINE.partition("  SV")[0])

    def test_smoothed_estimates_are_neither_shown_nor_written(self) -> None:
        with tempfile.TemporaryDirectory() as directory:
            path = Path(directory) / "out.csv"
            rows = RowFile(path)
            follower = subscribe.Follower("p", False, rows, None)
            messages = [
                ("estimate/state", state_bytes(1, 20)),
                ("estimate/parameters", parameter_bytes(1, 20)),
                (SMOOTHED_KEY, smoothed_bytes(1, 10)),
                ("estimate/state", state_bytes(2, 40)),
                ("estimate/parameters", parameter_bytes(2, 40)),
            ]
            for topic, payload in messages:
                follower.handle(subscribe.Received(f"p/bed1/{topic}", payload, False), 0.0)
            rows.close()
            self.assertEqual(path.read_text().splitlines(), [HEADER_ROW, expected_row(20), expected_row(40)])
        shown = follower.beds["bed1"].state
        self.assertEqual(shown.header.time_ns if shown else None, 40)
        self.assertEqual((follower.received, follower.problems()), (5, []))

    def test_beds_are_bounded(self) -> None:
        follower = subscribe.Follower("p", False, None, None)
        with contextlib.redirect_stderr(io.StringIO()) as complaints:
            for i in range(subscribe.MAX_BEDS + 50):
                follower.handle(subscribe.Received(f"p/bed{i}/status", status_bytes(1, 0), False), 0.0)
        self.assertEqual(len(follower.beds), subscribe.MAX_BEDS)
        self.assertEqual(follower.counters.total(), 50)
        self.assertEqual(len(complaints.getvalue().splitlines()), subscribe.MAX_COMPLAINTS)


class Publisher:
    """A router with a bed that publishes, and offers last values, in this process."""

    def __init__(self) -> None:
        self.asked = threading.Event()
        self.last: dict[str, bytes] = {}
        self.session = self._open_on_free_port()
        self.session.declare_queryable("hemostream/**", self._answer)

    def _open_on_free_port(self) -> zenoh.Session:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
        settings = {
            "mode": "router",
            "connect": {"endpoints": []},
            "listen": {"endpoints": [self.endpoint]},
            "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        }
        return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            for key, payload in self.last.items():
                if query.key_expr.intersects(zenoh.KeyExpr(key)):
                    query.reply(key, payload)
            # The subscriber declares its subscriptions first: once it asks for events it hears everything.
            if "/event" in str(query.key_expr):
                self.asked.set()

    def put(self, topic: str, payload: bytes, twin: dict[str, Any] | None = None, bed: str = "bed1") -> None:
        key = f"hemostream/{bed}/{topic}"
        self.session.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)
        if twin is not None:
            body = json.dumps(twin).encode()
            self.session.put(f"{key}/json", body, congestion_control=zenoh.CongestionControl.BLOCK)


def run_subscriber(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(Path(subscribe.__file__)), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)


class Loopback(InDirectory):
    def setUp(self) -> None:
        super().setUp()
        self.publisher = Publisher()
        self.addCleanup(self.publisher.session.close)

    @contextlib.contextmanager
    def subscriber(self, *arguments: str) -> Iterator[subprocess.Popen[str]]:
        """The subscriber as a process, once it listens."""
        command = [sys.executable, str(Path(subscribe.__file__)), "--connect", self.publisher.endpoint, *arguments]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            try:
                self.assertTrue(self.publisher.asked.wait(PATIENCE_S), "the subscriber never asked for last values")
                yield process
            finally:
                process.kill()

    def read_until(self, process: subprocess.Popen[str], wanted: Callable[[str], bool]) -> list[str]:
        assert process.stdout is not None
        watchdog = threading.Timer(PATIENCE_S, process.kill)
        watchdog.start()
        lines = []
        try:
            for line in process.stdout:
                lines.append(line.rstrip("\n"))
                if wanted(lines[-1]):
                    return lines
        finally:
            watchdog.cancel()
        self.fail(f"the line never came: {lines} {process.stderr.read() if process.stderr else ''}")

    def interrupt(self, process: subprocess.Popen[str]) -> tuple[int, str]:
        process.send_signal(signal.SIGINT)
        _, complaints = process.communicate(timeout=PATIENCE_S)
        self.assertNotIn("Traceback", complaints)
        return process.returncode, complaints

    def publish(self, sequence: int, time_ns: int) -> None:
        self.publisher.put("estimate/state", state_bytes(sequence, time_ns), state_json(sequence, time_ns))
        self.publisher.put("estimate/parameters", parameter_bytes(sequence, time_ns), parameter_json(sequence, time_ns))

    def test_last_values_live_lines_events_and_rows_in_both_formats(self) -> None:
        times = [i * 20_000_000 for i in range(50)]
        stored = {
            "estimate/state": (state_bytes(0, 0), state_json(0, 0)),
            "estimate/parameters": (parameter_bytes(0, 0), parameter_json(0, 0)),
            "status": (status_bytes(0, 0), status_json(0, 0)),
            "estimate/smoothed": (smoothed_bytes(0, -1), smoothed_json(0, -1)),
            "estimate/beat": (beat_bytes(0, 0), beat_json(0, 0)),
        }
        for topic, (payload, twin) in stored.items():
            self.publisher.last[f"hemostream/bed1/{topic}"] = payload
            self.publisher.last[f"hemostream/bed1/{topic}/json"] = json.dumps(twin).encode()
        with self.subscriber("--format", "both", "--csv", str(self.csv)) as process:
            for sequence, time_ns in enumerate(times):
                if sequence:
                    self.publish(sequence, time_ns)
            self.publisher.put(SMOOTHED_KEY, smoothed_bytes(1, 5), smoothed_json(1, 5))
            self.publisher.put("estimate/beat", beat_bytes(1, 1_000_000_000), beat_json(1, 1_000_000_000))
            self.publisher.put("alarm", alarm_bytes(0, 5, "active"), alarm_json(0, 5, "active"))
            self.publisher.put("alarm", alarm_bytes(1, 6, "active"), alarm_json(1, 6, "active"))
            self.publisher.put("note", Note(5, "Dr. Weber", "250 mL").encode())
            self.publisher.put("event", event_bytes(0, 5, "over"), event_json(0, 5, "over"))
            last = f"{parameter_values(times[-1])[0]:#.4g}"
            seen = self.read_until(process, lambda line: "0.980 s" in line and last in line)
            code, complaints = self.interrupt(process)
        self.assertEqual(code, 0, complaints)
        self.assertIn("bed1  0.000 s  EVENT gap p_a: over", seen)
        alarms = [line for line in seen if "  ALARM high" in line]
        self.assertEqual(alarms, ["bed1  0.000 s  ALARM high low output: active: too little"], "said again is no news")
        self.assertIn("bed1  0.000 s  NOTE by Dr. Weber: 250 mL", seen)
        self.assertIn("ALARM low output", seen[-1])
        self.assertEqual(seen.count(BEAT_LINE), 1)
        self.assertIn("lag p99 3.2 ms", seen[-1])
        self.assertRegex(complaints, r"\b(9[89]|10\d) pairs compared, 0 differ, 0 messages without twin")
        self.assertIn("50 rows of bed1 written, 0 without parameters", complaints)
        self.assertEqual(self.lines(), [HEADER_ROW, *map(expected_row, times)])

    def test_json_alone(self) -> None:
        with self.subscriber("--format", "json", "--bed", "bed1") as process:
            self.publish(1, 1_000_000_000)
            self.publisher.put("estimate/state", b"not decoded", state_json(1, 5), bed="bed2")
            seen = self.read_until(process, lambda line: "P_a" in line and "r_pv" in line)
            code, complaints = self.interrupt(process)
        self.assertEqual(code, 0, complaints)
        self.assertFalse([line for line in seen if "bed2" in line])
        self.assertIn("P_a 2.7 [4.3, 4.7]", seen[-1])

    def test_twin_that_differs(self) -> None:
        with self.subscriber("--format", "both") as process:
            self.publisher.put("event", event_bytes(0, 5, "one"), event_json(0, 5, "two"))
            self.publisher.put("event", event_bytes(1, 6, "same"), event_json(1, 6, "same"))
            self.read_until(process, lambda line: "same" in line)
            # The next line per second comes after the twin of the last event was there too.
            self.read_until(process, lambda line: "no state yet" in line)
            code, complaints = self.interrupt(process)
        self.assertEqual(code, 1)
        self.assertIn("sequence 0: bincode and JSON differ in text: 'one' against 'two'", complaints)
        self.assertIn("failed: 1 messages differ from their JSON twin", complaints)

    def test_file_holds_one_bed(self) -> None:
        with self.subscriber("--csv", str(self.csv)) as process:
            for bed in ("bed2", "bed1", "bed3"):
                self.publisher.put("estimate/state", state_bytes(1, 10), bed=bed)
                self.publisher.put("estimate/parameters", parameter_bytes(1, 10), bed=bed)
            self.read_until(process, lambda line: line.startswith("bed3") and "r_pv" in line)
            code, complaints = self.interrupt(process)
        self.assertEqual(code, 0, complaints)
        self.assertEqual(complaints.count("is not written: the file holds bed2"), 1)
        self.assertIn("4 messages of other beds not written to the file", complaints)
        self.assertEqual(self.lines(), [HEADER_ROW, expected_row(10)])

    def test_columns_that_change_end_the_run(self) -> None:
        with self.subscriber("--csv", str(self.csv)) as process:
            self.publish(1, 10)
            self.publisher.put("estimate/parameters", parameter_bytes(2, 20, ("c_a",)))
            _, complaints = process.communicate(timeout=PATIENCE_S)
        self.assertEqual(process.returncode, 1)
        self.assertRegex(complaints, "--csv .*: parameters changed from .*r_pv.* to .*c_a.*: begin another file")
        self.assertEqual(self.lines(), [HEADER_ROW, expected_row(10)])

    def test_twins_that_never_come(self) -> None:
        with self.subscriber("--format", "both") as process:
            self.publisher.put("event", event_bytes(0, 5, "alone"))
            self.read_until(process, lambda line: "alone" in line)
            code, complaints = self.interrupt(process)
        self.assertEqual(code, 1)
        self.assertIn("no message came together with its JSON twin", complaints)

    def test_garbage_is_reported_and_passed_over(self) -> None:
        with self.subscriber() as process:
            self.publisher.put("event", b"\x02\x00garbage")
            self.publisher.put("event", b"\x09\x00")
            self.publisher.put("event", event_bytes(0, 5, "sound"))
            self.read_until(process, lambda line: "sound" in line)
            code, complaints = self.interrupt(process)
        self.assertEqual(code, 1)
        self.assertIn("schema version 9, this module reads 2", complaints)
        self.assertIn("failed: 2 undecodable messages", complaints)

    def test_nothing_to_hear(self) -> None:
        done = run_subscriber("--connect", self.publisher.endpoint, "--seconds", "0.3")
        self.assertEqual(done.returncode, 1)
        self.assertIn("nothing received within 0.3 s under hemostream/*/estimate/state", done.stderr)

    def test_reader_that_leaves(self) -> None:
        with self.subscriber() as process:
            assert process.stdout is not None and process.stderr is not None
            process.stdout.close()
            deadline_s = time.monotonic() + PATIENCE_S
            while process.poll() is None and time.monotonic() < deadline_s:
                self.publisher.put("event", event_bytes(0, time.monotonic_ns(), "unheard"))
                time.sleep(0.01)
            self.assertEqual((process.poll(), process.stderr.read()), (0, ""))


class CommandLine(InDirectory):
    def test_help_has_an_example(self) -> None:
        done = run_subscriber("--help")
        self.assertEqual(done.returncode, 0)
        self.assertIn("python tools/subscribe.py --bed bed1 --csv bed1.csv", done.stdout)

    def run_here(self, arguments: list[str]) -> tuple[Any, str]:
        """In this process, because a process for each case takes long."""
        for number in (signal.SIGINT, signal.SIGTERM):
            self.addCleanup(signal.signal, number, signal.getsignal(number))
        with contextlib.redirect_stderr(io.StringIO()) as complaints:
            try:
                return subscribe.main(arguments), complaints.getvalue()
            except SystemExit as left:
                return left.code, complaints.getvalue()

    def test_wrong_usage(self) -> None:
        cases = [
            (["--seconds", "0"], "expected a positive number"),
            (["--seconds", "nan"], "expected a positive number"),
            (["--format", "xml"], "invalid choice"),
            (["--connect", "localhost"], "--connect `localhost`, expected PROTOCOL/ADDRESS"),
            (["--prefix", "/a"], "--prefix `/a`: Invalid Key Expr"),
            (["--prefix", "a/**"], "wildcard"),
            (["--bed", "a/b"], "has a `/`"),
            (["--bed", "*"], "wildcard"),
            (["--csv", str(self.csv / "below")], "No such file or directory"),
        ]
        for arguments, message in cases:
            with self.subTest(arguments=arguments):
                code, complaints = self.run_here(arguments)
                self.assertEqual(code, 2, complaints)
                self.assertIn(message, complaints)

    def test_no_router(self) -> None:
        with socket.socket() as taken:
            # Bound but not listening: nobody else can answer there.
            taken.bind(("127.0.0.1", 0))
            endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
            done = run_subscriber("--connect", endpoint)
        self.assertEqual(done.returncode, 1)
        self.assertIn(f"{endpoint}: Unable to connect", done.stderr)
        self.assertNotIn("Traceback", done.stderr)


if __name__ == "__main__":
    unittest.main()
