"""Wire schema v2 of hemostream: what crosses the bus, read with `struct` and numpy alone.

The bytes are bincode 2 with fixed-size little-endian integers and no framing: integers and floats are their
bytes, a list or string is a `u64` length and its elements, fields follow each other in the order declared here.
Every message starts with the schema version. Under KEY/json stands the same content as JSON, arranged by name;
numbers that JSON cannot hold are null there and NaN here.

    state = decode(StateEstimate, payload)             # bytes from PREFIX/BED/estimate/state
    twin = from_json(StateEstimate, json_payload)      # bytes from PREFIX/BED/estimate/state/json
    assert differences(state, twin) == []
    p_a = state.series("p_a", "mean")                  # mmHg, [times]

Units: pressures mmHg, flows mL/s, volumes mL, times as the suffix says. Event times are integers in ns.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Content = dict[str, Any]

SCHEMA = 2
"""Version of everything in this module."""

MAX_PAYLOAD_BYTES = 1 << 20
"""Longest payload that is read [bytes]; also bounds what a corrupt length can allocate."""

FLAG_LAST_BLOCK = 1
"""Bit of `PressureBlock.flags`: the sender will send no more."""

STATE_STATISTICS = ("mean", "sd", "epistemic_sd", "aleatoric_sd", "model_sd", "q05", "q95")
"""Last axis of `StateEstimate.values`."""

PARAMETER_STATISTICS = ("mean", "sd", "q05", "q95", "identifiability", "since_informed_s", "identifiable")
"""Last axis of `ParameterEstimate.values`."""

BEAT_STATISTICS = ("mean", "sd", "q05", "q95")
"""Last axis of `BeatEstimate.values`."""

SMOOTHED_KEY = "estimate/smoothed"
"""Where a `StateEstimate` comes again, corrected by what came in the smoothing lag."""


class WireError(ValueError):
    """A payload that cannot be understood."""


class TooLong(WireError):
    """Longer than `MAX_PAYLOAD_BYTES`."""


class Malformed(WireError):
    """Not the bytes, or not the JSON, of this type."""


class WrongSchema(WireError):
    """Written by another version."""


class Cursor:
    """Reads little-endian fields one after the other and never past the end."""

    def __init__(self, payload: bytes) -> None:
        self._payload = payload
        self._position = 0

    def _advance(self, count: int, what: str) -> int:
        start, left = self._position, len(self._payload) - self._position
        if count > left:
            raise Malformed(f"{what} at byte {start} needs {count} bytes, {left} are left")
        self._position = start + count
        return start

    def _number(self, layout: str, what: str) -> Any:
        return struct.unpack_from(layout, self._payload, self._advance(struct.calcsize(layout), what))[0]

    def boolean(self) -> bool:
        value = int(self._number("<B", "bool"))
        if value > 1:
            raise Malformed(f"bool at byte {self._position - 1} is {value}, expected 0 or 1")
        return value == 1

    def u16(self) -> int:
        return int(self._number("<H", "u16"))

    def u32(self) -> int:
        return int(self._number("<I", "u32"))

    def u64(self) -> int:
        return int(self._number("<Q", "u64"))

    def i64(self) -> int:
        return int(self._number("<q", "i64"))

    def f64(self) -> float:
        return float(self._number("<d", "f64"))

    def length(self, element_bytes: int) -> int:
        """Length of a list whose elements take at least `element_bytes` each."""
        start = self._position
        count = self.u64()
        left = len(self._payload) - self._position
        # Before anything is allocated or looped over: a corrupt length may be astronomical.
        if count * element_bytes > left:
            raise Malformed(f"length {count} at byte {start} needs {count * element_bytes} bytes, {left} are left")
        return count

    def string(self) -> str:
        count = self.length(1)
        start = self._advance(count, "string")
        try:
            return self._payload[start : start + count].decode("utf-8")
        except UnicodeDecodeError as error:
            raise Malformed(f"string at byte {start} is not UTF-8: {error.reason}") from error

    def strings(self) -> tuple[str, ...]:
        return tuple(self.string() for _ in range(self.length(8)))

    def _array(self, layout: str) -> NDArray[Any]:
        count = self.length(8)
        start = self._advance(8 * count, "array")
        # A copy: aligned, native, and independent of the payload's buffer.
        return np.frombuffer(self._payload, dtype=layout, count=count, offset=start).astype(layout[1:])

    def floats(self) -> Floats:
        return self._array("<f8")

    def integers(self) -> Integers:
        return self._array("<i8")

    def finish(self) -> None:
        left = len(self._payload) - self._position
        if left:
            raise Malformed(f"{left} bytes left over")


class Message(Protocol):
    """What every type of this module can do."""

    @classmethod
    def read(cls, cursor: Cursor) -> Self:
        """Reads the fields in the order of the wire."""

    @classmethod
    def read_json(cls, body: Mapping[str, Any]) -> Self:
        """Builds the same from the JSON twin."""

    def content(self) -> Content:
        """What is said, by name and without order: equal for a message and its JSON twin."""


M = TypeVar("M", bound=Message)
T = TypeVar("T")


def decode(kind: type[M], payload: bytes) -> M:
    """Reads the bincode bytes of a message; the schema version is looked at before anything else.

    Raises `TooLong`, `WrongSchema` or `Malformed` (trailing bytes included).
    """
    _check_length(payload)
    _check_schema(Cursor(payload).u16())
    cursor = Cursor(payload)
    message = kind.read(cursor)
    cursor.finish()
    return message


def from_json(kind: type[M], payload: bytes | str) -> M:
    """Reads the JSON twin of a message; raises like `decode`.

    Where the JSON is an object by name, `names` tells the order.
    """
    _check_length(payload)
    try:
        body = json.loads(payload, parse_constant=_no_constant)
    except WireError:
        raise
    except (ValueError, RecursionError) as error:
        raise Malformed(f"not JSON: {error}") from error
    if not isinstance(body, dict):
        raise Malformed("not a JSON object")
    _check_schema(_integer(body, "schema"))
    return kind.read_json(body)


def differences(left: Message, right: Message) -> list[str]:
    """What two messages say differently, in words; empty if nothing.

    NaN and the infinities count as the same, because JSON has one null for them.
    """
    if type(left) is not type(right):
        return [f"{type(left).__name__} against {type(right).__name__}"]
    a, b = left.content(), right.content()
    found = [f"`{name}` is on one side only" for name in sorted(a.keys() ^ b.keys())]
    shared = [name for name in a if name in b]
    return found + [f"{name}: {a[name]!r} against {b[name]!r}" for name in shared if not _same(a[name], b[name])]


@dataclass(frozen=True, eq=False)
class PressureBlock:
    """A block of samples of one channel (key `pressure/CHANNEL`, towards the estimator)."""

    sequence: int
    """Counts the blocks of this channel, so that losses show."""
    start_ns: int
    """Event time of the first sample [ns]."""
    period_ns: int
    """Spacing [ns]; 0 if `offsets_ns` tells the times."""
    values: Floats
    """Samples [mmHg], `[samples]`."""
    offsets_ns: Integers = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    """Time of each sample after `start_ns` [ns], `[samples]`; empty if `period_ns` tells the times."""
    flags: int = 0
    """Bit set of `FLAG_...`."""
    schema: int = SCHEMA

    def __post_init__(self) -> None:
        if len(self.offsets_ns) not in (0, len(self.values)):
            raise Malformed(f"{len(self.offsets_ns)} offsets for {len(self.values)} samples")

    def times_ns(self) -> Integers:
        """Event time of each sample [ns], `[samples]`."""
        if len(self.offsets_ns):
            return self.start_ns + self.offsets_ns
        return self.start_ns + self.period_ns * np.arange(len(self.values), dtype=np.int64)

    def encode(self) -> bytes:
        """The bincode bytes."""
        try:
            head = struct.pack("<HQIqq", self.schema, self.sequence, self.flags, self.start_ns, self.period_ns)
        except struct.error as error:
            raise Malformed(f"a field does not fit: {error}") from error
        payload = head + _encode_array(self.offsets_ns, "<i8") + _encode_array(self.values, "<f8")
        _check_length(payload)
        return payload

    @classmethod
    def read(cls, cursor: Cursor) -> Self:
        return cls(
            schema=cursor.u16(),
            sequence=cursor.u64(),
            flags=cursor.u32(),
            start_ns=cursor.i64(),
            period_ns=cursor.i64(),
            offsets_ns=cursor.integers(),
            values=cursor.floats(),
        )

    @classmethod
    def read_json(cls, body: Mapping[str, Any]) -> Self:
        return cls(
            **{name: _integer(body, name) for name in ("schema", "sequence", "flags", "start_ns", "period_ns")},
            offsets_ns=_integers(body, "offsets_ns") if "offsets_ns" in body else np.zeros(0, dtype=np.int64),
            values=_floats(_list(body, "values"), "values", nullable=False),
        )

    def content(self) -> Content:
        return dict(vars(self))


@dataclass(frozen=True, eq=False)
class Beats:
    """Onsets of heart beats, told by somebody who knows (key `beat`, towards the estimator)."""

    onsets_ns: Integers
    """Event times at which the ventricles began to contract [ns], `[beats]`."""
    schema: int = SCHEMA

    def encode(self) -> bytes:
        """The bincode bytes."""
        payload = struct.pack("<H", self.schema) + _encode_array(self.onsets_ns, "<i8")
        _check_length(payload)
        return payload

    @classmethod
    def read(cls, cursor: Cursor) -> Self:
        return cls(schema=cursor.u16(), onsets_ns=cursor.integers())

    @classmethod
    def read_json(cls, body: Mapping[str, Any]) -> Self:
        return cls(schema=_integer(body, "schema"), onsets_ns=_integers(body, "onsets_ns"))

    def content(self) -> Content:
        return dict(vars(self))


@dataclass(frozen=True)
class Header:
    """What every published message starts with."""

    schema: int
    seed: int
    """Seed of the ensemble."""
    config_hash: int
    """Hash of the effective configuration; 16 hexadecimal digits in JSON."""
    sequence: int
    """Counts the messages under this key; the JSON twin carries the same number."""
    time_ns: int
    """Event time of the (first) content [ns]."""

    @classmethod
    def read(cls, cursor: Cursor) -> Self:
        return cls(cursor.u16(), cursor.u64(), cursor.u64(), cursor.u64(), cursor.i64())

    @classmethod
    def read_json(cls, body: Mapping[str, Any]) -> Self:
        digits = _string(body, "config_hash")
        try:
            config_hash = int(digits, 16)
        except ValueError as error:
            raise Malformed(f"`config_hash` is `{digits}`, expected hexadecimal digits") from error
        seed, sequence, time_ns = (_integer(body, name) for name in ("seed", "sequence", "time_ns"))
        return cls(_integer(body, "schema"), seed, config_hash, sequence, time_ns)

    def content(self) -> Content:
        return dict(vars(self))


@dataclass(frozen=True, eq=False)
class StateEstimate:
    """Pressures, flows and volumes with their uncertainty, at one or more times (key `estimate/state`).

    Under the key `estimate/smoothed` the estimated parameters follow the quantities.
    """

    KEY: ClassVar[str] = "estimate/state"

    header: Header
    members: int
    """Members that took part."""
    times_ns: Integers
    """Event times [ns], `[times]`."""
    since_data_s: Floats
    """Seconds since data last entered the estimate, `[times]`; a forecast where it exceeds a sampling interval."""
    names: tuple[str, ...]
    """Names of the quantities; under `estimate/smoothed` also of the parameters."""
    values: Floats
    """`[times x names x 7]`, the `STATE_STATISTICS` of each in its own unit; q05 and q95 describe the true quantity."""

    def __post_init__(self) -> None:
        if len(self.since_data_s) != len(self.times_ns):
            raise Malformed(f"{len(self.since_data_s)} values of since_data_s for {len(self.times_ns)} times")

    def series(self, name: str, statistic: str) -> Floats:
        """One statistic of one quantity, `[times]`."""
        return self.values[:, self.names.index(name), STATE_STATISTICS.index(statistic)]

    @classmethod
    def read(cls, cursor: Cursor) -> Self:
        header, members = Header.read(cursor), cursor.u32()
        times_ns, since_data_s = cursor.integers(), cursor.floats()
        names = _unique(cursor.strings())
        shape = (len(times_ns), len(names), len(STATE_STATISTICS))
        return cls(header, members, times_ns, since_data_s, names, _shaped(cursor.floats(), shape))

    @classmethod
    def read_json(cls, body: Mapping[str, Any]) -> Self:
        times_ns, quantities = _integers(body, "times_ns"), _object(body, "quantities")
        names = _named(body, quantities)
        values = np.zeros((len(times_ns), len(names), len(STATE_STATISTICS)))
        for q, name in enumerate(names):
            for s, statistic in enumerate(STATE_STATISTICS):
                where = f"{name}.{statistic}"
                series = _floats(_list(_object(quantities, name), statistic), where)
                values[:, q, s] = _shaped(series, (len(times_ns),), where)
        since_data_s = _floats(_list(body, "since_data_s"), "since_data_s")
        return cls(Header.read_json(body), _integer(body, "members"), times_ns, since_data_s, names, values)

    def content(self) -> Content:
        head = {"members": self.members, "times_ns": self.times_ns, "since_data_s": self.since_data_s}
        series = {f"quantities.{n}.{s}": self.series(n, s) for n in self.names for s in STATE_STATISTICS}
        return self.header.content() | head | series


@dataclass(frozen=True, eq=False)
class ParameterEstimate:
    """Estimated parameters (key `estimate/parameters`)."""

    KEY: ClassVar[str] = "estimate/parameters"

    header: Header
    members: int
    """Members that took part."""
    names: tuple[str, ...]
    """Names of the parameters."""
    values: Floats
    """`[names x 7]`, the `PARAMETER_STATISTICS` of each.

    mean, sd, q05 and q95 in the parameter's unit (heart_rate bpm, c_* mL/mmHg, r_* mmHg s/mL, p_th mmHg,
    v0_* and blood_volume mL); identifiability without unit; since_informed_s in s; identifiable is 1 where data
    rather than settings say what the value is, else 0 (true or false in JSON).
    """

    def __post_init__(self) -> None:
        flags = self.values[:, PARAMETER_STATISTICS.index("identifiable")]
        if not np.isin(flags, (0.0, 1.0)).all():
            raise Malformed(f"`identifiable` holds {flags.tolist()!r:.60}, expected 0 or 1")

    def is_identifiable(self, name: str) -> bool:
        """Whether data rather than settings say what the value of a parameter is."""
        return self.value(name, "identifiable") == 1.0

    def value(self, name: str, statistic: str) -> float:
        """One statistic of one parameter."""
        return float(self.values[self.names.index(name), PARAMETER_STATISTICS.index(statistic)])

    @classmethod
    def read(cls, cursor: Cursor) -> Self:
        header, members = Header.read(cursor), cursor.u32()
        names = _unique(cursor.strings())
        return cls(header, members, names, _shaped(cursor.floats(), (len(names), len(PARAMETER_STATISTICS))))

    @classmethod
    def read_json(cls, body: Mapping[str, Any]) -> Self:
        parameters = _object(body, "parameters")
        names = _named(body, parameters)
        rows = [_parameter_row(_object(parameters, n)) for n in names]
        values = _floats([value for row in rows for value in row], "parameters")
        shape = (len(names), len(PARAMETER_STATISTICS))
        return cls(Header.read_json(body), _integer(body, "members"), names, _shaped(values, shape))

    def content(self) -> Content:
        values = {f"parameters.{n}.{s}": self.value(n, s) for n in self.names for s in PARAMETER_STATISTICS}
        return self.header.content() | {"members": self.members} | values


@dataclass(frozen=True, eq=False)
class BeatEstimate:
    """A heart beat that is over (key `estimate/beat`)."""

    KEY: ClassVar[str] = "estimate/beat"

    header: Header
    """Its time is the onset."""
    members: int
    """Members that took part."""
    end_ns: int
    """Event time at which the next beat began [ns]."""
    names: tuple[str, ...]
    """Names of the clinical quantities."""
    units: tuple[str, ...]
    """Their units, `[names]`; empty for a ratio."""
    values: Floats
    """`[names x 4]`, the `BEAT_STATISTICS` of each in its own unit."""

    def __post_init__(self) -> None:
        if len(self.units) != len(self.names):
            raise Malformed(f"{len(self.units)} units for {len(self.names)} names")

    def value(self, name: str, statistic: str) -> float:
        """One statistic of one quantity."""
        return float(self.values[self.names.index(name), BEAT_STATISTICS.index(statistic)])

    def unit(self, name: str) -> str:
        """Unit of one quantity."""
        return self.units[self.names.index(name)]

    @classmethod
    def read(cls, cursor: Cursor) -> Self:
        header, members, end_ns = Header.read(cursor), cursor.u32(), cursor.i64()
        names, units = _unique(cursor.strings()), cursor.strings()
        return cls(header, members, end_ns, names, units, _shaped(cursor.floats(), (len(names), len(BEAT_STATISTICS))))

    @classmethod
    def read_json(cls, body: Mapping[str, Any]) -> Self:
        header, members, end_ns = Header.read_json(body), _integer(body, "members"), _integer(body, "end_ns")
        by_name = _object(body, "quantities")
        names = _named(body, by_name)
        quantities = [_object(by_name, name) for name in names]
        units = tuple(_string(quantity, "unit") for quantity in quantities)
        values = _floats([_required(quantity, s) for quantity in quantities for s in BEAT_STATISTICS], "quantities")
        return cls(header, members, end_ns, names, units, _shaped(values, (len(names), len(BEAT_STATISTICS))))

    def content(self) -> Content:
        units = {f"quantities.{n}.unit": self.unit(n) for n in self.names}
        values = {f"quantities.{n}.{s}": self.value(n, s) for n in self.names for s in BEAT_STATISTICS}
        return self.header.content() | {"members": self.members, "end_ns": self.end_ns} | units | values


@dataclass(frozen=True, eq=False)
class Members:
    """The whole ensemble at one time (key `estimate/members`)."""

    KEY: ClassVar[str] = "estimate/members"

    header: Header
    names: tuple[str, ...]
    """Names of the columns: states [mmHg], then estimated parameters in their units."""
    values: Floats
    """`[members x names]`."""

    @classmethod
    def read(cls, cursor: Cursor) -> Self:
        header, names, values = Header.read(cursor), _unique(cursor.strings()), cursor.floats()
        # The number of members is not on the wire.
        members = len(values) // len(names) if names else 0
        return cls(header, names, _shaped(values, (members, len(names))))

    @classmethod
    def read_json(cls, body: Mapping[str, Any]) -> Self:
        header, names, rows = Header.read_json(body), _strings(body, "names"), _list(body, "members")
        if any(not isinstance(row, list) or len(row) != len(names) for row in rows):
            raise Malformed(f"`members` has a row that is not a list of {len(names)} numbers")
        values = _floats([value for row in rows for value in row], "members")
        return cls(header, _unique(names), _shaped(values, (len(rows), len(names))))

    def content(self) -> Content:
        return self.header.content() | {"names": self.names, "values": self.values}


@dataclass(frozen=True)
class ChannelStatus:
    """One channel in a `Status`."""

    name: str
    """State it observes."""
    state: str
    """live, silent or never."""
    last_sample_ns: int
    """Event time of its last sample [ns]."""
    samples_used: int
    """Samples that entered the estimate."""
    innovation_rms: float
    """Root mean square of the normalised innovations, lately: 1 when model and noise fit."""
    noise_sd: float
    """Noise that the sensor is taken to have [mmHg]."""
    whiteness: float
    """Mean square of sums of neighbouring innovations: 1 when the model fits, more when it is off for a while."""
    recurrence: float
    """Mean square of innovations laid over each other beat by beat: 1 when the model fits."""
    misfit: bool
    """Whether the model no longer fits this channel."""
    artefact: str
    """Why the channel is set aside; empty if it is not."""

    MIN_BYTES: ClassVar[int] = 8 + 8 + 8 + 8 + 4 * 8 + 1 + 8
    """On the wire, with empty strings."""

    @classmethod
    def read(cls, cursor: Cursor) -> Self:
        return cls(
            name=cursor.string(),
            state=cursor.string(),
            last_sample_ns=cursor.i64(),
            samples_used=cursor.u64(),
            innovation_rms=cursor.f64(),
            noise_sd=cursor.f64(),
            whiteness=cursor.f64(),
            recurrence=cursor.f64(),
            misfit=cursor.boolean(),
            artefact=cursor.string(),
        )

    @classmethod
    def read_json(cls, body: Mapping[str, Any]) -> Self:
        return cls(
            name=_string(body, "name"),
            state=_string(body, "state"),
            last_sample_ns=_integer(body, "last_sample_ns"),
            samples_used=_integer(body, "samples_used"),
            innovation_rms=_float(body, "innovation_rms"),
            noise_sd=_float(body, "noise_sd"),
            whiteness=_float(body, "whiteness"),
            recurrence=_float(body, "recurrence"),
            misfit=_boolean(body, "misfit"),
            artefact=_string(body, "artefact"),
        )

    def content(self) -> Content:
        return dict(vars(self))


@dataclass(frozen=True)
class Status:
    """Health of a bed, once a second (key `status`)."""

    KEY: ClassVar[str] = "status"

    header: Header
    members_alive: int
    """Members alive, of those configured."""
    members: int
    """Members configured."""
    windows: int
    """Windows solved since the start."""
    windows_without_data: int
    """Of these, without a sample: forecasts."""
    lag_p50_ms: float
    """From the arrival of the input that closed a window to its estimate, since the start [ms]: median."""
    lag_p99_ms: float
    """The same: 99th percentile."""
    lag_max_ms: float
    """The same: largest."""
    solve_ms: float
    """Mean time to solve a window for all members, lately [ms]."""
    iterations: float
    """Mean Gauss-Newton iterations per member and window."""
    not_converged: int
    """Member-windows whose iteration did not converge."""
    queue_depth: int
    """Inputs waiting."""
    counters: dict[str, int]
    """What was refused or lost, by cause; causes with count 0 are left out."""
    channels: tuple[ChannelStatus, ...]
    """Channels that are observed or configured to be."""
    disagreement: dict[str, float]
    """How far a second filter is from the estimates, by name, in units of both sd together; empty without one."""

    @classmethod
    def read(cls, cursor: Cursor) -> Self:
        return cls(
            header=Header.read(cursor),
            members_alive=cursor.u32(),
            members=cursor.u32(),
            windows=cursor.u64(),
            windows_without_data=cursor.u64(),
            lag_p50_ms=cursor.f64(),
            lag_p99_ms=cursor.f64(),
            lag_max_ms=cursor.f64(),
            solve_ms=cursor.f64(),
            iterations=cursor.f64(),
            not_converged=cursor.u64(),
            queue_depth=cursor.u32(),
            counters=_read_by_name(cursor, cursor.u64),
            channels=tuple(ChannelStatus.read(cursor) for _ in range(cursor.length(ChannelStatus.MIN_BYTES))),
            disagreement=_read_by_name(cursor, cursor.f64),
        )

    @classmethod
    def read_json(cls, body: Mapping[str, Any]) -> Self:
        counters, channels = _object(body, "counters"), _list(body, "channels")
        disagreement = _object(body, "disagreement")
        if not all(isinstance(channel, dict) for channel in channels):
            raise Malformed("`channels` holds something that is not an object")
        return cls(
            header=Header.read_json(body),
            members_alive=_integer(body, "members_alive"),
            members=_integer(body, "members"),
            windows=_integer(body, "windows"),
            windows_without_data=_integer(body, "windows_without_data"),
            lag_p50_ms=_float(body, "lag_p50_ms"),
            lag_p99_ms=_float(body, "lag_p99_ms"),
            lag_max_ms=_float(body, "lag_max_ms"),
            solve_ms=_float(body, "solve_ms"),
            iterations=_float(body, "iterations"),
            not_converged=_integer(body, "not_converged"),
            queue_depth=_integer(body, "queue_depth"),
            counters={cause: _integer(counters, cause) for cause in counters},
            channels=tuple(ChannelStatus.read_json(channel) for channel in channels),
            disagreement={name: _float(disagreement, name) for name in disagreement},
        )

    def content(self) -> Content:
        apart = ("header", "channels", "disagreement")
        own = {name: value for name, value in vars(self).items() if name not in apart}
        channels = {f"channels[{i}].{k}": v for i, c in enumerate(self.channels) for k, v in c.content().items()}
        disagreement = {f"disagreement.{name}": value for name, value in self.disagreement.items()}
        return self.header.content() | own | channels | disagreement


@dataclass(frozen=True)
class Event:
    """Something happened (key `event`)."""

    KEY: ClassVar[str] = "event"

    header: Header
    kind: str
    """start, gap, recovered, restart, rejected, overload, members_lost, ..."""
    channel: str
    """Channel concerned; empty if none."""
    text: str
    """For people."""

    @classmethod
    def read(cls, cursor: Cursor) -> Self:
        return cls(Header.read(cursor), cursor.string(), cursor.string(), cursor.string())

    @classmethod
    def read_json(cls, body: Mapping[str, Any]) -> Self:
        return cls(Header.read_json(body), *(_string(body, name) for name in ("kind", "channel", "text")))

    def content(self) -> Content:
        return self.header.content() | {"kind": self.kind, "channel": self.channel, "text": self.text}


@dataclass(frozen=True)
class Alarm:
    """One alarm of a bed in `Alarms`."""

    name: str
    """Its name in the configuration."""
    quantity: str
    """Quantity, parameter or clinical quantity that it watches."""
    unit: str
    """Unit of `limit` and of the band; empty for a ratio."""
    priority: str
    """low, medium or high."""
    state: str
    """normal, pending (beyond the limit, not yet long enough), active, or latched (over, not acknowledged)."""
    acknowledged: bool
    """Whether an operator has seen it; false unless it is active."""
    side: str
    """below or above."""
    limit: float
    """The limit."""
    since_ns: int
    """Event time since which it is in this state [ns]."""
    band: tuple[float, float, float]
    """The band when it last changed: mean, 5 and 95 % quantile; NaN before anything has happened."""
    text: str
    """For people: what is the matter; empty while it is normal."""

    MIN_BYTES: ClassVar[int] = 7 * 8 + 1 + 8 + 8 + 3 * 8
    """On the wire, with empty strings."""

    @classmethod
    def read(cls, cursor: Cursor) -> Self:
        return cls(
            name=cursor.string(),
            quantity=cursor.string(),
            unit=cursor.string(),
            priority=cursor.string(),
            state=cursor.string(),
            acknowledged=cursor.boolean(),
            side=cursor.string(),
            limit=cursor.f64(),
            since_ns=cursor.i64(),
            band=(cursor.f64(), cursor.f64(), cursor.f64()),
            text=cursor.string(),
        )

    @classmethod
    def read_json(cls, body: Mapping[str, Any]) -> Self:
        band = _shaped(_floats(_list(body, "band"), "band"), (3,), "band")
        return cls(
            name=_string(body, "name"),
            quantity=_string(body, "quantity"),
            unit=_string(body, "unit"),
            priority=_string(body, "priority"),
            state=_string(body, "state"),
            acknowledged=_boolean(body, "acknowledged"),
            side=_string(body, "side"),
            limit=_float(body, "limit"),
            since_ns=_integer(body, "since_ns"),
            band=(float(band[0]), float(band[1]), float(band[2])),
            text=_string(body, "text"),
        )

    def content(self) -> Content:
        return dict(vars(self)) | {"band": np.array(self.band)}


@dataclass(frozen=True)
class Alarms:
    """What stands against the limits of a bed, whenever an alarm changes and with every status (key `alarm`)."""

    KEY: ClassVar[str] = "alarm"

    header: Header
    alarms: tuple[Alarm, ...]
    """One per alarm of the configuration, in its order."""

    @classmethod
    def read(cls, cursor: Cursor) -> Self:
        header = Header.read(cursor)
        return cls(header, tuple(Alarm.read(cursor) for _ in range(cursor.length(Alarm.MIN_BYTES))))

    @classmethod
    def read_json(cls, body: Mapping[str, Any]) -> Self:
        alarms = _list(body, "alarms")
        if not all(isinstance(alarm, dict) for alarm in alarms):
            raise Malformed("`alarms` holds something that is not an object")
        return cls(Header.read_json(body), tuple(Alarm.read_json(alarm) for alarm in alarms))

    def content(self) -> Content:
        alarms = {f"alarms[{i}].{k}": v for i, a in enumerate(self.alarms) for k, v in a.content().items()}
        return self.header.content() | alarms


@dataclass(frozen=True)
class Acknowledge:
    """An operator has seen an alarm (key `acknowledge`, towards the estimator)."""

    alarm: str = ""
    """Name of the alarm; empty for all of the bed."""
    author: str = ""
    """Who; for the record."""
    schema: int = SCHEMA

    def encode(self) -> bytes:
        """The bincode bytes."""
        payload = struct.pack("<H", self.schema) + _encode_string(self.alarm) + _encode_string(self.author)
        _check_length(payload)
        return payload

    @classmethod
    def read(cls, cursor: Cursor) -> Self:
        return cls(schema=cursor.u16(), alarm=cursor.string(), author=cursor.string())

    @classmethod
    def read_json(cls, body: Mapping[str, Any]) -> Self:
        return cls(_string(body, "alarm"), _string(body, "author"), _integer(body, "schema"))

    def content(self) -> Content:
        return dict(vars(self))


@dataclass(frozen=True)
class Note:
    """What an operator says about a bed (key `note`)."""

    KEY: ClassVar[str] = "note"

    time_ns: int
    """Event time that it is about [ns]."""
    author: str
    """Who."""
    text: str
    """What."""
    schema: int = SCHEMA

    def encode(self) -> bytes:
        """The bincode bytes."""
        try:
            head = struct.pack("<Hq", self.schema, self.time_ns)
        except struct.error as error:
            raise Malformed(f"a field does not fit: {error}") from error
        payload = head + _encode_string(self.author) + _encode_string(self.text)
        _check_length(payload)
        return payload

    @classmethod
    def read(cls, cursor: Cursor) -> Self:
        return cls(schema=cursor.u16(), time_ns=cursor.i64(), author=cursor.string(), text=cursor.string())

    @classmethod
    def read_json(cls, body: Mapping[str, Any]) -> Self:
        time_ns, schema = _integer(body, "time_ns"), _integer(body, "schema")
        return cls(time_ns, _string(body, "author"), _string(body, "text"), schema)

    def content(self) -> Content:
        return dict(vars(self))


@dataclass(frozen=True, eq=False)
class Truth:
    """What a synthetic patient really is (key `truth`)."""

    KEY: ClassVar[str] = "truth"

    schema: int
    time_ns: int
    """Event time [ns]."""
    names: tuple[str, ...]
    """Names of the quantities and parameters."""
    values: Floats
    """Their values in their units, `[names]`."""

    @classmethod
    def read(cls, cursor: Cursor) -> Self:
        schema, time_ns, names = cursor.u16(), cursor.i64(), _unique(cursor.strings())
        return cls(schema, time_ns, names, _shaped(cursor.floats(), (len(names),)))

    @classmethod
    def read_json(cls, body: Mapping[str, Any]) -> Self:
        values = _object(body, "values")
        names = _named(body, values)
        numbers = _floats([values[name] for name in names], "values")
        return cls(_integer(body, "schema"), _integer(body, "time_ns"), names, numbers)

    def content(self) -> Content:
        values = {f"values.{name}": float(value) for name, value in zip(self.names, self.values, strict=True)}
        return {"schema": self.schema, "time_ns": self.time_ns} | values


def _check_length(payload: bytes | str) -> None:
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise TooLong(f"payload of {len(payload)} bytes, at most {MAX_PAYLOAD_BYTES} are accepted")


def _check_schema(version: int) -> None:
    if version != SCHEMA:
        raise WrongSchema(f"schema version {version}, this module reads {SCHEMA}")


def _encode_array(values: Integers | Floats, layout: str) -> bytes:
    return struct.pack("<Q", len(values)) + np.asarray(values).astype(layout).tobytes()


def _encode_string(text: str) -> bytes:
    encoded = text.encode()
    return struct.pack("<Q", len(encoded)) + encoded


def _read_by_name(cursor: Cursor, read: Callable[[], T]) -> dict[str, T]:
    """Pairs of a name and a number of 8 bytes."""
    pairs = [(cursor.string(), read()) for _ in range(cursor.length(16))]
    _unique(name for name, _ in pairs)
    return dict(pairs)


def _parameter_row(body: Mapping[str, Any]) -> list[Any]:
    return [float(_boolean(body, s)) if s == "identifiable" else _required(body, s) for s in PARAMETER_STATISTICS]


def _unique(names: Iterable[str]) -> tuple[str, ...]:
    """`names`, refused if one stands twice: in the JSON twin the second would hide the first."""
    names = tuple(names)
    if len(set(names)) != len(names):
        raise Malformed(f"a name stands twice in {', '.join(names)}")
    return names


def _shaped(values: Floats, shape: tuple[int, ...], what: str = "values") -> Floats:
    if values.size != int(np.prod(shape)):
        expected = " x ".join(str(n) for n in shape)
        raise Malformed(f"`{what}` has {values.size} entries, expected {expected}")
    return values.reshape(shape)


def _named(body: Mapping[str, Any], by_name: Mapping[str, Any]) -> tuple[str, ...]:
    names = _unique(_strings(body, "names"))
    if set(names) != set(by_name):
        raise Malformed("`names` are not those of the numbers")
    return names


def _same(left: Any, right: Any) -> bool:
    if isinstance(left, (float, np.ndarray)) and isinstance(right, (float, np.ndarray)):
        left, right = np.asarray(left), np.asarray(right)
        if left.dtype.kind == "f" and right.dtype.kind == "f":
            left, right = (np.where(np.isfinite(side), side, np.nan) for side in (left, right))
            return np.array_equal(left, right, equal_nan=True)
        return np.array_equal(left, right)
    return bool(left == right)


def _no_constant(token: str) -> None:
    raise Malformed(f"`{token}` is not JSON; numbers that JSON cannot hold are null")


def _required(body: Mapping[str, Any], name: str) -> Any:
    if name not in body:
        raise Malformed(f"no `{name}`")
    return body[name]


def _typed(body: Mapping[str, Any], name: str, kind: type[T], expected: str) -> T:
    value = _required(body, name)
    # bool is an int to Python, not to JSON.
    if not isinstance(value, kind) or isinstance(value, bool):
        raise Malformed(f"`{name}` is {value!r:.60}, expected {expected}")
    return value


def _integer(body: Mapping[str, Any], name: str) -> int:
    value = _typed(body, name, int, "an integer")
    if not -(1 << 63) <= value < 1 << 64:
        raise Malformed(f"`{name}` is an integer beyond 64 bits")
    return value


def _boolean(body: Mapping[str, Any], name: str) -> bool:
    value = _required(body, name)
    if not isinstance(value, bool):
        raise Malformed(f"`{name}` is {value!r:.60}, expected true or false")
    return value


def _string(body: Mapping[str, Any], name: str) -> str:
    return _typed(body, name, str, "a string")


def _list(body: Mapping[str, Any], name: str) -> list[Any]:
    return _typed(body, name, list, "a list")


def _object(body: Mapping[str, Any], name: str) -> dict[str, Any]:
    return _typed(body, name, dict, "an object")


def _float(body: Mapping[str, Any], name: str) -> float:
    return float(_floats([_required(body, name)], name)[0])


def _strings(body: Mapping[str, Any], name: str) -> tuple[str, ...]:
    values = _list(body, name)
    if not all(isinstance(value, str) for value in values):
        raise Malformed(f"`{name}` holds something that is not a string")
    return tuple(values)


def _integers(body: Mapping[str, Any], name: str) -> Integers:
    values = _list(body, name)
    if not all(type(value) is int for value in values):
        raise Malformed(f"`{name}` holds something that is not an integer")
    try:
        return np.array(values, dtype=np.int64)
    except OverflowError as error:
        raise Malformed(f"`{name}` holds an integer beyond 64 bits") from error


def _floats(values: list[Any], name: str, nullable: bool = True) -> Floats:
    allowed = (int, float, type(None)) if nullable else (int, float)
    for value in values:
        if type(value) not in allowed:
            raise Malformed(f"`{name}` holds {value!r:.60}, expected a number")
    try:
        return np.array([np.nan if value is None else value for value in values], dtype=np.float64)
    except OverflowError as error:
        raise Malformed(f"`{name}` holds a number beyond 64-bit floats") from error
