"""Follows hemostream live: a line per bed and second, beats, events, alarms and notes as they come, rows to a file."""

from __future__ import annotations

import argparse
import json
import math
import os
import queue
import re
import signal
import sys
import threading
import time
from collections import Counter
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from hemostream_rows import ColumnsChanged, RowFile
from hemostream_twins import TwinCheck
from hemostream_wire import (
    SMOOTHED_KEY,
    Alarms,
    BeatEstimate,
    Event,
    Header,
    Note,
    ParameterEstimate,
    StateEstimate,
    Status,
    WireError,
    decode,
    from_json,
)

try:
    import zenoh
except ImportError as missing:
    sys.exit(f"{missing}; pip install -r {Path(__file__).with_name('requirements.txt')}")

OK, FAILED, USAGE = 0, 1, 2

Published = StateEstimate | ParameterEstimate | BeatEstimate | Status | Event | Alarms
KINDS: dict[str, type[Published]] = {
    StateEstimate.KEY: StateEstimate,
    ParameterEstimate.KEY: ParameterEstimate,
    SMOOTHED_KEY: StateEstimate,
    BeatEstimate.KEY: BeatEstimate,
    Status.KEY: Status,
    Event.KEY: Event,
    Alarms.KEY: Alarms,
}

UNDECODABLE = "undecodable messages"
NOT_WRITTEN = "messages of other beds not written to the file"

MAX_QUEUE = 4096
MAX_BEDS = 1000
MAX_COMPLAINTS = 20
"""Complaints of one sort that are printed; all are counted."""

LAST_VALUES_TIMEOUT_S = 3.0
CLOSE_TIMEOUT_S = 3.0
POLL_S = 0.1
"""How late a signal may be noticed."""
LINE_PERIOD_S = 1.0
SILENT_AFTER_S = 2.0
FORECAST_AFTER_S = 0.5
"""Without data for longer, the live line says so."""

BAND = ("mean", "q05", "q95")
LIVE_PRESSURES = ("p_a", "p_pa", "p_l", "p_v")
BEAT_FIGURES = (
    ("heart_rate", "HR", ".1f"),
    ("stroke_volume", "SV", ".1f"),
    ("cardiac_output", "CO", ".2f"),
    ("ejection_fraction", "EF", ".3f"),
    ("svr", "SVR", ".3f"),
    ("pvr", "PVR", ".4f"),
)
"""Clinical quantities in the line of a beat, as they are called there, and their digits."""
BEAT_PRESSURES = ("p_a_systolic", "p_a_diastolic", "p_a_mean")
EPOCH_FROM_NS = 10**18
"""Event times from here on (2001) are shown as dates; earlier ones count from the start of a record."""

EXAMPLES = """examples:
  python tools/subscribe.py
  python tools/subscribe.py --bed bed1 --csv bed1.csv --seconds 60
  python tools/subscribe.py --connect tcp/10.0.0.5:7447 --format both --seconds 10

exit code: 0 done, 1 failed (no connection, nothing received within --seconds, undecodable messages, twins that
differ, disk full), 2 wrong usage"""


class UsageError(Exception):
    """Something on the command line that cannot work."""


class Received(NamedTuple):
    """A message as it came off the bus."""

    key: str
    payload: bytes
    stored: bool
    """A last value that was asked for, not one just published."""


class Intake:
    """Bounded queue between the callbacks of the bus and the main loop."""

    def __init__(self, capacity: int = MAX_QUEUE) -> None:
        self._queue: queue.Queue[Received] = queue.Queue(capacity)
        self._lock = threading.Lock()
        self.dropped = 0
        self.refused_replies = 0

    def on_sample(self, sample: Any) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            self.offer(Received(str(sample.key_expr), sample.payload.to_bytes(), stored=False))

    def on_reply(self, reply: Any) -> None:
        sample = reply.ok
        if sample is not None:
            self.offer(Received(str(sample.key_expr), sample.payload.to_bytes(), stored=True))
        else:
            with self._lock:
                self.refused_replies += 1

    def offer(self, received: Received) -> None:
        """Never blocks: a callback that waits would hold up the receive thread of the session."""
        try:
            self._queue.put_nowait(received)
        except queue.Full:
            with self._lock:
                self.dropped += 1

    def take(self, timeout_s: float) -> Received | None:
        try:
            return self._queue.get(timeout=timeout_s) if timeout_s > 0 else self._queue.get_nowait()
        except queue.Empty:
            return None


