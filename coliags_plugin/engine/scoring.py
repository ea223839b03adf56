"""Scores of held-out views under a protocol, error profiles of a test set, and views from refined poses."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional

from coliags_plugin.contracts import Comparison, Metric, Protocol
from coliags_plugin.core import registry
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.components import named_component
from coliags_plugin.core.errors import InputError, UnavailableError
from coliags_plugin.core.render_output import BLANK_ALPHA, OPAQUE_ALPHA, RenderOutput
from coliags_plugin.core.scenes import Frame
from coliags_plugin.core.tensors import masked_mean
from coliags_plugin.datamanagers.shots import fitted
from coliags_plugin.engine.model import Model
from coliags_plugin.results.hashing import ArraysHash
from coliags_plugin.results.record import REFINED_METRICS, REFINED_SUFFIXES, SEEN_SUFFIX, ProfileRecord, SetRecord


@dataclass(frozen=True)
class Scores:
    """Scores of one view by name, and the reasons why others cannot be had."""

    values: dict[str, float] = field(default_factory=dict)
    reasons: dict[str, str] = field(default_factory=dict)


#: Metrics that are also computed over pixels seen by a training frame, where frames have a seen mask.
SEEN_METRICS = ("psnr", "psnr_gain_fitted", "ssim", "depth_mse", "depth_median_error")


class Scorer:
    """Renders held-out views and scores them under the protocol of a name, by all its metrics or only some."""

    def __init__(self, protocol: str, only: Sequence[str] | None = None) -> None:
        self.protocol: Protocol = registry.protocols.get(protocol)()
        if self.protocol.name != protocol:
            raise InputError(
                f"protocol '{protocol}' from {registry.protocols.source(protocol)} has the name '{self.protocol.name}'",
                "the name that it is registered under",
            )
        self.wants = tuple(sorted({"rgb", "alpha"} | self.protocol.wants))
        self.metrics = self._made(self.protocol.metrics, only)
        self.optional_metrics = self._made(self.protocol.optional_metrics, only)

    def _made(
        self, table: Mapping[str, tuple[str, Mapping[str, Any]]], only: Sequence[str] | None
    ) -> dict[str, Metric]:
        metrics = {}
        for key, (name, options) in table.items():
            if only is None or key in only:
                asking = f"protocol '{self.protocol.name}', metric '{key}'"
                component = named_component("metrics", {"name": name, **options}, asking)
                metrics[key] = component.target(component.settings)
        return metrics

    @torch.no_grad()
    def render(self, model: Model, frame: Frame) -> RenderOutput:
        """Render a held-out frame, which is on the model's device.

        The outputs are those that the protocol compares and, if the renderer has it, accumulated depth for pictures.
        """
        wants = sorted({*self.wants} | ({"depth_accumulated"} & model.outputs))
        return model.render(frame.camera, wants, frame.view(trained=False))

    def compare(self, model: Model, frame: Frame, device: torch.device) -> Comparison:
        """Render a held-out frame for comparison with its ground truth."""
        placed = frame.to(device)
        return self.protocol.compare(self.render(model, placed), placed)

    def score(self, comparison: Comparison, names: Sequence[str] | None = None) -> Scores:
        """Every metric of a view, or those named among them."""
        scores = Scores()
        for name, metric in (self.metrics | self.optional_metrics).items():
            if names is not None and name not in names:
                continue
            try:
                value = metric(comparison)
            except UnavailableError as error:
                scores.reasons[name] = str(error)
                continue
            if math.isfinite(value):
                scores.values[name] = value
            else:
                scores.reasons[name] = f"the metric is {value}"
        return scores

    def refined(self, model: Model, frame: Frame) -> tuple[Comparison, Comparison]:
        """A frame, on the model's device, from its refined pose, as it is rendered, and with its colours fitted."""
        moved = replace(frame, camera=refined_camera(model, frame))
        view = self.compare(model, moved, frame.image.device)
        factors = color_factors(view.rgb, view.true_rgb, view.valid)
        return view, replace(view, rgb=(view.rgb * factors).clamp(0.0, 1.0))

    @property
    def further_metrics(self) -> dict[str, Metric]:
        """Metrics that only some frames have: optional ones, those over seen pixels, and those from refined poses."""
        metrics = self.metrics | self.optional_metrics
        named = {name + SEEN_SUFFIX: name for name in SEEN_METRICS}
        named |= {name + suffix: name for suffix, name in product(REFINED_SUFFIXES, REFINED_METRICS)}
        return self.optional_metrics | {name: metrics[base] for name, base in named.items() if base in metrics}


