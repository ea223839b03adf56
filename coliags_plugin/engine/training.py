"""Training of a method on a scene, from the start or resumed."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from coliags_plugin.config.method_config import LoadedMethod
from coliags_plugin.core.anonymity import without_places
from coliags_plugin.engine.data_formats import load_method_for, load_scene
from coliags_plugin.engine.resuming import resumed_method, resumed_seed
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.engine.trainer import Trainer

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class TrainingRequest:
    """What to train on what.

    Attributes:
        method: Name of a method or path of a method config.
        data: The scene's folder.
        overrides: ``key.path=value`` assignments.
        seed: Of all random generators; None: 0, or that of the resumed run.
        data_format: Name of a data manager; None: the method's, or the one that recognises the folder.
        anonymous: Keep absolute paths out of the run, so that ``--data`` has to name the scene afterwards.
    """

    method: str
    data: Path
    overrides: Sequence[str] = ()
    seed: int | None = None
    data_format: str | None = None
    anonymous: bool = False


@contextmanager
def start_training(
    request: TrainingRequest, folder: RunFolder, device: torch.device, overwrite: bool = False
) -> Iterator[Trainer]:
    """Make a run folder and what trains in it; no other process can train it until the block ends.

    Args:
        request: What to train.
        folder: The run folder to make.
        device: Where to compute.
        overwrite: Replace an existing run folder.

    Raises:
        InputError: Method, data or options are invalid or do not fit each other, or the folder exists or is another
            process's; nothing was written.
    """
    folder.check_free(overwrite)
    loaded = load_method_for(request.data, request.method, request.overrides, request.data_format)
    trainer = _trainer(loaded, request, folder, request.seed or 0, device)
    with folder.owned():
        trainer.start(overwrite)
        yield trainer


@contextmanager
def resume_training(request: TrainingRequest, folder: RunFolder, device: torch.device) -> Iterator[Trainer]:
    """What trains on in a run folder, from its newest whole checkpoint; no other process can until the block ends.

    Args:
        request: What is trained; overrides are applied to the run's own config.
        folder: The run.
        device: Where to compute.

    Raises:
        InputError: There is no run, it is another process's, or of another method, seed, other settings or data.
    """
    folder = RunFolder.existing(folder.path)
    loaded = resumed_method(folder, request.method, request.data, request.overrides, request.data_format)
    trainer = _trainer(loaded, request, folder, resumed_seed(folder, request.seed), device)
    with folder.owned():
        trainer.resume()
        yield trainer


def _trainer(
    loaded: LoadedMethod, request: TrainingRequest, folder: RunFolder, seed: int, device: torch.device
) -> Trainer:
    data = request.data
    scene, path = load_scene(loaded.config, data), str(data.resolve())
    if request.anonymous:
        scene, path = replace(scene, provenance=without_places(scene.provenance)), scene.name
    trainer = Trainer(loaded, scene, path, folder, seed, device)
    log.info("renderer %s: %s", trainer.chosen.name, trainer.chosen.reason)
    return trainer
