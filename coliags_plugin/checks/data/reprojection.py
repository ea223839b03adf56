"""Reprojection check: the back-projected surface of one frame must lie on the surface seen in another."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.scenes import Frame

Change = Callable[[Float[Tensor, "4 4"]], Float[Tensor, "4 4"]]

#: The poses as they are.
GIVEN = "given"
#: Identity poses, the baseline that the given poses must beat.
NO_MOTION = "no motion"


def _transposed(pose: Tensor) -> Tensor:
    turned = pose.clone()
    turned[:3, :3] = pose[:3, :3].T
    return turned


CHANGES: dict[str, Change] = {
    GIVEN: lambda pose: pose,
    NO_MOTION: lambda pose: torch.eye(4, dtype=pose.dtype),
    "world-to-camera": torch.linalg.inv,
    "rotation transposed": _transposed,
    "translation of opposite sign": lambda pose: pose * pose.new_tensor([[1.0, 1.0, 1.0, -1.0]] * 3 + [[1.0] * 4]),
    "camera axes y up, z backward": lambda pose: pose * pose.new_tensor([1.0, -1.0, -1.0, 1.0]),
}

#: Advice where a hypothesis fits.
ADVICE = {
    "world-to-camera": "The poses look like world-to-camera transforms; write camera-to-world, their inverses",
    "rotation transposed": "The rotations look transposed: the program that wrote the file confused rows and columns",
    "translation of opposite sign": "The translations look negated: check the sign in the program that wrote the file",
    "camera axes y up, z backward": "The camera axes look like OpenGL's; negate the second and third column",
}


#: Largest number of pixels reprojected per frame.
_PIXELS = 4000
#: Factors on depth of the coarse search.
_SCALES = np.logspace(-4.0, 4.0, 65)
#: Least confidence of estimated depth that is compared: it follows a prior where little is known.
LEAST_CONFIDENCE = 0.8
#: Stride of the pixels used in that search.
_STRIDE = 8
#: Smallest share of pixels that project into the other image for a factor to count.
_MIN_SHARE = 0.2


class Pair:
    """Two frames with depth, the first of which is reprojected into the second under several pose hypotheses."""

    def __init__(self, source: Frame, target: Frame) -> None:
        depth, there = _known_depth(source), _known_depth(target)
        known = torch.isfinite(depth).reshape(-1).nonzero()[:, 0]
        chosen = known[:: max(1, len(known) // _PIXELS)]
        own_axes = replace(source.camera, camera_to_world=torch.eye(4, dtype=torch.float64))
        self._source, self._target = source.camera, target.camera
        #: Points in the source camera's axes. [K, 3]
        self._points = own_axes.unproject(depth).reshape(-1, 3)[chosen]
        self._depth_there = there.reshape(-1)
        self._colors = source.image.reshape(-1, 3)[chosen].double()
        self._colors_there = target.image.reshape(-1, 3).double()

    @property
    def is_known(self) -> bool:
        """Whether there is depth to compare in both frames."""
        return bool(len(self._points) and torch.isfinite(self._depth_there).any())

    def reproject(self, change: Change, scale: float = 1.0, every: int = 1) -> tuple[float, Tensor, Tensor, Tensor]:
        """Reproject every n-th of the source's pixels, with both poses changed and both depths times ``scale``.

        Returns the share of them that project into the target image, in front of its camera; the difference of z-depth,
        relative and in scene units, where it is known [K]; and that of colour, grey levels. [L]
        """
        pose = change(self._source.camera_to_world.double())
        camera = changed(self._target, change)
        pixels, z = camera.project(self._points[::every] * scale @ pose[:3, :3].T + pose[:3, 3])
        column, row = pixels.floor().nan_to_num(-1.0).clamp(-1, 1 << 20).long().unbind(-1)
        lands = (z > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        hit = row[lands] * camera.width + column[lands]
        there = self._depth_there[hit] * scale
        difference = (z[lands] - there).abs()
        known = torch.isfinite(difference)
        colors = _color_difference(self._colors[::every][lands], self._colors_there[hit])
        return float(lands.double().mean()), (difference / there)[known], difference[known], colors


@dataclass(frozen=True)
class Agreement:
    """Agreement of frames under one pose hypothesis: medians over the pixels of all pairs."""

    depth_error: float | None  # relative error of z-depth; None where no pixel hits known depth
    depth_difference: float | None  # the same in scene units
    color_error: float | None  # grey levels
    share: float  # share of pixels that project into the target image


def agreement(pairs: Sequence[Pair], change: str = GIVEN, scale: float = 1.0, every: int = 1) -> Agreement:
    """Reproject the first frame of every pair into the second; arguments as in :meth:`Pair.reproject`."""
    reprojected = [pair.reproject(CHANGES[change], scale, every) for pair in pairs]
    shares, depths, lengths, colors = zip(*reprojected, strict=True)
    return Agreement(_median(depths), _median(lengths), _median(colors), float(np.mean(shares)))


@dataclass(frozen=True)
class BestScale:
    """The factor on depth with the smallest reprojection error."""

    factor: float  # on depth
    depth_error: float  # relative error of z-depth with it
    beside: float  # the smaller of the errors with half and with twice the factor; infinite where nothing overlaps


def best_scale(pairs: Sequence[Pair]) -> BestScale | None:
    """The factor on depth with the smallest reprojection error; None if none fits."""

    def error(scale: float) -> float:
        result = agreement(pairs, scale=float(scale), every=_STRIDE)
        return np.inf if result.depth_error is None or result.share < _MIN_SHARE else result.depth_error

    errors = [error(scale) for scale in _SCALES]
    least = int(np.argmin(errors))
    if not np.isfinite(errors[least]):
        return None
    step = _SCALES[1] / _SCALES[0]
    fine = _SCALES[least] * step ** np.linspace(-1.0, 1.0, 17)
    fine_errors = [error(scale) for scale in fine]
    best = float(fine[int(np.argmin(fine_errors))])
    return BestScale(best, float(min(fine_errors)), float(min(error(0.5 * best), error(2.0 * best))))


def warp_image(source: Frame, target: Frame) -> tuple[Float[Tensor, "H W 3"], Bool[Tensor, "H W"]]:
    """The source image warped into the target view by the target's depth, and the mask of warped pixels."""
    depth = _known_depth(target)
    pixels, z = changed(source.camera).project(changed(target.camera).unproject(depth).reshape(-1, 3))
    camera = source.camera
    grid = (pixels / pixels.new_tensor([camera.width, camera.height]) * 2 - 1).reshape(1, *depth.shape, 2)
    image = source.image.permute(2, 0, 1)[None].double()
    painted = torch.nn.functional.grid_sample(image, grid.nan_to_num(2.0), align_corners=False)[0].permute(1, 2, 0)
    z_there = torch.nn.functional.grid_sample(
        _known_depth(source)[None, None].nan_to_num(0.0), grid.nan_to_num(2.0), mode="nearest", align_corners=False
    )[0, 0]
    z = z.reshape(depth.shape)
    # Points occluded in the source image are left out.
    shown = (grid[0].abs() <= 1).all(-1) & (z > 0) & ((z_there - z).abs() < 0.05 * z)
    return painted / 255.0, shown


