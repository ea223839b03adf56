"""The model: a field, its renderer and the view modules around them; and checks that all components of a method fit."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor, nn

from coliags_plugin.config.method_config import MethodConfig
from coliags_plugin.contracts import Field, Loss, Renderer, Schedule, ViewModule
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.intrinsics import NEAR_PLANE
from coliags_plugin.core.json_files import JsonObject
from coliags_plugin.core.provenance import held_out_uses
from coliags_plugin.core.render_output import DEPTH_KINDS, RenderOutput
from coliags_plugin.core.scenes import TO_GET_DEPTH, Scene, View
from coliags_plugin.renderers.splatting import ChosenRenderer

log = logging.getLogger(__name__)

#: Descriptions of target attributes for messages; others are called by their names.
_DATA = {"sparse_depth": "depth at single points"}


class Model(nn.Module):
    """A field with its renderer and view modules, used by training, evaluation and export.

    Args:
        field: Scene representation.
        renderer: Renderer of the field.
        view_modules: By their names in the method config; cameras pass through them in this order, outputs too.
        near_plane: Of every camera that it renders from, in the model's unit of length.
        scale: Length of a scene unit in the model's unit, in which field and modules are: cameras are given, and
            outputs are, in scene units.
    """

    field: Field

    def __init__(
        self,
        field: Field,
        renderer: Renderer,
        view_modules: Mapping[str, ViewModule],
        near_plane: float = NEAR_PLANE,
        scale: float = 1.0,
    ) -> None:
        super().__init__()
        self.field = field
        self.renderer = renderer
        self.near_plane, self.scale = near_plane, scale
        # A ModuleDict would refuse names of its own attributes, such as "train" and "keys".
        self._view_modules = nn.ModuleList(view_modules.values())
        self._names = tuple(view_modules)

    def with_field(self, field: Field, scale: float) -> Model:
        """A model that shares all but the field and scale, in the same mode."""
        return Model(field, self.renderer, self.view_modules, self.near_plane, scale).train(self.training)

    @property
    def view_modules(self) -> dict[str, ViewModule]:
        """The view modules by name."""
        return dict(zip(self._names, self._view_modules, strict=True))  # type: ignore[arg-type]

    def placed(self, camera: Camera) -> Camera:
        """A camera, wherever it comes from, in the model's unit and with its near plane."""
        scaled = camera if self.scale == 1.0 else camera.scaled(self.scale)
        return replace(scaled, near_plane=self.near_plane)

    def adjusted(self, camera: Camera, view: View | None) -> Camera:
        """A :meth:`placed` camera as the view modules adjust it for a view; None for a free camera."""
        camera = self.placed(camera)
        for module in self.view_modules.values():
            camera = module.adjust_camera(camera, view)
        return camera

    def in_scene_units(self, output: RenderOutput) -> RenderOutput:
        """An output rendered from a :meth:`placed` camera, with its camera and depths in scene units."""
        if self.scale == 1.0:
            return output
        factors = {name: self.scale if name.startswith("inverse") else 1.0 / self.scale for name in DEPTH_KINDS}
        maps = {name: factors[name] * values if name in factors else values for name, values in output.maps.items()}
        camera = None if output.camera is None else output.camera.scaled(1.0 / self.scale)
        return replace(output, camera=camera, maps=maps)

    def render(
        self,
        camera: Camera,
        wants: Sequence[str] = ("rgb", "alpha"),
        view: View | None = None,
        pixels: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> RenderOutput:
        """Render a view; arguments as in :meth:`render_stages`."""
        return self.render_stages(camera, wants, view, pixels, generator)[-1]

    def render_stages(
        self,
        camera: Camera,
        wants: Sequence[str],
        view: View | None,
        pixels: Tensor | None,
        generator: torch.Generator | None,
    ) -> list[RenderOutput]:
        """A view as rendered, and as shaded by each module in turn: what a module is given, and at last the result.

        Modules adjust the camera first. Outputs always include rgb, alpha and what modules need; ``view`` is None for a
        free camera; ``pixels`` are columns and rows of the only ones to render, [P, 2]; ``generator``, in training, is
        of the random samples of renderers and fields that have any, and None renders without chance.
        """
        camera, modules = self.adjusted(camera, view), self.view_modules.values()
        needed = tuple(dict.fromkeys([*wants, *(name for module in modules for name in sorted(module.wants))]))
        stages = [self.renderer.render(self.field, camera, needed, pixels, generator)]
        for module in modules:
            stages.append(module.shade(stages[-1], view))
        return [self.in_scene_units(stage) for stage in stages]

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Parameters by group: the field's under their own names, a module's as ``<module>.<group>``."""
        groups = dict(self.field.parameter_groups())
        for name, module in self.view_modules.items():
            groups |= {f"{name}.{group}": parameters for group, parameters in module.parameter_groups().items()}
        return groups

    @property
    def learned(self) -> JsonObject:
        """Learned numbers that have a meaning of their own: ``field``, and those of modules under their names.

        Parts without any are left out.
        """
        numbers = {"field": self.field.learned, **{name: part.learned for name, part in self.view_modules.items()}}
        return {name: part for name, part in numbers.items() if part}

    @property
    def outputs(self) -> frozenset[str]:
        """Names of all available outputs."""
        return self.renderer.outputs_of(self.field.primitive) | self.field.feature_channels

    def check_outputs(self, wants: Sequence[str], asking: str) -> None:
        """Refuse outputs that the renderer lacks for this field, wanted by a module or by ``asking`` (a subject)."""
        needed = {asking: frozenset(wants)}
        needed |= {f"module '{name}'": module.wants for name, module in self.view_modules.items()}
        for subject, names in needed.items():
            missing = sorted(names - self.outputs)
            if missing:
                raise InputError(
                    f"outputs needed by {subject}: {', '.join(missing)}, which {type(self.renderer).__name__} does not "
                    "deliver for this field",
                    f"some of {', '.join(sorted(self.outputs))}",
                )


def make_view_modules(config: MethodConfig, scene: Scene) -> dict[str, ViewModule]:
    """Fresh view modules of a method for a scene."""
    return {name: node.target(node.settings, scene) for name, node in config.modules.items()}


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
    named = {name for loss in losses.values() for name in loss.needs | loss.reads_any}
    there = {name for name in named | {"sparse_depth"} if any(getattr(f, name, None) is not None for f in scene.train)}
    for key, loss in losses.items():
        for missing in sorted(loss.needs - there):
            raise InputError(
                f"loss term '{key}' needs {_DATA.get(missing, missing)}, and no training frame of scene "
                f"'{scene.name}' has any",
                f"frames with {_DATA.get(missing, missing)}, or no such term",
                f"Remove it with `losses.{key}=null`" if missing != "depth" else TO_GET_DEPTH,
            )
        if "depth" in loss.reads_any - there:
            points = "sparse_depth" in loss.reads_any & there
            does = "is of single points only" if points else "does nothing, and floaters are likely"
            dense = "no training frame of scene '%s' has dense depth: loss term '%s' %s; %s"
            log.warning(dense, scene.name, key, does, TO_GET_DEPTH)


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
        "`coliags check data` looks into poses, depth and units; small units on purpose need `near_plane=LENGTH`",
    )


def _warn_of_trusted_estimates(scene: Scene, losses: Mapping[str, Loss]) -> None:
    trusting = [key for key, loss in losses.items() if loss.trusts_depth]
    if trusting and scene.has_estimated_depth:
        log.warning(
            "the depth of scene '%s' is estimated, and loss term '%s' takes it for true, weighted by its confidence; "
            "the method coliags-plus is made for such scenes",
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
