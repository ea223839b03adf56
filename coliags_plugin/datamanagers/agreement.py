"""Depth that the frames of a video agree on: noise averaged over frames, and the blur at depth steps undone.

A pixel of frame i has depth z_i. Frame j shows the same surface; the pixel's ray meets it at depth z_ij.
Over pairs of frames that are l apart, V(l) is the robust variance of log z_ij / z_i. Noise contributes as much at every
l, what moves contributes with the square of l (docs/methods.md 4.14):

    2 s^2  = min(V(1), max(0, (4 V(1) - V(2)) / 3)),   m^2(l) = max(0, V(l) - 2 s^2)
    log z  = sum_j w_ij log z_ij / sum_j w_ij,   w_ii = 1 / s^2,   w_ij = 1 / (s^2 + m^2(l)),   within 4 sqrt(2) s
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.depth_maps import Pose, WeightedDepth, depths_by
from coliags_plugin.core.json_files import JsonObject
from coliags_plugin.core.scene_files import parallel_map
from coliags_plugin.core.scenes import Frame, Scene
from coliags_plugin.core.tensors import dilated
from coliags_plugin.datamanagers.fusion import DEPTH_POINTS, fuse_depth

#: Relative noise up to which depth is exact and stays as it is.
EXACT = 0.004
#: Sharpness of depth steps from which on they are not blurred.
SHARP = 0.7
#: Places before and after a frame, in the order of the training frames, of those that it is compared with.
_NEIGHBOURS = (1, 2, 3, 4, 6, 9, 13)
#: Frames from which the noise is estimated, and fewest frames and differences that tell it.
_SAMPLED, _FEWEST_FRAMES, _FEWEST = 16, 5, 100
#: Second difference of inverse depth, relative to it, above which there is a step; and the multiple of its median in
#: the frame, which white noise raises, that it must exceed, too.
_STEP, _NOISY_BEND = 0.03, 4.0
#: Pixels beside unknown depth that blurs into them.
_RIM = 3
#: Reach of a step's window, of its flat sides, and of its blur, pixels; least ratio of the depths of its sides.
_NEAR, _SIDES, _BLUR, _LEAST_RATIO = 2, 6, 3, 1.05
#: Share of a step's height about its middle within which a pixel is of neither side.
_UNDECIDED = 0.08


@dataclass(frozen=True)
class Agreement:
    """Errors of a scene's depth, as its frames tell them."""

    noise: float  # relative standard deviation of the given depth
    remaining_noise: float  # the same after the first pass of averaging, as far as errors of frames are independent
    sharpness: float  # median share of a depth step, over three pixels, that lies between its middle two
    deviations: Mapping[int, float]  # relative, between frames that are so many places of the video apart

    @property
    def is_noisy(self) -> bool:
        """True if averaging pays."""
        return self.noise > EXACT

    @property
    def is_blurred(self) -> bool:
        """True if depth steps are blurred."""
        return self.sharpness < SHARP

    @property
    def record(self) -> JsonObject:
        """The numbers, for a run's provenance."""
        return {**asdict(self), "deviations": {str(lag): value for lag, value in self.deviations.items()}}

    def __str__(self) -> str:
        """Findings in one line."""
        averaged = f", averaged to {100 * self.remaining_noise:.2f} %" if self.is_noisy else ""
        steps = "blurred and are sharpened" if self.is_blurred else "sharp"
        return f"noise {100 * self.noise:.2f} %{averaged}; depth steps are {steps} ({self.sharpness:.2f})"