class Sequences:
    """Tells new messages from repeated ones, and counts those lost on the way."""

    def __init__(self) -> None:
        self._last: dict[str, tuple[Header, bool]] = {}
        self.lost = 0

    def is_new(self, key: str, header: Header, stored: bool) -> bool:
        last, last_stored = self._last.get(key, (None, False))
        if last is not None:
            # A stored value may arrive after the live messages that overtook it.
            if header == last or (stored and header.time_ns <= last.time_ns):
                return False
            if not stored and not last_stored and header.sequence > last.sequence:
                self.lost += header.sequence - last.sequence - 1
        self._last[key] = (header, stored)
        return True


@dataclass
class Bed:
    """The latest of one bed."""

    state: StateEstimate | None = None
    parameters: ParameterEstimate | None = None
    status: Status | None = None
    alarms: Alarms | None = None
    heard_s: float = 0.0
    """When the last state came, on the monotonic clock."""

    def take(self, message: Published, now_s: float) -> None:
        match message:
            case StateEstimate():
                self.state, self.heard_s = message, now_s
            case ParameterEstimate():
                self.parameters = message
            case Status():
                self.status = message
            case Alarms():
                self.alarms = message

    def line(self, name: str, now_s: float) -> str:
        parts = [name, *self._estimate()]
        lag = self.status.lag_p99_ms if self.status else math.nan
        parts.append(f"lag p99 {lag:.1f} ms" if math.isfinite(lag) else "lag p99 -")
        parts += self._raised()
        silent_s = now_s - self.heard_s
        if self.state and silent_s > SILENT_AFTER_S:
            parts.append(f"SILENT for {silent_s:.0f} s")
        return printable("  ".join(parts))

    def _estimate(self) -> list[str]:
        parts = ["no state yet"] if self.state is None else self._pressures(self.state)
        if self.parameters is not None:
            p = self.parameters
            for n in p.names:
                mark = "" if p.is_identifiable(n) else " (not identifiable)"
                parts.append(banded(n, [p.value(n, s) for s in BAND], "#.4g") + mark)
        return parts

    def _raised(self) -> list[str]:
        """Alarms that are raised, or were and are not acknowledged."""
        marks = {"active": "", "latched": " (over)"}
        raised = [a for a in (self.alarms.alarms if self.alarms else ()) if a.state in marks]
        return [f"ALARM {a.name}{' (seen)' if a.acknowledged else marks[a.state]}" for a in raised]

    @staticmethod
    def _pressures(state: StateEstimate) -> list[str]:
        if not len(state.times_ns):
            return ["empty state"]
        parts = [event_time(int(state.times_ns[-1]))]
        for name in LIVE_PRESSURES:
            if name in state.names:
                band = [float(state.series(name, s)[-1]) for s in BAND]
                parts.append(banded(name.replace("p_", "P_"), band, ".1f"))
        since_data_s = float(state.since_data_s[-1])
        if since_data_s > FORECAST_AFTER_S:
            parts.append(f"FORECAST, no data for {since_data_s:.1f} s")
        return parts


