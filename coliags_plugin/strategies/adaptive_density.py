"""Adaptive density control: cloning, splitting and pruning explicit Gaussians, as in 3D Gaussian Splatting."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import torch
from pydantic import Field
from torch import Tensor, nn

from coliags_plugin.contracts import ParameterRows, Schedule, Strategy, TrainingStep, steps_text
from coliags_plugin.core.gaussians import rotation_matrices
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.core.settings import Settings

#: A split Gaussian's scales are divided by 0.8 times the number of its parts.
_SPLIT_PARTS = 2
_SPLIT_SHRINK = 0.8 * _SPLIT_PARTS
#: Steps that opacities need after a reset: from 0.01 to 0.5 it is 184 at 3DGS's rate of 0.025. Runs whose length scales
#: the interval below that have no resets.
_RECOVERY = 200


class AdaptiveDensitySettings(Settings):
    """Options of adaptive density control; the defaults are 3DGS's (docs/methods.md 7.2). Steps scale with the run."""

    densify_from: int = Field(default=500, ge=0)  # step after which events clone, split and prune
    until: int = Field(default=15_000, ge=0)  # step before which the last event is
    every: int = Field(default=100, ge=1)  # steps between events
    gradient_threshold: float = Field(default=0.0002, gt=0)  # of the centres' gradient, normalised image units
    dense_share: float = Field(default=0.01, gt=0)  # of the extent: larger Gaussians are split, smaller ones cloned
    min_opacity: float = Field(default=0.005, ge=0)  # of a Gaussian that stays
    reset_every: int = Field(default=3000, ge=1)  # steps between resets of the opacities, of long enough runs
    reset_opacity: float = Field(default=0.01, gt=0, lt=1)  # the most that a reset leaves
    max_radius: float | None = Field(default=20.0, gt=0)  # pixels; larger ones go after the first reset
    max_scale_share: float | None = Field(default=0.1, gt=0)  # of the extent; likewise
    # of a split Gaussian's smallest deviation, in which its parts are spread along that axis
    split_normal_share: float = Field(default=1.0, ge=0)
    prune_above: int = Field(default=0, ge=0)  # an event prunes only where more Gaussians than this would stay


