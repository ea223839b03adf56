"""Results files, and what is made of them: ``metrics.json``, facts in words, and tables of single frames."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import write_json
from coliags_plugin.core.json_files import read_json
from coliags_plugin.core.settings import invalid_reported
from coliags_plugin.reporting.numbers import Direction, duration
from coliags_plugin.results.hashing import metrics_sha256
from coliags_plugin.results.record import FORMAT, VERSION, CostRecord, Result

#: Name of the results file in the folder of an evaluation.
RESULT_FILE = "result.json"

_EXPECTED = "a results file, as `coliags eval` writes it"
_AGAIN = "Restore it, or run `coliags eval` again"


class NewerResultError(InputError):
    """A results file is from a newer version of the package."""


def write_result(path: Path, result: Result) -> None:
    """Write a results file atomically."""
    write_json(path, result.model_dump(mode="json"))


def read_result(path: Path) -> Result:
    """Read a results file, and check its values against their hash.

    Raises:
        NewerResultError: It is of a newer version of the schema.
        InputError: There is none, it is damaged, or its values are not those that were written.
    """
    content = read_json(path, _EXPECTED, _AGAIN)
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(f'{path} is not a results file: it lacks "format": "{FORMAT}"', _EXPECTED)
    version = content.get("version")
    if type(version) is not int or version < 1:
        raise InputError(f"{path}: version is {json.dumps(version)}", f"a number from 1 to {VERSION}", _AGAIN)
    if version > VERSION:
        raise NewerResultError(
            f"{path} is from a newer version of coliags_plugin: version {version} of the schema",
            f"version {VERSION} or older",
            "Update the package",
        )
    with invalid_reported(f"{path}: ", _EXPECTED, _AGAIN):
        result = Result.model_validate_json(json.dumps(content), strict=True)
    if metrics_sha256(result.sets) != result.metrics_sha256:
        raise InputError(
            f"{path}: the values do not have the hash metrics_sha256; the file was changed or damaged",
            "the values as `coliags eval` wrote them",
            _AGAIN,
        )
    return result


@dataclass(frozen=True)
class Cost:
    """A cost of a run: how it is read from the record, and printed."""

    key: str
    title: str
    value: Callable[[CostRecord], float | None]
    text: Callable[[float], str]
    unit: str = ""
    direction: Direction | None = "lower"  # whether higher or lower is better; None where neither is
    work: Literal["training", "rendering"] | None = None  # whose device it depends on
    missing: str = "not measured"


_NO_GAUSSIANS = "not counted, or a radiance field, which has none"
#: Costs but the times to a PSNR.
COSTS = (
    Cost("train_seconds", "Training", attrgetter("train_seconds"), duration, work="training"),
    Cost("processor_seconds", "Processor time", attrgetter("processor_seconds"), duration, work="training"),
    Cost("fps", "Rendering", attrgetter("render_fps"), "{:.3g}".format, "views/s", "higher", "rendering"),
    Cost("memory", "Peak memory", attrgetter("peak_memory_mib"), "{:,.0f}".format, "MiB", work="training"),
    Cost("gaussians", "Gaussians", attrgetter("gaussians"), "{:,.0f}".format, "", None, missing=_NO_GAUSSIANS),
    Cost("checkpoint", "Checkpoint", attrgetter("checkpoint_mib"), "{:,.1f}".format, "MiB"),
)


def facts(result: Result) -> dict[str, str]:
    """Facts of a run and its costs, in words; nothing about what was not measured."""
    cost = result.cost
    costs = {each.title.lower(): (each, each.value(cost)) for each in COSTS}
    reached = {mark: seconds for mark, seconds in cost.seconds_to_psnr.items() if seconds is not None}
    texts = {
        "key": result.key,
        "seed": str(result.seed),
        "split": f"{result.scene.split or 'unnamed'}, {len(result.scene.train)} training frames",
        "trained on": cost.device + ("" if cost.threads is None else f", {cost.threads} threads"),
        **{name: f"{each.text(value)} {each.unit}" for name, (each, value) in costs.items() if value is not None},
        "psnr reached": ", ".join(f"{mark} dB after {duration(seconds)}" for mark, seconds in reached.items()),
    }
    return {name: text.rstrip() for name, text in texts.items() if text}


def csv_text(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Rows below a heading as CSV: numbers with all their digits, None empty."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(head)
    writer.writerows(rows)
    return text.getvalue()


def frame_rows(result: Result, metrics: Iterable[str]) -> Iterator[list[Any]]:
    """Test set and name of every frame with its metrics; None where it lacks one."""
    names = list(metrics)
    for set_name, part in result.sets.items():
        for index, frame in enumerate(part.frames):
            values = (part.values[name][index] if name in part.values else None for name in names)
            yield [set_name, frame, *values]


def per_frame_table(result: Result) -> str:
    """Content of ``per_frame.csv``: one line per frame and one column per metric, empty where a frame has none."""
    return csv_text(["set", "frame", *result.metrics], frame_rows(result, result.metrics))
