"""Volume rendering of radiance fields, in one pass or from coarse to fine."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float
from pydantic import Field, model_validator
from torch import Tensor
from typing_extensions import Self

from coliags_plugin.contracts import Availability, RadianceField, RadianceLevel, Renderer
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.render_output import OUTPUTS, SURFEL_OUTPUTS, RenderOutput, check_outputs, concatenate_pixels
from coliags_plugin.core.settings import Settings
from coliags_plugin.core.tensors import constant, sent

#: Every output of the splatting renderers that has a meaning without surfaces.
_COMPOSITED = frozenset(OUTPUTS) - SURFEL_OUTPUTS - {"normals"}
#: Ending of the outputs of the first pass.
_COARSE = "_coarse"
#: Transmittance behind which samples are not evaluated in rendering.
OPAQUE = 1e-6
#: Samples of each ray that are evaluated at once in rendering, and what the number of rays is a multiple of.
_AT_ONCE, _RAYS = 8, 256

#: Added to every weight, so that no stretch of a ray is left out for good.
WEIGHT_FLOOR = 1e-5


class VolumeRendererSettings(Settings):
    """Options of :class:`VolumeRenderer`.

    The first interval starts at the camera's near plane, in terms of ``spacing``; near plane 0: at the field's own
    distance.
    """

    far_plane: float | None = Field(default=100.0, gt=0)
    """End of the last interval in terms of ``spacing``, scene units; null: the field's own, a distance."""
    spacing: Literal["depth", "distance"] = "depth"
    """The intervals are equal in z-depth, or in distance from the camera."""
    samples: int = Field(default=128, ge=2)
    """Intervals per ray; the field is evaluated at their midpoints, in training with ``jitter`` anywhere in them."""
    importance_samples: int = Field(default=0, ge=0)
    """Samples added where those of a first pass, through the field's coarse level, have weight; 0: a single pass."""
    jitter: bool = False
    """Random places of samples in training; rendering is not affected."""
    opaque_end: bool = False
    """The last sample of a ray absorbs everything where its density is above 0: rays end on tissue."""
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Background RGB."""
    rays_at_once: int = Field(default=8192, ge=1)
    """Rays per batch when rendering whole images; bounds memory."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.spacing == "depth" and self.far_plane is None:
            raise ValueError("far_plane null with spacing 'depth': a field's own is a distance")
        if self.importance_samples and self.samples < 3:
            raise ValueError(f"importance_samples with samples {self.samples}: expected at least 3")
        return self


