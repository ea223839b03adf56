"""The method under check, the small scene it is checked on, and results that its checks share."""

from __future__ import annotations

import io
import shutil
import sysconfig
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stderr, suppress
from functools import cache, cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import torch
from torch import Tensor

from coliags_plugin.checks.results import CheckResult, CheckSkippedError, fail_if, run_check
from coliags_plugin.config.method_config import LoadedMethod, MethodConfig, load_method, method_tree
from coliags_plugin.core import registry
from coliags_plugin.core.components import Component
from coliags_plugin.core.errors import InputError, InterruptedRunError, ReportedError
from coliags_plugin.core.scenes import Scene
from coliags_plugin.engine.checkpoints import Checkpoint, checkpoint_folder, read_checkpoint
from coliags_plugin.engine.data_formats import load_method_for, load_scene
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.engine.trainer import Trainer
from coliags_plugin.phantom.generate import generate
from coliags_plugin.phantom.settings import phantom_settings

CPU = torch.device("cpu")
#: Fewer leave nothing to stop half-way, nor between events of a strategy.
MIN_STEPS = 10
#: Any seed would do.
_SEED = 0
#: A phantom that is made in a second and has few pixels to render; two of its frames are held out.
_PHANTOM = {
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
#: Layout with depth, from which initial points are fused; and layouts with what losses may need besides.
_DEFAULT_LAYOUT, _LAYOUTS_WITH = "c3vd", {"sparse_depth": "colmap"}

_PACKAGE = Path(__file__).parents[1]
_LIBRARIES = tuple(Path(sysconfig.get_path(name)) for name in ("stdlib", "platstdlib", "purelib", "platlib"))
T = TypeVar("T")


class CheckContext:
    """A method, the scene it is checked on, and the results of its checks, each of which is made once.

    A check is a function of the context. It returns what later ones need, and raises :class:`CheckFailedError`,
    :class:`CheckSkippedError`, or whatever a component raises.
    """

    def __init__(
        self,
        method: str,
        folder: Path,
        overrides: Sequence[str] = (),
        data: Path | None = None,
        data_format: str | None = None,
        steps: int = 20,
    ) -> None:
        """Make the phantom if no scene is named; schedules are scaled to ``steps``.

        Args:
            method: Name or path of the method config.
            folder: Existing folder for the phantom and the runs.
            overrides: ``key.path=value`` assignments.
            data: The scene's folder; None: a small phantom.
            data_format: A data manager's name; None: the method's, or recognised.
            steps: Length of the runs.

        Raises:
            InputError: There is no such method or folder, or the runs are too short.
        """
        method_tree(method, overrides)
        if steps < MIN_STEPS:
            raise InputError(f"`steps={steps}`", f"{MIN_STEPS} or more")
        if data is not None and not data.exists():
            raise InputError(f"no folder {data}", "a scene", "Check the path, or leave `data` out")
        self.method, self.folder, self.overrides, self.data_format = method, folder, tuple(overrides), data_format
        self.steps, self.half = steps, steps // 2
        self.data = data or _write_phantom(method, overrides, folder)
        self._results: dict[Callable[[CheckContext], Any], Any] = {}

    def run(self, check: Callable[[CheckContext], T]) -> T:
        """Return or raise what a check returned or raised, running it unless that has been done."""
        if check not in self._results:
            try:
                # Progress bars are hidden, and the global random numbers that `build` resets go on as before.
                with redirect_stderr(io.StringIO()), torch.random.fork_rng(devices=[]):
                    self._results[check] = check(self)
            except InterruptedRunError:
                raise
            except Exception as error:
                self._results[check] = error
        result = self._results[check]
        if isinstance(result, Exception):
            raise result
        return result

    def result_of(self, check: Callable[[CheckContext], T]) -> T:
        """Return what a check returned that has to pass before the one that asks, which is skipped otherwise."""
        try:
            return self.run(check)
        except Exception as error:
            raise CheckSkippedError(f"needs '{name_of_check(check)}'") from error

    def outcome(self, check: Callable[[CheckContext], Any]) -> CheckResult:
        """Run a check for its line: its docstring, or why it failed or was skipped."""

        def run() -> str:
            self.run(check)
            return (check.__doc__ or "").partition("\n")[0]

        return run_check(name_of_check(check), run, self.describe)

    @cached_property
    def loaded(self) -> LoadedMethod:
        """The method, resolved for the scene."""
        return self.load()

    @cached_property
    def scene(self) -> Scene:
        """The scene, as the method reads it."""
        return load_scene(self.loaded.config, self.data)

    def load(self, extra: Sequence[str] = ()) -> LoadedMethod:
        """Load the method with its length set, logging every step, and with a checkpoint in the middle."""
        lengths = (f"steps={self.steps}", "log_every=1", f"checkpoint_every={self.half}")
        changes = [*self.overrides, *(f"schedule.{length}" for length in lengths), *extra]
        return load_method_for(self.data, self.method, changes, self.data_format)

    def build(self, run: str, scene: Scene | None = None, method: LoadedMethod | None = None) -> Trainer:
        """Make a trainer of the method on the scene, unless others are given; its run folder is not written yet.

        Global random numbers of torch are as they are when Python has just started: two runs in one process then draw
        the same ones, as they would in two, and a resumed run does not go on with them.
        """
        torch.set_rng_state(torch.Generator().get_state())
        method, scene = method or self.loaded, scene or self.scene
        return Trainer(method, scene, str(self.data.resolve()), RunFolder(self.folder / run), _SEED, CPU)

    def saved(self, trainer: Trainer, step: int) -> Checkpoint:
        """Read a checkpoint of a run."""
        return read_checkpoint(checkpoint_folder(trainer.run.checkpoints, step), self.loaded.name, CPU)

    def compare(self, first: Trainer, second: Trainer, step: int, what: str) -> None:
        """Fail the check where two runs do not have the same bits at a step; the message begins with ``what``."""
        ours, theirs = (self.saved(trainer, step) for trainer in (first, second))
        planned = "the sampler plans other frames" if ours.frame_queue != theirs.frame_queue else ""
        fail_if(
            planned or difference(ours.tensors, theirs.tensors),
            what,
            "random numbers must come from the generators given, and what decides on the steps to come must be in "
            "them, in parameters, buffers or counters",
        )

    def describe(self, error: BaseException) -> str:
        """Put an exception into one line: message, and type and line in the user's code unless it is a reported one."""
        message = "; ".join(str(error).split("\n"))
        if isinstance(error, ReportedError):
            return message
        location = _location(error)
        return f"{type(error).__name__}: {message}{f' ({location})' if location else ''}"


def name_of_check(check: Callable[..., Any]) -> str:
    """Name of a check as it is printed, for instance ``renders again``."""
    return check.__name__.removeprefix("check_").replace("_", " ")


def difference(first: dict[str, Tensor], second: dict[str, Tensor]) -> str:
    """Describe how two sets of tensors differ that should be equal to the bit; empty where they are."""
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


def _location(error: BaseException) -> str:
    """``file:line`` of the innermost frame in code that is neither a library's nor this package's; empty without."""
    for frame, number in reversed(list(traceback.walk_tb(error.__traceback__))):
        path = Path(frame.f_code.co_filename)
        if not any(path.is_relative_to(root) for root in (_PACKAGE, *_LIBRARIES)):
            return f"{path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path}:{number}"
    return ""


def _write_phantom(method: str, overrides: Sequence[str], folder: Path) -> Path:
    """Make a phantom in the layout of the method's data manager, if there is one of that name, or for its losses."""
    manager = method_tree(method, overrides).find(["datamanager", "name"]).value
    layout = manager
    if manager not in registry.phantom_layouts:
        layout = _DEFAULT_LAYOUT
        with suppress(InputError):  # of an invalid config: the first check tells
            losses = load_method(method, overrides).config.losses
            needed = {name for node in losses.values() for name in node.target.needs}
            layout = next((other for name, other in _LAYOUTS_WITH.items() if name in needed), layout)
        if manager in registry.datamanagers and registry.datamanagers.source(manager) == "built in":
            if manager not in ("auto", layout):
                raise InputError(f"no phantom is made for the data manager '{manager}'", do="Name a scene with `data`")
    return shutil.copytree(_phantom(layout).name, folder / "phantom", dirs_exist_ok=True)


@cache
def _phantom(layout: str) -> TemporaryDirectory[str]:
    """Phantom in a layout, made once in a process and removed at its end."""
    folder = TemporaryDirectory(prefix="coliags-phantom-")
    generate(phantom_settings({"layout": layout, **_PHANTOM}), Path(folder.name), overwrite=True)
    return folder
