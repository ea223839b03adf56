"""Densification: growing, splitting and pruning between optimiser steps."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Int
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


def _idle_text(what: str, schedule: Schedule, every: int, first: int, until: int) -> str:
    """Plan of a run without an event between steps ``first`` and ``until``; ``what`` says what it does not do."""
    return f"this run {what}: its {schedule.steps} steps leave no multiple of {every} between steps {first} and {until}"


class NoStrategy(Strategy):
    """Strategy that neither grows nor prunes."""

    serves: ClassVar[frozenset[str] | None] = None

    def plan(self) -> str:
        """The sentence for the log: no growing, no pruning."""
        return "this run neither grows nor prunes: strategy none"


class AdaptiveDensitySettings(Settings):
    """Options of adaptive density control; the defaults are 3DGS's (docs/methods.md 7.2). Steps scale with the run."""

    densify_from: int = Field(default=500, ge=0)  # step after which events clone, split and prune
    until: int = Field(default=15_000, ge=0)  # step before which the last event is
    every: int = Field(default=100, ge=1)  # steps between events
    # least gradient of a centre that is densified, normalised image units
    gradient_threshold: float = Field(default=0.0002, gt=0)
    # share of the extent: larger Gaussians are split, smaller ones cloned
    dense_share: float = Field(default=0.01, gt=0)
    min_opacity: float = Field(default=0.005, ge=0)  # least opacity of a Gaussian that stays
    reset_every: int = Field(default=3000, ge=1)  # steps between resets of the opacities, of long enough runs
    reset_opacity: float = Field(default=0.01, gt=0, lt=1)  # the most that a reset leaves
    max_radius: float | None = Field(default=20.0, gt=0)  # pixels; larger ones go after the first reset
    # largest scale of a Gaussian that stays, as a share of the extent
    max_scale_share: float | None = Field(default=0.1, gt=0)
    # share of a split Gaussian's smallest deviation by which its parts are spread along that axis
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
            first = self.schedule.at(self.settings.densify_from)
            return _idle_text("neither densifies nor prunes", self.schedule, every, first, self.until)
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
        self.load_state_dict({name: _extended(value, len(parents)) for name, value in self.state_dict().items()})
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

    def _keep(self, field: Any, rows: ParameterRows, keep: Tensor) -> None:
        if keep.all():
            return
        self.load_state_dict({name: value[keep] for name, value in self.state_dict().items()})
        rows.keep_rows(field.row_parameters, keep)
        field.rows_kept(keep)


class AnchorGrowthSettings(Settings):
    """Options of anchor growth (docs/methods.md 4.3 lists Scaffold-GS's values). Steps scale with the run."""

    statistics_from: int = Field(default=500, ge=0)  # step after which gradients and opacities are summed up
    growth_from: int = Field(default=1500, ge=0)  # step after which events grow and prune
    until: int = Field(default=15_000, ge=0)  # step before which the last event is
    every: int = Field(default=100, ge=1)  # steps between events
    # least gradient of a centre that is densified, normalised image units
    gradient_threshold: float = Field(default=0.0002, gt=0)
    # share of ``every`` steps with an anchor in view for pruning, half of it for growing (docs/methods.md 4.3)
    success_share: float = Field(default=0.8, gt=0, le=1)
    min_opacity: float = Field(default=0.005, ge=0)  # least sum of the children's opacities of an anchor that stays
    levels: int = Field(default=3, ge=1)  # sizes of cells: the anchors' spacing, then a quarter of the one before
    finest_cell: float = Field(default=0.25, ge=0)  # edge of the finest cells, in voxels; finer levels are left out
    pixels_per_birth: int = Field(default=500, ge=1)  # pixels of a view for each birth of an event, strongest first
    max_scale: float | None = Field(default=4.0, gt=0)  # cap on base scales at every event, times the spacing


