"""The light of a scene from surface points that several training frames see, before anything is trained."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from coliags_plugin.core.masked import zero_outside
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


@dataclass(frozen=True)
class LightFit:
    """Light that explains the colours of surface points.

    Attributes:
        log_gains: Of the training frames, encoded, with a mean of 0. [F]
        cosine_exponents: Of cos(theta), theta the angle to the optical axis, for each colour. [3]
    """

    log_gains: Float[Tensor, "F"]
    cosine_exponents: Float[Tensor, "3"]


def fit_light(scene: Scene) -> LightFit | None:
    """Fit gains and fall-off over the angle; None without depth, or with too few frames or points.

    Least squares, reweighted by the residuals, of log c = albedo of the point + gain of the frame - 0.91 log d + b
    log cos(theta), d the distance to the camera, over the scene's points at pixels of the same depth, for each colour.
    The gains are those of green. Only training frames are looked at.

    Args:
        scene: The scene.
    """
    points = scene.points.positions[:: max(1, len(scene.points) // _POINTS)].double()
    if min(len(scene.train), len(points)) < _FEWEST or any(frame.depth is None for frame in scene.train):
        return None
    parts = zip(*(_seen(frame, points) for frame in scene.train), strict=True)
    logs, usable, cosines = (torch.stack(maps, dim=1) for maps in parts)
    usable = usable & (usable.sum(1, keepdim=True) > 1)
    fits = [_fit(logs[..., channel], usable[..., channel], cosines.log()) for channel in range(3)]
    return LightFit(fits[_GREEN][0].float(), torch.stack([slope for _, slope in fits]).float())


def _seen(
    frame: Frame, points: Float[Tensor, "P 3"]
) -> tuple[Float[Tensor, "P 3"], Bool[Tensor, "P 3"], Float[Tensor, "P"]]:
    """Log colours of points in a frame without the fall-off over distance, where they count, and cosines."""
    assert frame.depth is not None
    camera = frame.camera.to("cpu", torch.float64)
    pixels, depths = camera.project(points)
    inside = camera.sees(points)[1]
    limits = torch.tensor([camera.width - 1, camera.height - 1])
    column, row = pixels.nan_to_num(0.0).clamp(torch.zeros(2), limits).long().unbind(1)
    valid = frame.valid.cpu()
    blurred = _mean_of_neighbours(zero_outside(frame.rgb.cpu(), valid))
    whole = _mean_of_neighbours(valid[..., None].float())[..., 0] > _ALL
    colors = blurred[row, column].double()
    same = inside & ((frame.depth.cpu()[row, column] - depths).abs() < _SAME_SURFACE * depths)
    same = same & whole[row, column]
    usable = same[:, None] & (colors > _DARKEST) & (colors < _BRIGHTEST)
    distances = (points - camera.center).norm(dim=1).clamp_min(1e-9)
    logs = colors.clamp_min(1e-3).log() - _DISTANCE_EXPONENT * distances.log()[:, None]
    return logs, usable, (depths / distances).clamp(1e-3, 1.0)


def _mean_of_neighbours(image: Float[Tensor, "H W C"]) -> Float[Tensor, "H W C"]:
    """Mean over 3x3 pixels, over those that there are at the border. [H, W, C]"""
    planes = image.permute(2, 0, 1)[None]
    return torch.nn.functional.avg_pool2d(planes, 3, 1, 1, count_include_pad=False)[0].permute(1, 2, 0)


def _fit(
    logs: Float[Tensor, "P F"], usable: Bool[Tensor, "P F"], feature: Float[Tensor, "P F"]
) -> tuple[Float[Tensor, "F"], Float[Tensor, ""]]:
    """Gains and coefficient in log = point + gain + coefficient times feature; the gains' mean is 0. [F], []"""
    frames, weights = logs.shape[1], usable.to(logs.dtype)
    solution = logs.new_zeros(frames + 1)
    for _ in range(_PASSES):
        # Points are eliminated: everything is relative to its weighted mean over the frames that see the point.
        sums = weights.sum(1, keepdim=True).clamp_min(1e-9)
        x, y = (values - (weights * values).sum(1, keepdim=True) / sums for values in (feature, logs))
        matrix = logs.new_zeros(frames + 1, frames + 1)
        matrix[:-1, :-1] = torch.diag(weights.sum(0)) - weights.T @ (weights / sums)
        matrix[:-1, -1] = matrix[-1, :-1] = (weights * x).sum(0)
        matrix[-1, -1] = (weights * x * x).sum()
        right = torch.cat([(weights * y).sum(0), (weights * x * y).sum()[None]])
        # The smallest solution: what no observation determines stays at 0.
        solution = torch.linalg.lstsq(matrix, right[:, None], rcond=1e-10, driver="gelsd").solution[:, 0]
        shifts = solution[:-1] - (weights * solution[:-1]).sum(1, keepdim=True) / sums
        residuals = y - solution[-1] * x - shifts
        if usable.any():
            deviation = 1.4826 * residuals[usable].abs().median().clamp_min(1e-6)
            weights = usable / (1.0 + (residuals / (_HALF_WEIGHT * deviation)).square())
    return solution[:-1] - solution[:-1].mean(), solution[-1]