class VolumeRenderer(Renderer[VolumeRendererSettings, RadianceField]):
    """Volume renderer of radiance fields, for whole images or selected pixels (docs/rendering.md)."""

    primitives: ClassVar[frozenset[str]] = frozenset({"radiance"})
    outputs: ClassVar[frozenset[str]] = _COMPOSITED | {name + _COARSE for name in _COMPOSITED} | {"ray_lengths"}
    devices: ClassVar[frozenset[str]] = frozenset({"cpu", "cuda"})
    name: ClassVar[str] = "volume"
    renders_pixels: ClassVar[bool] = True

    @classmethod
    def availability(cls) -> Availability:
        """Always available: PyTorch only."""
        return Availability(True, "plain PyTorch, runs wherever PyTorch does")

    def check_field(self, field: RadianceField, near_plane: float) -> None:
        """Refuse a field without bounds where the options leave them to it, and bounds with nothing between them."""
        near, far = (float(end) for end in self._bounds(field, near_plane))
        if near >= far:
            raise InputError(
                f"rays that start at {near:.4g} and end at {far:.4g} scene units",
                "an end beyond the start",
                "Change near_plane or renderer.far_plane",
            )

    def render(
        self,
        field: RadianceField,
        camera: Camera,
        wants: Sequence[str] = ("rgb", "alpha"),
        pixels: Tensor | None = None,
        generator: torch.Generator | None = None,
    ) -> RenderOutput:
        """Render a view, or some of its pixels, as :class:`Renderer` says; in training samples may be at random places.

        Outputs of the first pass have ``_coarse`` behind their names; ``ray_lengths`` is the length of a pixel's ray
        per z-depth. Depths are z-depths; there are no normals and no distortion.
        """
        self.check_primitive(field)
        check_outputs(wants, sorted(self.outputs))
        like: Any = next(field.parameters())
        camera = camera.to(like.device, like.dtype)
        if pixels is not None:
            return self._march(field, camera, camera.rays_at(pixels), wants, generator)
        rays = camera.rays().flatten(0, 1)
        split: Any = torch.split(rays, self.settings.rays_at_once)
        whole = concatenate_pixels([self._march(field, camera, part, wants, generator) for part in split])
        shape = (camera.height, camera.width)
        maps = {name: value.reshape(*shape, *value.shape[2:]) for name, value in whole.maps.items()}
        return RenderOutput(whole.rgb.view(*shape, 3), whole.alpha.view(shape), camera, maps)

    def _march(
        self,
        field: RadianceField,
        camera: Camera,
        rays: Float[Tensor, "P 3"],
        wants: Sequence[str],
        generator: torch.Generator | None,
    ) -> RenderOutput:
        """Sample and composite along rays normalised to z = 1."""
        options = self.settings
        near, far = self._bounds(field, camera.near_plane)
        lines = _Lines.of(rays, options.spacing == "distance", far - near)
        background = constant(options.background, rays)
        chance = generator if options.jitter else None
        early = [name for name in wants if name.endswith(_COARSE)]
        places = even_places(near, far, options.samples, rays, chance)
        first = None
        if options.importance_samples:
            # Where samples go has no gradient: without an output of its own the first pass needs neither that nor
            # colours.
            with torch.set_grad_enabled(torch.is_grad_enabled() and bool(early)):
                colors = "rgb" + _COARSE in early
                first = self._composite(field.coarse_level, camera, lines, places, generator, colors)
            places = refined_places(places, first.weights.detach(), options.importance_samples, chance)
        final = self._composite(field, camera, lines, places, generator, True)
        maps = {}
        for name in wants:
            if name == "ray_lengths":
                maps[name] = lines.lengths
            elif name in early:
                maps[name] = (final if first is None else first).output(name.removesuffix(_COARSE), background)
            elif name not in ("rgb", "alpha"):
                maps[name] = final.output(name, background)
        return RenderOutput(final.output("rgb", background), final.output("alpha", background), camera, maps)

    def _composite(
        self,
        level: RadianceLevel,
        camera: Camera,
        lines: _Lines,
        places: Float[Tensor, "P S"],
        generator: torch.Generator | None,
        colors: bool,
    ) -> CompositedRays:
        """One pass through a level of the field."""
        lengths = lines.stretches(places)
        rgb: Tensor | None = None
        if generator is not None:
            where = (lines.positions(camera, places), lines.directions, camera)
            density, rgb = level.query(*where, generator)
        elif torch.is_grad_enabled():
            density, rgb = _samples(level, camera, lines, places, slice(None), colors)
        else:
            density, rgb = _samples_until_opaque(level, camera, lines, places, lengths, colors)
        behind = transmittances(density, lengths, self.settings.opaque_end)
        return CompositedRays(places * lines.depth_per_place, behind, rgb)

    def _bounds(self, field: RadianceField, near_plane: float) -> tuple[Tensor | float, Tensor | float]:
        """Start and end of rays, in terms of ``spacing``, by the options or by the field."""
        far = self.settings.far_plane
        if near_plane > 0.0 and far is not None:
            return near_plane, far
        bounds, to_do = field.ray_bounds, "Set them with `near_plane=...` and `renderer.far_plane=...`"
        if self.settings.spacing == "depth":
            raise InputError("near_plane 0 with spacing 'depth'", "one above 0: a field's own is a distance", to_do)
        if bounds is None:
            raise InputError(
                f"near_plane {near_plane:g} and far_plane {far} for a field that does not know where its surface is",
                "both in scene units, above 0",
                to_do,
            )
        return near_plane if near_plane > 0.0 else bounds[0], bounds[1] if far is None else far