class EvaluatedSet:
    """Scores, error profiles and hashes of one test set of a scene, whose unit of length is printed as ``unit``.

    ``scale`` is that of lengths in training.
    """

    def __init__(self, unit: str, scorer: Scorer, scale: float = 1.0) -> None:
        self._scorer = scorer
        self._rows: dict[str, dict[str, float]] = {}
        self._reasons: dict[str, str] = {}
        self._predictions, self._truth = ArraysHash(), ArraysHash()
        self._profiles = ErrorProfiles(unit, scale)
        self._pixels = self._transparent = self._blank = 0

    def add(self, frame: Frame, comparison: Comparison, alpha: Float[Tensor, "H W"], *refined: Comparison) -> None:
        """Score a frame under its protocol and take it up, with its rendered alpha, and views from a refined pose."""
        self._pixels += int(frame.valid.sum())
        self._transparent += int(((alpha < OPAQUE_ALPHA) & frame.valid).sum())
        self._blank += shows_nothing(alpha, frame)
        self._add_scores(frame.name, self._scorer.score(comparison))
        if frame.seen is not None:
            self._add_scores(frame.name, self._scorer.score(within_seen(comparison, frame), SEEN_METRICS), SEEN_SUFFIX)
        for suffix, view in zip(REFINED_SUFFIXES, refined, strict=False):
            self._add_scores(frame.name, self._scorer.score(view, REFINED_METRICS), suffix)
        _hash(self._predictions, frame.name, rgb=comparison.rgb, depth=comparison.depth)
        _hash(
            self._truth,
            frame.name,
            rgb=comparison.true_rgb,
            valid=comparison.valid,
            depth=comparison.true_depth,
            depth_valid=comparison.depth_valid,
            seen=frame.seen,
        )
        self._profiles.add(comparison, frame)

    def _add_scores(self, frame: str, scores: Scores, suffix: str = "") -> None:
        """Take up scores of a frame, under names with a suffix."""
        row = self._rows.setdefault(frame, {})
        row.update({name + suffix: value for name, value in scores.values.items()})
        for name, reason in scores.reasons.items():
            self._reasons.setdefault(name + suffix, reason)

    @property
    def scored(self) -> set[str]:
        """Names of the metrics that some frame has."""
        return {name for row in self._rows.values() for name in row}

    def record(self) -> SetRecord:
        """The set's record; the protocol's metrics are listed even where no frame has one."""
        rows, scored = self._rows.values(), self.scored
        names = [*self._scorer.metrics, *(name for name in self._scorer.further_metrics if name in scored)]
        lacking = self._scorer.optional_metrics.keys() - scored
        return SetRecord(
            frames=tuple(self._rows),
            values={name: tuple(row.get(name) for row in rows) for name in names},
            reasons={name: reason for name, reason in self._reasons.items() if name not in lacking},
            predictions_sha256=self._predictions.hexdigest(),
            truth_sha256=self._truth.hexdigest(),
            profiles=self._profiles.records(),
            transparent=self._transparent / self._pixels if self._pixels else None,
            blank=self._blank,
        )


def shows_nothing(alpha: Float[Tensor, "H W"], frame: Frame) -> bool:
    """Return True if a view is blank: its mean alpha within the frame's mask is below :data:`BLANK_ALPHA`."""
    return bool(frame.valid.any() and alpha[frame.valid].mean() < BLANK_ALPHA)


