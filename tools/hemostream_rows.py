"""State and parameter messages of one bed as the rows that `hemostream estimate` writes.

A row belongs to one event time. Its parameters come in a message of their own, so a state waits here until the
parameters of the same event time are there, or until it is certain that they are not coming.
"""

from __future__ import annotations

import csv
from collections import OrderedDict
from pathlib import Path
from typing import TextIO

from hemostream_wire import (
    PARAMETER_STATISTICS,
    STATE_STATISTICS,
    Floats,
    ParameterEstimate,
    StateEstimate,
)

STATE_COLUMNS = ("mean", "sd", "q05", "q95", "epistemic_sd", "aleatoric_sd", "model_sd")
"""Order of the columns of a quantity in the file; the wire has another."""

PARAMETER_COLUMNS = ("mean", "sd", "q05", "q95")

MAX_WAITING = 2048
"""States (and parameters) that wait for their counterpart: 40 s at 50 Hz."""

STATE_PICK = [STATE_STATISTICS.index(name) for name in STATE_COLUMNS]
PARAMETER_PICK = [PARAMETER_STATISTICS.index(name) for name in PARAMETER_COLUMNS]


class ColumnsChanged(Exception):
    """The stream no longer has the quantities or parameters that the file was begun with."""


class RowFile:
    """Writes one CSV row per published time, in the order of publication."""

    def __init__(self, path: Path) -> None:
        self._file: TextIO = path.open("w", newline="", encoding="utf-8")
        self._writer = csv.writer(self._file, lineterminator="\n")
        self._states: OrderedDict[int, Floats] = OrderedDict()
        self._parameters: OrderedDict[int, Floats] = OrderedDict()
        self._quantity_names: tuple[str, ...] | None = None
        self._parameter_names: tuple[str, ...] | None = None
        self._header_written = False
        self._last_state_ns = self._last_parameters_ns = -(1 << 63)
        self._restart_awaited: str | None = None
        self.rows = 0
        self.rows_without_parameters = 0

    def add_state(self, state: StateEstimate) -> None:
        self._check_quantities(state.names)
        for time_ns, row in zip(state.times_ns.tolist(), state.values, strict=True):
            if time_ns <= self._last_state_ns:
                self._begin_anew("state", "parameters")
            self._last_state_ns = time_ns
            self._states[time_ns] = row[:, STATE_PICK].ravel()
        self._give_up(len(self._states) - MAX_WAITING)
        self._write_complete()

    def add_parameters(self, parameters: ParameterEstimate) -> None:
        self._check_parameters(parameters.names)
        time_ns = parameters.header.time_ns
        if time_ns <= self._last_parameters_ns:
            self._begin_anew("parameters", "state")
        self._last_parameters_ns = time_ns
        self._parameters[time_ns] = parameters.values[:, PARAMETER_PICK].ravel()
        if len(self._parameters) > MAX_WAITING:
            self._parameters.popitem(last=False)
        self._write_complete()

    def _begin_anew(self, which: str, other: str) -> None:
        """Event time went back: nothing of the old run may be joined with the new one."""
        if self._restart_awaited == which:
            # The other stream went back first; what waits now is already of the new run.
            self._restart_awaited = None
            return
        self._give_up(len(self._states))
        self._parameters.clear()
        self._restart_awaited = other

    def flush(self) -> None:
        """Hands what is written to the operating system."""
        self._file.flush()

    def close(self) -> None:
        """Writes what still waits, with empty parameters where none came."""
        try:
            self._give_up(len(self._states))
        finally:
            self._file.close()

    def _check_quantities(self, names: tuple[str, ...]) -> None:
        if self._quantity_names is None:
            self._quantity_names = names
        elif names != self._quantity_names:
            raise ColumnsChanged(f"quantities changed from {self._quantity_names} to {names}: begin another file")

    def _check_parameters(self, names: tuple[str, ...]) -> None:
        if self._parameter_names is None and not self._header_written:
            self._parameter_names = names
        elif names != (self._parameter_names or ()):
            raise ColumnsChanged(f"parameters changed from {self._parameter_names} to {names}: begin another file")

    def _write_complete(self) -> None:
        while self._states and self._parameters:
            time_ns = next(iter(self._states))
            if time_ns not in self._parameters and next(reversed(self._parameters)) < time_ns:
                return
            # Messages under one key keep their order: with later parameters here, those of this time were lost.
            self._write_first()

    def _give_up(self, count: int) -> None:
        for _ in range(count):
            self._write_first()

    def _write_first(self) -> None:
        time_ns, state = self._states.popitem(last=False)
        parameters = self._parameters.get(time_ns)
        while self._parameters and next(iter(self._parameters)) <= time_ns:
            self._parameters.popitem(last=False)
        self._write_header()
        # Integers divided by integers round once.
        cells = [repr(time_ns / 1_000_000_000), *map(repr, state.tolist())]
        if parameters is not None:
            cells += map(repr, parameters.tolist())
        else:
            cells += [""] * (len(PARAMETER_COLUMNS) * len(self._parameter_names or ()))
            self.rows_without_parameters += 1
        self._writer.writerow(cells)
        self.rows += 1

    def _write_header(self) -> None:
        if self._header_written:
            return
        quantities = [f"{name}_{column}" for name in self._quantity_names or () for column in STATE_COLUMNS]
        parameters = [f"{name}_{column}" for name in self._parameter_names or () for column in PARAMETER_COLUMNS]
        self._writer.writerow(["time_s", *quantities, *parameters])
        self._header_written = True
