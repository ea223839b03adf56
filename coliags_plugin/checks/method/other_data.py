"""Checks on scenes that lack something, and on pixels that are to be ignored."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch

from coliags_plugin.checks.method.context import CheckContext, as_in_new_process, difference
from coliags_plugin.checks.method.error_location import describe
from coliags_plugin.checks.results import CheckFailedError
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import Frame, PointCloud, Scene
from coliags_plugin.engine.trainer import Trainer

_VARIANTS: dict[str, Callable[[Scene], Scene]] = {
    "without depth": lambda scene: replace(scene, train=[_without_depth(frame.to("cpu")) for frame in scene.train]),
    "without points": lambda scene: replace(scene, points=PointCloud(torch.zeros(0, 3))),
    "with one frame": lambda scene: replace(scene, train=scene.train[:1]),
}
_STEPS = 2


def copes_with_other_data(context: CheckContext) -> str:
    """A scene without depth, without points or with one training frame is trained on, or refused beforehand."""
    told = {}
    for what, change in _VARIANTS.items():
        try:
            told[what] = _outcome(context, change(context.scene))
        except CheckFailedError as error:
            raise CheckFailedError(f"{what}: {error}") from error
        except Exception as error:
            raise CheckFailedError(
                f"{what}: {describe(error, context.loaded.config)}; expected training, or an InputError beforehand"
            ) from error
    return ", ".join(f"{what} {outcome}" for what, outcome in told.items())


def _without_depth(frame: Frame) -> Frame:
    return replace(frame, depth=None, depth_at_least=None, sparse_depth=None, depth_confidence=None)


def _outcome(context: CheckContext, scene: Scene) -> str:
    with as_in_new_process():
        try:
            trainer = context.build("elsewhere", scene)
        except InputError:
            return "refused"
        try:
            _take_steps(trainer)
        except InputError as error:
            raise CheckFailedError(f"refused only when training had begun: {error}") from error
    return "trains"


def ignores_masked_pixels(context: CheckContext) -> str:
    """What is in masked pixels, NaN included, changes no loss and no parameter."""
    runs: list[tuple[list[dict[str, Any]], Trainer]] = []
    for spoilt in (False, True):
        with as_in_new_process():
            frames = [_masked(frame.to("cpu"), spoilt) for frame in context.scene.train]
            trainer = context.build("masked", replace(context.scene, train=frames))
            runs.append((_take_steps(trainer), trainer))
    (rows, first), (spoilt_rows, second) = runs
    for ours, theirs in zip(rows, spoilt_rows, strict=True):
        wrong = [key for key, value in ours["terms"].items() if theirs["terms"][key] != value]
        if wrong:
            raise CheckFailedError(
                f"loss terms that depend on masked pixels: {', '.join(wrong)}; see coliags_plugin.core.masked"
            )
    apart = difference(first.model.state_dict(), second.model.state_dict())
    if apart:
        raise CheckFailedError(f"masked pixels change the model: {apart}; see coliags_plugin.core.masked")
    return "masked pixels change nothing"


def _masked(frame: Frame, spoilt: bool) -> Frame:
    """The frame with a part of its image masked out; ``spoilt``: there of other colours, and depth that is NaN."""
    height, width = frame.image.shape[:2]
    ignored = torch.zeros(height, width, dtype=torch.bool)
    ignored[height // 4 : height // 2, width // 4 : width // 2] = True
    masked = replace(frame, mask=frame.valid & ~ignored)
    if not spoilt:
        return masked
    depth = None if frame.depth is None else frame.depth.masked_fill(ignored, torch.nan)
    return replace(masked, image=torch.where(ignored[..., None], 255 - frame.image, frame.image), depth=depth)


def _take_steps(trainer: Trainer) -> list[dict[str, Any]]:
    return [trainer.take_step() for _ in range(min(_STEPS, trainer.steps))]