class Follower:
    """Everything that is done with a message; knows nothing of the bus."""

    def __init__(self, prefix: str, both: bool, rows: RowFile | None, rows_bed: str | None) -> None:
        self._prefix = prefix
        self._sequences = Sequences()
        self._rows = rows
        self._rows_bed = rows_bed
        self.twins = TwinCheck() if both else None
        self.beds: dict[str, Bed] = {}
        self.received = 0
        self._alarms: dict[str, list[tuple[str, str, bool]]] = {}
        self.counters: Counter[str] = Counter()

    def handle(self, received: Received, now_s: float) -> None:
        bed, topic, is_json = split_key(self._prefix, received.key)
        self.received += 1
        if topic == Note.KEY:
            self._note(received, bed)
            return
        try:
            message = (from_json if is_json else decode)(KINDS[topic], received.payload)
        except WireError as error:
            self._complain(UNDECODABLE, f"{received.key}: {error}")
            return
        if not self._admit(bed) or not self._sequences.is_new(received.key, message.header, received.stored):
            return
        if self.twins is not None:
            self._compare(self.twins, received.key, bed, topic, is_json, message)
            if is_json:
                return
        self._take(bed, topic, message, now_s)

    def _note(self, received: Received, bed: str) -> None:
        """What an operator says; it has no header and no twin."""
        try:
            print(note_line(bed, decode(Note, received.payload)), flush=True)
        except WireError as error:
            self._complain(UNDECODABLE, f"{received.key}: {error}")

    def print_lines(self, now_s: float) -> None:
        for name in sorted(self.beds):
            print(self.beds[name].line(name, now_s), flush=True)
        if self._rows is not None:
            self._rows.flush()

    def problems(self) -> list[str]:
        """What makes the run a failure."""
        undecodable = self.counters[UNDECODABLE]
        found = [f"{undecodable} {UNDECODABLE}"] if undecodable else []
        if self.twins is not None:
            if self.twins.mismatches:
                found.append(f"{self.twins.mismatches} messages differ from their JSON twin")
            if self.received and not self.twins.compared:
                found.append("no message came together with its JSON twin")
            found += [f"no twin of any {topic} came" for topic in self.twins.never_compared()]
        return found

    def summary(self) -> list[str]:
        missing = self._sequences.lost
        lines = [f"{self.received} messages of {len(self.beds)} beds, {missing} missing by sequence number"]
        if self.twins is not None:
            pairs, alone = self.twins.compared.total(), self.twins.unpaired.total()
            lines.append(f"{pairs} pairs compared, {self.twins.mismatches} differ, {alone} messages without twin")
        if self._rows is not None:
            count, incomplete = self._rows.rows, self._rows.rows_without_parameters
            lines.append(f"{count} rows of {self._rows_bed or 'no bed'} written, {incomplete} without parameters")
        return lines + [f"{count} {what}" for what, count in sorted(self.counters.items())]

    def _admit(self, bed: str) -> bool:
        if bed in self.beds:
            return True
        if len(self.beds) >= MAX_BEDS:
            self._complain("messages of beds beyond the limit", f"{bed}: more than {MAX_BEDS} beds")
            return False
        self.beds[bed] = Bed()
        return True

    def _compare(self, twins: TwinCheck, key: str, bed: str, topic: str, is_json: bool, message: Published) -> None:
        found = twins.add(bed, topic, is_json, message.header, message)
        if found and twins.mismatches <= MAX_COMPLAINTS:
            where = f"{key}, sequence {message.header.sequence}"
            warn(f"{where}: bincode and JSON differ in {'; '.join(found[:3])}")

    def _is_news(self, bed: str, message: Alarms) -> bool:
        """Whether an alarm has changed: alarms are said again with every status."""
        now = [(alarm.name, alarm.state, alarm.acknowledged) for alarm in message.alarms]
        before, self._alarms[bed] = self._alarms.get(bed), now
        return now != before

    def _take(self, bed: str, topic: str, message: Published, now_s: float) -> None:
        if topic == SMOOTHED_KEY:
            # Of the same times once more, and later: not for the live line, nor for the rows.
            return
        self.beds[bed].take(message, now_s)
        if isinstance(message, Event):
            print(event_line(bed, message), flush=True)
        elif isinstance(message, BeatEstimate):
            print(beat_line(bed, message), flush=True)
        elif isinstance(message, Alarms) and self._is_news(bed, message):
            for line in alarm_lines(bed, message):
                print(line, flush=True)
        if self._rows is None or not isinstance(message, StateEstimate | ParameterEstimate):
            return
        self._rows_bed = self._rows_bed or bed
        if bed != self._rows_bed:
            if not self.counters[NOT_WRITTEN]:
                warn(f"{bed} is not written: the file holds {self._rows_bed} (choose with --bed)")
            self.counters[NOT_WRITTEN] += 1
            return
        if isinstance(message, StateEstimate):
            self._rows.add_state(message)
        else:
            self._rows.add_parameters(message)

    def _complain(self, what: str, detail: str) -> None:
        self.counters[what] += 1
        if self.counters[what] <= MAX_COMPLAINTS:
            warn(f"{what}: {detail}")


def split_key(prefix: str, key: str) -> tuple[str, str, bool]:
    """`PREFIX/BED/TOPIC[/json]` as bed, topic, and whether it is the JSON twin."""
    bed, _, topic = key.removeprefix(f"{prefix}/").partition("/")
    return bed, topic.removesuffix("/json"), topic.endswith("/json")


def banded(name: str, band: list[float], digits: str) -> str:
    mean, low, high = band
    return f"{name} {mean:{digits}} [{low:{digits}}, {high:{digits}}]"


