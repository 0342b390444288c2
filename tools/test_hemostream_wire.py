"""Tests of the wire schema against byte strings assembled by hand: `python -m unittest discover tools`."""

from __future__ import annotations

import json
import math
import re
import struct
import unittest
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from hemostream_wire import (
    BEAT_STATISTICS,
    FLAG_LAST_BLOCK,
    MAX_PAYLOAD_BYTES,
    PARAMETER_STATISTICS,
    STATE_STATISTICS,
    Acknowledge,
    Alarm,
    Alarms,
    BeatEstimate,
    Beats,
    ChannelStatus,
    Event,
    Malformed,
    Members,
    Note,
    ParameterEstimate,
    PressureBlock,
    StateEstimate,
    Status,
    TooLong,
    Truth,
    WireError,
    WrongSchema,
    decode,
    differences,
    from_json,
)

README = Path(__file__).resolve().parent.parent / "README.md"


def u64(value: int) -> bytes:
    return struct.pack("<Q", value)


def f64(*values: float) -> bytes:
    return struct.pack(f"<{len(values)}d", *values)


def text(value: str) -> bytes:
    return u64(len(value.encode())) + value.encode()


def floats(*values: float) -> bytes:
    return u64(len(values)) + f64(*values)


def texts(*values: str) -> bytes:
    return u64(len(values)) + b"".join(map(text, values))


# schema 2, seed 42, configuration hash 0x0123456789abcdef, sequence 7, time 1.5 s
HEADER = bytes.fromhex("0200 2a00000000000000 efcdab8967452301 0700000000000000 002f685900000000")
HEADER_JSON = {
    "schema": 2,
    "seed": 42,
    "config_hash": "0123456789abcdef",
    "sequence": 7,
    "time_ns": 1_500_000_000,
}

# One sample of 80.5 mmHg every 8 ms from 2 s on, twice.
BLOCK = bytes.fromhex(
    "0200"  # schema
    "0300000000000000"  # sequence
    "01000000"  # flags
    "0094357700000000"  # start_ns
    "00127a0000000000"  # period_ns
    "0000000000000000"  # no offsets
    "0200000000000000 0000000000205440 0000000000205440"  # values
)

# Quantities p_pa, p_a (not in alphabetical order) at two times; 28 numbers.
STATE = (
    HEADER
    + bytes.fromhex("64000000")
    + bytes.fromhex("0200000000000000 002f685900000000 c0597a5900000000")
    + floats(0.0, 0.25)
    + texts("p_pa", "p_a")
    + floats(*range(28))
)
STATE_JSON = HEADER_JSON | {
    "members": 100,
    "times_ns": [1_500_000_000, 1_501_190_592],
    "since_data_s": [0.0, 0.25],
    "names": ["p_a", "p_pa"],
    "quantities": {
        "p_a": {s: [7.0 + i, 21.0 + i] for i, s in enumerate(STATE_STATISTICS)},
        "p_pa": {s: [0.0 + i, 14.0 + i] for i, s in enumerate(STATE_STATISTICS)},
    },
}

PARAMETER = HEADER + bytes.fromhex("63000000") + texts("r_pv", "c_a") + floats(*range(6), 1, *range(6, 11), math.nan, 0)
PARAMETER_JSON: dict[str, Any] = HEADER_JSON | {
    "members": 99,
    "names": ["r_pv", "c_a"],
    "parameters": {
        "c_a": {
            "mean": 6.0,
            "sd": 7.0,
            "q05": 8.0,
            "q95": 9.0,
            "identifiability": 10.0,
            "since_informed_s": None,
            "identifiable": False,
        },
        "r_pv": {
            "mean": 0.0,
            "sd": 1.0,
            "q05": 2.0,
            "q95": 3.0,
            "identifiability": 4.0,
            "since_informed_s": 5.0,
            "identifiable": True,
        },
    },
}

