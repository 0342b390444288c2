"""Plots quantities of a recording with their bands: mean, and between 5 and 95 %.

A recording is what `hemostream record` writes. What a synthetic patient really was, and samples of a sensor of the same
name, are drawn where they were recorded. Example:

    python plot_recording.py recording --bed bed1 --output bed1.png p_l p_v r_pv
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

try:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    import pandas as pd
    import pyarrow as pa
    import pyarrow.dataset as ds
except ImportError as missing:
    sys.exit(f"{missing}; pip install -r requirements.txt")

OK, FAILED, USAGE = 0, 1, 2

TABLES = ("estimates", "parameters")
"""Where a quantity is looked for; `--smoothed` puts its table before them."""

MAX_POINTS = 20_000
"""Points drawn of a curve; of more, every n-th is."""

NS_PER_S = 1_000_000_000


class UsageError(Exception):
    """What was asked for is not there."""


def table(recording: Path, name: str, bed: str, columns: list[str] | None = None) -> pd.DataFrame:
    """The rows of a bed in order of event time; empty where the table was not recorded.

    Columns that only some files have are empty elsewhere.
    """
    folder = recording / name
    if not folder.is_dir():
        return pd.DataFrame()
    files = ds.dataset(folder, partitioning="hive", format="parquet")
    schemas = [fragment.physical_schema for fragment in files.get_fragments()]
    if columns is not None and not set(columns) <= {field.name for schema in schemas for field in schema}:
        return pd.DataFrame()
    # A bed called 7 is a name all the same.
    folders = pa.schema([pa.field("bed", pa.string()), pa.field("hour", pa.string())])
    partitioning = ds.partitioning(folders, flavor="hive")
    schema = pa.unify_schemas([*schemas, folders])
    rows = ds.dataset(folder, partitioning=partitioning, format="parquet", schema=schema)
    return rows.to_table(columns=columns, filter=ds.field("bed") == bed).to_pandas().sort_values("time_ns", kind="stable")


def band(recording: Path, bed: str, quantity: str, smoothed: bool) -> pd.DataFrame:
    """Event time, mean and quantiles of a quantity or parameter."""
    columns = [f"{quantity}_{statistic}" for statistic in ("mean", "q05", "q95")]
    for name in (("smoothed",) if smoothed else ()) + TABLES:
        rows = table(recording, name, bed, ["time_ns", *columns])
        if not rows.empty:
            return rows.set_axis(["time_ns", "mean", "q05", "q95"], axis="columns").dropna()
    raise UsageError(f"{recording}: found no {quantity} of bed {bed}, expected a quantity or parameter of the recording")


def thinned(rows: pd.DataFrame) -> pd.DataFrame:
    return rows.iloc[:: max(1, len(rows) // MAX_POINTS)]


def plot(recording: Path, bed: str, quantities: list[str], smoothed: bool, output: Path) -> None:
    figure, axes = plt.subplots(
        len(quantities), 1, sharex=True, squeeze=False, figsize=(10, 2.4 * len(quantities)), layout="constrained"
    )
    start_ns: int | None = None
    for axis, quantity in zip(axes[:, 0], quantities, strict=True):
        rows = thinned(band(recording, bed, quantity, smoothed))
        if start_ns is None:
            start_ns = int(rows["time_ns"].iloc[0])
        time = (rows["time_ns"] - start_ns) / NS_PER_S
        axis.fill_between(time, rows["q05"], rows["q95"], alpha=0.3, linewidth=0, label="5-95 %")
        axis.plot(time, rows["mean"], linewidth=1.0, label="mean")
        samples = table(recording, "samples", bed, ["time_ns", "channel", "value"])
        if not samples.empty:
            samples = thinned(samples[samples["channel"] == quantity].dropna())
            seconds = (samples["time_ns"] - start_ns) / NS_PER_S
            axis.plot(seconds, samples["value"], ".", markersize=1.0, color="0.6", zorder=0)
        truth = table(recording, "truth", bed, ["time_ns", quantity])
        if not truth.empty:
            truth = thinned(truth.dropna())
            axis.plot((truth["time_ns"] - start_ns) / NS_PER_S, truth[quantity], "k--", linewidth=0.8, label="truth")
        axis.set_ylabel(quantity)
        axis.legend(loc="upper right", fontsize="small")
    axes[-1, 0].set_xlabel(f"event time of {bed} [s]")
    figure.savefig(output, dpi=150)
    plt.close(figure)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path, help="directory that `hemostream record` wrote")
    parser.add_argument("quantities", nargs="+", metavar="NAME", help="quantities and parameters, such as p_l or r_pv")
    parser.add_argument("--bed", default="bed1")
    parser.add_argument("--smoothed", action="store_true", help="what was known after the smoothing lag, where recorded")
    parser.add_argument("--output", type=Path, required=True, metavar="PNG")
    asked = parser.parse_args(arguments)
    try:
        plot(asked.recording, asked.bed, asked.quantities, asked.smoothed, asked.output)
    except UsageError as error:
        print(f"plot_recording.py: {error}", file=sys.stderr)
        return USAGE
    except OSError as error:
        print(f"plot_recording.py: {error}", file=sys.stderr)
        return FAILED
    return OK


if __name__ == "__main__":
    sys.exit(main())