def event_time(time_ns: int) -> str:
    if time_ns < EPOCH_FROM_NS:
        return f"{time_ns / 1_000_000_000:.3f} s"
    clock = datetime.fromtimestamp(time_ns // 1_000_000_000, tz=UTC)
    return f"{clock:%Y-%m-%d %H:%M:%S}.{time_ns // 1_000_000 % 1000:03d}Z"


def event_line(bed: str, event: Event) -> str:
    channel = f" {event.channel}" if event.channel else ""
    return printable(f"{bed}  {event_time(event.header.time_ns)}  EVENT {event.kind}{channel}: {event.text}")


def alarm_lines(bed: str, alarms: Alarms) -> list[str]:
    """A line per alarm that is not normal, most urgent first; one that says so if all are."""
    urgency = ("high", "medium", "low")
    moved = [alarm for alarm in alarms.alarms if alarm.state != "normal"]
    moved.sort(key=lambda alarm: urgency.index(alarm.priority) if alarm.priority in urgency else len(urgency))
    start = f"{bed}  {event_time(alarms.header.time_ns)}  ALARM"
    if not moved:
        return [printable(f"{start} none of {len(alarms.alarms)}")]
    return [
        printable(f"{start} {a.priority} {a.name}: {a.state}{', acknowledged' if a.acknowledged else ''}: {a.text}")
        for a in moved
    ]


def note_line(bed: str, note: Note) -> str:
    by = f" by {note.author}" if note.author else ""
    return printable(f"{bed}  {event_time(note.time_ns)}  NOTE{by}: {note.text}")


def beat_line(bed: str, beat: BeatEstimate) -> str:
    """A beat with the bands of its figures; systolic and diastolic pressure go without, to keep the line short."""
    parts = [bed, event_time(beat.header.time_ns), "BEAT"]
    for name, short, digits in BEAT_FIGURES:
        if name in beat.names:
            figure = banded(short, [beat.value(name, s) for s in BAND], digits)
            parts.append(f"{figure} {beat.unit(name)}".rstrip())
    if all(name in beat.names for name in BEAT_PRESSURES):
        systolic, diastolic, mean = BEAT_PRESSURES
        pressures = f"P_a {beat.value(systolic, 'mean'):.0f}/{beat.value(diastolic, 'mean'):.0f}"
        mean_band = banded("mean", [beat.value(mean, s) for s in BAND], ".1f")
        parts.append(f"{pressures} {mean_band} {beat.unit(mean)}".rstrip())
    return printable("  ".join(parts))


def printable(text: str) -> str:
    """What comes from the network must not steer the terminal."""
    return "".join(c if c.isprintable() else "?" for c in text)


def warn(text: str) -> None:
    print(f"subscribe.py: {printable(text)}", file=sys.stderr, flush=True)


def positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0):
        raise argparse.ArgumentTypeError(f"`{text}`, expected a positive number of seconds")
    return value