# From 1.5 s to 2.25 s.
BEAT = (
    HEADER
    + bytes.fromhex("64000000")
    + bytes.fromhex("80461c8600000000")
    + texts("heart_rate", "ejection_fraction")
    + texts("bpm", "")
    + floats(80, 0.5, 79, 81, 0.6, math.nan, 0.55, 0.65)
)
BEAT_JSON: dict[str, Any] = HEADER_JSON | {
    "members": 100,
    "end_ns": 2_250_000_000,
    "names": ["heart_rate", "ejection_fraction"],
    "quantities": {
        "ejection_fraction": {"mean": 0.6, "sd": None, "q05": 0.55, "q95": 0.65, "unit": ""},
        "heart_rate": {"mean": 80.0, "sd": 0.5, "q05": 79.0, "q95": 81.0, "unit": "bpm"},
    },
}

BEATS = bytes.fromhex("0200 0200000000000000 002f685900000000 ffffffffffffffff")
BEATS_JSON = {"schema": 2, "onsets_ns": [1_500_000_000, -1]}

MEMBERS = HEADER + texts("p_l", "p_a", "r_pv") + floats(1, 2, 3, 4, 5, 6)
MEMBERS_JSON = HEADER_JSON | {"names": ["p_l", "p_a", "r_pv"], "members": [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]}

STATUS = (
    HEADER
    + struct.pack("<II", 98, 100)
    + u64(5000)
    + u64(12)
    + f64(0.5, 3.25, 9.0, 0.75, 2.5)
    + u64(4)
    + struct.pack("<I", 17)
    + u64(2)
    + text("late")
    + u64(3)
    + text("duplicate")
    + u64(1)
    + u64(1)
    + text("p_a")
    + text("live")
    + struct.pack("<q", 1_499_000_000)
    + u64(4988)
    + f64(math.nan, 1.5, 1.25, 0.875)
    + b"\x01"
    + text("flat")
    + u64(2)
    + text("p_l")
    + f64(0.25)
    + text("c_a")
    + f64(math.nan)
)
STATUS_JSON: dict[str, Any] = HEADER_JSON | {
    "members_alive": 98,
    "members": 100,
    "windows": 5000,
    "windows_without_data": 12,
    "lag_p50_ms": 0.5,
    "lag_p99_ms": 3.25,
    "lag_max_ms": 9.0,
    "solve_ms": 0.75,
    "iterations": 2.5,
    "not_converged": 4,
    "queue_depth": 17,
    "counters": {"duplicate": 1, "late": 3},
    "channels": [
        {
            "name": "p_a",
            "state": "live",
            "last_sample_ns": 1_499_000_000,
            "samples_used": 4988,
            "innovation_rms": None,
            "noise_sd": 1.5,
            "whiteness": 1.25,
            "recurrence": 0.875,
            "misfit": True,
            "artefact": "flat",
        }
    ],
    "disagreement": {"c_a": None, "p_l": 0.25},
}

EVENT = HEADER + bytes.fromhex("0300000000000000") + b"gap" + text("p_a") + text("nichts für 2 s")
EVENT_JSON = HEADER_JSON | {"kind": "gap", "channel": "p_a", "text": "nichts für 2 s"}

# Active and seen; and one that has not seen anything yet.
ALARMS = (
    HEADER
    + u64(2)
    + text("low output")
    + text("cardiac_output")
    + text("L/min")
    + text("high")
    + text("active")
    + b"\x01"
    + text("below")
    + f64(4.0)
    + struct.pack("<q", 1_490_000_000)
    + f64(3.2, 2.9, 3.5)
    + text("cardiac output below 4 L/min")
    + text("weak heart")
    + text("ejection_fraction")
    + text("")
    + text("low")
    + text("normal")
    + b"\x00"
    + text("above")
    + f64(0.8)
    + struct.pack("<q", -1)
    + f64(math.nan, math.nan, math.nan)
    + text("")
)
ALARMS_JSON: dict[str, Any] = HEADER_JSON | {
    "alarms": [
        {
            "name": "low output",
            "quantity": "cardiac_output",
            "unit": "L/min",
            "priority": "high",
            "state": "active",
            "acknowledged": True,
            "side": "below",
            "limit": 4.0,
            "since_ns": 1_490_000_000,
            "band": [3.2, 2.9, 3.5],
            "text": "cardiac output below 4 L/min",
        },
        {
            "name": "weak heart",
            "quantity": "ejection_fraction",
            "unit": "",
            "priority": "low",
            "state": "normal",
            "acknowledged": False,
            "side": "above",
            "limit": 0.8,
            "since_ns": -1,
            "band": [None, None, None],
            "text": "",
        },
    ]
}

