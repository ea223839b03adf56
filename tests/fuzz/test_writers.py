"""A command that is killed, or whose disk is full, leaves what was there or all that it writes; repeated, it ends well.

It is stopped at one of its writes, ``fsync`` and renames, half of the data of a write being on the disk.
``FUZZ_EXAMPLES=10`` tries ten of them for every command, spread over all of its work.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import sys
import traceback
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.comparison.small import TINY
from tests.faults import content, fault, killed, no_space

pytestmark = pytest.mark.thorough

MOMENTS = int(os.environ.get("FUZZ_EXAMPLES", "1"))
#: Exit statuses of an exception that no message was made of, and of a command that was killed.
TRACEBACK, KILLED = 99, 9
TEXTS = (".json", ".jsonl", ".html", ".yaml", ".csv", ".md", ".log", ".txt")
SMALL = " ".join(f"--set {setting}" for setting in (*TINY, "schedule.checkpoint_every=1"))
COARSE = "--set mesh_spacing=3 --set texture_spacing=1 --set interreflection=0 --set supersampling=1"


@dataclass(frozen=True)
class Writer:
    """A command that writes.

    Attributes:
        words: The command line; {seeds} and {out} stand for folders.
        again: Words that it needs to replace what is there, or to go on.
        goes_on: Whether each of its steps is kept, so that a repetition goes on.
        needs: What of the seeds is to lie in the folder of the output.
    """

    words: str
    again: str = "--overwrite"
    goes_on: bool = False
    needs: str = ""


WRITERS = {
    "poses convert": Writer("poses convert {seeds}/poses/nerfstudio/transforms.json -o {out}/model --to colmap"),
    "train": Writer(
        f"train coliags --data {{seeds}}/run/scene --output {{out}}/run --steps 5 {SMALL}", "--resume", goes_on=True
    ),
    "eval": Writer("eval {out}/run --data {seeds}/run/scene", "", needs="run/run"),
    "export": Writer("export {seeds}/run/run -o {out}/cloud.ply"),
    "report": Writer("report {seeds}/results/run -o {out}/report.html --format all"),
}
SLOW_WRITERS = {
    "phantom": Writer(f"phantom -o {{out}}/phantom --frames 9 --size 64x52 --rotation-views 0 {COARSE}"),
    "import": Writer("import {seeds}/splats/cloud.ply --data {seeds}/run/scene --output {out}/run"),
    "render": Writer("render {seeds}/run/run --data {seeds}/run/scene --output {out}/renders"),
    "view": Writer("view {seeds}/run/run --data {seeds}/run/scene --output {out}/view.html", ""),
    "compare": Writer(
        f"compare coliags --scenes {{seeds}}/run/scene --output {{out}}/all --steps 3 {SMALL}", "", goes_on=True
    ),
    "reconstruct": Writer(
        "reconstruct {seeds}/c3vd --output {out}/all --steps 3 --set mesh.voxel_size=4", "", goes_on=True
    ),
}
ROWS = [
    *(pytest.param(writer, id=name) for name, writer in WRITERS.items()),
    *(pytest.param(writer, id=name, marks=pytest.mark.slow) for name, writer in SLOW_WRITERS.items()),
]


def _work(words, when, kind, folder):
    """Work of the child, which writes how many operations it counted, and ends with the status of the command."""
    sys.stdout = sys.stderr = open(folder / "log.txt", "w")
    os.umask(0o077)
    status = TRACEBACK
    import torch

    from coliags_plugin.cli import main

    torch.set_num_threads(1)
    with fault(when, kind) as faulty:
        try:
            main(words)
            status = 0
        except SystemExit as stopped:
            status = int(stopped.code or 0)
        except BaseException:
            traceback.print_exc()
    (folder / "count.txt").write_text(str(faulty.seen))
    sys.stdout.flush()
    os._exit(status)


@pytest.fixture(scope="module")
def run():
    """Runs a command in a process forked from one that has imported everything and has no threads."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(
        ["coliags_plugin.api", "coliags_plugin.cli", "cv2", "kornia", "numba", "open3d", "pycolmap", "torch"]
    )

    def run(words, folder, when=-1, kind=no_space):
        process = context.Process(target=_work, args=(words.split(), when, kind, folder))
        process.start()
        process.join()
        return process.exitcode, (folder / "log.txt").read_text()

    return run


