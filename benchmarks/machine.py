"""Clocks, description of the machine and printing of results, shared by the benchmarks."""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from coliags_plugin.engine.devices import device_name

#: Clocks in seconds, by the name that ``--clock`` takes: elapsed time, and processor time of this process.
CLOCKS = {"wall": time.perf_counter, "processor": time.process_time}


def describe_machine() -> dict[str, Any]:
    """Processor, threads, library versions."""
    found = {
        "cpu": device_name(torch.device("cpu")),
        "cpus": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "python": platform.python_version(),
        "torch": torch.__version__,
    }
    if torch.cuda.is_available():
        found["gpu"] = torch.cuda.get_device_name(0)
    return found


def markdown_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows of equal keys as a Markdown table."""
    keys = list(rows[0])
    lines = ["| " + " | ".join(keys) + " |", "|" + "---|" * len(keys)]
    lines += ["| " + " | ".join(_cell(row[key]) for key in keys) + " |" for row in rows]
    return "\n".join(lines)


def _cell(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def write_results(path: Path | None, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write the rows as JSON where a path is given."""
    if path is not None:
        path.write_text(json.dumps(list(rows), indent=2) + "\n", encoding="utf-8")
