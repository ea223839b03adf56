"""Many cases in workers that are killed when they hang, and what became of them."""

from __future__ import annotations

import hashlib
import json
import os
import queue
import select
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

from tests.fuzz.mutations import draw, single
from tests.fuzz.targets import TARGETS, files_of

Case = dict[str, Any]

ROOT = Path(__file__).resolve().parents[2]
CORPUS = Path(__file__).parent / "corpus"
#: Seconds of processor time of one case.
LIMIT = 10.0
#: Seconds of processor time of the undamaged files, which compile what is compiled.
_FIRST_LIMIT = 300.0
#: Seconds of the clock for a second of processor time, on a machine that others use too.
_PATIENCE = 30.0
FINE = ("fine", "message")
OUTCOMES = (*FINE, "traceback", "hang", "memory", "absurd", "crash")


@dataclass
class Tally:
    """Outcomes so far.

    Attributes:
        outcomes: By target, then outcome.
        broken: Cases that are none of :data:`FINE`, with what they did: the first of each kind.
    """

    outcomes: dict[str, Counter[str]] = field(default_factory=dict)
    broken: dict[str, tuple[Case, dict[str, Any]]] = field(default_factory=dict)

    @property
    def count(self) -> int:
        """Cases in all."""
        return sum(sum(counter.values()) for counter in self.outcomes.values())

    def add(self, case: Case, found: dict[str, Any]) -> None:
        """Count a case."""
        self.outcomes.setdefault(case["target"], Counter())[found["outcome"]] += 1
        if found["outcome"] not in FINE:
            place = found.get("place") or f"{case['target']} {[edit['op'] for edit in case['edits']]}"
            kind = f"{found['outcome']} {place} {found['detail'].split(':')[0]}"
            self.broken.setdefault(kind, (case, found))

    def table(self) -> str:
        """Markdown: a row per target and one of sums."""
        rows = [(name, self.outcomes[name]) for name in TARGETS if name in self.outcomes]
        rows.append(("**all**", sum((counter for _, counter in rows), Counter())))
        lines = [f"| read | cases | {' | '.join(OUTCOMES)} |", "|---" * (len(OUTCOMES) + 2) + "|"]
        for name, counter in rows:
            cells = [f"{counter[outcome]:,}" for outcome in OUTCOMES]
            lines.append(f"| {name} | {sum(counter.values()):,} | {' | '.join(cells)} |")
        return "\n".join(lines)


def cases(seeds: Path, first: int, count: int, names: Iterable[str] = ()) -> Iterator[Case]:
    """Cases by their numbers: the same numbers give the same cases."""
    chosen = list(names) or list(TARGETS)
    weights = [TARGETS[name].weight for name in chosen]
    files = {name: files_of(TARGETS[name], seeds) for name in chosen}
    for number in range(first, first + count):
        random = Random(number)
        name = random.choices(chosen, weights)[0]
        yield {"target": name, "edits": draw(files[name], seeds / TARGETS[name].seeds, random)}


def single_cases(seeds: Path, names: Iterable[str] = ()) -> Iterator[Case]:
    """Cases of one edit each, of every value of one file of every kind that a target reads."""
    for name in list(names) or list(TARGETS):
        kinds: dict[tuple[str, str], str] = {}
        for file in files_of(TARGETS[name], seeds):
            path = Path(file)
            of_many = path.suffix in (".png", ".jpg", ".tiff", ".npy")
            kinds.setdefault((str(path.parent), path.suffix if of_many else path.name), file)
        for file in kinds.values():
            for edit in single(file, (seeds / TARGETS[name].seeds / file).read_bytes()):
                yield {"target": name, "edits": [edit]}


