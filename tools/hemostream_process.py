"""Processes of `hemostream` and of others for tests: found, started on free ports, listened to, ended.

The binary is the one that `HEMOSTREAM` names, else the debug build of this repository. Where something that a test
needs is missing the test is skipped, unless `HEMOSTREAM_REQUIRED=1`: then it fails.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import socket
import subprocess
import threading
import time
import unittest
import urllib.error
import urllib.request
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

ROOT = Path(__file__).resolve().parent.parent
LINES_KEPT = 2000
"""Of what a process prints; older lines are forgotten."""
STOP_S = 15.0
"""A process that has not ended so long after it was asked to is killed."""
POLL_S = 0.05
HTTP_S = 5.0

T = TypeVar("T")


def missing(what: str) -> Exception:
    """What to raise where `what` is missing: a failure where everything is required, else a reason to skip."""
    if os.environ.get("HEMOSTREAM_REQUIRED") == "1":
        return AssertionError(f"{what}, and HEMOSTREAM_REQUIRED=1")
    return unittest.SkipTest(what)


def hemostream() -> str:
    """Path of the binary under test."""
    named = os.environ.get("HEMOSTREAM")
    path = Path(named) if named else ROOT / "target" / "debug" / "hemostream"
    if not os.access(path, os.X_OK):
        raise missing(f"no binary at {path}: expected a built one there or in HEMOSTREAM")
    return str(path)


def program(name: str) -> str:
    """Path of a program of the system."""
    path = shutil.which(name)
    if path is None:
        raise missing(f"{name} is not installed")
    return path


def free_port() -> int:
    """A port of loopback that is free now."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


def slowness() -> float:
    """How many times longer things may take than on a machine that does nothing else: tasks per core, 1 at least."""
    return max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))


def until(check: Callable[[], T], within_s: float, what: str) -> T:
    """The first true value of `check`; fails with `what` and the last value if there is none in time.

    The time is that of a machine that does nothing else; a busy one is given more.
    """
    deadline = time.monotonic() + within_s * slowness()
    while True:
        value = check()
        if value:
            return value
        if time.monotonic() > deadline:
            raise AssertionError(f"{what}: not within {within_s:g} s; last: {value!r}")
        time.sleep(POLL_S)


def fetch(url: str) -> tuple[int, str]:
    """Status and text of a page; status 0 where nobody answers."""
    try:
        with urllib.request.urlopen(url, timeout=HTTP_S) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()
    except OSError as error:
        return 0, str(error)


def environment() -> dict[str, str]:
    """Without what `hemostream` would take for settings: those of whoever runs the tests, and those of the tests."""
    return {name: value for name, value in os.environ.items() if not name.startswith("HEMOSTREAM")}


class Process:
    """A running program, and the last lines that it printed."""

    def __init__(self, *command: str, cwd: Path | None = None) -> None:
        self.started_at = time.monotonic()
        self.command = command
        self._lines: deque[str] = deque(maxlen=LINES_KEPT)
        self._child = subprocess.Popen(
            command,
            cwd=cwd,
            env=environment(),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        # A pipe that nobody empties would stop the process.
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._child.stdout is not None
        for line in self._child.stdout:
            self._lines.append(line.rstrip("\n"))

    @property
    def age_s(self) -> float:
        return time.monotonic() - self.started_at

    def output(self) -> str:
        """What it printed lately."""
        return "\n".join(list(self._lines))

    def wait_for(self, pattern: str, within_s: float) -> re.Match[str]:
        """The first match in what it prints."""

        def look() -> re.Match[str] | None:
            match = re.search(pattern, self.output())
            if match is None and self._child.poll() is not None:
                raise AssertionError(f"{self.command} ended with {self._child.returncode}:\n{self.output()}")
            return match

        return until(look, within_s, f"{pattern!r} from {self.command[:2]}")

    def kill(self) -> None:
        """Ends it as a crash would."""
        self._child.kill()
        self._child.wait()
        self._close()

    def stop(self) -> int:
        """Asks it to end, and returns its exit code."""
        if self._child.poll() is None:
            self._child.send_signal(signal.SIGTERM)
            try:
                self._child.wait(STOP_S)
            except subprocess.TimeoutExpired:
                self.kill()
        self._close()
        return int(self._child.returncode)

    def _close(self) -> None:
        """Reads what it printed last."""
        self._reader.join(STOP_S)
        assert self._child.stdout is not None
        self._child.stdout.close()


ADDRESS = r"http://127\.0\.0\.1:\d+"


def start_daemon(port: int, *sets: str) -> Process:
    """`hemostream serve` at a port; `sets` are settings `KEY=VALUE`."""
    settings = [f'zenoh.listen=["tcp/127.0.0.1:{port}"]', 'observed=["p_a", "p_pa"]', *sets]
    process = Process(hemostream(), "serve", *(part for text in settings for part in ("--set", text)))
    process.wait_for("hemostream serves", 20.0)
    return process


def start_replay(port: int, *options: str) -> Process:
    """`hemostream replay` to the daemon at a port."""
    sets = ("--set", 'observed=["p_a", "p_pa"]')
    return Process(hemostream(), "replay", "--connect", f"tcp/127.0.0.1:{port}", *sets, *options)


def start_dashboard(port: int) -> tuple[Process, str]:
    """`hemostream dashboard` of the daemon at a port, and the address of its page."""
    process = Process(hemostream(), "dashboard", "--connect", f"tcp/127.0.0.1:{port}", "--listen", "127.0.0.1:0")
    return process, process.wait_for(ADDRESS, 20.0)[0]


def start_demo(*options: str) -> tuple[Process, str]:
    """`hemostream demo`, and the address of its page."""
    process = Process(hemostream(), "demo", "--listen", "127.0.0.1:0", *options)
    return process, process.wait_for(rf"open +({ADDRESS})/", 20.0)[1]