ACKNOWLEDGE = bytes.fromhex("0200") + text("low output") + text("Dr. Müller")
ACKNOWLEDGE_JSON = {"schema": 2, "alarm": "low output", "author": "Dr. Müller"}

NOTE = bytes.fromhex("0200 002f685900000000") + text("") + text("250 mL")
NOTE_JSON = {"schema": 2, "time_ns": 1_500_000_000, "author": "", "text": "250 mL"}

TRUTH = bytes.fromhex("0200 ffffffffffffffff") + texts("p_a", "r_pv") + floats(91.5, 0.08)
TRUTH_JSON = {"schema": 2, "time_ns": -1, "names": ["p_a", "r_pv"], "values": {"p_a": 91.5, "r_pv": 0.08}}

BLOCK_JSON = {
    "schema": 2,
    "sequence": 3,
    "flags": 1,
    "start_ns": 2_000_000_000,
    "period_ns": 8_000_000,
    "values": [80.5, 80.5],
}

ALL: list[tuple[type[Any], bytes, dict[str, Any]]] = [
    (PressureBlock, BLOCK, BLOCK_JSON),
    (StateEstimate, STATE, STATE_JSON),
    (ParameterEstimate, PARAMETER, PARAMETER_JSON),
    (BeatEstimate, BEAT, BEAT_JSON),
    (Beats, BEATS, BEATS_JSON),
    (Members, MEMBERS, MEMBERS_JSON),
    (Status, STATUS, STATUS_JSON),
    (Event, EVENT, EVENT_JSON),
    (Alarms, ALARMS, ALARMS_JSON),
    (Acknowledge, ACKNOWLEDGE, ACKNOWLEDGE_JSON),
    (Note, NOTE, NOTE_JSON),
    (Truth, TRUTH, TRUTH_JSON),
]


def parameter_json(statistic: str, value: Any) -> dict[str, Any]:
    """The JSON of one parameter, with one statistic replaced."""
    parameters = {"r_pv": PARAMETER_JSON["parameters"]["r_pv"] | {statistic: value}}
    return PARAMETER_JSON | {"names": ["r_pv"], "parameters": parameters}


def beat_json(statistic: str, value: Any) -> dict[str, Any]:
    """The JSON of one clinical quantity, with one statistic replaced."""
    quantities = {"heart_rate": BEAT_JSON["quantities"]["heart_rate"] | {statistic: value}}
    return BEAT_JSON | {"names": ["heart_rate"], "quantities": quantities}


