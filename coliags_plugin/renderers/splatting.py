"""Splatting renderers: their base class, options and checks; and the choice of the renderer of any field."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import pydantic
import torch
from jaxtyping import Float
from torch import Tensor
from typing_extensions import TypeVar

from coliags_plugin.contracts import GaussianField, Renderer
from coliags_plugin.core import registry
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.components import Component, candidates, is_auto, with_options
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.core.render_output import OUTPUTS, SURFEL_OUTPUTS, RenderOutput, Splats, check_outputs
from coliags_plugin.core.settings import Settings


class AutoSettings(Settings):
    """Order of preference, and options common to all splatting renderers."""

    prefer: tuple[str, ...] = ("triton", "cpu", "torch")
    """Names of renderers, the most preferred first."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Background RGB."""


class SplattingSettings(Settings):
    """Options common to all splatting renderers; the defaults are 3DGS's (docs/methods.md 2.1, 2.2)."""

    eps2d: float = pydantic.Field(default=0.3, gt=0)
    """Low-pass term added to the diagonal of every 2D covariance, square pixels."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Background RGB."""


class CutSettings(SplattingSettings):
    """Options of this package's renderers, whose alpha and transmittance thresholds are configurable."""

    alpha_max: float = pydantic.Field(default=0.99, gt=0, lt=1)
    """Upper bound of alpha at any pixel."""
    alpha_min: float = pydantic.Field(default=1 / 255, gt=0, lt=1)
    """Contributions of smaller alpha are skipped."""
    transmittance_min: float = pydantic.Field(default=1e-4, ge=0, lt=1)
    """Compositing stops before the Gaussian that would bring the transmittance below this."""
    surfel_filter: float = pydantic.Field(default=0.70710678, gt=0)
    """Standard deviation of the low-pass filter of surfels, pixels."""
    distortion_far: float = pydantic.Field(default=100.0, gt=0)
    """z-depth that the output ``distortion`` maps to 1; the near plane is mapped to 0. Scene units."""

    def distortion_slope(self, near_plane: float) -> float:
        """Factor of -1/z in the depths whose differences ``distortion`` measures, scene units."""
        if self.distortion_far <= near_plane:
            raise InputError(
                f"renderer.distortion_far {self.distortion_far:g} with near_plane {near_plane:g}",
                "a distortion_far beyond the near plane",
            )
        return self.distortion_far * near_plane / (self.distortion_far - near_plane)


#: Settings of a splatting renderer.
SplattingT = TypeVar("SplattingT", bound=SplattingSettings, default=SplattingSettings)