@torch.no_grad()
def agreed_depth(scene: Scene) -> tuple[Scene, Agreement | None]:
    """The scene with training depth that its frames agree on, and with points fused from it if they came from depth.

    Depth that is exact and sharp stays as it is, to the bit. A pixel at a blurred step gets the depth of its side, and
    is unknown where it is of neither side. None instead of an agreement where too few frames have true depth: the
    errors of estimated depth are shared by its frames.
    """
    frames = [frame for frame in scene.train if frame.true_depth is not None]
    if len(frames) < _FEWEST_FRAMES:
        return scene, None
    sharpness = _sharpness(frames[:: max(1, len(frames) // _SAMPLED)])
    views = parallel_map(lambda frame: _view(frame, sharpness < SHARP), frames, "find depth steps")
    variances = _variances(views)
    if not variances:
        return scene, None
    noise = _at_zero(variances)
    agreement = Agreement(noise**0.5, noise**0.5, sharpness, {lag: value**0.5 for lag, value in variances.items()})
    if not (agreement.is_noisy or agreement.is_blurred):
        return scene, agreement
    if agreement.is_noisy:
        left = _average(views, variances, noise, noise)
        agreement = replace(agreement, remaining_noise=left**0.5)
        # Neighbours share errors by now: this pass lessens them further, but by less than it computes.
        _average(views, variances, noise, left)
    depths = [view.depth for view in views]
    if agreement.is_blurred:
        depths = parallel_map(_sharpened, views, "sharpen depth steps")
    changed = {frame.name: frame.with_maps(depth=depth) for frame, depth in zip(frames, depths, strict=True)}
    train, points = [changed.get(frame.name, frame) for frame in scene.train], scene.points
    if len(points) and scene.provenance.points.source == DEPTH_POINTS:
        generator = np.random.default_rng(scene.provenance.points.seed)
        points = fuse_depth(train, len(points), generator)
    return replace(scene, train=train, points=points), agreement


@dataclass
class _View:
    """A training frame's depth on the way to agreement. Maps are [H, W]."""

    camera: Camera
    index: int
    given: Tensor  # NaN where unknown
    known: Tensor
    steps: Tensor  # at depth steps, and one pixel around them
    comparable: Tensor  # away from steps, and from unknown depth that blurs into the known
    depth: Tensor  # as averaged so far

    @property
    def surface(self) -> WeightedDepth:
        """Depth where it is comparable, NaN elsewhere, to compare others with."""
        depth = torch.where(self.comparable, self.depth, torch.nan)
        return WeightedDepth(Pose.of(self.camera), depth.numpy(), np.ones(depth.shape, np.float32))


def _view(frame: Frame, is_blurred: bool) -> _View:
    assert frame.depth is not None
    depth = torch.where(frame.valid, frame.depth, torch.nan)
    known = torch.isfinite(depth) & (depth > 0)
    depth = torch.where(known, depth, torch.nan)
    steps = _steps(depth, known)
    comparable = known & ~steps & ~_rim(known) if is_blurred else known & ~steps
    return _View(frame.camera, frame.index, depth, known, steps, comparable, depth)


def _rim(known: Bool[Tensor, "H W"]) -> Bool[Tensor, "H W"]:
    return dilated(~known, _RIM)


def _steps(depth: Float[Tensor, "H W"], known: Bool[Tensor, "H W"]) -> Bool[Tensor, "H W"]:
    """Pixels beside which inverse depth, linear on planes, bends by more than a plane with noise does."""
    inverse = torch.where(known, depth.reciprocal(), torch.nan)
    bends = []
    for down, across in ((0, 1), (1, 0), (1, 1), (1, -1)):
        ahead, behind = (torch.roll(inverse, (s * down, s * across), (0, 1)) for s in (-1, 1))
        bend = ((ahead - 2 * inverse + behind) / inverse).abs()
        bend[[0, -1]], bend[:, [0, -1]] = 0, 0
        bends.append(bend)
    largest = torch.stack(bends).nan_to_num(0.0).amax(0)
    return dilated(largest > max(_STEP, _NOISY_BEND * float(largest[known].median())), 1)


def _sharpness(frames: Sequence[Frame]) -> float:
    """Median share of a step's height over three pixels that lies between its middle two; 1 with hardly any step."""
    shares = []
    for frame in frames:
        assert frame.depth is not None
        logs = torch.where(frame.valid, frame.depth, torch.nan).log()
        for lines in (logs, logs.T):
            jumps = lines.diff(dim=1).abs()
            before, jump, after = jumps[:, :-2], jumps[:, 1:-1], jumps[:, 2:]
            height = (lines[:, 3:] - lines[:, :-3]).abs()
            noisy = _NOISY_BEND * float(lines.diff(n=2, dim=1).abs().nanmedian())
            steep = (height > max(0.15, noisy)) & (jump >= before) & (jump >= after)
            shares.append((jump / height)[steep])
    steps = torch.cat(shares)
    return float(steps.median()) if len(steps) > _FEWEST else 1.0


def _offsets(view: _View, others: Sequence[_View]) -> list[Float[Tensor, "H W"]]:
    """Log depth at which the rays of a view meet the surface of each other one, less its own; NaN where unknown."""
    frame = WeightedDepth(Pose.of(view.camera), view.depth.numpy(), np.ones(view.depth.shape, np.float32))
    depth, by_others, _ = depths_by([other.surface for other in others], frame)
    offsets = torch.from_numpy(by_others / depth)[:, : view.depth.numel()].log()
    return list(offsets.view(-1, *view.depth.shape).unbind(0))


def _neighbours(views: Sequence[_View], place: int) -> list[_View]:
    places = [place + sign * offset for offset in _NEIGHBOURS for sign in (-1, 1)]
    return [views[other] for other in places if 0 <= other < len(views)]


def _variances(views: Sequence[_View]) -> dict[int, float]:
    """V(l), by the distance l of two frames in the video, ascending."""
    differences: dict[int, list[Tensor]] = {}
    for place in range(0, len(views), max(1, len(views) // _SAMPLED)):
        view = views[place]
        others = _neighbours(views, place)
        for other, offset in zip(others, _offsets(view, others), strict=True):
            logs = offset[view.comparable]
            differences.setdefault(abs(other.index - view.index), []).append(logs[logs.isfinite()][::7])
    gathered = {lag: torch.cat(parts) for lag, parts in sorted(differences.items())}
    return {lag: _robust_variance(logs) for lag, logs in gathered.items() if len(logs) > _FEWEST}


def _robust_variance(values: Float[Tensor, "K"]) -> float:
    return float((1.4826 * (values - values.median()).abs().median()).square())


def _at_zero(variances: Mapping[int, float]) -> float:
    """s^2: half of what is left of V(l) at l = 0."""
    first = next(iter(variances))
    nearest, twice = variances[first], variances.get(2 * first)
    at_zero = nearest if twice is None else min(nearest, max(0.0, (4 * nearest - twice) / 3))
    return at_zero / 2


def _average(views: Sequence[_View], variances: Mapping[int, float], noise: float, left: float) -> float:
    """Average the views' depths, whose errors have a variance of ``left``, over their neighbours; the variance then."""

    def moved(lag: int) -> float:
        near = min(variances, key=lambda other: abs(other - lag))
        return max(0.0, variances[near] - 2 * noise)

    def averaged(place: int) -> tuple[Tensor, float]:
        view = views[place]
        logs = view.depth.log()
        total, weights = torch.zeros_like(logs), torch.full_like(logs, 1 / left)
        others = _neighbours(views, place)
        for other, offset in zip(others, _offsets(view, others), strict=True):
            weight = 1 / (left + moved(abs(other.index - view.index)))
            agrees = view.comparable & (offset.abs() < 4 * math.sqrt(2 * left))
            total += torch.where(agrees, weight * offset, 0.0)
            weights += torch.where(agrees, weight, 0.0)
        offset = torch.where(view.comparable, total / weights, 0.0)
        # Near steps, whose pixels are compared with none, the change of the pixels around.
        spread, counted = offset, view.comparable.float()
        for _ in range(2):
            spread, counted = (functional.avg_pool2d(v[None, None], 9, 1, 4)[0, 0] for v in (spread, counted))
        offset = torch.where(view.comparable, offset, spread / counted.clamp_min(1e-3))
        variance = (1 / weights)[view.comparable]
        return (logs + offset).exp(), float(variance.median()) if len(variance) else left

    results = parallel_map(averaged, range(len(views)), "average depth")
    for view, (depth, _) in zip(views, results, strict=True):
        view.depth = depth
    return float(np.median([variance for _, variance in results]))


def _sharpened(view: _View) -> Float[Tensor, "H W"]:
    """Depth whose pixels at blurred steps are at that of their side, and unknown at the rim of unknown depth.

    A blur moves the pixels of a step between its sides and leaves its middle in place. Slopes, which have no flat
    sides, stay as they are.
    """
    pixels = (view.steps & view.known).nonzero()
    nearby, _ = _windows(torch.where(view.known, view.given, torch.nan), pixels, _NEAR)
    lowest, highest = nearby.nan_to_num(math.inf).amin(1), nearby.nan_to_num(-math.inf).amax(1)
    middle = (lowest + highest) / 2
    given = view.given[pixels[:, 0], pixels[:, 1]]
    flat = view.known & ~view.steps
    around, squares = _windows(torch.where(flat, view.given, torch.nan), pixels, _SIDES)
    logs, _ = _windows(torch.where(flat, view.depth, torch.nan).log(), pixels, _SIDES)
    weights = torch.exp(-squares / 8.0)
    near_side = around < middle[:, None]
    sides = [_mean_and_deviation(logs, weights * (side & logs.isfinite())) for side in (near_side, ~near_side)]
    (near, near_deviation), (far, far_deviation) = sides
    is_step = (far - near > math.log(_LEAST_RATIO)) & (highest > _LEAST_RATIO * lowest)
    is_blur = is_step & (far - near > 2 * (near_deviation + far_deviation))
    blurred = torch.zeros_like(view.known)
    blurred[pixels[:, 0], pixels[:, 1]] = is_blur
    changes = is_step & dilated(blurred, _BLUR)[pixels[:, 0], pixels[:, 1]]
    values = torch.where(given < middle, near, far).exp()
    values[(given - middle).abs() < _UNDECIDED * (highest - lowest)] = torch.nan
    row, column = pixels[changes].unbind(1)
    sharp = view.depth.clone()
    sharp[row, column] = values[changes]
    return torch.where(_rim(view.known), torch.nan, sharp)


def _windows(
    image: Float[Tensor, "H W"], pixels: Tensor, reach: int
) -> tuple[Float[Tensor, "P K"], Float[Tensor, "K"]]:
    """Values around pixels, NaN outside of the image, and their squared distances, pixels squared."""
    padded = functional.pad(image, (reach,) * 4, value=math.nan)
    offsets = torch.cartesian_prod(*[torch.arange(2 * reach + 1)] * 2)
    places = pixels[:, None] + offsets
    return padded[places[..., 0], places[..., 1]], (offsets - reach).square().sum(1)


def _mean_and_deviation(values: Float[Tensor, "P K"], weights: Float[Tensor, "P K"]) -> tuple[Tensor, Tensor]:
    """Weighted mean and deviation of each row; NaN where the weights are next to none."""
    values, total = values.nan_to_num(0.0), weights.sum(1)
    total = torch.where(total > 1e-3, total, torch.nan)
    mean = (weights * values).sum(1) / total
    return mean, ((weights * values.square()).sum(1) / total - mean.square()).clamp_min(0.0).sqrt()
