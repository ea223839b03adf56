"""Stages that are done once, in order."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from coliags_plugin.core.errors import InputError
from coliags_plugin.pipeline import stages
from coliags_plugin.pipeline.stages import (
    LOCK_FILE,
    RECORD_FILE,
    Record,
    Stage,
    StageRecord,
    check_options,
    run_stages,
)
from tests.pipeline.conftest import Killed


@pytest.fixture(autouse=True)
def outputs(monkeypatch):
    for name in ("first", "second", "third"):
        monkeypatch.setitem(stages.OUTPUTS, name, (f"{name}.txt",))


class Workshop:
    """Three stages that write a file each, and a list of what was done."""

    def __init__(self, folder, kill=None, fail=None):
        self.folder, self.kill, self.fail, self.done = folder, kill, fail, []

    def stages(self, **options):
        return [
            Stage(name, lambda name=name: self.work(name), {"value": options.get(name, 0)})
            for name in ("first", "second", "third")
        ]

    def work(self, name):
        if name == self.fail:
            raise InputError("nothing to see", "something", "Look elsewhere")
        (self.folder / f"{name}.txt").write_text(name)
        if name == self.kill:
            raise Killed
        self.done.append(name)
        return StageRecord(f"{name} is there", {f"{name}.txt": "a file"})

    def run(self, overwrite=False, **options):
        self.done = []
        record, stages = Record.of(self.folder), self.stages(**options)
        check_options(stages, record, overwrite)
        run_stages(stages, record)
        return self.done


def test_an_option_that_the_version_of_a_record_did_not_have_is_none(tmp_path):
    shop = Workshop(tmp_path)
    shop.run()
    record, (first, *_) = Record.of(tmp_path), shop.stages()
    check_options([replace(first, options={"value": 0, "new": None})], record, overwrite=False)
    with pytest.raises(InputError, match="made with new None, not 2"):
        check_options([replace(first, options={"value": 0, "new": 2})], record, overwrite=False)


@pytest.mark.parametrize("name", ["first", "second", "third"])
def test_a_killed_run_goes_on(tmp_path, name):
    with pytest.raises(Killed):
        Workshop(tmp_path, kill=name).run()
    with pytest.raises(InputError, match=f"stage {name} was made with value 0, not 1"):
        Workshop(tmp_path).run(**{name: 1})
    order = ["first", "second", "third"]
    assert Workshop(tmp_path).run() == order[order.index(name) :]


def test_other_options_are_refused_or_repeat_what_depends_on_them(tmp_path):
    shop = Workshop(tmp_path)
    assert shop.run() == ["first", "second", "third"]
    content = json.loads((tmp_path / RECORD_FILE).read_text())
    assert (content["format"], list(content["stages"])) == (2, ["first", "second", "third"])
    second = Record.of(tmp_path).stages["second"]
    assert (second.state, second.summary, second.files) == ("done", "second is there", {"second.txt": "a file"})
    with pytest.raises(InputError, match=r"stage second was made with value 0, not 5.*`overwrite=True` to repeat"):
        shop.run(second=5)
    assert shop.run() == []
    (tmp_path / "third.txt").write_text("old")
    assert shop.run(overwrite=True, second=5) == ["second", "third"]
    assert (tmp_path / "third.txt").read_text() == "third"
    assert shop.run(second=5) == []


def test_a_stage_that_failed_can_be_tried_with_other_options(tmp_path):
    with pytest.raises(InputError) as refused:
        Workshop(tmp_path, fail="third").run()
    assert str(refused.value) == (
        "stage third: nothing to see. Expected something. Look elsewhere. "
        "first, second stand: the same command goes on from there."
    )
    assert Record.of(tmp_path).stages["third"].state == "failed"
    assert Workshop(tmp_path).run(third=1) == ["third"]


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("thesis.tex", "", "already exists and is no reconstruction"),
        (RECORD_FILE, '{"format": 2, "stages": 3}', r"cannot read .*reconstruction.json"),
        (RECORD_FILE, '{"format": 1, "version": "0.0.1", "stages": {}}', r"is of version 0\.0\.1 .*Choose another"),
    ],
)
def test_folders_of_something_else_or_of_other_versions_are_refused(tmp_path, file, content, message):
    (tmp_path / file).write_text(content)
    with pytest.raises(InputError, match=message):
        Record.of(tmp_path)


def test_several_processes_change_one_record_which_is_in_order(tmp_path):
    record = Record(tmp_path, {"survey": StageRecord()})
    record.write()
    names = ["segment-001/frames", "segment-000/submap-1/train", "segment-000/train"]
    workers = {name: Record.of(tmp_path) for name in names}
    for name, worker in workers.items():
        worker.put(name, StageRecord(files={name: "a file"}))
    assert record.refresh() and list(record.stages) == ["survey", *names[:0:-1], names[0]]
    workers[names[0]].forget(names[1:2])
    assert list(Record.of(tmp_path).stages) == ["survey", names[2], names[0]]
    assert [path.name for path in tmp_path.iterdir()] == [RECORD_FILE]
    assert list(record.within("segment-000")) == ["train", "submap-1/train"]


def test_what_a_kill_leaves_before_the_record_is_no_hindrance(tmp_path):
    (tmp_path / LOCK_FILE).write_text("")
    (tmp_path / f".{RECORD_FILE}.1234567890-0123abcd.partial").mkdir()
    Record.of(tmp_path).write()
    assert Record.of(tmp_path).stages == {}
    assert sorted(path.name for path in tmp_path.iterdir()) == [LOCK_FILE, RECORD_FILE]
