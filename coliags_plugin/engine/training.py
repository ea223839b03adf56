"""Training of a method on a scene: the one place that decides whether a run begins, goes on or is refused."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from typing import Literal

import torch

from coliags_plugin.config.method_config import method_name
from coliags_plugin.config.options import TrainOptions
from coliags_plugin.core.errors import InputError
from coliags_plugin.engine.data_formats import at_scale, load_method_for, load_scene, training_scale
from coliags_plugin.engine.evaluator import check_evaluable
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.engine.scoring import Scorer
from coliags_plugin.engine.trainer import Trainer

log = logging.getLogger(__name__)

#: What becomes of a run folder that is there; see :func:`open_training`.
IfExists = Literal["refuse", "overwrite", "resume", "continue"]


@contextmanager
def open_training(
    options: TrainOptions,
    folder: RunFolder,
    device: torch.device,
    if_exists: IfExists = "refuse",
    *,
    owned: bool = False,
    run_name: str | None = None,
    scene_name: str | None = None,
    protocol: str | None = None,
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
    block ends.

    Args:
        options: Method, scene, changes and seed.
        folder: The run.
        device: To train on.
        if_exists: See above.
        owned: The caller holds the run's lock.
        run_name: The method's name in the run; None: its own.
        scene_name: The scene's name in the run; None: its own.
        protocol: Protocol of evaluations that has to fit the run; None: not checked.
    """
    resumes = if_exists == "resume" or (if_exists == "continue" and folder.config_file.is_file())
    if resumes:
        folder = RunFolder.existing(folder.path)
        overrides, data_format = ((), None) if if_exists == "continue" else (options.overrides, options.data_format)
        name = method_name(run_name or options.method)
        folder.check_method(name)
        # The config stored in the run, even if that of this name has changed since.
        method = load_method_for(options.data, str(folder.config_file.resolve()), overrides, data_format)
        method = replace(method, name=name)
        identity = folder.identity()
        seed, scale = identity.seed, identity.scale
        if options.seed not in (None, seed):
            begun = f"{folder.path}, which was started with seed {seed}"
            raise InputError(f"`seed={options.seed}` for {begun}", "no `seed`, or that one")
    else:
        folder.check_free(if_exists == "overwrite")
        method = load_method_for(options.data, options.method, options.overrides, options.data_format)
        method, seed, scale = replace(method, name=run_name or method.name), options.seed or 0, None
    scene, path = load_scene(method.config, options.data), str(options.data.resolve())
    scene = at_scale(scene, training_scale(scene) if scale is None else scale, method.config.near_plane)
    if scene_name is not None:
        scene = replace(scene, name=scene_name)
    trainer = Trainer(method, scene, path, folder, seed, device)
    if protocol is not None:
        check_evaluable(trainer.model, scene, Scorer(protocol))
    log.info("renderer %s: %s", trainer.chosen.name, trainer.chosen.reason)
    with nullcontext() if owned else folder.owned():
        if resumes:
            trainer.resume()
        else:
            trainer.start(if_exists == "overwrite")
        yield trainer
