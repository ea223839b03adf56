"""Checks on scenes that lack something, and on pixels that are to be ignored."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from coliags_plugin.checks.method.context import CheckContext, as_in_new_process, difference
from coliags_plugin.checks.method.error_location import describe
from coliags_plugin.checks.method.scenes import with_ignored_pixels, with_one_frame, without_depth, without_points
from coliags_plugin.checks.results import CheckFailedError
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import Scene
from coliags_plugin.engine.trainer import Trainer

_VARIANTS: dict[str, Callable[[Scene], Scene]] = {
    "without depth": without_depth,
    "without points": without_points,
    "with one frame": with_one_frame,
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
            trainer = context.build("masked", with_ignored_pixels(context.scene, spoilt))
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


def _take_steps(trainer: Trainer) -> list[dict[str, Any]]:
    return [trainer.take_step() for _ in range(min(_STEPS, trainer.steps))]