@dataclass(frozen=True)
class _Lines:
    """Rays, and places along them, measured in z-depth or in distance.

    A unit of place is ``steps`` in space, ``length_per_place`` in distance and ``depth_per_place`` in z-depth;
    ``lengths`` are those of the rays per z-depth; ``reach`` is that of all the stretches together, in units of place.
    """

    steps: Float[Tensor, "P 3"]
    directions: Float[Tensor, "P 3"]
    lengths: Float[Tensor, "P 1"]
    length_per_place: Float[Tensor, "P 1"]
    depth_per_place: Float[Tensor, "P 1"]
    reach: Tensor | float

    @classmethod
    def of(cls, rays: Float[Tensor, "P 3"], by_distance: bool, reach: Tensor | float) -> Self:
        """Lines along rays normalised to z = 1. [P, 3]"""
        lengths = rays.norm(dim=-1, keepdim=True)
        directions, ones = rays / lengths, torch.ones_like(lengths)
        if by_distance:
            return cls(directions, directions, lengths, ones, 1.0 / lengths, reach)
        return cls(rays, directions, lengths, lengths, ones, reach)

    def positions(
        self, camera: Camera, places: Float[Tensor, "P S"], rows: Tensor | slice = slice(None)
    ) -> Float[Tensor, "P S 3"]:
        """World positions of places along some of the rays."""
        return camera.center + places[..., None] * self.steps[rows, None]

    def stretches(self, places: Float[Tensor, "P S"]) -> Float[Tensor, "P S"]:
        """Length of ray that each sample stands for: to the next; the last one's makes all of them ``reach``."""
        between = places.diff(dim=1)
        last = self.reach - (places[:, -1:] - places[:, :1])
        return torch.cat([between, last], dim=1) * self.length_per_place


def _samples(
    level: RadianceLevel,
    camera: Camera,
    lines: _Lines,
    places: Float[Tensor, "R S"],
    rows: Tensor | slice,
    colors: bool,
) -> tuple[Float[Tensor, "R S"], Float[Tensor, "R S 3"] | None]:
    """Density, and colours where asked for, at places along some of the rays."""
    where = (lines.positions(camera, places, rows), lines.directions[rows], camera)
    return level.query(*where) if colors else (level.query_density(*where), None)