def files(place):
    """Content of every file at its final place, by name: not that of locks, nor of what was not finished."""
    contents = content(place)
    return {name: data for name, data in contents.items() if not any(part.startswith(".") for part in Path(name).parts)}


def scratch(place):
    return [path for path in place.rglob(".*") if path.suffix == ".partial"]


def is_whole(name, data, new):
    """True if a file is written to its end, as in a run that nobody disturbed."""
    if name.endswith((".safetensors", "per_frame.csv")):
        return data == new  # training and evaluation end in the same to the bit
    if name.endswith(".json"):
        try:
            return bool(json.loads(data)) or data == new
        except ValueError:
            return False
    end = b"</html>" if name.endswith(".html") else new.rstrip()[-1:]
    return data.rstrip().endswith(end) if name.endswith(TEXTS) else len(data) == len(new)


def wrong(current, old, new):
    """Files that are neither as before nor whole, of the files and folders that are replaced as one."""
    units = {name.split("/")[0] for name in (*current, *old, *new)}
    for unit in units:
        now, before, after = (
            {n: d for n, d in some.items() if n.split("/")[0] == unit} for some in (current, old, new)
        )
        if now != before:
            yield from now.keys() ^ after.keys()
            yield from (name for name in now.keys() & after.keys() if not is_whole(name, now[name], after[name]))


@pytest.mark.parametrize("writer", ROWS)
def test_nothing_is_lost(seeds, run, tmp_path, writer):
    out, reference = tmp_path / "out", tmp_path / "reference"
    words = writer.words.format(seeds=seeds, out=out)

    def prepare():
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir()
        if writer.needs:
            shutil.copytree(seeds / writer.needs, out / Path(writer.needs).name)

    prepare()
    before = set(out.rglob("*"))
    assert run(words, tmp_path)[0] == 0, (tmp_path / "log.txt").read_text()
    count = int((tmp_path / "count.txt").read_text())
    for path in set(out.rglob("*")) - before:
        assert path.stat().st_mode & 0o077 == 0, f"{path} can be read by others"
    shutil.copytree(out, reference)
    new = files(out)

    for moment in range(MOMENTS):
        when = int((moment + 0.5) / MOMENTS * count)
        for kind in (killed, no_space):
            prepare()
            if not (writer.goes_on or writer.needs):
                shutil.copytree(reference, out, dirs_exist_ok=True)
                for unit in out.iterdir():  # an older result
                    file = unit if unit.is_file() else max(path for path in unit.rglob("*") if path.is_file())
                    file.write_bytes(file.read_bytes() + b"\n# old\n")
            old = files(out)
            status, log = run(f"{words} {writer.again if old and not writer.needs else ''}", tmp_path, when, kind)
            current = files(out)
            if writer.goes_on or writer.needs:
                growing = (".jsonl", ".log", ".db")
                broken = [n for n in current.keys() & new.keys() - old.keys() if not n.endswith(growing)]
                assert not [name for name in broken if not is_whole(name, current[name], new[name])]
            elif (
                current or kind is no_space
            ):  # a kill between the two renames of a folder leaves the next write to put it back
                assert not list(wrong(current, old, new)), (when, kind, log)
            if kind is killed:
                assert status == KILLED
            else:
                assert (status == 0 and current.keys() == new.keys()) or ("space" in log and status in (1, 2)), log
                assert not scratch(out)
            again = writer.again if files(out) and not (writer.needs and files(out) == old) else ""
            status, log = run(f"{words} {again}", tmp_path)
            assert status == 0, log
            assert not list(wrong(files(out), {}, new)) and not scratch(out)
