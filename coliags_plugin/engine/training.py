"""Training of a method on a scene, from the start or resumed."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from coliags_plugin.config.method_config import LoadedMethod
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
    """

    method: str
    data: Path
    overrides: Sequence[str] = ()
    seed: int | None = None
    data_format: str | None = None


def start_training(
    request: TrainingRequest, folder: RunFolder, device: torch.device, overwrite: bool = False
) -> Trainer:
    """Make a run folder and what trains in it.

    Args:
        request: What to train.
        folder: The run folder to make.
        device: Where to compute.
        overwrite: Replace an existing run folder.

    Raises:
        InputError: Method, data or options are invalid or do not fit each other, or the folder exists; nothing was
            written.
    """
    folder.check_free(overwrite)
    loaded = load_method_for(request.data, request.method, request.overrides, request.data_format)
    trainer = _trainer(loaded, request, folder, request.seed or 0, device)
    trainer.start(overwrite)
    return trainer


def resume_training(request: TrainingRequest, folder: RunFolder, device: torch.device) -> Trainer:
    """What trains on in a run folder, from its latest checkpoint.

    Args:
        request: What is trained; overrides are applied to the run's own config.
        folder: The run.
        device: Where to compute.

    Raises:
        InputError: There is no run, or it is of another method, seed, other settings or data.
    """
    folder = RunFolder.existing(folder.path)
    loaded = resumed_method(folder, request.method, request.data, request.overrides, request.data_format)
    trainer = _trainer(loaded, request, folder, resumed_seed(folder, request.seed), device)
    trainer.resume()
    return trainer


def _trainer(
    loaded: LoadedMethod, request: TrainingRequest, folder: RunFolder, seed: int, device: torch.device
) -> Trainer:
    data = request.data
    trainer = Trainer(loaded, load_scene(loaded.config, data), str(data.resolve()), folder, seed, device)
    log.info("renderer %s: %s", trainer.chosen.name, trainer.chosen.reason)
    return trainer