class Contents(unittest.TestCase):
    def test_header(self) -> None:
        header = decode(Event, EVENT).header
        self.assertEqual((header.schema, header.seed, header.config_hash), (2, 42, 0x0123456789ABCDEF))
        self.assertEqual((header.sequence, header.time_ns), (7, 1_500_000_000))

    def test_pressure_block(self) -> None:
        block = decode(PressureBlock, BLOCK)
        self.assertEqual((block.sequence, block.flags), (3, FLAG_LAST_BLOCK))
        np.testing.assert_array_equal(block.times_ns(), [2_000_000_000, 2_008_000_000])
        np.testing.assert_array_equal(block.values, [80.5, 80.5])

    def test_pressure_block_is_encoded_as_it_is_decoded(self) -> None:
        self.assertEqual(decode(PressureBlock, BLOCK).encode(), BLOCK)
        offsets_ns, values = np.array([0, 3, 10]), np.array([1.0, math.nan, -math.inf])
        payload = PressureBlock(9, -5, 0, values, offsets_ns).encode()
        block = decode(PressureBlock, payload)
        self.assertEqual(block.encode(), payload)
        np.testing.assert_array_equal(block.times_ns(), [-5, -2, 5])
        np.testing.assert_array_equal(block.values, values)

    def test_the_readme_publishes_blocks_as_they_are_read(self) -> None:
        code = re.search(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
        self.assertIsNotNone(code)
        zenoh = mock.MagicMock()
        names = {"blocks_of_your_monitor": lambda: [[80.5, 81.5]]}
        with mock.patch.dict("sys.modules", zenoh=zenoh):
            exec(code[1] if code else "", names)
        (key, payload), options = zenoh.open.return_value.__enter__.return_value.put.call_args
        self.assertRegex(key, r"^hemostream/[^/]+/pressure/ABP$")
        self.assertEqual(options, {"encoding": "application/json"})
        block = from_json(PressureBlock, payload)
        np.testing.assert_array_equal(block.values, [80.5, 81.5])
        self.assertEqual(list(np.diff(block.times_ns())), [8_000_000])

    def test_pressure_block_refuses_what_does_not_fit(self) -> None:
        with self.assertRaisesRegex(Malformed, "2 offsets for 1 samples"):
            PressureBlock(0, 0, 0, np.zeros(1), np.zeros(2, dtype=np.int64))
        with self.assertRaisesRegex(Malformed, "does not fit"):
            PressureBlock(-1, 0, 0, np.zeros(1)).encode()
        with self.assertRaises(TooLong):
            PressureBlock(0, 0, 0, np.zeros(MAX_PAYLOAD_BYTES // 8)).encode()

    def test_state(self) -> None:
        state = decode(StateEstimate, STATE)
        self.assertEqual((state.members, state.names), (100, ("p_pa", "p_a")))
        np.testing.assert_array_equal(state.times_ns, [1_500_000_000, 1_501_190_592])
        np.testing.assert_array_equal(state.since_data_s, [0.0, 0.25])
        np.testing.assert_array_equal(state.values, np.arange(28.0).reshape(2, 2, 7))
        np.testing.assert_array_equal(state.series("p_a", "q95"), [13.0, 27.0])
        self.assertTrue(state.values.flags.aligned and state.values.flags.writeable)

    def test_parameters(self) -> None:
        parameters = decode(ParameterEstimate, PARAMETER)
        self.assertEqual((parameters.members, parameters.names), (99, ("r_pv", "c_a")))
        self.assertEqual(parameters.values.shape, (2, 7))
        self.assertEqual(parameters.value("c_a", "mean"), 6.0)
        self.assertTrue(math.isnan(parameters.value("c_a", "since_informed_s")))
        twin = from_json(ParameterEstimate, json.dumps(PARAMETER_JSON))
        for side in (parameters, twin):
            self.assertEqual([side.is_identifiable(name) for name in ("r_pv", "c_a")], [True, False])

    def test_smoothed_state_has_parameters_too(self) -> None:
        lengths = bytes(4) + u64(1) + u64(0) + floats(0.0)
        smoothed = decode(StateEstimate, HEADER + lengths + texts("p_a", "r_pv") + floats(*range(14)))
        np.testing.assert_array_equal(smoothed.series("r_pv", "mean"), [7.0])

    def test_beat(self) -> None:
        beat = decode(BeatEstimate, BEAT)
        self.assertEqual((beat.header.time_ns, beat.end_ns, beat.members), (1_500_000_000, 2_250_000_000, 100))
        self.assertEqual(beat.names, ("heart_rate", "ejection_fraction"))
        self.assertEqual((beat.unit("heart_rate"), beat.unit("ejection_fraction")), ("bpm", ""))
        self.assertEqual([beat.value("heart_rate", s) for s in BEAT_STATISTICS], [80.0, 0.5, 79.0, 81.0])
        self.assertEqual(beat.value("ejection_fraction", "q95"), 0.65)

    def test_beats_are_encoded_as_they_are_decoded(self) -> None:
        beats = decode(Beats, BEATS)
        np.testing.assert_array_equal(beats.onsets_ns, [1_500_000_000, -1])
        self.assertEqual(beats.encode(), BEATS)
        self.assertEqual(Beats(np.array([1_500_000_000, -1])).encode(), BEATS)
        with self.assertRaises(TooLong):
            Beats(np.zeros(MAX_PAYLOAD_BYTES // 8, dtype=np.int64)).encode()

    def test_members(self) -> None:
        members = decode(Members, MEMBERS)
        self.assertEqual(members.names, ("p_l", "p_a", "r_pv"))
        np.testing.assert_array_equal(members.values, [[1, 2, 3], [4, 5, 6]])

    def test_alarms(self) -> None:
        low, weak = decode(Alarms, ALARMS).alarms
        self.assertEqual((low.name, low.quantity, low.unit), ("low output", "cardiac_output", "L/min"))
        self.assertEqual(low.priority, "high")
        self.assertEqual((low.state, low.acknowledged, low.side, low.limit), ("active", True, "below", 4.0))
        self.assertEqual((low.since_ns, low.band), (1_490_000_000, (3.2, 2.9, 3.5)))
        self.assertEqual(low.text, "cardiac output below 4 L/min")
        self.assertEqual((weak.state, weak.acknowledged, weak.since_ns), ("normal", False, -1))
        self.assertTrue(all(map(math.isnan, weak.band)))

    def test_alarm_has_a_band_of_three(self) -> None:
        for band in ([1.0, 2.0], [1.0, 2.0, 3.0, 4.0]):
            with self.subTest(band=band), self.assertRaisesRegex(Malformed, "`band` has . entries, expected 3"):
                Alarm.read_json(ALARMS_JSON["alarms"][0] | {"band": band})

    def test_acknowledge_and_note_are_encoded_as_they_are_decoded(self) -> None:
        seen = decode(Acknowledge, ACKNOWLEDGE)
        self.assertEqual((seen.alarm, seen.author), ("low output", "Dr. Müller"))
        self.assertEqual(Acknowledge("low output", "Dr. Müller").encode(), ACKNOWLEDGE)
        self.assertEqual(Acknowledge().encode(), bytes.fromhex("0200") + u64(0) + u64(0))
        note = decode(Note, NOTE)
        self.assertEqual((note.time_ns, note.author, note.text), (1_500_000_000, "", "250 mL"))
        self.assertEqual(note.encode(), NOTE)
        with self.assertRaises(TooLong):
            Note(0, "", "x" * MAX_PAYLOAD_BYTES).encode()
        with self.assertRaisesRegex(Malformed, "does not fit"):
            Note(1 << 63, "", "").encode()

    def test_status(self) -> None:
        status = decode(Status, STATUS)
        self.assertEqual((status.members_alive, status.members, status.windows_without_data), (98, 100, 12))
        self.assertEqual((status.lag_p50_ms, status.lag_p99_ms, status.lag_max_ms), (0.5, 3.25, 9.0))
        self.assertEqual((status.solve_ms, status.iterations, status.not_converged), (0.75, 2.5, 4))
        self.assertEqual((status.queue_depth, status.counters), (17, {"late": 3, "duplicate": 1}))
        channel = status.channels[0]
        self.assertEqual((channel.name, channel.state, channel.samples_used), ("p_a", "live", 4988))
        self.assertEqual(channel.last_sample_ns, 1_499_000_000)
        self.assertEqual((channel.noise_sd, channel.whiteness, channel.recurrence), (1.5, 1.25, 0.875))
        self.assertEqual((channel.misfit, channel.artefact), (True, "flat"))
        self.assertEqual((list(status.disagreement), status.disagreement["p_l"]), (["p_l", "c_a"], 0.25))

    def test_shortest_elements_fit_their_least_length(self) -> None:
        channel = bytes(ChannelStatus.MIN_BYTES)
        head = STATUS[: STATUS.index(text("late")) - 8]
        status = decode(Status, head + u64(1) + bytes(16) + u64(1) + channel + u64(1) + bytes(16))
        self.assertEqual((status.counters, status.disagreement), ({"": 0}, {"": 0.0}))
        self.assertEqual((status.channels[0].misfit, status.channels[0].artefact), (False, ""))
        with self.assertRaisesRegex(Malformed, "length 2 at byte [0-9]+ needs 146 bytes, 145 are left"):
            decode(Status, head + u64(0) + u64(2) + bytes(145))

    def test_event(self) -> None:
        event = decode(Event, EVENT)
        self.assertEqual((event.kind, event.channel, event.text), ("gap", "p_a", "nichts für 2 s"))

    def test_truth(self) -> None:
        truth = decode(Truth, TRUTH)
        self.assertEqual((truth.time_ns, truth.names), (-1, ("p_a", "r_pv")))
        np.testing.assert_array_equal(truth.values, [91.5, 0.08])

    def test_empty_lists(self) -> None:
        state = decode(StateEstimate, HEADER + bytes(4) + u64(0) * 4)
        self.assertEqual(state.values.shape, (0, 0, 7))
        self.assertEqual(decode(ParameterEstimate, HEADER + bytes(4) + u64(0) * 2).values.shape, (0, 7))
        self.assertEqual(decode(BeatEstimate, HEADER + bytes(4 + 8) + u64(0) * 3).values.shape, (0, 4))
        self.assertEqual(len(decode(Beats, BEATS[:2] + u64(0)).onsets_ns), 0)
        self.assertEqual(decode(Members, HEADER + u64(0) * 2).values.shape, (0, 0))


class Refusals(unittest.TestCase):
    def test_every_truncation(self) -> None:
        for kind, payload, _ in ALL:
            for length in range(len(payload)):
                with self.subTest(kind=kind.__name__, length=length), self.assertRaises(Malformed):
                    decode(kind, payload[:length])

    def test_truncation_says_where(self) -> None:
        with self.assertRaisesRegex(Malformed, "u64 at byte 2 needs 8 bytes, 1 are left"):
            decode(Event, EVENT[:3])

    def test_trailing_bytes(self) -> None:
        for kind, payload, _ in ALL:
            with self.subTest(kind=kind.__name__), self.assertRaisesRegex(Malformed, "2 bytes left over"):
                decode(kind, payload + b"\0\0")

    def test_other_schema(self) -> None:
        for kind, payload, body in ALL:
            with self.subTest(kind=kind.__name__):
                with self.assertRaisesRegex(WrongSchema, "schema version 513, this module reads 2"):
                    decode(kind, b"\x01\x02" + payload[2:])
                # Looked at before anything else: what follows may be of any form.
                with self.assertRaises(WrongSchema):
                    decode(kind, b"\x01\x00")
                with self.assertRaises(WrongSchema):
                    from_json(kind, json.dumps(body | {"schema": 1}))

    def test_too_long(self) -> None:
        with self.assertRaises(TooLong):
            decode(Event, bytes(MAX_PAYLOAD_BYTES + 1))
        with self.assertRaises(TooLong):
            from_json(Event, " " * (MAX_PAYLOAD_BYTES + 1))

    def test_astronomical_length_is_refused_before_it_is_allocated(self) -> None:
        with self.assertRaisesRegex(Malformed, "length 18446744073709551615"):
            decode(Event, HEADER + b"\xff" * 8 + b"gap")
        with self.assertRaises(Malformed):
            decode(Members, HEADER + u64(1 << 40) + bytes(64))

    def test_wrong_shapes(self) -> None:
        with self.assertRaisesRegex(Malformed, "`values` has 11 entries, expected 2 x 7"):
            decode(ParameterEstimate, HEADER + bytes(4) + texts("r_pv", "c_a") + floats(*range(11)))
        with self.assertRaisesRegex(Malformed, "`values` has 5 entries, expected 2 x 2"):
            decode(Members, HEADER + texts("p_a", "p_l") + floats(*range(5)))
        beat = HEADER + bytes(4 + 8)
        with self.assertRaisesRegex(Malformed, "`values` has 5 entries, expected 1 x 4"):
            decode(BeatEstimate, beat + texts("svr") + texts("mmHg s/mL") + floats(*range(5)))
        with self.assertRaisesRegex(Malformed, "0 units for 1 names"):
            decode(BeatEstimate, beat + texts("svr") + texts() + floats(*range(4)))
        with self.assertRaisesRegex(Malformed, "since_data_s"):
            decode(StateEstimate, HEADER + bytes(4) + u64(0) + floats(1.0) + u64(0) * 2)
        with self.assertRaisesRegex(Malformed, "1 offsets for 2 samples"):
            decode(PressureBlock, BLOCK[:30] + u64(1) + u64(0) + BLOCK[38:])

    def test_repeated_name(self) -> None:
        with self.assertRaisesRegex(Malformed, "stands twice"):
            decode(Truth, TRUTH[:10] + texts("p_a", "p_a") + floats(1, 2))
        with self.assertRaisesRegex(Malformed, "stands twice"):
            decode(Status, STATUS.replace(text("c_a"), text("p_l")))

    def test_flags_that_are_neither_true_nor_false(self) -> None:
        misfit = STATUS.index(b"\x01" + text("flat"))
        with self.assertRaisesRegex(Malformed, f"bool at byte {misfit} is 2, expected 0 or 1"):
            decode(Status, STATUS[:misfit] + b"\x02" + STATUS[misfit + 1 :])
        for value in (0.5, math.nan):
            payload = HEADER + bytes(4) + texts("r_pv") + floats(*range(6), value)
            with self.assertRaisesRegex(Malformed, "`identifiable` holds .*, expected 0 or 1"):
                decode(ParameterEstimate, payload)

    def test_string_that_is_not_utf8(self) -> None:
        with self.assertRaisesRegex(Malformed, "not UTF-8"):
            decode(Event, HEADER + u64(1) + b"\xff" + text("") + text(""))

    def test_json(self) -> None:
        cases: list[tuple[type[Any], Any, str]] = [
            (Event, "{", "not JSON"),
            (Event, "[]", "not a JSON object"),
            (Event, b"\xff\xff", "not JSON"),
            (Event, '{"schema": 2, "time_ns": ' + "9" * 5000 + "}", "not JSON"),
            (Event, {}, "no `schema`"),
            (Event, EVENT_JSON | {"kind": 3}, "`kind` is 3, expected a string"),
            (Event, EVENT_JSON | {"seed": True}, "`seed` is True"),
            (Event, EVENT_JSON | {"time_ns": 1 << 64}, "beyond 64 bits"),
            (Event, EVENT_JSON | {"config_hash": "xyz"}, "hexadecimal"),
            (Event, json.dumps(EVENT_JSON | {"seed": math.nan}), "NaN"),
            (StateEstimate, STATE_JSON | {"times_ns": [1.5]}, "`times_ns` holds something"),
            (StateEstimate, STATE_JSON | {"times_ns": [1]}, "entries, expected 1"),
            (StateEstimate, STATE_JSON | {"names": ["p_a"], "quantities": {"p_a": {}}}, "no `mean`"),
            (ParameterEstimate, PARAMETER_JSON | {"names": ["c_a"], "parameters": {"c_a": {"mean": 1.0}}}, "no `sd`"),
            (Members, MEMBERS_JSON | {"members": [[1.0]]}, "list of 3 numbers"),
            (Members, MEMBERS_JSON | {"members": [[1.0, "2.0", 3.0]]}, "expected a number"),
            (ParameterEstimate, parameter_json("identifiable", 1.0), "`identifiable` is 1.0, expected true or false"),
            (ParameterEstimate, parameter_json("mean", True), "expected a number"),
            (BeatEstimate, beat_json("unit", None), "`unit` is None, expected a string"),
            (BeatEstimate, beat_json("q05", "79"), "expected a number"),
            (BeatEstimate, BEAT_JSON | {"names": ["heart_rate"]}, "not those of the numbers"),
            (Beats, BEATS_JSON | {"onsets_ns": [1.5]}, "`onsets_ns` holds something"),
            (Status, STATUS_JSON | {"channels": [1]}, "not an object"),
            (Status, STATUS_JSON | {"channels": [STATUS_JSON["channels"][0] | {"misfit": 1}]}, "expected true"),
            (Status, STATUS_JSON | {"disagreement": []}, "expected an object"),
            (Status, STATUS_JSON | {"disagreement": {"p_l": "far"}}, "expected a number"),
            (Truth, TRUTH_JSON | {"names": ["p_a"], "values": {"p_a": [1]}}, "expected a number"),
            (Truth, TRUTH_JSON | {"names": ["p_a"]}, "not those of the numbers"),
            (PressureBlock, BLOCK_JSON | {"values": [None]}, "expected a number"),
        ]
        for kind, body, message in cases:
            with self.subTest(message=message), self.assertRaisesRegex(WireError, message):
                from_json(kind, body if isinstance(body, str | bytes) else json.dumps(body))


class JsonTwins(unittest.TestCase):
    def test_twins_are_equal(self) -> None:
        for kind, payload, body in ALL:
            with self.subTest(kind=kind.__name__):
                for twin in (json.dumps(body), json.dumps(body).encode()):
                    self.assertEqual(differences(decode(kind, payload), from_json(kind, twin)), [])

    def test_every_changed_number_is_found(self) -> None:
        for kind, payload, body in ALL:
            for path, changed in changes(body):
                # Names that do not fit the numbers are malformed, not different.
                if path == ("schema",) or (path[0] == "names" and kind is not Members):
                    continue
                with self.subTest(kind=kind.__name__, path=path):
                    self.assertNotEqual(differences(decode(kind, payload), from_json(kind, json.dumps(changed))), [])

    def test_nan_and_infinities_are_null(self) -> None:
        for value in (math.nan, math.inf, -math.inf):
            truth = decode(Truth, TRUTH[:10] + texts("p_a") + floats(value))
            twin = from_json(Truth, '{"schema": 2, "time_ns": -1, "names": ["p_a"], "values": {"p_a": null}}')
            self.assertTrue(math.isnan(twin.values[0]))
            self.assertEqual(differences(truth, twin), [])
        self.assertNotEqual(differences(decode(Truth, TRUTH[:10] + texts("p_a") + floats(0.0)), twin), [])

    def test_floats_survive(self) -> None:
        values = np.random.default_rng(1).integers(0, 1 << 64, 2000, dtype=np.uint64).view(np.float64)
        values = values[np.isfinite(values)]
        names = [f"n{i}" for i in range(len(values))]
        truth = decode(Truth, TRUTH[:10] + texts(*names) + floats(*values))
        body = TRUTH_JSON | {"names": names, "values": dict(zip(names, values.tolist(), strict=True))}
        self.assertEqual(differences(truth, from_json(Truth, json.dumps(body))), [])

    def test_missing_and_extra_names_are_found(self) -> None:
        body = TRUTH_JSON | {"names": ["p_a", "c_a"], "values": {"p_a": 91.5, "c_a": 1.0}}
        found = differences(decode(Truth, TRUTH), from_json(Truth, json.dumps(body)))
        self.assertEqual(found, [f"`values.{name}` is on one side only" for name in ("c_a", "r_pv")])

    def test_different_kinds(self) -> None:
        self.assertEqual(differences(decode(Event, EVENT), decode(Truth, TRUTH)), ["Event against Truth"])

    def test_names_keep_their_order(self) -> None:
        quantities = {name: {s: [0.0, 0.0] for s in STATE_STATISTICS} for name in ("a", "p_l", "z")}
        body = STATE_JSON | {"names": ["z", "p_l", "a"], "quantities": quantities}
        self.assertEqual(from_json(StateEstimate, json.dumps(body)).names, ("z", "p_l", "a"))


def changes(body: Any, path: tuple[Any, ...] = ()) -> list[tuple[tuple[Any, ...], Any]]:
    """Copies of a JSON value, each with one number or string changed, and where."""
    if isinstance(body, dict):
        return [(w, body | {key: inner}) for key in body for w, inner in changes(body[key], (*path, key))]
    if isinstance(body, list):
        nested = [(i, change) for i in range(len(body)) for change in changes(body[i], (*path, i))]
        return [(w, [*body[:i], inner, *body[i + 1 :]]) for i, (w, inner) in nested]
    if path == ("config_hash",):
        return [(path, "0123456789abcdee")]
    if body is None:
        return [(path, 0.0)]
    if isinstance(body, bool):
        return [(path, not body)]
    return [(path, body + "x" if isinstance(body, str) else body + 1)]


if __name__ == "__main__":
    unittest.main()
