"""Comparisons small enough for tests."""

from __future__ import annotations

import re
import time
from contextlib import suppress
from pathlib import Path

import pytest

from coliags_plugin.comparison import compare
from coliags_plugin.comparison.compare import carry_out
from coliags_plugin.comparison.worker import CellTask
from coliags_plugin.config.options import CompareOptions
from coliags_plugin.engine.tasks import TaskOutcome
from tests.task_list import TaskList

#: Overrides that make the anchor methods small, whose steps then take some milliseconds.
TINY = (
    *("datamanager.points_count=500", "field.features=8", "field.children=4", "field.voxel_size=4"),
    *("schedule.log_every=1", "strategy.statistics_from=0", "strategy.growth_from=2", "strategy.every=3"),
    *("strategy.gradient_threshold=1e-6", "strategy.pixels_per_birth=100"),
)
#: The same, saved often.
OFTEN = (*TINY, "schedule.checkpoint_every=10")


class InlineExecutor(TaskList):
    """Works on cells in this process."""

    def outcome(self, task: CellTask) -> TaskOutcome:
        return task.attempt()


def compare_inline(
    methods, scenes, output, executor=None, *, steps=3, overrides=TINY, seeds=1, splits=(), check_data=None
):
    """A comparison in this process."""
    runs = {"seeds": seeds, "splits": splits, "steps": steps, "settings": tuple(overrides), "device": "cpu"}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compare, "make_executor", lambda options: executor or InlineExecutor())
        return carry_out(methods, CompareOptions(scenes, Path(output), **runs), check_data)


def hashes(folder: Path) -> dict[str, str]:
    """``metrics_sha256`` of every results file, by its place."""
    by_place = {}
    for path in sorted((folder / "results").rglob("*.json")):
        (value,) = re.findall(r'"metrics_sha256": "(\w+)"', path.read_text(encoding="utf-8"))
        by_place[path.relative_to(folder).as_posix()] = value
    return by_place


def lock_holder(folder, pattern):
    """A process that one of these locks names, at work or killed; None where nobody has one."""
    for lock in folder.glob(pattern):
        with suppress(FileNotFoundError, IndexError):  # removed at the end; empty at the beginning
            return int(lock.read_text(encoding="utf-8").split()[1])
    return None


def until(what, value):
    """Wait until a function of no argument returns something true, and return that."""
    end = time.monotonic() + 300.0
    while not (result := value()):
        assert time.monotonic() < end, f"no {what}"
        time.sleep(0.005)
    return result
