"""Damaged files of every kind end in a result or in a message: never in another error, a hang or a full memory.

``FUZZ_EXAMPLES=1000 python -m pytest -m thorough tests/fuzz/test_readers.py`` draws as many new cases of every kind.
What breaks is to be added to ``corpus.jsonl``.
"""

from __future__ import annotations

import faulthandler
import json
import os
import resource
import shutil
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import HealthCheck, example, given, settings

from coliags_plugin.core.errors import ReportedError
from tests.fuzz.mutations import apply, edits
from tests.fuzz.targets import TARGETS

pytestmark = pytest.mark.thorough

#: Cases of each kind.
EXAMPLES = int(os.environ.get("FUZZ_EXAMPLES", "4"))
#: Bytes of address space that a case may take.
MEMORY = 3 << 29
#: Seconds of processor time of a case; seconds of the clock after which its process is ended.
LIMIT, LAST = 10.0, 300.0
CORPUS = [json.loads(line) for line in Path(__file__).with_name("corpus.jsonl").read_text().splitlines()]


class HangError(BaseException):
    """A case takes too much processor time."""


@contextmanager
def limits(seconds: float, memory: int) -> Iterator[None]:
    """Limit the processor time and address space of what is done."""

    def stop(number, frame):
        raise HangError(f"more than {seconds} s of processor time")

    size = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmSize"))
    before = resource.getrlimit(resource.RLIMIT_AS)
    handler = signal.signal(signal.SIGPROF, stop)
    faulthandler.dump_traceback_later(LAST, exit=True)
    resource.setrlimit(resource.RLIMIT_AS, (int(size.split()[1]) * 1024 + memory, before[1]))
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        resource.setrlimit(resource.RLIMIT_AS, before)
        faulthandler.cancel_dump_traceback_later()
        signal.signal(signal.SIGPROF, handler)


def read(seeds, target, damages, seconds=LIMIT, memory=MEMORY):
    """True if a target reads its files after these edits, or refuses them by a message."""
    with TemporaryDirectory() as place:
        folder = Path(place) / "seed"
        shutil.copytree(seeds / target.seeds, folder, copy_function=shutil.copy if target.writes else os.link)
        for edit in damages:
            apply(folder, edit)
        with limits(seconds, memory):
            try:
                target.read(folder)
            except ReportedError:
                return False
        return True


@pytest.mark.parametrize("name", TARGETS)
def test_damaged_files_are_read_or_refused_by_a_message(seeds, name):
    target = TARGETS[name]
    assert read(seeds, target, [], seconds=LAST), "the files as they are"

    @settings(
        max_examples=EXAMPLES,
        deadline=None,
        database=None,
        derandomize="FUZZ_EXAMPLES" not in os.environ,
        suppress_health_check=list(HealthCheck),
    )
    @given(edits(seeds / target.seeds, target.files))
    def check(damages):
        read(seeds, target, damages)

    for case in CORPUS:
        if case["target"] == name:
            check = example(case["edits"])(check)
    check()


def test_the_corpus_is_of_targets_that_there_are():
    assert {case["target"] for case in CORPUS} <= set(TARGETS)