class AdaptiveDensity(Strategy[AdaptiveDensitySettings]):
    """Clones small and splits large Gaussians whose image gradients stay large; prunes faint and oversized ones.

    The field is an ``ExplicitField``, or one with its means, scales, quaternions and opacities.
    """

    serves: ClassVar[frozenset[str] | None] = frozenset({"gaussians"})
    counters: ClassVar[tuple[str, ...]] = ("gradient_sum", "drawn", "largest_radius")

    def __init__(
        self, settings: AdaptiveDensitySettings, generator: torch.Generator, schedule: Schedule, extent: float
    ) -> None:
        super().__init__(settings, generator, schedule, extent)
        self.until = schedule.at(settings.until)
        self.every, reset_every = schedule.interval(settings.every), schedule.interval(settings.reset_every)
        recovers = reset_every >= min(settings.reset_every, _RECOVERY)
        self.resets = range(reset_every, self.until if recovers else 0, reset_every)
        self.events = schedule.events(settings.densify_from, settings.until, settings.every)
        self.gradient_sum = torch.zeros(0)  # [N]
        self.drawn = torch.zeros(0)  # [N]
        self.largest_radius = torch.zeros(0)  # [N]

    def plan(self) -> str:
        """Steps at which this run densifies and resets opacities, for the log."""
        every, events, resets = self.every, self.events, self.resets
        if len(events) == 0:
            return (
                f"this run neither densifies nor prunes: its {self.schedule.steps} steps leave no multiple of {every} "
                f"between steps {self.schedule.at(self.settings.densify_from)} and {self.until}"
            )
        return f"this run clones, splits and prunes {steps_text(events)}, and resets opacities {steps_text(resets)}"

    @torch.no_grad()
    def after_backward(self, step: TrainingStep, rows: ParameterRows) -> dict[str, int]:
        """Accumulate statistics; at event steps densify, prune, and reset opacities."""
        if step.step >= self.until:
            return {}
        field: Any = step.model.field
        if len(self.drawn) != len(field.means):
            self._forget(field.means)
        self._count(step.output)
        changes = {}
        if step.step in self.events:
            grown = self._densify(field, rows)
            changes = {"grown": grown, "pruned": self._prune(field, rows, step.step)}
            self._forget(field.means)
        if step.step in self.resets:
            highest = math.log(self.settings.reset_opacity / (1.0 - self.settings.reset_opacity))
            rows.replace_values("opacities", field.opacities.clamp_max(highest))
        return changes

    def _forget(self, like: Tensor) -> None:
        self.load_state_dict({name: like.new_zeros(len(like)) for name in self.counters})

    def _count(self, output: RenderOutput) -> None:
        splats, lengths = output.drawn, output.gradient_lengths
        if lengths is None:
            return
        slots = splats.gaussians.source_index
        self.gradient_sum.index_add_(0, slots, lengths)
        self.drawn.index_add_(0, slots, (splats.radii > 0).to(self.drawn.dtype))
        self.largest_radius[slots] = torch.maximum(self.largest_radius[slots], splats.radii)

    def _densify(self, field: Any, rows: ParameterRows) -> int:
        """Clone and split Gaussians; returns the increase in their number."""
        before = len(field.means)
        is_steep = self.gradient_sum / self.drawn.clamp_min(1.0) >= self.settings.gradient_threshold
        large = field.scales.amax(dim=1).exp() > self.settings.dense_share * self.extent
        clones, splits = (is_steep & ~large).nonzero().squeeze(1), (is_steep & large).nonzero().squeeze(1)
        parents = torch.cat([clones, splits.repeat(_SPLIT_PARTS)])
        if len(parents) == 0:
            return 0
        born = {name: getattr(field, name)[parents] for name in field.row_parameters}
        parts = slice(len(clones), None)
        born["means"][parts] += self._shifts(born["scales"][parts], born["quats"][parts])
        born["scales"][parts] -= math.log(_SPLIT_SHRINK)
        rows.add_rows(born)
        field.rows_added(born["means"], parents)
        self._extend(len(parents))
        keep = torch.ones(len(field.means), dtype=torch.bool, device=field.means.device)
        keep[splits] = False
        self._keep(field, rows, keep)
        return len(field.means) - before

    def _shifts(self, scales: Tensor, quats: Tensor) -> Tensor:
        """Random offsets sampled from Gaussians, relative to their means; surfels' lie in their planes."""
        points = torch.randn(len(scales), 3, generator=self.generator).to(scales)
        deviations = scales.exp()
        if scales.shape[1] == 3 and self.settings.split_normal_share != 1.0:
            smallest = deviations.argmin(1, keepdim=True)
            deviations.scatter_(1, smallest, deviations.gather(1, smallest) * self.settings.split_normal_share)
        axes = rotation_matrices(nn.functional.normalize(quats, dim=1))[:, :, : scales.shape[1]]
        return (axes @ (points[:, : scales.shape[1]] * deviations)[..., None]).squeeze(-1)

    def _prune(self, field: Any, rows: ParameterRows, step: int) -> int:
        """Remove transparent and, after the first reset, oversized Gaussians; returns their number."""
        options = self.settings
        gone = field.opacities.sigmoid() < options.min_opacity
        if self.resets and step > self.resets[0]:
            if options.max_radius is not None:
                gone |= self.largest_radius > options.max_radius
            if options.max_scale_share is not None:
                gone |= field.scales.amax(dim=1).exp() > options.max_scale_share * self.extent
        if int((~gone).sum()) <= options.prune_above:
            return 0  # at 0 too: an empty field could not recover
        self._keep(field, rows, ~gone)
        return int(gone.sum())

    def _extend(self, count: int) -> None:
        self.load_state_dict(
            {name: torch.cat([value, value.new_zeros(count)]) for name, value in self.state_dict().items()}
        )

    def _keep(self, field: Any, rows: ParameterRows, keep: Tensor) -> None:
        if keep.all():
            return
        self.load_state_dict({name: value[keep] for name, value in self.state_dict().items()})
        rows.keep_rows(field.row_parameters, keep)
        field.rows_kept(keep)
