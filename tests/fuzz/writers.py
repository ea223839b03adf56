"""Every command that writes, at a size at which it takes a second, and whether what it wrote is whole."""

from __future__ import annotations

import json
import os
import shutil
import sys
import tempfile
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from coliags_plugin.export.splats.cloud import SplatCloud

#: Exit status that stands for an exception that no message was made of.
TRACEBACK = 99
#: Where what is made of a fused mesh lies.
_FUSED = ("mesh/mesh", "coverage/")
_TEXTS = frozenset({".json", ".jsonl", ".html", ".yaml", ".csv", ".md", ".log"})


@dataclass(frozen=True)
class Writer:
    """A command that writes.

    Attributes:
        argv: Its words, of the folder of inputs and the folder to write to.
        again: Words that it needs to replace what is there, or to go on.
        prepare: Puts something into the folder before, from the inputs.
        goes_on: Whether it is done in steps of which each is kept, so that a repetition goes on.
        within: Where in that folder it writes.
    """

    argv: Callable[[Path, Path], Sequence[object]]
    again: tuple[str, ...] = ("--overwrite",)
    prepare: Callable[[Path, Path], object] | None = None
    goes_on: bool = False
    within: str = "."

    def words(self, inputs: Path, place: Path, repeated: bool) -> list[str]:
        """The command line; with options of repeating where something is there."""
        return [str(word) for word in (*self.argv(inputs, place), *(self.again if repeated else ()))]


def _settings(*pairs: str) -> tuple[str, ...]:
    return tuple(word for pair in pairs for word in ("--set", pair))


_PHANTOM = ("--frames", 9, "--size", "64x52", "--rotation-views", 0)
_COARSE = _settings("mesh_spacing=3", "texture_spacing=1", "interreflection=0", "supersampling=1")
_SMALL = _settings(
    *("datamanager.points_count=500", "field.features=8", "field.children=4", "field.voxel_size=4"),
    *("schedule.log_every=1", "schedule.checkpoint_every=1", "strategy.statistics_from=0", "strategy.growth_from=2"),
    *("strategy.every=3", "strategy.gradient_threshold=1e-6", "strategy.pixels_per_birth=100"),
)


def _run(inputs: Path, place: Path) -> None:
    shutil.copytree(inputs / "run", place / "run")


WRITERS: dict[str, Writer] = {
    "phantom": Writer(lambda i, o: ("phantom", "-o", o / "phantom", *_PHANTOM, *_COARSE)),
    "train": Writer(
        lambda i, o: ("train", "coliags", "--data", i / "scene", "--output", o / "run", "--steps", 9, *_SMALL),
        again=("--resume",),
        goes_on=True,
    ),
    "import": Writer(lambda i, o: ("import", i / "cloud.ply", "--data", i / "scene", "--output", o / "run")),
    "eval": Writer(lambda i, o: ("eval", o / "run"), again=(), prepare=_run, within="run/eval"),
    "render": Writer(lambda i, o: ("render", i / "run", "--output", o / "renders")),
    "mesh": Writer(lambda i, o: ("mesh", i / "opaque", "-o", o / "mesh", *_settings("voxel_size=4", "min_views=1"))),
    "coverage": Writer(lambda i, o: ("coverage", i / "run", "--mesh", i / "mesh.ply", "--output", o / "coverage")),
    "export": Writer(lambda i, o: ("export", i / "run", "--output", o / "cloud.ply")),
    "view --output": Writer(lambda i, o: ("view", i / "run", "--output", o / "view.html"), again=()),
    "report": Writer(lambda i, o: ("report", i / "run", "--output", o / "report.html", "--format", "all"), again=()),
    "results export": Writer(lambda i, o: ("results", "export", i / "run", "--output", o / "table.csv"), again=()),
    "compare": Writer(
        lambda i, o: (
            *("compare", "coliags", "--scenes", i / "scene", "--output", o / "comparison", "--steps", 3, *_SMALL),
        ),
        again=(),
        goes_on=True,
    ),
    "poses convert (TUM)": Writer(
        lambda i, o: ("poses", "convert", i / "poses.txt", "-o", o / "poses.txt", "--to", "tum")
    ),
    "poses convert (COLMAP)": Writer(
        lambda i, o: ("poses", "convert", i / "poses.json", "-o", o / "model", "--to", "colmap")
    ),
    "poses export": Writer(lambda i, o: ("poses", "export", i / "procedure", "--output", o / "exported")),
    "poses sfm": Writer(
        lambda i, o: (
            *("poses", "sfm", i / "tube/images", "--output", o / "found"),
            *("--camera", "PINHOLE", "--params", (i / "params.txt").read_text()),
        )
    ),
    "depth estimate": Writer(
        lambda i, o: ("depth", "estimate", i / "tube", "--output", o / "depth", "--jobs", 1), goes_on=True
    ),
    "data check": Writer(lambda i, o: ("data", "check", i / "scene", "--html", o / "data.html"), again=()),
    "reconstruct": Writer(
        lambda i, o: (
            *("reconstruct", i / "scene", "--output", o / "reconstructed", "--steps", 3),
            *_settings("mesh.voxel_size=4"),
        ),
        again=(),
        goes_on=True,
    ),
}