def _known_depth(frame: Frame) -> Float[Tensor, "H W"]:
    """A frame's z-depth, NaN where it is unknown, masked, or estimated with confidence below the least. [H, W]"""
    depth, confidence = frame.depth, frame.depth_confidence
    if depth is None:
        return torch.full(frame.image.shape[:2], torch.nan, dtype=torch.float64)
    trusted = frame.valid if confidence is None else frame.valid & (confidence >= LEAST_CONFIDENCE)
    return torch.where(trusted, depth.double(), torch.nan)


def changed(camera: Camera, change: Change = CHANGES[GIVEN]) -> Camera:
    """The camera in double precision with its pose read in another way."""
    return replace(camera, camera_to_world=change(camera.camera_to_world.double()))


def _color_difference(colors: Tensor, colors_there: Tensor) -> Tensor:
    """Mean absolute colour difference after matching the channels' medians, as lamp and gain change. [K]"""
    if not len(colors):
        return torch.zeros(0, dtype=torch.float64)
    factor = (colors_there.median(dim=0).values + 1.0) / (colors.median(dim=0).values + 1.0)
    return (colors * factor - colors_there).abs().mean(dim=1)


def _median(parts: Sequence[Tensor]) -> float | None:
    values = torch.cat(tuple(parts))
    return float(values.median()) if len(values) else None
