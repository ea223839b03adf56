"""Mutated files of every kind end in a result or in a message: never in a traceback, a hang or a full memory.

``python -m tests.fuzz --count 100000 --jobs 2`` runs more of the same cases.
"""

from __future__ import annotations

from random import Random

import pytest

from tests.fuzz import mutations
from tests.fuzz.campaign import FINE, cases, corpus, run_all
from tests.fuzz.seeds import make_seeds
from tests.fuzz.targets import TARGETS, files_of

pytestmark = pytest.mark.thorough

#: Cases in the suite: about half a minute on a quiet core.
COUNT = 150


@pytest.fixture(scope="module")
def seeds(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fuzz") / "seeds"
    make_seeds(folder)
    return folder


def test_every_seed_can_be_read_and_whatever_broke_once_or_may_break_ends_in_a_message(seeds):
    untouched = [{"target": name, "edits": []} for name in TARGETS]
    tally = run_all(seeds, [*untouched, *corpus().values(), *cases(seeds, 10**9, COUNT)])
    assert tally.count == len(TARGETS) + len(corpus()) + COUNT
    assert not tally.broken, "\n".join(f"{kind}: {case} {found}" for kind, (case, found) in tally.broken.items())


def test_the_same_numbers_are_the_same_cases(seeds):
    assert list(cases(seeds, 5, 20)) == list(cases(seeds, 5, 20))
    assert list(cases(seeds, 5, 20))[3:] == list(cases(seeds, 8, 17))


def test_every_edit_is_drawn_and_can_be_applied(seeds, tmp_path):
    drawn = {edit["op"] for case in cases(seeds, 0, 3000) for edit in case["edits"]}
    assert drawn == {*mutations.EDITS, "node"}
    for name, target in TARGETS.items():
        assert files_of(target, seeds), name
    random = Random(0)
    for number in range(300):
        path = tmp_path / f"{number}.json"
        path.write_bytes(b'{"a": [1, 2.5], "b": "c"}')
        for edit in mutations.draw({path.name: 1}, tmp_path, random):
            mutations.apply(tmp_path, edit)


def test_what_is_bad_is_told_apart(seeds):
    """The judge sees what it is there for."""
    from tests.fuzz.worker import Runner

    target = TARGETS["c3vd"]
    runner = Runner(seeds)

    def outcome(read):
        TARGETS["judged"] = type(target)(target.seeds, target.files, read)
        try:
            runner._needs["judged"] = 0
            return runner.run({"target": "judged", "edits": []})
        finally:
            del TARGETS["judged"]

    def full(folder):
        return bytes(2 << 30)

    assert outcome(lambda folder: None)["outcome"] in FINE
    assert outcome(full)["outcome"] == "memory"
    failed = outcome(lambda folder: {}["x"])
    assert failed["outcome"] == "traceback"
    assert "KeyError" in failed["detail"]
