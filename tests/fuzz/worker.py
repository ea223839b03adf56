"""Runs cases in a process of its own, whose memory is limited: one JSON object per line in, one per line out."""

from __future__ import annotations

import contextlib
import gc
import json
import logging
import os
import resource
import shutil
import sys
import tempfile
import traceback
import warnings
from pathlib import Path
from typing import Any

#: Beyond the need of the seed, bytes; a case that asks for more has failed.
MEMORY = 1 << 30
#: Address space that may be reserved beyond that without being used: stacks of threads, arenas.
_SLACK = 1 << 29


def main() -> None:
    """Serve until the end of the input."""
    seeds = Path(sys.argv[1])
    answers = os.fdopen(os.dup(1), "w")
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in (1, 2):
        os.dup2(nothing, stream)
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    import torch

    torch.set_num_threads(1)
    runner = Runner(seeds)
    print("ready", file=answers, flush=True)
    for line in sys.stdin:
        asked = json.loads(line)
        found = runner.measure(asked["measure"]) if "measure" in asked else runner.run(asked)
        print(json.dumps(found), file=answers, flush=True)


class Runner:
    """Runs cases on copies of the seeds.

    Args:
        seeds: Their folder.
    """

    def __init__(self, seeds: Path) -> None:
        self.seeds = seeds
        self._needs: dict[str, int] = {}

    def measure(self, name: str) -> dict[str, Any]:
        """What becomes of the undamaged files of a target; the memory that they need limits its cases."""
        found = self._once({"target": name, "edits": []}, None)
        self._needs[name] = found["memory"]
        return found

    def run(self, case: dict[str, Any]) -> dict[str, Any]:
        """What became of a case: ``outcome``, ``detail``, and for a traceback its ``place``.

        Its target is to be measured before.
        """
        name = case["target"]
        found = self._once(case, self._needs[name] + MEMORY)
        if found["memory"] > self._needs[name] + MEMORY and found["outcome"] != "traceback":
            found.update(outcome="memory", detail=f"{found['memory'] - self._needs[name]:,} bytes beyond the need")
        return found

    def _once(self, case: dict[str, Any], most: int | None) -> dict[str, Any]:
        from coliags_plugin.core.errors import ReportedError
        from tests.fuzz.geometry import AbsurdError
        from tests.fuzz.mutations import apply
        from tests.fuzz.targets import TARGETS

        target = TARGETS[case["target"]]
        work = Path(tempfile.mkdtemp(prefix="fuzz-", dir=os.environ.get("TMPDIR")))
        folder = work / "seed"
        try:
            shutil.copytree(self.seeds / target.seeds, folder, copy_function=shutil.copy if target.writes else os.link)
            for edit in case["edits"]:
                apply(folder, edit)
            before = _start_measuring()
            with _limited(None if most is None else most + _SLACK):
                try:
                    target.read(folder)
                    found = {"outcome": "fine", "detail": ""}
                except ReportedError as error:
                    found = {"outcome": "message", "detail": str(error)[:300]}
                except AbsurdError as error:
                    found = {"outcome": "absurd", "detail": str(error)[:300]}
                except MemoryError as error:
                    found = {"outcome": "memory", "detail": str(error)[:300], "place": _place(error)}
                except BaseException as error:
                    if isinstance(error, RuntimeError) and "allocate memory" in str(error):
                        found = {"outcome": "memory", "detail": str(error)[:300], "place": _place(error)}
                    else:
                        found = {
                            "outcome": "traceback",
                            "detail": f"{type(error).__name__}: {str(error)[:300]}",
                            "place": _place(error),
                        }
            return {**found, "memory": _peak() - before}
        finally:
            shutil.rmtree(work, ignore_errors=True)
            gc.collect(0)


def _place(error: BaseException) -> str:
    """The deepest line of the package in a traceback."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if "coliags_plugin/" in frame.filename]
    if not frames:
        return "outside the package"
    last = frames[-1]
    return f"{last.filename.split('coliags_plugin/')[-1]}:{last.lineno} {last.name}"


def _status(key: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(key):
            return int(line.split()[1]) * 1024
    return 0


def _start_measuring() -> int:
    """Resident memory now, bytes; its highest value is counted anew."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return _status("VmRSS:")


def _peak() -> int:
    return _status("VmHWM:")


@contextlib.contextmanager
def _limited(more: int | None) -> Any:
    """Let the address space grow by so many bytes and no more."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    if more is not None:
        resource.setrlimit(resource.RLIMIT_AS, (_status("VmSize:") + more, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


if __name__ == "__main__":
    main()
