"""The method under check, the small scene it is checked on, and where in its components an exception comes from."""

from __future__ import annotations

import shutil
import sysconfig
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from torch import Tensor

from coliags_plugin.checks.results import CheckFailedError
from coliags_plugin.config import registry
from coliags_plugin.config.components import Component
from coliags_plugin.config.method_config import LoadedMethod, MethodConfig, load_method, method_tree
from coliags_plugin.core.errors import InputError, ReportedError
from coliags_plugin.core.scenes import Scene
from coliags_plugin.engine.checkpoints import Checkpoint, checkpoint_folder, read_checkpoint
from coliags_plugin.engine.data_formats import load_method_for
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.engine.trainer import Trainer
from coliags_plugin.phantom.generate import generate
from coliags_plugin.phantom.settings import phantom_settings

CPU = torch.device("cpu")
#: Of every run; another one would do.
SEED = 0
#: Small and coarse: a second to make, and few pixels to render. Two of the frames are held out.
PHANTOM = {
    "frames": 12,
    "width": 40,
    "height": 32,
    "rotation_views": 0,
    "polyps": 1,
    "path_length": 20.0,
    "interreflection": 0.0,
    "mesh_spacing": 2.0,
    "texture_spacing": 0.5,
}
#: Has depth, from which initial points are fused.
_DEFAULT_LAYOUT = "c3vd"
#: Layouts that have what losses may need and the default layout lacks.
_LAYOUTS_WITH = {"sparse_depth": "colmap"}

