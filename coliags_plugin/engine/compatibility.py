"""Checks, before anything is written, that the components of a method fit each other and the scene."""

from __future__ import annotations

import logging
from collections.abc import Mapping

from coliags_plugin.config.method_config import MethodConfig
from coliags_plugin.contracts import Loss, Schedule
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.provenance import held_out_uses
from coliags_plugin.core.scenes import Scene
from coliags_plugin.renderers.splatting import ChosenRenderer

log = logging.getLogger(__name__)

#: Descriptions of target attributes for messages; others are called by their names.
_DATA = {"sparse_depth": "depth at single points"}


def check_components(
    config: MethodConfig, chosen: ChosenRenderer, scene: Scene, losses: Mapping[str, Loss], schedule: Schedule
) -> None:
    """Refuse components that cannot work together."""
    _check_strategy(config)
    _check_sampler(config, chosen, losses)
    _check_splats(config, losses)
    _check_data(scene, losses)
    _check_points_in_view(config, scene)
    _warn_of_trusted_estimates(scene, losses)
    for use in held_out_uses(scene.provenance.held_out_used):
        log.warning("scene '%s': %s (docs/data.md 3)", scene.name, use)
    _check_schedule(losses, schedule)


def _check_strategy(config: MethodConfig) -> None:
    serves, elements = config.strategy.target.serves, config.field.target.elements
    if serves is not None and elements not in serves:
        raise InputError(
            f"strategy '{config.strategy.name}' changes {', '.join(sorted(serves))}, and field '{config.field.name}' "
            f"has {elements}",
            "a strategy for this field",
            "Choose another, or `strategy=none`",
        )


def _check_sampler(config: MethodConfig, chosen: ChosenRenderer, losses: Mapping[str, Loss]) -> None:
    if config.sampler.target.whole_images:
        return
    if not chosen.renderer.renders_pixels:
        raise InputError(
            f"sampler '{config.sampler.name}' with renderer '{chosen.name}', which draws whole images",
            "a renderer of radiance fields",
            "Use `sampler=frames`",
        )
    whole = [(f"loss term '{key}'", "losses of", f"losses.{key}") for key, loss in losses.items() if loss.whole_image]
    whole += [
        (f"module '{name}'", "modules that shade", f"modules.{name}")
        for name, node in config.modules.items()
        if node.target.whole_image
    ]
    for what, others, option in whole:
        raise InputError(
            f"{what} needs whole images, and sampler '{config.sampler.name}' gives single pixels",
            f"{others} single pixels",
            f"Remove it with `{option}=null`, or use `sampler=frames`",
        )


def _check_splats(config: MethodConfig, losses: Mapping[str, Loss]) -> None:
    for key, loss in losses.items():
        if loss.needs_splats and config.field.target.primitive == "radiance":
            raise InputError(
                f"loss term '{key}' is about Gaussians, and field '{config.field.name}' has none",
                "a field of Gaussians",
                f"Remove it with `losses.{key}=null`",
            )


def _check_data(scene: Scene, losses: Mapping[str, Loss]) -> None:
    needed = {name for loss in losses.values() for name in loss.needs}
    there = {name for name in needed | {"sparse_depth"} if any(getattr(f, name, None) is not None for f in scene.train)}
    for key, loss in losses.items():
        for missing in sorted(loss.needs - there):
            instead = ""
            if missing == "depth":
                of_points = ", train the method coliags-sparse-depth on its points" if "sparse_depth" in there else ""
                instead = f"{of_points}, or make a scene with depth: coliags depth estimate"
            raise InputError(
                f"loss term '{key}' needs {_DATA.get(missing, missing)}, and no training frame of scene "
                f"'{scene.name}' has any",
                f"frames with {_DATA.get(missing, missing)}, or no such term",
                f"Remove it with `losses.{key}=null`{instead}",
            )


def _check_points_in_view(config: MethodConfig, scene: Scene) -> None:
    if config.field.target.primitive == "radiance" or not len(scene.points):
        return
    near = config.near_plane
    depths = scene.depths_in_view()
    if (depths > near).any():
        return
    problem = (
        f"the initial points in view are at most {float(depths.max()):.2g} from the cameras"
        if len(depths)
        else f"none of the {len(scene.points)} initial points is in view of the training cameras"
    )
    raise InputError(
        f"{problem}, and nothing nearer than {near:g} is drawn",
        "lengths in mm, and poses and points of one world",
        "`coliags data check` looks into poses, depth and units; small units on purpose need `near_plane=LENGTH`",
    )


def _warn_of_trusted_estimates(scene: Scene, losses: Mapping[str, Loss]) -> None:
    trusting = [key for key, loss in losses.items() if loss.trusts_depth]
    if trusting and any(frame.depth_confidence is not None for frame in scene.train):
        log.warning(
            "the depth of scene '%s' is estimated, and loss term '%s' takes it for true, weighted by its confidence; "
            "the method coliags-in-vivo is made for such scenes",
            scene.name,
            trusting[0],
        )


def _check_schedule(losses: Mapping[str, Loss], schedule: Schedule) -> None:
    """Terms start after ``from_step`` and end with ``until_step``: looking at each step after one of them will do."""
    ends = {0, *(schedule.at(loss.settings.until_step) for loss in losses.values() if loss.settings.until_step)}
    for step in sorted(end + 1 for end in ends if end < schedule.steps):
        if not any(loss.settings.active(step, schedule) for loss in losses.values()):
            raise InputError(
                f"no loss term counts at step {step} of {schedule.steps}",
                "at least one at every step",
                "Change from_step and until_step of a term",
            )
