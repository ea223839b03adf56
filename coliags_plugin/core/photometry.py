"""The light of a scene from surface points that several training frames see, before anything is trained."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from coliags_plugin.core.masked import zero_outside
from coliags_plugin.core.point_normals import wall_normals
from coliags_plugin.core.scenes import Frame, Scene

#: Approximate number of points, spread evenly over the scene's; fewest of these and of frames.
_POINTS, _FEWEST = 3000, 3
#: Encoded colours that count: darker ones are noise, brighter ones are compressed by the camera, or glints.
_DARKEST, _BRIGHTEST = 0.06, 0.72
#: Relative difference of depth up to which a point is what the pixel shows.
_SAME_SURFACE = 0.02
#: Passes of reweighting by residuals, and the residual at which the weight is a half, in robust standard deviations.
_PASSES, _HALF_WEIGHT = 5, 2.0
#: Share of valid pixels among 3x3 above which all are.
_ALL = 0.99
#: Whose fit gives the gain of all: red is least like direct light, because the wall lights itself.
_GREEN = 1
#: Of encoded colours over the distance to the lamp: inverse square at gamma 2.2. Fitted, it would take up the gain of a
#: camera that moves one way.
_DISTANCE_EXPONENT = -2.0 / 2.2
#: Smallest cosines that count, of the angles to the optical axis and to the wall's normal.
_SMALLEST_COSINES = (0.05, 0.1)
#: Of the lamp's offset, as shares of the median distance: largest component, largest step of one iteration, step of the
#: finite differences, step that ends the iterations; and most iterations.
_LARGEST_OFFSET, _LARGEST_STEP, _DIFFERENCE, _CONVERGED, _ITERATIONS = 0.3, 0.08, 0.002, 0.0005, 12
#: Share of the residuals' deviation with a lamp at the lens above which it stays there.
_NOT_BETTER = 0.975


@dataclass(frozen=True)
class LightFit:
    """Light that explains the colours of surface points.

    Attributes:
        log_gains: Of the training frames, encoded, with a mean of 0. [F]
        lamp_offset: Of the lamp from the optical centre, camera axes, scene units. [3]
        cosine_exponents: Of cos(psi), psi the angle at the lamp to the optical axis, for each colour. [3]
        incidence_exponents: Of the cosine of the angle of incidence, for each colour. [3]
    """

    log_gains: Float[Tensor, "F"]
    lamp_offset: Float[Tensor, "3"]
    cosine_exponents: Float[Tensor, "3"]
    incidence_exponents: Float[Tensor, "3"]


@dataclass(frozen=True)
class _Observations:
    """Points in the training frames.

    Attributes:
        logs: Logarithms of their colours. [P, F, 3]
        usable: Where they count. [P, F, 3]
        sights: Positions in camera axes, scene units. [P, F, 3]
        normals: In camera axes, of either sign. [P, F, 3]
    """

    logs: Float[Tensor, "P F 3"]
    usable: Bool[Tensor, "P F 3"]
    sights: Float[Tensor, "P F 3"]
    normals: Float[Tensor, "P F 3"]

    def falloff(self, offset: Float[Tensor, "3"]) -> tuple[Float[Tensor, "P F"], Float[Tensor, "P F 2"]]:
        """Log fall-off over the distance to a lamp at an offset, and log cosines of the angles to axis and normal."""
        rays = self.sights - offset
        distances = rays.norm(dim=-1).clamp_min(1e-9)
        cosines = torch.stack([rays[..., 2], (self.normals * rays).sum(-1).abs()], dim=-1) / distances[..., None]
        least = torch.tensor(_SMALLEST_COSINES, dtype=rays.dtype)
        return _DISTANCE_EXPONENT * distances.log(), cosines.clamp(least, torch.ones_like(least)).log()


def fit_light(scene: Scene) -> LightFit | None:
    """Fit gains, the lamp's place and fall-off over angles; None without depth, or with too few frames or points.

    Least squares, reweighted by the residuals, of log c = albedo of the point + gain of the frame - 0.91 log d +
    b log cos(psi) + c log cos(incidence) over the scene's points at pixels of the same depth, for each colour. d and
    the angles are those at the lamp, whose offset from the lens is found by Gauss-Newton steps; it and the gains are
    those of green. Only training frames are looked at.

    Args:
        scene: The scene.
    """
    everything = scene.points.positions.double()
    points = everything[:: max(1, len(everything) // _POINTS)]
    if min(len(scene.train), len(points)) < _FEWEST or any(frame.depth is None for frame in scene.train):
        return None
    normals = wall_normals(everything, points)
    parts = zip(*(_seen(frame, points, normals) for frame in scene.train), strict=True)
    logs, usable, sights, turned = (torch.stack(maps, dim=1) for maps in parts)
    seen = _Observations(logs, usable & (usable.sum(1, keepdim=True) > 1), sights, turned)
    offset = _lamp_offset(seen)
    known, cosines = seen.falloff(offset)
    fits = [_fit(seen.logs[..., color] - known, seen.usable[..., color], cosines) for color in range(3)]
    slopes = torch.stack([fit.slopes for fit in fits]).float()
    return LightFit(fits[_GREEN].log_gains.float(), offset.float(), slopes[:, 0], slopes[:, 1])


def _seen(
    frame: Frame, points: Float[Tensor, "P 3"], normals: Float[Tensor, "P 3"]
) -> tuple[Float[Tensor, "P 3"], Bool[Tensor, "P 3"], Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
    """Log colours, where they count, positions and normals in camera axes of the points in one frame."""
    assert frame.depth is not None
    camera = frame.camera.to("cpu", torch.float64)
    pixels, depths = camera.project(points)
    limits = torch.tensor([camera.width - 1, camera.height - 1])
    column, row = pixels.nan_to_num(0.0).clamp(torch.zeros(2), limits).long().unbind(1)
    valid = frame.valid.cpu()
    blurred = _mean_of_neighbours(zero_outside(frame.rgb.cpu(), valid))
    whole = _mean_of_neighbours(valid[..., None].float())[..., 0] > _ALL
    colors = blurred[row, column].double()
    same = camera.is_inside(pixels, depths) & ((frame.depth.cpu()[row, column] - depths).abs() < _SAME_SURFACE * depths)
    usable = (same & whole[row, column])[:, None] & (colors > _DARKEST) & (colors < _BRIGHTEST)
    axes = camera.camera_to_world[:3, :3]
    return colors.clamp_min(1e-3).log(), usable, (points - camera.center) @ axes, normals @ axes


def _mean_of_neighbours(image: Float[Tensor, "H W C"]) -> Float[Tensor, "H W C"]:
    """Mean over 3x3 pixels, over those that there are at the border. [H, W, C]"""
    planes = image.permute(2, 0, 1)[None]
    return torch.nn.functional.avg_pool2d(planes, 3, 1, 1, count_include_pad=False)[0].permute(1, 2, 0)


def _lamp_offset(seen: _Observations) -> Float[Tensor, "3"]:
    """Lamp's offset from the optical centre by Gauss-Newton steps on green; 0 where residuals hardly fall. [3]"""
    logs, usable = seen.logs[..., _GREEN], seen.usable[..., _GREEN]
    offset = logs.new_zeros(3)
    if not usable.any():
        return offset
    scale = float(seen.sights.norm(dim=-1)[usable].median())
    known, cosines = seen.falloff(offset)
    at_lens = _fit(logs - known, usable, cosines)
    slopes = at_lens.slopes
    for _ in range(_ITERATIONS):
        known, cosines = seen.falloff(offset)
        changes = []
        for axis in torch.eye(3, dtype=logs.dtype) * _DIFFERENCE * scale:
            (far, far_cosines), (near, near_cosines) = seen.falloff(offset + axis), seen.falloff(offset - axis)
            change = (far - near) + (far_cosines - near_cosines) @ slopes
            changes.append(change / (2.0 * _DIFFERENCE * scale))
        found = _fit(logs - known, usable, torch.cat([cosines, torch.stack(changes, dim=-1)], dim=-1))
        slopes = found.slopes[:2]
        step = found.slopes[2:].clamp(-_LARGEST_STEP * scale, _LARGEST_STEP * scale)
        offset = (offset + step).clamp(-_LARGEST_OFFSET * scale, _LARGEST_OFFSET * scale)
        if float(step.abs().max()) < _CONVERGED * scale:
            break
    known, cosines = seen.falloff(offset)
    better = _fit(logs - known, usable, cosines).deviation < _NOT_BETTER * at_lens.deviation
    return offset if better else torch.zeros_like(offset)