class SplattingRenderer(Renderer[SplattingT, GaussianField]):
    """Base class of renderers that splat a :class:`GaussianField` into whole images."""

    primitives: ClassVar[frozenset[str]] = frozenset({"gaussians3d", "surfels"})
    outputs: ClassVar[frozenset[str]] = frozenset(OUTPUTS) - SURFEL_OUTPUTS

    @classmethod
    def outputs_of(cls, primitive: str) -> frozenset[str]:
        """Surfels have more outputs than 3D Gaussians."""
        return cls.outputs | SURFEL_OUTPUTS if primitive == "surfels" else cls.outputs

    def render(
        self,
        field: GaussianField,
        camera: Camera,
        wants: Sequence[str] = ("rgb", "alpha"),
        pixels: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> RenderOutput:
        """Draw a view as :class:`Renderer` says; refuses ``pixels``, as whole images are drawn."""
        if pixels is not None:
            raise InputError(
                f"the {self.name} renderer was requested to render single pixels",
                "whole images: it splats",
                "Leave pixels out, or choose a renderer of radiance fields",
            )
        self.check_primitive(field)
        return self.draw(field.gaussians(camera, generator=generator), camera, wants)

    def check_field(self, field: GaussianField, near_plane: float) -> None:
        """Refuse a near plane beyond ``distortion_far``."""
        if isinstance(self.settings, CutSettings):
            self.settings.distortion_slope(near_plane)

    def check_gaussian_outputs(self, wants: Iterable[str], gaussians: Gaussians) -> None:
        """Refuse outputs that are neither this renderer's nor features of the Gaussians, and malformed features."""
        outputs = self.outputs_of("surfels" if is_surfels(gaussians) else "gaussians3d")
        check_outputs(wants, (*(name for name in OUTPUTS if name in outputs), *gaussians.features))
        for name, values in gaussians.features.items():
            if values.ndim != 2 or len(values) != len(gaussians):
                raise InputError(f"feature {name} of shape {list(values.shape)}", f"[{len(gaussians)}, channels]")

    def check_tensors(self, gaussians: Gaussians) -> None:
        """Refuse Gaussians that are malformed, not float32, or on a device that this renderer does not serve."""
        count = len(gaussians.means) if gaussians.means.ndim else 0
        scales = 2 if is_surfels(gaussians) else 3
        widths = {"means": 3, "quats_wxyz": 4, "scales": scales, "opacities": None, "colors": 3}
        checked = [(name, getattr(gaussians, name), width) for name, width in widths.items()]
        checked += [(f"feature {name}", value, value.shape[1]) for name, value in gaussians.features.items()]
        for name, tensor, width in checked:
            shape = (count,) if width is None else (count, width)
            if tuple(tensor.shape) != shape:
                raise InputError(
                    f"{name} of shape {list(tensor.shape)}",
                    f"{list(shape)}, for means of shape {list(gaussians.means.shape)}",
                )
            if tensor.dtype != torch.float32:
                raise InputError(
                    f"{name} of dtype {str(tensor.dtype).removeprefix('torch.')} for the {self.name} renderer",
                    "float32",
                    "Cast it, or choose the torch renderer, which computes in float64 too",
                )
            if tensor.device.type not in self.devices:
                raise InputError(
                    f"{name} on {tensor.device} for the {self.name} renderer",
                    f"tensors on {', '.join(sorted(self.devices))}",
                    "Move the field there, or choose renderer 'auto'",
                )

    @abstractmethod
    def draw(self, gaussians: Gaussians, camera: Camera, wants: Sequence[str]) -> RenderOutput:
        """Render the Gaussians from the camera: surfels where they have two scales.

        Everything but ``radii`` and, of 3D Gaussians, ``depth_median`` is differentiable, once, in the Gaussians and in
        ``camera.camera_to_world``; ``means2d.grad`` is set by ``backward``.

        Raises:
            InputError: An output is unknown or not of these Gaussians, or these cannot be drawn.
        """


def output_of(
    gaussians: Gaussians,
    camera: Camera,
    wants: Sequence[str],
    maps: dict[str, Float[Tensor, "H W *C"]],
    means2d: Float[Tensor, "N 2"],
    radii: Float[Tensor, "N"],
) -> RenderOutput:
    """Output of a renderer, from composited images by name; ``means2d`` then retains its gradient.

    ``depth_expected`` is made from ``depth_accumulated``.
    """
    maps = {**maps}
    if "depth_expected" in wants:
        # 0, and no gradient, where alpha is 0.
        covered = maps["alpha"] > 0
        depth = maps["depth_accumulated"] / torch.where(covered, maps["alpha"], 1.0)
        maps["depth_expected"] = torch.where(covered, depth, 0.0)
    if means2d.requires_grad:
        means2d.retain_grad()
    further = {name: maps[name] for name in wants if name not in ("rgb", "alpha")}
    return RenderOutput(maps["rgb"], maps["alpha"], camera, further, Splats(gaussians, means2d, radii))


def split_channels(sums: Float[Tensor, "H W F"], features: dict[str, Tensor]) -> dict[str, Tensor]:
    """Composited channels by output; the renderer's own single channels without the last dimension.

    ``features`` are those of the Gaussians by output, in the same order. [N, C] each
    """
    parts = torch.split(sums, [part.shape[1] for part in features.values()], dim=-1)
    return {
        name: part[..., 0] if name in OUTPUTS and part.shape[-1] == 1 else part
        for name, part in zip(features, parts, strict=True)
    }


# --- checks -----------------------------------------------------------------------------------------------------------


def is_surfels(gaussians: Gaussians) -> bool:
    """True if Gaussians are surfels, with two scales each; InputError if they have neither two nor three."""
    scales = gaussians.scales
    if scales.ndim != 2 or scales.shape[1] not in (2, 3):
        raise InputError(
            f"Gaussians with scales of shape {list(scales.shape)}", "three scales each, [N, 3], or two for surfels"
        )
    return scales.shape[1] == 2


# --- choice -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ChosenRenderer:
    """A renderer, its registered name and the reason for choosing it."""

    name: str
    renderer: Renderer
    reason: str


def choose_renderer(component: Component, primitive: str, device: torch.device) -> ChosenRenderer:
    """Make the renderer of a config; of ``auto``, the first preferred one that can render the field."""
    if is_auto(component.kind, component.name):
        return _first_of(component, primitive, device)
    obstacle = component.target.obstacle(primitive, device)
    if obstacle:
        raise InputError(
            f"renderer '{component.name}' {obstacle}", "a renderer that can serve the field", _others(primitive, device)
        )
    return ChosenRenderer(component.name, component.target(component.settings), "named by the config")


def _first_of(auto: Component, primitive: str, device: torch.device) -> ChosenRenderer:
    refused: list[str] = []
    for name in auto.settings.model_dump()["prefer"]:
        candidate = with_options(auto, name)
        obstacle = candidate.target.obstacle(primitive, device)
        if not obstacle:
            available = candidate.target.availability().reason
            reason = "; ".join([*refused, f"{auto.name} chose {name}: {available}"])
            return ChosenRenderer(name, candidate.target(candidate.settings), reason)
        refused.append(f"{name} {obstacle}")
    raise InputError(
        f"no renderer can serve: {'; '.join(refused)}",
        f"one for {primitive} on {device.type}",
        _others(primitive, device),
    )


def _others(primitive: str, device: torch.device) -> str:
    """Hint that names the renderers of a primitive on a device; empty without any."""
    classes = {name: registry.renderers.get(name) for name in candidates("renderers")}
    able = [
        name
        for name, renderer_class in classes.items()
        if primitive in renderer_class.primitives and device.type in renderer_class.devices
    ]
    return f"Use `renderer=NAME`, NAME being {' or '.join(able)}" if able else ""
