"""Long tables of results: one row per run, test set, frame and metric."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import atomic_write
from coliags_plugin.results.record import Result


class Row(NamedTuple):
    """One value of one frame.

    Attributes:
        key: Of the result.
        method: Name of the method.
        scene: Name of the scene.
        split: Name of the split.
        seed: Of the run.
        protocol: Name of the evaluation protocol.
        protocol_version: Its version.
        set: Name of the test set.
        frame: Name of the frame.
        metric: Name of the metric.
        value: The raw value; None where the frame has none.
        unit: Of the value.
    """

    key: str
    method: str
    scene: str
    split: str
    seed: int
    protocol: str
    protocol_version: int
    set: str
    frame: str
    metric: str
    value: float | None
    unit: str


def rows(result: Result) -> Iterator[Row]:
    """The rows of a result."""
    run = (result.key, result.method, result.scene.name, result.scene.split, result.seed)
    protocol = (result.protocol.name, result.protocol.version)
    for set_name, part in result.sets.items():
        for metric, values in part.values.items():
            for frame, value in zip(part.frames, values, strict=True):
                yield Row(*run, *protocol, set_name, frame, metric, value, result.metrics[metric].unit)


def write_csv(path: Path, results: Sequence[Result]) -> None:
    """Write the rows of results as CSV, values with all their digits, missing ones empty.

    Raises:
        InputError: The file cannot be written.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(Row._fields)
    for result in results:
        writer.writerows(rows(result))
    atomic_write(path, text.getvalue())


def write_parquet(path: Path, results: Sequence[Result]) -> None:
    """Write the rows of results as Parquet, missing values null.

    Raises:
        InputError: pyarrow is not installed, or the file cannot be written.
    """
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise InputError(
            f"a Parquet file without pyarrow: {error}",
            "an installation with the extra `tables`",
            "pip install 'coliags_plugin[tables]', or use --format csv",
        ) from error
    types = dict.fromkeys(Row._fields, pyarrow.string())
    types |= {"seed": pyarrow.int64(), "protocol_version": pyarrow.int64(), "value": pyarrow.float64()}
    found = [row._asdict() for result in results for row in rows(result)]
    table = pyarrow.Table.from_pylist(found, schema=pyarrow.schema(list(types.items())))
    buffer = io.BytesIO()
    parquet.write_table(table, buffer)
    atomic_write(path, buffer.getvalue())