def parse_arguments(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--connect", default="tcp/127.0.0.1:7447", metavar="ENDPOINT", help="router [%(default)s]")
    parser.add_argument("--prefix", default="hemostream", help="first part of every key [%(default)s]")
    parser.add_argument("--bed", help="only this bed [all that appear]")
    parser.add_argument(
        "--format",
        choices=("json", "bincode", "both"),
        default="bincode",
        help="what is subscribed to; both: also checks that the two are equal [%(default)s]",
    )
    parser.add_argument(
        "--csv", type=Path, metavar="OUT.csv", help="writes every row of BED, or of the first bed that is heard"
    )
    parser.add_argument("--seconds", type=positive, metavar="N", help="ends after this time [at Ctrl-C]")
    return parser.parse_args(arguments)


def check_usage(arguments: argparse.Namespace) -> None:
    if not re.fullmatch(r"[\w-]+/\S+", arguments.connect):
        raise UsageError(f"--connect `{arguments.connect}`, expected PROTOCOL/ADDRESS such as tcp/127.0.0.1:7447")
    check_key("--prefix", arguments.prefix)
    if arguments.bed is not None:
        check_key("--bed", arguments.bed)
        if "/" in arguments.bed:
            raise UsageError(f"--bed `{arguments.bed}` has a `/`")


def check_key(option: str, key: str) -> None:
    try:
        if any(c in key for c in "*$?#"):
            raise UsageError(f"{option} `{key}` has a wildcard")
        zenoh.KeyExpr(key)
    except zenoh.ZError as error:
        raise UsageError(f"{option} `{key}`: {reason(error)}") from error


def reason(error: zenoh.ZError) -> str:
    """The message without the source location that zenoh appends."""
    return re.sub(r"\s+at \S+\.rs:\d+\.?", "", str(error))


def client_config(endpoint: str) -> zenoh.Config:
    """A client and nothing else: one endpoint, no scouting, no listening."""
    settings = {
        "mode": "client",
        "connect": {"endpoints": [endpoint]},
        "listen": {"endpoints": []},
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
    }
    return zenoh.Config.from_json5(json.dumps(settings))


def patterns(arguments: argparse.Namespace) -> list[str]:
    endings = {"bincode": [""], "json": ["/json"], "both": ["", "/json"]}[arguments.format]
    bed = f"{arguments.prefix}/{arguments.bed or '*'}"
    # Notes have no JSON twin.
    return [f"{bed}/{topic}{end}" for topic in KINDS for end in endings] + [f"{bed}/{Note.KEY}"]


def subscribe(session: zenoh.Session, keys: list[str], intake: Intake) -> None:
    # On the receive thread itself: with a thread per subscription the order between keys would be lost.
    on_sample = zenoh.handlers.Callback(intake.on_sample, indirect=False)
    on_reply = zenoh.handlers.Callback(intake.on_reply, indirect=False)
    for key in keys:
        session.declare_subscriber(key, on_sample)
    # Asked for after subscribing, so that nothing falls between the last value and the first live one.
    for key in keys:
        session.get(
            key,
            on_reply,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=LAST_VALUES_TIMEOUT_S,
        )


def follow(intake: Intake, follower: Follower, seconds: float | None, stop: threading.Event) -> None:
    """Until `seconds` are over or `stop` is set."""
    start_s = time.monotonic()
    end_s = math.inf if seconds is None else start_s + seconds
    next_line_s = start_s + LINE_PERIOD_S
    while not stop.is_set() and (now_s := time.monotonic()) < end_s:
        if now_s >= next_line_s:
            follower.print_lines(now_s)
            # From now on: after a suspension the missed lines are not made up for.
            next_line_s = max(next_line_s + LINE_PERIOD_S, now_s)
        received = intake.take(min(POLL_S, next_line_s - now_s, end_s - now_s))
        if received is not None:
            follower.handle(received, time.monotonic())
    # What had arrived by the end still counts; what comes from now on does not.
    for _ in range(MAX_QUEUE):
        if (received := intake.take(0)) is None:
            break
        follower.handle(received, time.monotonic())
    follower.print_lines(time.monotonic())


def close(session: zenoh.Session) -> bool:
    """Closes the session; false if that takes too long, as on a lossy link."""
    closing = threading.Thread(target=session.close, daemon=True)
    closing.start()
    closing.join(CLOSE_TIMEOUT_S)
    return not closing.is_alive()


def run(arguments: argparse.Namespace, stop: threading.Event) -> int:
    check_usage(arguments)
    config = client_config(arguments.connect)
    try:
        rows = RowFile(arguments.csv) if arguments.csv else None
    except OSError as error:
        raise UsageError(f"--csv {arguments.csv}: {error.strerror}") from error
    follower = Follower(arguments.prefix, arguments.format == "both", rows, arguments.bed)
    intake = Intake()
    try:
        session = zenoh.open(config)
        try:
            subscribe(session, patterns(arguments), intake)
            follow(intake, follower, arguments.seconds, stop)
        finally:
            closed = close(session)
    finally:
        if rows is not None:
            rows.close()
    code = report(follower, intake, arguments, stop)
    if not closed:
        # The threads of a session that does not close would keep the process alive.
        sys.stdout.flush()
        os._exit(code)
    return code


def report(follower: Follower, intake: Intake, arguments: argparse.Namespace, stop: threading.Event) -> int:
    """Says how it went; the exit code."""
    if follower.twins is not None:
        follower.twins.finish()
    for line in follower.summary():
        warn(line)
    if intake.dropped:
        warn(f"{intake.dropped} messages dropped here: the queue of {MAX_QUEUE} was full; they are among the missing")
    if intake.refused_replies:
        warn(f"{intake.refused_replies} requests for last values were refused")
    problems = follower.problems()
    if not follower.received and not stop.is_set():
        problems.append(f"nothing received within {arguments.seconds:g} s under {patterns(arguments)[0]}")
    for problem in problems:
        warn(f"failed: {problem}")
    return FAILED if problems else OK


def main(arguments: list[str] | None = None) -> int:
    parsed = parse_arguments(arguments)
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    try:
        return run(parsed, stop)
    except UsageError as error:
        warn(str(error))
        return USAGE
    except zenoh.ZError as error:
        warn(f"{parsed.connect}: {reason(error)}")
    except ColumnsChanged as error:
        warn(f"--csv {parsed.csv}: {error}")
    except BrokenPipeError:
        # The reader of our output has left (`| head`); Python would complain once more at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return OK
    except OSError as error:
        warn(str(error))
    return FAILED


if __name__ == "__main__":
    sys.exit(main())
