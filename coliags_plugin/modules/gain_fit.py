"""Gains from surface points that several training frames see, before training."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from coliags_plugin.core.scenes import Frame, Scene

#: Approximate number of points, spread evenly over the scene's; fewest of these and of frames.
_POINTS, _FEWEST = 3000, 3
#: Encoded colours that count: darker ones are noise, brighter ones are compressed by the camera, or glints.
_DARKEST, _BRIGHTEST = 0.06, 0.72
#: Relative difference of depth up to which a point is what the pixel shows.
_SAME_SURFACE = 0.02
#: Passes of reweighting by residuals, and the residual at which the weight is a half, in robust standard deviations.
_PASSES, _HALF_WEIGHT = 5, 2.0
#: Green: red is least like direct light, because the wall lights itself.
_CHANNEL = 1
#: Of encoded colours over the distance to the lamp: inverse square at gamma 2.2. Fitted, it would take up the gain of a
#: camera that moves one way.
_DISTANCE_EXPONENT = -2.0 / 2.2


def fit_log_gains(scene: Scene) -> Float[Tensor, "F"] | None:
    """Logarithm of the gain of every training frame, with a mean of 0; None without depth, or with too few frames.

    Least squares, reweighted by the residuals, of log green = albedo of the point + gain of the frame - 0.91 log d + b
    log cos(theta), d the distance to the camera and theta the angle to the optical axis, over the scene's points at
    pixels of the same depth. Only training frames are looked at.

    Args:
        scene: The scene.
    """
    points = scene.points.positions[:: max(1, len(scene.points) // _POINTS)].double()
    if min(len(scene.train), len(points)) < _FEWEST or any(frame.depth is None for frame in scene.train):
        return None
    logs, usable, cosines = (
        torch.stack(maps, dim=1) for maps in zip(*(_seen(f, points) for f in scene.train), strict=True)
    )
    return _fit(logs, usable & (usable.sum(1, keepdim=True) > 1), cosines.log()).float()


def _seen(
    frame: Frame, points: Float[Tensor, "P 3"]
) -> tuple[Float[Tensor, "P"], Bool[Tensor, "P"], Float[Tensor, "P"]]:
    """Log green of points in a frame without the fall-off over distance, where that counts, and cosines."""
    assert frame.depth is not None
    camera = frame.camera.to("cpu", torch.float64)
    pixels, depths = camera.project(points)
    inside = camera.sees(points)[1]
    limits = torch.tensor([camera.width - 1, camera.height - 1])
    column, row = pixels.nan_to_num(0.0).clamp(torch.zeros(2), limits).long().unbind(1)
    green = frame.rgb.cpu()[None, None, ..., _CHANNEL]
    colors = torch.nn.functional.avg_pool2d(green, 3, 1, 1, count_include_pad=False)[0, 0, row, column].double()
    same = inside & ((frame.depth.cpu()[row, column] - depths).abs() < _SAME_SURFACE * depths)
    usable = same & frame.valid.cpu()[row, column] & (colors > _DARKEST) & (colors < _BRIGHTEST)
    distances = (points - camera.center).norm(dim=1).clamp_min(1e-9)
    logs = colors.clamp_min(1e-3).log() - _DISTANCE_EXPONENT * distances.log()
    return logs, usable, (depths / distances).clamp(1e-3, 1.0)


def _fit(logs: Float[Tensor, "P F"], usable: Bool[Tensor, "P F"], feature: Float[Tensor, "P F"]) -> Float[Tensor, "F"]:
    """Gains in log = point + gain + coefficient times feature, with a mean of 0. [F]"""
    frames, weights = logs.shape[1], usable.to(logs.dtype)
    gains = logs.new_zeros(frames)
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
        gains = solution[:-1]
        shifts = gains - (weights * gains).sum(1, keepdim=True) / sums
        residuals = y - solution[-1] * x - shifts
        if usable.any():
            deviation = 1.4826 * residuals[usable].abs().median().clamp_min(1e-6)
            weights = usable / (1.0 + (residuals / (_HALF_WEIGHT * deviation)).square())
    return gains - gains.mean()