def _hash(target: ArraysHash, frame: str, **parts: Tensor | None) -> None:
    for name, values in parts.items():
        if values is not None:
            target.add(frame, name, values.detach().cpu().numpy())


def within_seen(comparison: Comparison, frame: Frame) -> Comparison:
    """A comparison restricted to pixels that a training frame sees, where the frame has a seen mask."""
    if frame.seen is None:
        return comparison
    mask = frame.seen.to(comparison.valid.device)
    depth_valid = None if comparison.depth_valid is None else comparison.depth_valid & mask
    return replace(comparison, valid=comparison.valid & mask, depth_valid=depth_valid)


#: Adam steps on each view; the first and last of their lengths, in pixels of the image that is rendered in them.
STEPS, FIRST_STEP, LAST_STEP = 40, 0.5, 0.05
#: Size that this image is within, pixels.
_WITHIN = (192, 192)


def refined_camera(model: Model, frame: Frame) -> Camera:
    """The camera of a held-out frame at the pose that fits its image best, found by gradients through a frozen model.

    Adam on the mean absolute difference over the valid pixels of a reduced image, from the frame's pose, after each
    colour was multiplied by its best factor, so that a wrong exposure moves no pose; view modules act as they do on the
    frame. The camera turns about the median rendered depth on its axis. The pose of least difference along the way is
    returned; that given where nothing opaque is in view.

    Args:
        model: On the frame's device.
        frame: Held out.
    """
    camera = frame.camera.resized(*fitted(frame.camera.width, frame.camera.height, _WITHIN))
    view = frame.view(trained=False)
    image, valid = _area_mean(frame.rgb, camera), _area_mean(frame.valid[..., None].float(), camera)[..., 0] == 1.0
    with torch.no_grad():
        output = model.render(camera, ("rgb", "alpha", "depth_expected"), view)
    opaque = output.alpha >= OPAQUE_ALPHA
    if not opaque.any():
        return frame.camera
    depth = float(output["depth_expected"][opaque].median())
    pixel = 1.0 / (camera.fx * camera.fy) ** 0.5  # radians, and in depths
    motion = torch.zeros(6, device=image.device, requires_grad=True)  # rotation and translation, pixels
    optimizer = torch.optim.Adam([motion], lr=FIRST_STEP)
    decay = torch.optim.lr_scheduler.ExponentialLR(optimizer, (LAST_STEP / FIRST_STEP) ** (1.0 / STEPS))
    least, best = torch.inf, motion.detach()
    with _frozen(model):
        for _ in range(STEPS):
            turn, shift = pixel * motion[:3], pixel * depth * motion[3:]
            rgb = model.render(camera.moved(turn, shift, depth), ("rgb", "alpha"), view).rgb
            error = masked_mean((rgb * color_factors(rgb, image, valid) - image).abs(), valid)
            if error.item() < least:
                least, best = error.item(), motion.detach().clone()
            optimizer.zero_grad()
            torch.autograd.backward(error)
            optimizer.step()
            decay.step()
    return frame.camera.moved(pixel * best[:3], pixel * depth * best[3:], depth)


@contextmanager
def _frozen(model: nn.Module) -> Iterator[None]:
    """Without gradients of the parameters."""
    learned = [parameter for parameter in model.parameters() if parameter.requires_grad]
    for parameter in learned:
        parameter.requires_grad_(False)
    try:
        yield
    finally:
        for parameter in learned:
            parameter.requires_grad_(True)


def _area_mean(values: Float[Tensor, "H W C"], camera: Camera) -> Float[Tensor, "h w C"]:
    """An image at the size of a camera."""
    small = functional.interpolate(values.permute(2, 0, 1)[None], (camera.height, camera.width), mode="area")
    return small[0].permute(1, 2, 0)


