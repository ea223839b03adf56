"""Loading of finished or interrupted runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch

from coliags_plugin.config.method_config import MethodConfig
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.lamps import HeldLight, Lamp
from coliags_plugin.core.scenes import Scene
from coliags_plugin.engine.checkpoints import read_checkpoint, restore_model
from coliags_plugin.engine.costs import TrainingCost
from coliags_plugin.engine.data_formats import load_scene
from coliags_plugin.engine.model import Model
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.renderers.splatting import choose_renderer


@dataclass(frozen=True)
class TrainedRun:
    """Scene and model of a run at its latest checkpoint, with the provenance that training recorded."""

    run: RunFolder
    config: MethodConfig = field(repr=False)
    method: str
    scene: Scene
    model: Model = field(repr=False)
    step: int
    device: torch.device
    seed: int
    provenance: Mapping[str, Any] = field(repr=False)
    cost: TrainingCost | None = None  # up to the checkpoint; None where it was not measured
    lamp: Lamp | None = None  # that it was relit with; None under the one that the data were recorded with
    held: HeldLight | None = None  # that stays as it is in all views; None under a lamp that moves with the camera

    @property
    def relit(self) -> bool:
        """True if it is rendered in another light than the data were recorded with."""
        return self.lamp is not None or self.held is not None

    @cached_property
    def in_model_units(self) -> TrainedRun:
        """The run with its scene in the model's unit of length, for what uses the model's field itself."""
        scale = self.model.scale
        if scale == 1.0:
            return self
        model = self.model.with_field(self.model.field, 1.0)
        light = None if self.held is None else self.held.scaled(scale)
        return replace(self, model=model, scene=self.scene.scaled(scale), held=light)

    @cached_property
    def training_frames(self) -> frozenset[str]:
        """Names of the frames it was trained on."""
        return frozenset(frame.name for frame in self.scene.train)


def load_trained(path: Path, device: torch.device, data: Path | None = None) -> TrainedRun:
    """Load a run, whose scene is read from ``data`` where it has moved since training."""
    run = RunFolder.existing(path)
    config = run.method().config
    identity, provenance = run.identity(), run.provenance()
    method, folder = identity.method, data or identity.scene_path
    saved = read_checkpoint(run.newest_checkpoint, method, device)
    scale = identity.scale
    scene = load_scene(config, folder).with_near_plane(config.near_plane / scale)
    if scene.provenance.fingerprint != identity.fingerprint:
        raise InputError(
            f"{folder} is not the data the run was trained on", "the same, unchanged data", "Pass `data=SCENE`"
        )
    renderer = choose_renderer(config.renderer, config.field.target.primitive, device).renderer
    model = restore_model(saved, config, scene, renderer, scale).to(device).eval()
    return TrainedRun(run, config, method, scene, model, saved.step, device, identity.seed, provenance, saved.cost)


def load_newer(trained: TrainedRun) -> TrainedRun | None:
    """The run at a checkpoint that was written since it was loaded; None where there is none."""
    if trained.run.step in (0, trained.step):
        return None
    saved, old = read_checkpoint(trained.run.newest_checkpoint, trained.method, trained.device), trained.model
    model = restore_model(saved, trained.config, trained.scene, old.renderer, old.scale).to(trained.device).eval()
    return replace(trained, model=model, step=saved.step, cost=saved.cost)
