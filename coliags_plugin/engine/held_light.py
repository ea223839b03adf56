"""Other light for a trained run: another lamp, the same light everywhere, or a lamp that stays where it is."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import torch

from coliags_plugin.contracts import GaussianField
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError, check_name
from coliags_plugin.core.lamps import FlattenedLight, HeldLight, Lamp, LightOfCamera
from coliags_plugin.core.registry import fields
from coliags_plugin.core.render_output import OPAQUE_ALPHA, RenderOutput
from coliags_plugin.engine.model import Model
from coliags_plugin.engine.trained import TrainedRun
from coliags_plugin.renderers.splatting import SplattingRenderer

#: Approximate number of training cameras, evenly spaced, that the flattened light is the median of.
_CAMERAS = 16


def mean_camera(cameras: Sequence[Camera], weights: Sequence[float] | None = None) -> Camera:
    """The first camera at the mean position and the mean rotation of all, the one nearest to their mean matrix.

    Means are weighted by ``weights``, which add up to 1; without, all count alike.
    """
    poses = torch.stack([camera.camera_to_world.double() for camera in cameras])
    shares = poses.new_full((len(poses),), 1.0 / len(poses)) if weights is None else poses.new_tensor(weights)
    mean = torch.einsum("n,nij->ij", shares, poses)
    u, _, vt = torch.linalg.svd(mean[:3, :3])
    rotation = u @ torch.diag(torch.tensor([1.0, 1.0, float(torch.det(u @ vt))], dtype=u.dtype)) @ vt
    pose = torch.eye(4, dtype=poses.dtype)
    pose[:3, :3], pose[:3, 3] = rotation, mean[:3, 3]
    return replace(cameras[0], camera_to_world=pose)


@torch.no_grad()
def flattened_light(model: Model, cameras: Sequence[Camera]) -> HeldLight:
    """The median distance and the median angle to the optical axis of what the training cameras see, for everything."""
    distances, cosines = [], []
    device = next(model.field.parameters()).device
    for camera in cameras[:: max(1, len(cameras) // _CAMERAS)]:
        placed = model.placed(camera).to(device)
        rendered = model.renderer.render(model.field, placed, ("rgb", "alpha", "depth_accumulated"))
        output = model.in_scene_units(rendered)
        opaque = output.alpha >= OPAQUE_ALPHA
        lengths = placed.rays().norm(dim=-1)[opaque]
        distances.append(output["depth_accumulated"][opaque] / output.alpha[opaque] * lengths)
        cosines.append(1.0 / lengths)
    return FlattenedLight(float(torch.cat(distances).median()), float(torch.cat(cosines).median()))


#: Lights for Gaussians of all views, by the names that users give them; none is held where the lamp moves on with
#: every camera, as in the video.
LIGHTS: Mapping[str, Callable[[Model, Sequence[Camera]], HeldLight | None]] = {
    "recorded": lambda *_: None,
    "mean": lambda _, cameras: LightOfCamera(mean_camera(cameras)),
    "flattened": flattened_light,
}


def held_light(name: str, model: Model, cameras: Sequence[Camera]) -> HeldLight | None:
    """The light of a name in :data:`LIGHTS`, for a model of Gaussians and its training cameras."""
    check_name("light", name, LIGHTS)
    return LIGHTS[name](model, cameras)


def render_held(model: Model, camera: Camera, light: HeldLight | None, wants: Sequence[str]) -> RenderOutput:
    """Render the view of a free camera under a held light, or else the camera's own lamp.

    View modules shade it as for any free camera: with the response of the camera, and no frame's own gain.
    """
    camera, field, renderer = model.placed(camera), gaussians_of(model), splatting_of(model)
    modules = model.view_modules.values()
    needed = tuple(dict.fromkeys([*wants, *(name for module in modules for name in module.wants)]))
    output = renderer.draw(
        field.gaussians(camera, None if light is None else light.scaled(model.scale)), camera, needed
    )
    for module in modules:
        output = module.shade(output, None)
    return model.in_scene_units(output)


def gaussians_of(model: Model) -> GaussianField:
    """The model's field of Gaussians."""
    if not isinstance(model.field, GaussianField):
        raise InputError(f"a field of '{model.field.primitive}'", "Gaussians", "Choose a splatting method")
    return model.field


def splatting_of(model: Model) -> SplattingRenderer:
    """The model's splatting renderer."""
    if not isinstance(model.renderer, SplattingRenderer):
        raise InputError(f"renderer {type(model.renderer).__name__}", "one of this package's splatting renderers")
    return model.renderer


def relight(trained: TrainedRun, lamp: Lamp) -> TrainedRun:
    """The run under another lamp; it shares the parameters."""
    model = trained.model
    if not model.field.lamp_is_apart:
        lit = ", ".join(name for name in fields if fields.get(name).lamp_is_apart)
        raise InputError(
            f"another lamp for method '{trained.method}', whose field '{trained.config.field.name}' has the light in "
            "its colours",
            f"a method with one of these fields: {lit}",
            "Train such a method, for instance pr-endo",
        )
    return replace(trained, model=model.with_field(model.field.with_lamp(lamp), model.scale), lamp=lamp)


def flatten(trained: TrainedRun) -> TrainedRun:
    """The run in the same light everywhere: at the median distance and angle of what the training cameras see.

    No frame's own gain is applied; it shares the parameters.
    """
    splatting_of(trained.model)
    gaussians_of(trained.model)
    cameras = [frame.camera for frame in trained.scene.train]
    return replace(trained, held=flattened_light(trained.model, cameras))
