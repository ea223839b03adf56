"""Memory that training takes on a device, predicted before it starts."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from coliags_plugin.contracts import GaussianField
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.gaussians import Gaussians
from coliags_plugin.core.scenes import Frame
from coliags_plugin.engine.model import Model
from coliags_plugin.renderers.checks import is_surfels
from coliags_plugin.renderers.projection import project_gaussians
from coliags_plugin.renderers.surfel_projection import project_surfels
from coliags_plugin.renderers.tiles import TileGrid, bin_gaussians, bin_surfels, gaussian_extents, surfel_extents
from coliags_plugin.renderers.torch_renderer import TorchRendererSettings

log = logging.getLogger(__name__)

#: Value and Adam's two moments of a parameter, at all times.
_COPIES = 3
#: Bytes that a step with renderer ``triton`` holds at once, for a Gaussian drawn, an anchor decoded, a pair of Gaussian
#: and tile, a pixel, and each number composited at one: measured on the CPU (docs/rendering.md, Memory on a device).
_DRAWN, _DECODED, _PAIR, _PIXEL, _NUMBER = 240, 1600, 40, 150, 12
#: Share by which a prediction may be off.
ERROR = 0.2
#: Training views, evenly chosen, of which the largest counts.
_VIEWS = 4
#: What a user can do about it.
LESS = (
    "Fewer initial points (--set datamanager.points_count=50000), slower growth (a higher strategy.gradient_threshold) "
    "or smaller images (datamanager.width and height) take less; --device cpu has the computer's memory"
)


@dataclass(frozen=True)
class MemoryForecast:
    """Bytes that training takes, as far as they can be told; of radiance fields only what is trained.

    Attributes:
        elements: Rows of the field.
        drawn: Most Gaussians in view.
        trained: Of values and moments of parameters, and of buffers.
        gradients: Of all parameters.
        of_gaussians: Of a step, for its Gaussians and their pairs with tiles.
        of_pixels: Of a step, for its pixels, and the frame; mostly freed before all gradients are there.
    """

    elements: int
    drawn: int
    trained: int
    gradients: int
    of_gaussians: int
    of_pixels: int

    @property
    def step(self) -> int:
        """What a step takes beyond :attr:`trained`, at its peak."""
        return self.of_gaussians + max(self.of_pixels, self.gradients)

    @property
    def total(self) -> int:
        """All that is there at once."""
        return self.trained + self.step

    @property
    def least(self) -> float:
        """What it takes if the prediction is as much too high as it may be."""
        return self.total / (1.0 + ERROR)

    def with_more(self, elements: int) -> MemoryForecast:
        """With so many further elements, of which as large a share is in view."""
        factor = 1.0 + elements / max(1, self.elements)
        scaled = {
            name: round(factor * getattr(self, name)) for name in ("drawn", "trained", "gradients", "of_gaussians")
        }
        return replace(self, elements=self.elements + elements, **scaled)

    def __str__(self) -> str:
        """In words."""
        return (
            f"{_gib(self.total)}: {_gib(self.trained)} for parameters and moments of {self.elements:,} elements, "
            f"{_gib(self.step)} for a step with {self.drawn:,} Gaussians in view"
        )


@torch.no_grad()
def forecast(model: Model, wants: Sequence[str], frames: Sequence[Frame]) -> MemoryForecast:
    """Predict the memory of training a model, on whatever device it is now, on some frames for these outputs."""
    field = model.field
    parameters = [value for group in model.parameter_groups().values() for value in group]
    gradients = sum(value.nbytes for value in parameters)
    trained = _COPIES * gradients + sum(value.nbytes for value in model.buffers())
    if not isinstance(field, GaussianField):
        return MemoryForecast(field.element_count, 0, trained, gradients, 0, 0)
    drawn, of_gaussians = 0, 0
    chosen = frames[:: max(1, len(frames) // _VIEWS)][:_VIEWS]
    for frame in chosen:
        camera = model.placed(frame.camera.to(parameters[0].device, parameters[0].dtype))
        gaussians = field.gaussians(camera)
        decoded = len(gaussians.visible_sources) if field.elements == "anchors" else 0
        held = _DRAWN * len(gaussians) + _DECODED * decoded + _PAIR * _pairs(gaussians, camera)
        drawn, of_gaussians = max(drawn, len(gaussians)), max(of_gaussians, held)
    numbers = sum(3 if name in ("rgb", "normals") else 1 for name in wants)
    pixels = max(frame.camera.width * frame.camera.height for frame in frames)
    of_pixels = pixels * (_PIXEL + _NUMBER * numbers) + max(map(_size, chosen))
    return MemoryForecast(field.element_count, drawn, trained, gradients, of_gaussians, of_pixels)


def check_memory(needed: MemoryForecast, most_added: int | None, device: torch.device) -> None:
    """Refuse what cannot fit in the free memory of a CUDA device, and tell what it takes.

    Args:
        needed: At the start.
        most_added: Elements that may be added in training; None: without a limit.
        device: CUDA device.

    Raises:
        InputError: It does not fit.
    """
    free = torch.cuda.mem_get_info(device)[0]
    if needed.least > free:
        seen = f"training takes about {needed}, and {device} has {_gib(free)} free"
        raise InputError(seen, "a run that fits", LESS)
    log.info("memory of %s, %s free: about %s", device, _gib(free), needed)
    grown = needed.with_more(1_000_000 if most_added is None else most_added)
    if most_added is None:
        log.info("each further million elements take %s; growth has no limit", _gib(grown.total - needed.total))
    elif grown.total > free:
        log.warning("growth may need more: about %s. %s", grown, LESS)


def frames_size(frames: Sequence[Frame]) -> int:
    """Bytes of the pixels of some frames."""
    return sum(map(_size, frames))


def _size(frame: Frame) -> int:
    kept = (frame.image, frame.depth, frame.depth_at_least, frame.mask, frame.seen, frame.depth_confidence)
    return sum(tensor.nbytes for tensor in kept if tensor is not None)


def _pairs(gaussians: Gaussians, camera: Camera) -> int:
    """Number of pairs of a Gaussian and a tile that it touches."""
    cuts = TorchRendererSettings()
    grid = TileGrid(camera.width, camera.height, cuts.tile_size)
    if is_surfels(gaussians):
        discs = project_surfels(gaussians, camera)
        pairs = bin_surfels(discs, surfel_extents(discs, gaussians.opacities, camera, grid, cuts), grid)
    else:
        projected = project_gaussians(gaussians, camera, cuts.eps2d)
        extents = gaussian_extents(projected, gaussians.opacities, grid, cuts.alpha_min)
        pairs = bin_gaussians(projected, extents, grid)
    return len(pairs.gaussian)


def _gib(size: float) -> str:
    return f"{size / 2**30:.3g} GiB"