def make_inputs(folder: Path) -> None:
    """Make what the commands read."""
    from coliags_plugin.export.splats.files import write_splats
    from tests.export.splats.clouds import random_cloud
    from tests.pipeline.procedures import write_procedure
    from tests.textured_tube import INTRINSICS, write_tube

    folder.mkdir(parents=True)
    _done("phantom", "-o", folder / "scene", *_PHANTOM, *_COARSE)
    _done("train", "coliags", "--data", folder / "scene", "--output", folder / "run", "--steps", 3, *_SMALL)
    _done("eval", folder / "run")
    shutil.copy(folder / "scene/truth/mesh.ply", folder / "mesh.ply")
    shutil.copy(folder / "scene/camera_pose.txt", folder / "poses.txt")
    _done(
        "poses",
        "convert",
        folder / "poses.txt",
        "-o",
        folder / "poses.json",
        "--to",
        "nerfstudio",
        "--intrinsics",
        "50,50,32,26",
        "--size",
        "64x52",
    )
    write_splats(folder / "cloud.ply", random_cloud(20, degree=0), "ply")
    write_splats(folder / "wall.ply", _wall(folder / "scene"), "ply")
    _done("import", folder / "wall.ply", "--data", folder / "scene", "--output", folder / "opaque")
    write_tube(folder / "tube", 9)
    write_procedure(folder / "procedure")
    (folder / "params.txt").write_text(",".join(map(str, INTRINSICS)))


def _wall(scene: Path) -> SplatCloud:
    """Opaque Gaussians on the wall of a scene, which can be meshed."""
    import numpy as np

    from coliags_plugin.api.scenes import load_scene
    from coliags_plugin.export.splats.cloud import SplatCloud

    means = load_scene(scene, settings={"points_count": 3000}).points.positions.numpy()
    count = len(means)
    return SplatCloud(
        means=means,
        quats_wxyz=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        scales=np.full((count, 3), 0.7, np.float32),
        opacities=np.full(count, 0.99, np.float32),
        harmonics=np.zeros((count, 1, 3), np.float32),
    )


def _done(*words: object) -> None:
    status = in_child(lambda: command([str(word) for word in words]))
    if status != 0:
        raise RuntimeError(f"{' '.join(map(str, words))} ended with {status}")


def command(words: Sequence[str]) -> int:
    """Exit status of a command in this process."""
    from coliags_plugin.cli import main

    try:
        main(words)
    except SystemExit as stopped:
        return int(stopped.code or 0)
    except BaseException:
        traceback.print_exc()
        return TRACEBACK
    return 0


def start(work: Callable[[], int], messages: Path | None = None) -> int:
    """Do something in a process forked from this one, which is warm; returns its number."""
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()
    if pid:
        return pid
    status = TRACEBACK
    try:
        os.setsid()
        target = os.open(messages or os.devnull, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o600)
        for stream in (1, 2):
            os.dup2(target, stream)
        import torch

        torch.set_num_threads(1)
        status = work()
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        os._exit(status)