class AnchorGrowth(Strategy[AnchorGrowthSettings]):
    """Adds anchors where children's image gradients stay large and removes anchors that stay transparent.

    Statistics and thresholds are Scaffold-GS's; the grid cells, the initialisation of new anchors and the limit per
    event are this package's, because the published ones rely on cells finer than the spacing of the initial points
    (docs/methods.md 4.3). Only anchors visible in the view are counted, as in Scaffold-GS. The field is an
    ``AnchorField``, or one with its anchors, offsets, features, scalings, spacing, voxel size and child positions.
    """

    serves: ClassVar[frozenset[str] | None] = frozenset({"anchors"})
    counters: ClassVar[tuple[str, ...]] = ("opacity_sum", "seen", "gradient_sum", "drawn")

    def __init__(
        self, settings: AnchorGrowthSettings, generator: torch.Generator, schedule: Schedule, extent: float
    ) -> None:
        super().__init__(settings, generator, schedule, extent)
        self.statistics_from = schedule.at(settings.statistics_from)
        self.until = schedule.at(settings.until)
        self.every = schedule.interval(settings.every)
        self.events = schedule.events(settings.growth_from, settings.until, settings.every)
        self.opacity_sum = torch.zeros(0)  # [M]
        self.seen = torch.zeros(0)  # [M]
        self.gradient_sum = torch.zeros(0)  # [M * K]
        self.drawn = torch.zeros(0)  # [M * K]

    def plan(self) -> str:
        """Steps at which this run grows and prunes, for the log."""
        every, events = self.every, self.events
        if len(events) == 0:
            first = self.schedule.at(self.settings.growth_from)
            return _idle_text("neither grows nor prunes anchors", self.schedule, every, first, self.until)
        return f"this run grows and prunes anchors {steps_text(events)}"

    @torch.no_grad()
    def after_backward(self, step: TrainingStep, rows: ParameterRows) -> dict[str, int]:
        """Accumulate statistics; at event steps grow and prune."""
        if not self.statistics_from < step.step < self.until:
            return {}
        field: Any = step.model.field
        children = field.offsets.shape[1]
        self._resize(len(field.anchors), children, field.anchors.device)
        self._count(step.output, children)
        if step.step not in self.events:
            return {}
        most_births = max(1, step.output.alpha.numel() // self.settings.pixels_per_birth)
        grown = self._grow(field, rows, children, most_births)
        pruned = self._prune(field, rows, children)
        return {"grown": grown, "pruned": pruned}

    def _resize(self, anchors: int, children: int, device: torch.device) -> None:
        """Extend the counters to new anchors."""
        for name, per_anchor in zip(self.counters, (1, 1, children, children), strict=True):
            values = getattr(self, name).to(device)
            setattr(self, name, _extended(values, anchors * per_anchor - len(values)))

    def _count(self, output: RenderOutput, children: int) -> None:
        gaussians, lengths = output.drawn.gaussians, output.gradient_lengths
        self.seen[gaussians.visible_sources] += 1
        self.opacity_sum.index_add_(0, gaussians.source_index // children, gaussians.opacities)
        if lengths is None:
            return
        self.gradient_sum.index_add_(0, gaussians.source_index, lengths)
        self.drawn.index_add_(0, gaussians.source_index, (output.drawn.radii > 0).to(self.drawn.dtype))

    def _grow(self, field: Any, rows: ParameterRows, children: int, most_births: int) -> int:
        options = self.settings
        ready = self.drawn > self.every * options.success_share * 0.5
        gradient = self.gradient_sum / self.drawn.clamp_min(1.0)
        positions = field.child_positions().reshape(-1, 3)
        first_count = len(field.anchors)
        for level in range(options.levels):
            cell = float(field.spacing) / 4**level
            births = most_births - (len(field.anchors) - first_count)
            if births == 0 or cell < options.finest_cell * float(field.voxel_size):
                break
            slots = (ready & (gradient >= options.gradient_threshold * 2.0**level)).nonzero().squeeze(1)
            chosen = slots[one_per_free_cell(field.anchors, positions[slots], gradient[slots], cell, births)]
            if len(chosen):
                self._add(field, rows, positions[chosen], chosen // children, cell)
        self.gradient_sum[ready] = 0.0
        self.drawn[ready] = 0.0
        self._resize(len(field.anchors), children, field.anchors.device)
        return len(field.anchors) - first_count

    def _add(self, field: Any, rows: ParameterRows, positions: Tensor, parents: Tensor, cell: float) -> None:
        """Append anchors with their parents' features, normals and Adam second moments, at most the size of a cell."""
        born = {
            "offsets": field.offsets.new_zeros(len(parents), *field.offsets.shape[1:]),
            "features": field.features[parents],
            "scalings": field.scalings[parents].clamp_max(math.log(cell)),
        }
        rows.add_rows(born, parents)
        field.rows_added(positions, parents)

    def _prune(self, field: Any, rows: ParameterRows, children: int) -> int:
        options = self.settings
        if options.max_scale is not None:
            field.scalings[:, 3:].clamp_(max=math.log(options.max_scale * float(field.spacing)))
        judged = self.seen > self.every * options.success_share
        faint = judged & (self.opacity_sum < options.min_opacity * self.seen)
        self.opacity_sum[judged] = 0.0
        self.seen[judged] = 0.0
        keep = ~faint
        if not keep.any() or keep.all():
            return 0  # an empty field could not recover
        keep_children = keep.repeat_interleave(children)
        self.opacity_sum, self.seen = self.opacity_sum[keep], self.seen[keep]
        self.gradient_sum, self.drawn = self.gradient_sum[keep_children], self.drawn[keep_children]
        rows.keep_rows(field.row_parameters, keep)
        field.rows_kept(keep)
        return int(faint.sum())


def one_per_free_cell(
    anchors: Float[Tensor, "M 3"],
    positions: Float[Tensor, "C 3"],
    gradients: Float[Tensor, "C"],
    cell: float,
    limit: int,
) -> Int[Tensor, "B"]:
    """Indices of the candidate of the largest gradient in each cell without an anchor, the strongest cells first.

    Args:
        anchors: Existing anchors, scene units.
        positions: Candidates, scene units.
        gradients: Gradient statistic of each candidate.
        cell: Edge of a cell, scene units.
        limit: Largest number of new anchors.
    """
    occupied_cells = torch.unique(torch.round(anchors / cell), dim=0)
    cells, member_of = torch.unique(torch.round(positions / cell), dim=0, return_inverse=True)
    _, place = torch.unique(torch.cat([occupied_cells, cells]), dim=0, return_inverse=True)
    occupied = torch.zeros(len(occupied_cells) + len(cells), dtype=torch.bool, device=cells.device)
    occupied[place[: len(occupied_cells)]] = True
    free = ~occupied[place[len(occupied_cells) :]]
    # Sorted by gradient; the first of each cell is kept.
    order = torch.argsort(gradients, descending=True, stable=True)
    order = order[free[member_of[order]]]
    first = torch.full((len(cells),), len(order), device=cells.device)
    first.scatter_reduce_(0, member_of[order], torch.arange(len(order), device=cells.device), "amin")
    return order[first[first < len(order)].sort().values[:limit]]


def _extended(values: Tensor, count: int) -> Tensor:
    """Counters with zeros of further rows."""
    return torch.cat([values, values.new_zeros(count)])