def run_all(seeds: Path, chosen: Iterable[Case], jobs: int = 1, tell: Any = None) -> Tally:
    """Run cases.

    Args:
        seeds: Folder of the seeds.
        chosen: The cases.
        jobs: Workers at a time.
        tell: Called with the tally after each.
    """
    waiting: queue.Queue[Case | None] = queue.Queue(maxsize=4 * jobs)
    tally, lock = Tally(), threading.Lock()

    def work() -> None:
        worker = Worker(seeds)
        try:
            while (case := waiting.get()) is not None:
                found = worker.run(case)
                with lock:
                    tally.add(case, found)
                    if tell is not None:
                        tell(tally)
        finally:
            worker.stop()

    threads = [threading.Thread(target=work, daemon=True) for _ in range(jobs)]
    for thread in threads:
        thread.start()
    for case in chosen:
        while True:
            try:
                waiting.put(case, timeout=1.0)
                break
            except queue.Full:
                if not any(thread.is_alive() for thread in threads):
                    raise RuntimeError("all workers have failed") from None
    for _ in threads:
        waiting.put(None)
    for thread in threads:
        thread.join()
    return tally


class Worker:
    """A process that runs cases; another takes its place when it hangs or dies.

    Args:
        seeds: Folder of the seeds.
    """

    def __init__(self, seeds: Path) -> None:
        self.seeds = seeds
        self._process: subprocess.Popen[str] | None = None
        self._known: set[str] = set()

    def run(self, case: Case) -> dict[str, Any]:
        """What became of a case (:meth:`tests.fuzz.worker.Runner.run`), ``hang`` and ``crash`` among it."""
        name = case["target"]
        if name not in self._known:
            untouched = self._answer({"measure": name}, _FIRST_LIMIT)
            if untouched["outcome"] != "fine":
                return {**untouched, "outcome": "crash", "detail": f"the seed itself: {untouched['detail']}"}
            self._known.add(name)
        return self._answer(case, LIMIT)

    def _answer(self, question: Case, limit: float) -> dict[str, Any]:
        process = self._running()
        assert process.stdin is not None
        began = _processor_time(process.pid)
        process.stdin.write(json.dumps(question) + "\n")
        process.stdin.flush()
        until = time.monotonic() + _PATIENCE * limit
        while True:
            line = _line(process, 0.5)
            if line:
                return dict(json.loads(line))
            if process.poll() is not None or line == "":
                self.stop()
                return {"outcome": "crash", "detail": f"ended with {process.returncode}", "memory": 0}
            used = _processor_time(process.pid) - began
            if used > limit or time.monotonic() > until:
                self.stop()
                return {"outcome": "hang", "detail": f"{used:.1f} s of processor time", "memory": 0}

    def _running(self) -> subprocess.Popen[str]:
        if self._process is None:
            environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT), "PYTHONUTF8": "1"}
            command = [sys.executable, "-m", "tests.fuzz.worker", str(self.seeds)]
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment, cwd=ROOT
            )
            if _line(self._process, 300.0) != "ready\n":
                raise RuntimeError("the worker does not start")
        return self._process

    def stop(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.communicate()
            self._process = None
            self._known.clear()


def _line(process: subprocess.Popen[str], seconds: float) -> str | None:
    """The next line; None where none comes in that time, empty at the end."""
    assert process.stdout is not None
    ready, _, _ = select.select([process.stdout], [], [], seconds)
    return process.stdout.readline() if ready else None


def _processor_time(pid: int) -> float:
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def save(case: Case, found: dict[str, Any]) -> Path:
    """Store a case that broke something in the corpus."""
    text = json.dumps(case, indent=1, sort_keys=True) + "\n"
    path = CORPUS / f"{case['target']}-{hashlib.sha256(text.encode()).hexdigest()[:8]}.json"
    path.write_text(text)
    return path


def corpus() -> dict[str, Case]:
    """Everything that ever broke, by its name."""
    return {path.stem: json.loads(path.read_text()) for path in sorted(CORPUS.glob("*.json"))}


def shortened(seeds: Path, case: Case, found: dict[str, Any]) -> Case:
    """The case with the edits only that it needs to do the same."""
    worker = Worker(seeds)
    try:
        for edit in list(case["edits"]):
            fewer = {**case, "edits": [other for other in case["edits"] if other is not edit]}
            if fewer["edits"]:
                again = worker.run(fewer)
                if (again["outcome"], again.get("place")) == (found["outcome"], found.get("place")):
                    case = fewer
    finally:
        worker.stop()
    return case