def in_child(work: Callable[[], int], messages: Path | None = None) -> int:
    """Exit status of something done in a forked process."""
    return os.waitstatus_to_exitcode(os.waitpid(start(work, messages), 0)[1])


def warm_up() -> None:
    """Import what the commands import, and start no thread."""
    import cv2
    import open3d
    import pycolmap
    import torch

    import coliags_plugin.cli
    from coliags_plugin.config import registry

    for component in registry.datamanagers:
        registry.datamanagers.get(component)
    assert cv2 and open3d and pycolmap and torch and coliags_plugin.cli


def contents(place: Path) -> dict[str, bytes]:
    """Every file at its final place by name: not those of locks, nor unfinished work."""
    found = {}
    for path in sorted(place.rglob("*")):
        name = path.relative_to(place)
        if path.is_file() and not any(part.startswith(".") for part in name.parts):
            found[str(name)] = path.read_bytes()
    return found


def scratch(place: Path) -> list[str]:
    """What is being written, or was when its process ended."""
    return [str(path.relative_to(place)) for path in place.rglob(".*") if path.suffix == ".partial"]


def is_whole(name: str, data: bytes, reference: bytes | None) -> bool:
    """Whether a file is one that the command wrote to the end, as it wrote the reference."""
    suffix = Path(name).suffix
    if suffix == ".json":
        return _is_json(data)
    if suffix == ".html":
        return data.rstrip().endswith(b"</html>")
    if reference is not None and (suffix == ".safetensors" or name.endswith("per_frame.csv")):
        return data == reference  # training and evaluation end in the same to the bit, whatever killed them
    if suffix in _TEXTS or reference is None or name.endswith("SHA256SUMS"):
        return data.endswith(b"\n") or suffix in (".safetensors", ".log", "") or not data
    if suffix in (".npz", ".npy", ".db"):
        return len(data) > 0
    # open3d's triangles come in any order, and what is made of them differs a little
    return _is_readable(name, data) if any(part in name for part in _FUSED) else data == reference


def _is_json(data: bytes) -> bool:
    try:
        json.loads(data)
    except ValueError:
        return False
    return True


def _is_readable(name: str, data: bytes) -> bool:
    """Whether a mesh or an image can be read to its end."""
    from coliags_plugin.core.errors import InputError
    from coliags_plugin.core.images import decode_image
    from coliags_plugin.geometry.meshes.files import read_mesh

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / Path(name).name
        file.write_bytes(data)
        try:
            decode_image(file) if file.suffix == ".png" else read_mesh(file)
        except InputError:
            return False
    return file.suffix != ".obj" or data.endswith(b"\n")


def units(found: dict[str, bytes]) -> set[str]:
    """What is replaced as one: files and folders at the top."""
    return {name.split("/")[0] for name in found}


def judge(found: dict[str, bytes], old: dict[str, bytes], new: dict[str, bytes]) -> str:
    """``old``, ``new`` or what is wrong: every unit must be exactly as before, or whole as it is to be."""
    states = set()
    for unit in sorted(units(old) | units(new) | units(found)):
        parts = [{n: d for n, d in some.items() if n.split("/")[0] == unit} for some in (found, old, new)]
        now, before, after = parts
        if now == before:
            states.add("old")
        elif now.keys() == after.keys() and all(is_whole(name, now[name], after[name]) for name in now):
            states.add("new")
        else:
            broken = [name for name in now if name in after and not is_whole(name, now[name], after[name])]
            return (
                f"{unit}: missing {sorted(after.keys() - now.keys())[:3]}, "
                f"extra {sorted(now.keys() - after.keys())[:3]}, broken {broken[:3]}"
            )
    return "new" if states == {"new"} else "old" if states <= {"old"} else "old and new"


def mark_old(place: Path) -> dict[str, bytes]:
    """Make what is there tell itself from what will replace it; its new content."""
    for unit in sorted(units(contents(place))):
        path = place / unit
        last = path if path.is_file() else max(found for found in path.rglob("*") if found.is_file())
        last.write_bytes(last.read_bytes() + b"\n# old\n")
    return contents(place)