class _Fit(NamedTuple):
    """Gains with a mean of 0 [F], coefficients of features [K], and the residuals' robust standard deviation."""

    log_gains: Float[Tensor, "F"]
    slopes: Float[Tensor, "K"]
    deviation: float


def _fit(logs: Float[Tensor, "P F"], usable: Bool[Tensor, "P F"], features: Float[Tensor, "P F K"]) -> _Fit:
    """Fit log = point + gain of the frame + slopes times features."""
    deviation = 0.0
    frames, count, weights = logs.shape[1], features.shape[2], usable.to(logs.dtype)
    values = torch.cat([features, logs[..., None]], dim=-1)
    solution = logs.new_zeros(frames + count)
    for _ in range(_PASSES):
        # Points are eliminated: everything is relative to its weighted mean over the frames that see the point.
        sums = weights.sum(1, keepdim=True).clamp_min(1e-9)
        relative = values - ((weights[..., None] * values).sum(1, keepdim=True) / sums[..., None])
        x, y = relative[..., :-1], relative[..., -1]
        weighted = weights[..., None] * relative
        matrix = logs.new_zeros(frames + count, frames + count)
        matrix[:frames, :frames] = torch.diag(weights.sum(0)) - weights.T @ (weights / sums)
        matrix[:frames, frames:] = weighted[..., :-1].sum(0)
        matrix[frames:, :frames] = matrix[:frames, frames:].T
        products = weighted[..., :-1].flatten(0, 1).T @ relative.flatten(0, 1)
        matrix[frames:, frames:] = products[:, :-1]
        right = torch.cat([weighted[..., -1].sum(0), products[:, -1]])
        # The smallest solution: what no observation determines stays at 0.
        solution = torch.linalg.lstsq(matrix, right[:, None], rcond=1e-10, driver="gelsd").solution[:, 0]
        shifts = solution[:frames] - (weights * solution[:frames]).sum(1, keepdim=True) / sums
        residuals = y - x @ solution[frames:] - shifts
        if usable.any():
            deviation = 1.4826 * float(residuals[usable].abs().median().clamp_min(1e-6))
            weights = usable / (1.0 + (residuals / (_HALF_WEIGHT * deviation)).square())
    return _Fit(solution[:frames] - solution[:frames].mean(), solution[frames:], deviation)
