"""The method under check, the scene, and what earlier checks have made of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from coliags_plugin.config.method_config import LoadedMethod, MethodConfig
from coliags_plugin.core.scenes import Scene
from coliags_plugin.engine.checkpoints import Checkpoint, read_checkpoint
from coliags_plugin.engine.data_formats import load_method_for
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.engine.trainer import Trainer

CPU = torch.device("cpu")
#: Of every run; another one would do.
SEED = 0


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
    def config(self) -> MethodConfig | None:
        """The method's config; None where it could not be read."""
        return self.loaded.config if hasattr(self, "loaded") else None

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
        """A trainer of the method on the scene, unless others are given; its run folder is not made yet."""
        scene = scene or self.scene
        return Trainer(method or self.loaded, scene, str(self.data.resolve()), RunFolder(self.folder / run), SEED, CPU)

    def saved(self, trainer: Trainer, step: int) -> Checkpoint:
        """A checkpoint of a run."""
        return read_checkpoint(trainer.run.checkpoints / f"step-{step:06d}", self.loaded.name, CPU)


@contextmanager
def as_in_new_process() -> Iterator[None]:
    """Global random numbers of torch as they are when Python has just started, and afterwards as they were.

    Two runs in one process then draw the same ones, as they would in two; and a resumed run does not go on with them.
    """
    with torch.random.fork_rng(devices=[]):
        torch.set_rng_state(torch.Generator().get_state())
        yield


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
