"""Checks the pressures that hemostream reads from a WFDB record against the Python package `wfdb`.

Every sample that the package reads must be in the CSV file at its own time, at the sample's own rate; a missing
sample is an empty cell, or no row. Nothing else may be in the file.
"""

from __future__ import annotations

import argparse
import csv
import sys
from dataclasses import dataclass
from pathlib import Path

try:
    import numpy as np
    import wfdb
except ImportError as missing:
    sys.exit(f"{missing}; pip install wfdb")

OK, FAILED, USAGE = 0, 1, 2

LABELS = {"ABP": "p_a", "PAP": "p_pa", "CVP": "p_v"}
"""Column of each signal that is compared; in mmHg only."""

TOLERANCE = 1e-9
"""Largest difference, relative to values beyond 1 mmHg."""

TIME_TOLERANCE_S = 1e-6

Floats = np.ndarray[tuple[int], np.dtype[np.float64]]


class UsageError(Exception):
    """A file that cannot be read."""


@dataclass(frozen=True)
class Signal:
    label: str
    rate_hz: float
    samples: Floats


def warn(text: str) -> None:
    print(f"check_wfdb.py: {text}", file=sys.stderr, flush=True)


def read_record(path: Path) -> dict[str, Signal]:
    """The signals that are compared, by column."""
    name = str(path.with_suffix("")) if path.suffix == ".hea" else str(path)
    try:
        record = wfdb.rdrecord(name, physical=True, smooth_frames=False)
    except (OSError, ValueError, IndexError) as error:
        raise UsageError(f"{path}: {error}") from error
    signals = {}
    for index, label in enumerate(record.sig_name):
        if label not in LABELS or record.units[index].lower() != "mmhg":
            continue
        rate_hz = record.fs * record.samps_per_frame[index]
        signals[LABELS[label]] = Signal(label, rate_hz, np.asarray(record.e_p_signal[index], dtype=np.float64))
    return signals


def read_csv(path: Path) -> tuple[Floats, dict[str, Floats]]:
    """Times, and the columns of pressures with NaN for an empty cell."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            header, *rows = csv.reader(file)
        table = np.array([[float(cell or "nan") for cell in row] for row in rows], dtype=np.float64)
        table = table.reshape(len(rows), len(header))
        time = header.index("time_s")
    except (OSError, ValueError) as error:
        raise UsageError(f"{path}: {error}") from error
    return table[:, time], {name: table[:, i] for i, name in enumerate(header) if i != time}


def rows_at(times: Floats, wanted: Floats) -> tuple[np.ndarray, np.ndarray]:
    """The row nearest to each wanted time, and whether it is that time."""
    after = np.searchsorted(times, wanted).clip(0, len(times) - 1)
    before = (after - 1).clip(0)
    rows = np.where(np.abs(times[before] - wanted) < np.abs(times[after] - wanted), before, after)
    return rows, np.abs(times[rows] - wanted) <= TIME_TOLERANCE_S


def compare(column: str, signal: Signal, times: Floats, values: Floats) -> list[str]:
    """Prints the account of a signal; what is wrong, in words."""
    sample_times = np.arange(len(signal.samples)) / signal.rate_hz
    rows, present = rows_at(times, sample_times)
    read = np.where(present, values[rows], np.nan)
    missing = np.isnan(signal.samples)
    both = ~missing & ~np.isnan(read)
    difference = np.abs(read - signal.samples)[both]
    largest = float(difference.max(initial=0.0))
    print(
        f"{signal.label} -> {column}: {len(signal.samples)} samples at {signal.rate_hz:g} Hz, "
        f"{int(missing.sum())} missing, largest difference {largest:.3g} mmHg"
    )
    elsewhere = np.ones(len(values), dtype=bool)
    elsewhere[rows[present]] = False
    counts = {
        "samples that differ": difference > TOLERANCE * np.abs(signal.samples[both]).clip(1.0),
        "samples that are not in the file": ~missing & np.isnan(read),
        "missing samples that have a value in the file": missing & ~np.isnan(read),
        "values at other times": elsewhere & ~np.isnan(values),
    }
    return [f"{column}: {int(wrong.sum())} {what}" for what, wrong in counts.items() if wrong.any()]


def run(arguments: argparse.Namespace) -> int:
    signals = read_record(arguments.record)
    times, columns = read_csv(arguments.csv)
    problems = []
    if not signals:
        problems.append(f"{arguments.record}: no signal {', '.join(LABELS)} in mmHg")
    if not len(times) or not np.all(np.diff(times) > 0):
        problems.append(f"{arguments.csv}: no rows, or times that do not increase")
    else:
        problems += [f"{column}: not in the record" for column in columns.keys() - signals.keys()]
        for column, signal in signals.items():
            if column in columns:
                problems += compare(column, signal, times, columns[column])
            else:
                problems.append(f"{column}: not in the file, {signal.label} in the record")
    for problem in problems:
        warn(f"failed: {problem}")
    return FAILED if problems else OK


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("record", type=Path, metavar="RECORD", help="WFDB record, with or without .hea")
    parser.add_argument("csv", type=Path, metavar="HEMOSTREAM_CSV", help="what hemostream made of it")
    try:
        return run(parser.parse_args(arguments))
    except UsageError as error:
        warn(str(error))
        return USAGE


if __name__ == "__main__":
    sys.exit(main())
