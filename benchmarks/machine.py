"""Clocks, memory, description of the machine and printing of results, shared by the benchmarks."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
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
        found["gpu"] = torch.cuda.get_device_name()  # of the current device
    return found


def markdown_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows of equal keys as a Markdown table."""
    keys = list(rows[0])
    lines = ["| " + " | ".join(keys) + " |", "|" + "---|" * len(keys)]
    lines += ["| " + " | ".join(_cell(row[key]) for key in keys) + " |" for row in rows]
    return "\n".join(lines)


def _cell(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def show(rows: Sequence[Mapping[str, Any]], path: Path | None, shown: Sequence[Mapping[str, Any]] = ()) -> None:
    """Print the machine and a table, of the rows or of ``shown``, and write the rows as JSON where a path is given."""
    print(", ".join(f"{key}: {value}" for key, value in describe_machine().items()), end="\n\n")
    print(markdown_table(shown or rows))
    if path is not None:
        path.write_text(json.dumps(list(rows), indent=2) + "\n", encoding="utf-8")


def size_of(text: str) -> tuple[int, int]:
    """Width and height of ``WxH``."""
    width, height = map(int, text.split("x"))
    return width, height


def peak_mib() -> float:
    """Peak resident memory of this process, MiB.

    Not from getrusage: its figure begins with that of the process that started this one.
    """
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    return next(float(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM")) / 1024.0


def numbers_of(script: str, *arguments: str) -> list[float]:
    """What a benchmark prints as one case, in a process of its own: numbers on its last line."""
    printed = subprocess.run([sys.executable, script, *arguments], check=True, stdout=subprocess.PIPE, text=True).stdout
    return [float(word) for word in printed.splitlines()[-1].split()]
