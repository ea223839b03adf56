"""The light of a scene from surface points that several training frames see, before anything is trained."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple
from weakref import WeakKeyDictionary

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from coliags_plugin.core.scenes import Frame, Scene
from coliags_plugin.core.shadows import find_lamps
from coliags_plugin.core.tensors import depth_steps, wall_normals, zero_outside

#: Approximate number of patches, and the nearest of them that tell how large one is.
_PATCHES, _NEIGHBOURS = 600, 8
#: Reflections that count; at an albedo of .4 the rest is below 1 %.
_BOUNCES = 5


@dataclass(frozen=True)
class Cavity:
    """Radiosity model of a Lambertian wall: patches of one albedo and the form factors between them.

    Occlusion is neglected: patches that face each other see each other.

    Attributes:
        every: Stride over the points at which patches are centred.
        between: Form factors from each patch to every patch. [K, K]
        onto_points: Form factors from each point to every patch. [P, K]
    """

    every: int
    between: Float[Tensor, "K K"]
    onto_points: Float[Tensor, "P K"]

    @classmethod
    def of(cls, points: Float[Tensor, "P 3"], normals: Float[Tensor, "P 3"]) -> Cavity:
        """The wall that points lie on, scene units, spread evenly; unit normals point away from it."""
        every = max(1, len(points) // _PATCHES)
        centres, outward = points[::every], normals[::every]
        nearest = torch.cdist(centres, centres).topk(min(_NEIGHBOURS + 1, len(centres)), largest=False).values
        areas = math.pi * nearest[:, -1].square() / max(1, nearest.shape[1] - 1)
        between = _form_factors(centres, outward, centres, outward, areas)
        return cls(every, between, _form_factors(points, normals, centres, outward, areas))

    def indirect(self, direct: Float[Tensor, "K F"], albedo: float) -> Float[Tensor, "P F"]:
        """Irradiance of the points by a wall of an albedo, by radiosity; direct: of the patches by the lamp."""
        total = direct
        for _ in range(_BOUNCES - 1):
            total = direct + albedo * (self.between @ total)
        return albedo * (self.onto_points @ total)


def _form_factors(
    points: Float[Tensor, "P 3"],
    normals: Float[Tensor, "P 3"],
    centres: Float[Tensor, "K 3"],
    outward: Float[Tensor, "K 3"],
    areas: Float[Tensor, "K"],
) -> Float[Tensor, "P K"]:
    """Form factors of discs seen from points; those of a point sum to 1 at most."""
    rays = centres[None] - points[:, None]
    squares = rays.square().sum(-1)
    lengths = squares.sqrt().clamp_min(1e-9)
    leaving = -(rays * outward[None]).sum(-1) / lengths
    arriving = (rays * normals[:, None]).sum(-1) / lengths
    factors = leaving.clamp_min(0.0) * arriving.clamp_min(0.0) * areas / (math.pi * squares + areas).clamp_min(1e-12)
    return factors / factors.sum(1, keepdim=True).clamp_min(1.0)


#: Approximate number of points, spread evenly over the scene's; fewest of these and of frames.
_POINTS, _FEWEST = 3000, 3
#: Encoded colours that count: darker ones are noise, brighter ones are compressed by the camera, or glints.
_DARKEST, _BRIGHTEST = 0.06, 0.72
#: Relative difference of depth up to which a point is what the pixel shows, and of depths among 3x3 pixels above which
#: their mean mixes colours of two surfaces.
_SAME_SURFACE, _TWO_SURFACES = 0.02, 0.1
#: Passes of reweighting by residuals, and the residual at which the weight is a half, in robust standard deviations.
_PASSES, _HALF_WEIGHT = 5, 2.0
#: Share of valid pixels among 3x3 above which all are.
_ALL = 0.99
#: Whose fit gives the gain of all: red is least like direct light, because the wall lights itself.
_GREEN = 1
#: Exponent that encodes linear light, and that of linear light over the distance to the lamp. Fitted, the latter would
#: take up the gain of a camera that moves one way.
_ENCODING, _INVERSE_SQUARE = 1.0 / 2.2, -2.0
#: Smallest cosines that count, of the angles to the optical axis and to the wall's normal; smallest distance to the
#: lamp at which a patch is lit, as a share of the median distance.
_SMALLEST_COSINES, _SMALLEST_DISTANCE = (0.05, 0.1), 0.2
#: Start of the fit: b, c and albedo; and the largest albedo.
_START, _LARGEST_ALBEDO = (0.5, 0.4, 0.2), 0.8
#: Of the lamp's offset, as shares of the median distance: largest component, largest step of one iteration, step of the
#: finite differences, step that ends the iterations.
_LARGEST_OFFSET, _LARGEST_STEP, _DIFFERENCE, _CONVERGED = 0.3, 0.08, 0.002, 0.001
#: The last three of the exponents and the albedo; and most iterations.
_LARGEST_CHANGE, _SMALL_CHANGE, _CHANGE_CONVERGED, _ITERATIONS = 0.3, 0.01, 0.01, 12
#: Share of the residuals' deviation with a lamp at the lens above which it stays there.
_MAX_RESIDUAL_RATIO = 0.975


@dataclass(frozen=True)
class LightFit:
    """Light that explains the colours of surface points."""

    log_gains: Float[Tensor, "F"]  # of the training frames, encoded, with a mean of 0
    lamp_offset: Float[Tensor, "3"]  # of the lamp from the optical centre, camera axes, scene units
    cosine_exponents: Float[Tensor, "3"]  # of cos(psi), psi the angle at the lamp to the optical axis, for each colour
    incidence_exponents: Float[Tensor, "3"]  # of the cosine of the angle of incidence, for each colour
    albedo: float  # of the wall in green light, in which it lights itself
    lamps: Float[Tensor, "K 4"]  # that cast shadows: offsets as above, shares of the light that is missing there


@dataclass(frozen=True)
class _Observations:
    """Points in the training frames."""

    logs: Float[Tensor, "P F 3"]  # logarithms of their colours
    usable: Bool[Tensor, "P F 3"]  # where they count
    sights: Float[Tensor, "P F 3"]  # positions in camera axes, scene units
    normals: Float[Tensor, "P F 3"]  # in camera axes, towards the cameras that see them
    lit: Bool[Tensor, "P F"]  # where nothing that is seen keeps the lamp's light from them
    cavity: Cavity  # the wall that they are of

    @property
    def distance(self) -> float:
        """Median distance of what is usable, scene units."""
        return float(self.sights.norm(dim=-1)[self.usable[..., _GREEN]].median())

    def rays(self, offset: Float[Tensor, "3"]) -> tuple[Float[Tensor, "P F"], Float[Tensor, "P F 2"]]:
        """Distances to a lamp at an offset, and cosines of the angles to its axis and to the normals."""
        rays = self.sights - offset
        distances = rays.norm(dim=-1).clamp_min(1e-9)
        cosines = torch.stack([rays[..., 2], -(self.normals * rays).sum(-1)], dim=-1)
        return distances, cosines / distances[..., None]

    def light(self, parameters: Float[Tensor, "6"], scale: float) -> Float[Tensor, "P F"]:
        """Logarithm of the light on the points, encoded: the lamp's and the wall's.

        Parameters are the lamp's offset, the exponents of the cosines as of colours, and the albedo; scale is the
        median distance.
        """
        exponents = parameters[3:5]
        distances, cosines = self.rays(parameters[:3])
        falloffs, angles = _falloff(distances, cosines)
        direct = ((falloffs + angles @ exponents) / _ENCODING).exp()
        distances, cosines = distances[:: self.cavity.every], cosines[:: self.cavity.every]
        reached = self.lit[:: self.cavity.every] & (cosines > 0.0).all(-1)
        near = distances.clamp_min(_SMALLEST_DISTANCE * scale) ** _INVERSE_SQUARE
        beam = cosines[..., 0].clamp_min(_SMALLEST_COSINES[0]) ** (exponents[0] / _ENCODING)
        patches = torch.where(reached, near * beam * cosines[..., 1], 0.0)
        return _ENCODING * (direct + self.cavity.indirect(patches, float(parameters[5]))).log()


def _falloff(
    distances: Float[Tensor, "P F"], cosines: Float[Tensor, "P F 2"]
) -> tuple[Float[Tensor, "P F"], Float[Tensor, "P F 2"]]:
    """Log fall-off of colours over the distance, and logarithms of cosines, that of the normal of either sign."""
    least = torch.tensor(_SMALLEST_COSINES, dtype=distances.dtype)
    facing = torch.stack([cosines[..., 0], cosines[..., 1].abs()], dim=-1)
    return _ENCODING * _INVERSE_SQUARE * distances.log(), facing.clamp_min(least).log()


def fit_light(scene: Scene) -> LightFit | None:
    """Fit gains, the lamp's place and fall-off over angles; None without true depth, or with few frames or points.

    Least squares, reweighted by the residuals, of green of the scene's points at pixels of the same depth:

        log g = albedo of the point + gain of the frame + log(E + albedo of the wall * E_wall) / 2.2,
        E = cos(psi)^(2.2 b) cos(incidence)^(2.2 c) / d^2

    d and the angles are those at the lamp, whose offset from the lens, b, c and the wall's albedo are found by
    Gauss-Newton steps. Then exponents of each colour are fitted to these gains and this lamp, without E_wall. Only
    training frames are looked at. A scene is fitted once.
    """
    if scene not in _FITS:
        _FITS[scene] = _fit_scene(scene)
    return _FITS[scene]


#: Of the scenes that there are: a field and a module of one method ask for the same.
_FITS: WeakKeyDictionary[Scene, LightFit | None] = WeakKeyDictionary()


def _fit_scene(scene: Scene) -> LightFit | None:
    everything = scene.points.positions.double()
    points = everything[:: max(1, len(everything) // _POINTS)]
    has_truth = all(frame.depth is not None for frame in scene.train) and not scene.has_estimated_depth
    if min(len(scene.train), len(points)) < _FEWEST or not has_truth:
        return None
    observations = _observe(scene, points, wall_normals(everything, points))
    parameters, log_gains = _lamp(observations)
    falloffs, cosines = _falloff(*observations.rays(parameters[:3]))
    rest = observations.logs - (falloffs + log_gains)[..., None]
    slopes = torch.stack(
        [_fit(rest[..., color], observations.usable[..., color], cosines, gains=False).slopes for color in range(3)]
    ).float()
    distance = observations.distance
    logs = observations.logs[..., _GREEN] - observations.light(parameters, distance) - log_gains
    lamps = find_lamps(scene.train, logs, observations.usable[..., _GREEN], observations.sights, distance)
    return LightFit(log_gains.float(), parameters[:3].float(), slopes[:, 0], slopes[:, 1], float(parameters[5]), lamps)


def _observe(scene: Scene, points: Float[Tensor, "P 3"], normals: Float[Tensor, "P 3"]) -> _Observations:
    """Points with normals of either sign in the training frames."""
    views = [_seen(frame, points) for frame in scene.train]
    logs, usable, same, hidden = (torch.stack(maps, dim=1) for maps in zip(*views, strict=True))
    cameras = [frame.camera.to("cpu", torch.float64) for frame in scene.train]
    centers = torch.stack([camera.center for camera in cameras])
    towards = torch.einsum("pfc,pc->pf", centers - points[:, None], normals)
    normals = normals * torch.where((towards * same).sum(1) < 0.0, -1.0, 1.0)[:, None]
    axes = torch.stack([camera.camera_to_world[:3, :3] for camera in cameras])
    sights = torch.einsum("pfc,fcd->pfd", points[:, None] - centers, axes)
    return _Observations(
        logs,
        usable & (usable.sum(1, keepdim=True) > 1),
        sights,
        torch.einsum("pc,fcd->pfd", normals, axes),
        ~hidden,
        Cavity.of(points, normals),
    )


def _seen(
    frame: Frame, points: Float[Tensor, "P 3"]
) -> tuple[Float[Tensor, "P 3"], Bool[Tensor, "P 3"], Bool[Tensor, "P"], Bool[Tensor, "P"]]:
    """Log colours of the points in one frame, and masks: usable, visible, and occluded according to the depth map."""
    assert frame.depth is not None
    camera = frame.camera.to("cpu", torch.float64)
    pixels, depths = camera.project(points)
    limits = torch.tensor([camera.width - 1, camera.height - 1])
    column, row = pixels.nan_to_num(0.0).clamp(torch.zeros(2), limits).long().unbind(1)
    valid = frame.valid.cpu()
    blurred = _mean_of_neighbours(zero_outside(frame.rgb.cpu(), valid))
    whole = _mean_of_neighbours(valid[..., None].float())[..., 0] > _ALL
    colors = blurred[row, column].double()
    depth = torch.where(valid, frame.depth.cpu(), math.nan)
    whole &= ~depth_steps(depth, depth.isfinite(), _TWO_SURFACES)
    stored_depths = depth[row, column]
    has_depth = camera.is_inside(pixels, depths) & stored_depths.isfinite()
    same = has_depth & ((stored_depths - depths).abs() < _SAME_SURFACE * depths)
    usable = (same & whole[row, column])[:, None] & (colors > _DARKEST) & (colors < _BRIGHTEST)
    return colors.clamp_min(1e-3).log(), usable, same, has_depth & ~same


def _mean_of_neighbours(image: Float[Tensor, "H W C"]) -> Float[Tensor, "H W C"]:
    """Mean over 3x3 pixels, over those that there are at the border."""
    planes = image.permute(2, 0, 1)[None]
    return torch.nn.functional.avg_pool2d(planes, 3, 1, 1, count_include_pad=False)[0].permute(1, 2, 0)


def _lamp(obs: _Observations) -> tuple[Float[Tensor, "6"], Float[Tensor, "F"]]:
    """Fitted parameters (lamp offset, exponents, albedo) and log gains; the offset is 0 unless it lowers residuals."""
    usable = obs.usable[..., _GREEN]
    if not usable.any():
        return obs.logs.new_tensor([0.0, 0.0, 0.0, *_START]), obs.logs.new_zeros(obs.logs.shape[1])
    scale = obs.distance
    at_lens, fit = _descend(obs, scale, obs.logs.new_tensor([0.0, 0.0, 0.0, *_START]), range(3, 6))
    beside, better = _descend(obs, scale, at_lens, range(6))
    if better.deviation < _MAX_RESIDUAL_RATIO * fit.deviation:
        return beside, better.log_gains
    return at_lens, fit.log_gains


def _descend(obs: _Observations, scale: float, at: Float[Tensor, "6"], free: range) -> tuple[Float[Tensor, "6"], _Fit]:
    """Gauss-Newton steps of some of offset, exponents and albedo on green, and the last fit."""
    logs, usable = obs.logs[..., _GREEN], obs.usable[..., _GREEN]

    def limits(of_offset: float, of_others: float) -> Float[Tensor, "6"]:
        return logs.new_tensor([of_offset * scale] * 3 + [of_others] * 3)

    def light(parameters: Float[Tensor, "6"]) -> Float[Tensor, "P F"]:
        return torch.where(usable, obs.light(parameters, scale), 0.0)

    differences, largest = limits(_DIFFERENCE, _SMALL_CHANGE), limits(_LARGEST_STEP, _LARGEST_CHANGE)
    enough = limits(_CONVERGED, _CHANGE_CONVERGED)
    low, high = limits(-_LARGEST_OFFSET, -math.inf), limits(_LARGEST_OFFSET, math.inf)
    low[5], high[5] = 0.0, _LARGEST_ALBEDO
    here = light(at)
    for _ in range(_ITERATIONS):
        moved = [at + torch.eye(6, dtype=at.dtype)[index] * differences[index] for index in free]
        slopes = [(light(shifted) - here) / differences[index] for shifted, index in zip(moved, free, strict=True)]
        step = torch.zeros_like(at)
        step[list(free)] = _fit(logs - here, usable, torch.stack(slopes, dim=-1)).slopes
        step = step.clamp(-largest, largest)
        at = (at + step).clamp(low, high)
        here = light(at)
        if (step.abs() < enough).all():
            break
    return at, _fit(logs - here, usable, logs.new_zeros(*logs.shape, 0))


class _Fit(NamedTuple):
    """Gains with a mean of 0 [F], coefficients of features [K], and the residuals' robust standard deviation."""

    log_gains: Float[Tensor, "F"]
    slopes: Float[Tensor, "K"]
    deviation: float


def _fit(
    logs: Float[Tensor, "P F"], usable: Bool[Tensor, "P F"], features: Float[Tensor, "P F K"], gains: bool = True
) -> _Fit:
    """Fit log = point + gain of the frame + slopes times features; without ``gains``, they are 0."""
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
        fitted = slice(0 if gains else frames, None)
        # The smallest solution: what no observation determines stays at 0.
        solution[fitted] = torch.linalg.lstsq(
            matrix[fitted, fitted], right[fitted, None], rcond=1e-10, driver="gelsd"
        ).solution[:, 0]
        shifts = solution[:frames] - (weights * solution[:frames]).sum(1, keepdim=True) / sums
        residuals = y - x @ solution[frames:] - shifts
        if usable.any():
            deviation = 1.4826 * float(residuals[usable].abs().median().clamp_min(1e-6))
            weights = usable / (1.0 + (residuals / (_HALF_WEIGHT * deviation)).square())
    return _Fit(solution[:frames] - solution[:frames].mean(), solution[frames:], deviation)
