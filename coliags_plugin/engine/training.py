"""Training of a method on a scene: the one place that decides whether a run begins, goes on or is refused."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch

from coliags_plugin.config.method_config import method_name
from coliags_plugin.core.errors import InputError
from coliags_plugin.engine.data_formats import at_scale, load_method_for, load_scene, training_scale
from coliags_plugin.engine.evaluator import check_evaluable
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.engine.scoring import Scorer
from coliags_plugin.engine.trainer import Trainer

log = logging.getLogger(__name__)

#: What becomes of a run folder that is there; see :func:`open_training`.
IfExists = Literal["refuse", "overwrite", "resume", "continue"]


@dataclass(frozen=True)
class TrainingRequest:
    """Method, scene and changes of a run to be trained."""

    method: str  # name of a method, or path of a method config
    data: Path  # the scene's folder
    overrides: Sequence[str] = ()  # ``key.path=value`` assignments
    seed: int | None = None  # None: 0, or that of the resumed run
    data_format: str | None = None  # a data manager; None: the method's, or the one that recognises the folder
    method_name: str | None = None  # in the run; None: the method's own
    scene_name: str | None = None  # in the run; None: the scene's own
    protocol: str | None = None  # of evaluations that has to fit the run; None: not checked


@contextmanager
def open_training(
    request: TrainingRequest,
    folder: RunFolder,
    device: torch.device,
    if_exists: IfExists = "refuse",
    owned: bool = False,
) -> Iterator[Trainer]:
    """Trainer of a run, from its newest whole checkpoint or from the start, after everything has been checked.

    ============  ====================  ============================================
    ``if_exists`` no or an empty folder a run
    ============  ====================  ============================================
    ``refuse``    begins                is refused
    ``overwrite`` begins                is replaced
    ``resume``    is refused            goes on, with the overrides on its own config
    ``continue``  begins                goes on as it was begun
    ============  ====================  ============================================

    Any other folder is refused; after a refusal, nothing was written. No other process can train the run until the
    block ends; ``owned``: the caller holds the run's lock.
    """
    resumes = if_exists == "resume" or (if_exists == "continue" and folder.config_file.is_file())
    if resumes:
        folder = RunFolder.existing(folder.path)
        overrides, data_format = ((), None) if if_exists == "continue" else (request.overrides, request.data_format)
        name = method_name(request.method_name or request.method)
        folder.check_method(name)
        # The config stored in the run, even if that of this name has changed since.
        method = load_method_for(request.data, str(folder.config_file.resolve()), overrides, data_format)
        method = replace(method, name=name)
        identity = folder.identity()
        seed, scale = identity.seed, identity.scale
        if request.seed not in (None, seed):
            begun = f"{folder.path}, which was started with seed {seed}"
            raise InputError(f"`seed={request.seed}` for {begun}", "no `seed`, or that one")
    else:
        folder.check_free(if_exists == "overwrite")
        method = load_method_for(request.data, request.method, request.overrides, request.data_format)
        method, seed, scale = replace(method, name=request.method_name or method.name), request.seed or 0, None
    scene, path = load_scene(method.config, request.data), str(request.data.resolve())
    scene = at_scale(scene, training_scale(scene) if scale is None else scale, method.config.near_plane)
    if request.scene_name is not None:
        scene = replace(scene, name=request.scene_name)
    trainer = Trainer(method, scene, path, folder, seed, device)
    if request.protocol is not None:
        check_evaluable(trainer.model, scene, Scorer(request.protocol))
    log.info("renderer %s: %s", trainer.chosen.name, trainer.chosen.reason)
    with nullcontext() if owned else folder.owned():
        if resumes:
            trainer.resume()
        else:
            trainer.start(if_exists == "overwrite")
        yield trainer