def _samples_until_opaque(
    level: RadianceLevel,
    camera: Camera,
    lines: _Lines,
    places: Float[Tensor, "P S"],
    lengths: Float[Tensor, "P S"],
    colors: bool,
) -> tuple[Float[Tensor, "P S"], Float[Tensor, "P S 3"] | None]:
    """:func:`_samples` of all rays, each at least until less than :data:`OPAQUE` gets through; 0 behind."""
    density = torch.zeros_like(places)
    rgb = places.new_zeros(*places.shape, 3) if colors else None
    absorbed = places.new_zeros(len(places))
    rows = torch.arange(len(places), device=places.device)
    for first in range(0, places.shape[1], _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        density[rows, part], sample_colors = _samples(level, camera, lines, places[rows, part], rows, colors)
        if rgb is not None and sample_colors is not None:
            rgb[rows, part] = sample_colors
        absorbed += (density[:, part] * lengths[:, part]).sum(1)
        going_on = int((absorbed < -math.log(OPAQUE)).sum())
        if going_on == 0:
            break
        # oneDNN compiles, and keeps in memory, kernels for every number of rows of a product of bfloat16: few of them.
        rows = absorbed.argsort()[: math.ceil(going_on / _RAYS) * _RAYS]
    return density, rgb


# --- places and samples along rays ------------------------------------------------------------------------------------


def even_places(
    near: Float[Tensor, ""] | float,
    far: Float[Tensor, ""] | float,
    count: int,
    rays: Float[Tensor, "P 3"],
    generator: torch.Generator | None,
) -> Float[Tensor, "P S"]:
    """One place in each of ``count`` equal intervals between two ends, for as many rays, in their dtype and device.

    The generator draws a place within each interval; None takes the midpoints.
    """
    return near + (far - near) * _shares(len(rays), count, rays, generator)


def refined_places(
    places: Float[Tensor, "P S"], weights: Float[Tensor, "P S"], count: int, generator: torch.Generator | None
) -> Float[Tensor, "P S+N"]:
    """The places, in order and at least three, and ``count`` more, distributed like the weights; sorted.

    The distribution is NeRF's: constant between the midpoints of neighbouring places, where it is the weight of the
    place between them plus :data:`WEIGHT_FLOOR`; the first and the last weight are not used. The generator draws a
    number within each of ``count`` equal intervals of [0, 1], which the inverse of the cumulative distribution makes a
    place; None takes the midpoints.
    """
    edges = 0.5 * (places[:, 1:] + places[:, :-1])
    mass = weights[:, 1:-1] + WEIGHT_FLOOR
    cumulative = (mass / mass.sum(1, keepdim=True)).cumsum(1)
    cumulative = torch.cat([torch.zeros_like(cumulative[:, :1]), cumulative[:, :-1]], dim=1)  # at the lower edges
    shares = _shares(len(places), count, places, generator)
    interval = torch.searchsorted(cumulative, shares, right=True) - 1
    start = cumulative.gather(1, interval)
    within = (shares - start) * mass.sum(1, keepdim=True) / mass.gather(1, interval)
    below, above = edges.gather(1, interval), edges.gather(1, interval + 1)
    return torch.cat([places, below + within.clamp(0.0, 1.0) * (above - below)], dim=1).sort(dim=1).values


def _shares(rows: int, count: int, like: Tensor, generator: torch.Generator | None) -> Float[Tensor, "P S"]:
    """One number in each of ``count`` equal intervals of [0, 1], in order."""
    index = torch.arange(count, dtype=like.dtype, device=like.device)
    if generator is None:
        return ((index + 0.5) / count).expand(rows, -1).contiguous()
    return (index + sent(torch.rand(rows, count, generator=generator, dtype=like.dtype), like.device)) / count


@dataclass(frozen=True)
class CompositedRays:
    """Samples along rays: z-depths in scene units, RGB, which is None where only depths are asked for, and weights.

    ``transmittance`` is that before every sample and behind the last.
    """

    depths: Float[Tensor, "P S"]
    transmittance: Float[Tensor, "P S+1"]
    colors: Float[Tensor, "P S 3"] | None

    @property
    def weights(self) -> Float[Tensor, "P S"]:
        """Weights of the samples. [P, S]"""
        return self.transmittance[:, :-1] - self.transmittance[:, 1:]

    def output(self, name: str, background: Float[Tensor, "3"]) -> Float[Tensor, "P 1 *C"]:
        """An output of ``core.render_output`` by its name, normals excepted; rgb needs colours. [P, 1] or [P, 1, 3]"""
        alpha = 1.0 - self.transmittance[:, -1:]
        if name == "alpha":
            return alpha
        if name == "rgb" and self.colors is not None:
            rgb = (self.weights[..., None] * self.colors).sum(1) + (1.0 - alpha) * background
            return rgb[:, None]
        if name == "inverse_depth_accumulated":
            return (self.weights / self.depths).sum(1, keepdim=True)
        if name == "depth_median":
            reached = self.transmittance[:, 1:] <= 0.5
            first = self.depths.gather(1, reached.to(torch.int8).argmax(1, keepdim=True))
            return torch.where(reached.any(1, keepdim=True), first, 0.0).detach()
        accumulated = (self.weights * self.depths).sum(1, keepdim=True)
        if name == "depth_accumulated":
            return accumulated
        total = self.weights.sum(1, keepdim=True)
        return torch.where(total > 0, accumulated / torch.where(total > 0, total, 1.0), 0.0)


def transmittances(
    density: Float[Tensor, "P S"], lengths: Float[Tensor, "P S"], opaque_end: bool
) -> Float[Tensor, "P S+1"]:
    """Transmittance before every sample and behind the last, from densities per scene unit and lengths in scene units.

    With ``opaque_end`` the last stretch has no end: it lets nothing through where its density is above 0.
    """
    absorbed = density * lengths
    if opaque_end:
        absorbed = torch.cat([absorbed[:, :-1], torch.where(density[:, -1:] > 0, torch.inf, 0.0)], dim=1)
    return torch.exp(-torch.cat([torch.zeros_like(absorbed[:, :1]), absorbed.cumsum(1)], dim=1))