_PACKAGE = Path(__file__).parents[2]
_LIBRARIES = tuple(Path(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib", "purelib", "platlib"))


@dataclass
class CheckContext:
    """Inputs of the checks of a method, and intermediate results that one check leaves for those that need it."""

    method: str  # name or path of the method config
    overrides: tuple[str, ...]  # the user's ``key.path=value`` assignments
    data: Path  # the scene's folder
    data_format: str | None  # a data manager's name; None: the method's, or recognised
    steps: int  # length of the runs
    folder: Path  # where runs go
    loaded: LoadedMethod = field(init=False)  # the method, resolved for the scene (by ``resolves``)
    scene: Scene = field(init=False)  # the scene (by ``builds``)
    trainer: Trainer = field(init=False)  # the run of the whole length, at its end (by ``trains``)
    rows: list[dict[str, Any]] = field(init=False)  # its log, one row per step (by ``trains``)
    trained: TrainedRun = field(init=False)  # the same run, read back from its folder (by ``loads``)

    @property
    def half(self) -> int:
        """The step in the middle of a run, of which there is a checkpoint."""
        return self.steps // 2

    def load(self, extra: Sequence[str] = ()) -> LoadedMethod:
        """The method with its length set, logging every step, and with a checkpoint in the middle."""
        lengths = (f"steps={self.steps}", "log_every=1", f"checkpoint_every={self.half}")
        changes = [*self.overrides, *(f"schedule.{length}" for length in lengths), *extra]
        return load_method_for(self.data, self.method, changes, self.data_format)

    def build(self, run: str, scene: Scene | None = None, method: LoadedMethod | None = None) -> Trainer:
        """A trainer of the method on the scene, unless others are given; its run folder is not made yet.

        Global random numbers of torch are as they are when Python has just started: two runs in one process then draw
        the same ones, as they would in two, and a resumed run does not go on with them.
        """
        torch.set_rng_state(torch.Generator().get_state())
        scene = scene or self.scene
        return Trainer(method or self.loaded, scene, str(self.data.resolve()), RunFolder(self.folder / run), SEED, CPU)

    def saved(self, trainer: Trainer, step: int) -> Checkpoint:
        """A checkpoint of a run."""
        return read_checkpoint(checkpoint_folder(trainer.run.checkpoints, step), self.loaded.name, CPU)

    def compare(self, first: Trainer, second: Trainer, step: int, what: str) -> None:
        """Fail the check where two runs have not the same bits at a step; the message begins with what they are."""
        ours, theirs = (self.saved(trainer, step) for trainer in (first, second))
        planned = "the sampler plans other frames" if ours.frame_queue != theirs.frame_queue else ""
        refuse(
            what,
            planned or difference(ours.tensors, theirs.tensors),
            "random numbers must come from the generators given, and what decides on the steps to come must be in "
            "them, in parameters, buffers or counters",
        )

    def describe(self, error: BaseException) -> str:
        """An exception in one line: its message, with type and line in the user's code unless it is a reported one."""
        message = "; ".join(str(error).split("\n"))
        if isinstance(error, ReportedError):
            return message
        location = _location(error, components(self.loaded.config) if hasattr(self, "loaded") else {})
        return f"{type(error).__name__}: {message}{f' ({location})' if location else ''}"


@dataclass(frozen=True)
class MethodCheck:
    """One entry of the list of checks."""

    name: str  # short and unique
    #: does it and returns what it found; its docstring says what it is about. Raises CheckFailedError or
    #: CheckSkippedError, or whatever a component raises.
    run: Callable[[CheckContext], str]
    needs: tuple[str, ...] = ()  # checks that must have passed


def difference(first: dict[str, Tensor], second: dict[str, Tensor]) -> str:
    """What differs between two sets of tensors, which should be the same to the bit; empty where nothing does."""
    if first.keys() != second.keys():
        return f"{', '.join(sorted(first.keys() ^ second.keys()))} in one of them only"
    for name, tensor in first.items():
        other = second[name]
        if tensor.shape != other.shape:
            return f"{name} has shape {list(tensor.shape)} and {list(other.shape)}"
        if not torch.equal(tensor, other):
            apart = tensor != other
            most = (tensor.double() - other.double()).abs().max()
            return f"{name} differs in {int(apart.sum())} of {apart.numel()} numbers, by up to {float(most):.2g}"
    return ""


def refuse(fault: str, seen: str | Sequence[str], advice: str = "") -> None:
    """Fail the check where something is seen: a difference, or names that have a fault."""
    if seen:
        told = seen if isinstance(seen, str) else ", ".join(seen)
        raise CheckFailedError(f"{fault}: {told}{'; ' if advice else ''}{advice}")


def components(config: MethodConfig) -> dict[str, Component]:
    """Every component of a method by its path in the config, for instance ``field.geometry_head``."""
    fields = {name: getattr(config, name) for name in type(config).model_fields}
    return {path: node for name, value in fields.items() for path, node in _nested(name, value)}


def _nested(path: str, node: Any) -> Iterator[tuple[str, Component]]:
    """Paths and components of a value of the config: itself, its entries, or those among its options."""
    children: dict[str, Any] = node if isinstance(node, dict) else {}
    if isinstance(node, Component):
        yield path, node
        children = {name: getattr(node.settings, name) for name in type(node.settings).model_fields}
    for name, child in children.items():
        yield from _nested(f"{path}.{name}", child)


def _location(error: BaseException, parts: dict[str, Component]) -> str:
    """``file:line`` of the innermost frame in the method's own components, or else in code that is no library's."""
    names = {str(node.target.__module__).partition(".")[0] for node in parts.values()} - {_PACKAGE.name}
    frames = [
        (Path(frame.f_code.co_filename), line, str(frame.f_globals.get("__name__")).partition(".")[0])
        for frame, line in traceback.walk_tb(error.__traceback__)
        if Path(frame.f_code.co_filename).parent != Path(__file__).parent
    ]
    for chosen in (
        [frame for frame in frames if frame[2] in names],
        [frame for frame in frames if not any(frame[0].is_relative_to(root) for root in (_PACKAGE, *_LIBRARIES))],
        [frame for frame in frames if frame[0].is_relative_to(_PACKAGE)],
    ):
        if chosen:
            path, line, _ = chosen[-1]
            return f"{path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path}:{line}"
    return ""


def write_phantom(method: str, overrides: Sequence[str], folder: Path) -> Path:
    """Make the phantom that a method is checked on in a folder.

    In the layout of its data manager, where there is one of that name, or in one that has what its losses need.
    """
    named = method_tree(method, overrides).find(["datamanager", "name"]).value
    layout = named if named in registry.phantom_layouts else _layout_for_losses(method, overrides)
    reads_others = named in registry.datamanagers and registry.datamanagers.source(named) == "built in"
    if reads_others and named not in ("auto", layout):
        raise InputError(f"no phantom is made for the data manager '{named}'", do="Name a scene with `data`")
    return shutil.copytree(_phantom(layout).name, folder / "phantom", dirs_exist_ok=True)


def _layout_for_losses(method: str, overrides: Sequence[str]) -> str:
    needed: set[str] = set()
    with suppress(InputError):  # of an invalid config: the first check tells
        losses = load_method(method, overrides).config.losses
        needed = {name for node in losses.values() for name in node.target.needs}
    return next((layout for name, layout in _LAYOUTS_WITH.items() if name in needed), _DEFAULT_LAYOUT)


@cache
def _phantom(layout: str) -> TemporaryDirectory[str]:
    """Made once in a process, and removed at its end."""
    folder = TemporaryDirectory(prefix="coliags-phantom-")
    generate(phantom_settings({"layout": layout, **PHANTOM}), Path(folder.name), overwrite=True)
    return folder