@torch.no_grad()
def color_factors(
    rgb: Float[Tensor, "H W 3"], true: Float[Tensor, "H W 3"], valid: Bool[Tensor, "H W"]
) -> Float[Tensor, "3"]:
    """The factor on each colour of least squared difference over the valid pixels."""
    rendered = rgb[valid]
    return (rendered * true[valid]).sum(0) / rendered.square().sum(0).clamp_min(1e-12)


#: Distance from the camera's centre along the pixel's ray, scene units (mm).
DISTANCE_EDGES = (0.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0, 60.0, 80.0, 100.0, 150.0, 200.0, 300.0)
#: Angle of the pixel's ray to the optical axis, degrees.
ANGLE_EDGES = tuple(float(angle) for angle in range(0, 95, 5))


class ErrorProfiles:
    """Sums of squared errors over the pixels of many frames whose true depth is known, in bins with fixed edges.

    A pixel counts if the frame's own true depth is finite and the protocol compares both its colour and its depth. Its
    distance is that of the true surface, in ``unit``; pixels beyond the last edge are left out. Edges times ``scale``
    are :data:`DISTANCE_EDGES`.
    """

    def __init__(self, unit: str, scale: float) -> None:
        distances = tuple(edge / scale for edge in DISTANCE_EDGES)
        self._edges = {"distance": (unit, distances), "angle": ("degrees", ANGLE_EDGES)}
        #: Number of pixels, and sums of squared colour and depth errors, in each bin.
        self._sums = {name: np.zeros((3, len(edges) - 1)) for name, (_, edges) in self._edges.items()}
        self._frames = 0

    def add(self, comparison: Comparison, frame: Frame) -> None:
        """Add the pixels of a frame; none where it has no true depth. A bin holds its lower edge."""
        if frame.depth is None or comparison.depth is None or comparison.true_depth is None:
            return
        depth, compared = _float64(frame.depth), comparison.valid
        if comparison.depth_valid is not None:
            compared = compared & comparison.depth_valid
        counts = np.isfinite(depth) & compared.cpu().numpy()
        tangents = _tangents(frame.camera)
        rgb = np.square(_float64(comparison.rgb) - _float64(comparison.true_rgb)).mean(axis=-1)
        z = np.square(_float64(comparison.depth) - _float64(comparison.true_depth))
        places = {"distance": depth * np.hypot(1.0, tangents), "angle": np.degrees(np.arctan(tangents))}
        for name, place in places.items():
            _, edges = self._edges[name]
            bins = np.searchsorted(edges, place[counts], side="right") - 1
            inside = (bins >= 0) & (bins < len(edges) - 1)
            weights = (values[counts][inside] for values in (np.ones_like(rgb), rgb, z))
            self._sums[name] += [np.bincount(bins[inside], values, len(edges) - 1) for values in weights]
        self._frames += 1

    def records(self) -> dict[str, ProfileRecord]:
        """Profiles over distance and angle; empty where no frame had true depth."""
        records = {}
        for name, (unit, edges) in self._edges.items() if self._frames else ():
            counts, *sums = self._sums[name]
            with np.errstate(divide="ignore", invalid="ignore"):
                means = (np.array(sums) / counts).tolist()
            rgb, depth = (tuple(mean if math.isfinite(mean) else None for mean in row) for row in means)
            pixels = tuple(map(int, counts))
            records[name] = ProfileRecord(unit=unit, edges=edges, pixels=pixels, rgb_mse=rgb, depth_mse=depth)
        return records


def _tangents(camera: Camera) -> Float[np.ndarray, "H W"]:
    """Tangent of the angle between each pixel's ray and the optical axis. [H, W]"""
    rays = Camera.of(camera.intrinsics, torch.eye(4, dtype=torch.float64)).rays()
    return np.linalg.norm(rays[..., :2].numpy(), axis=-1)


def _float64(values: Tensor) -> Float[np.ndarray, "..."]:
    return values.detach().cpu().double().numpy()
