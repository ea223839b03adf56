"""Growing and pruning of anchors by Scaffold-GS's statistics, with grid cells of the anchors' spacing."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import torch
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor

from coliags_plugin.contracts import ParameterRows, Schedule, Strategy, TrainingStep, steps_text
from coliags_plugin.core.render_output import RenderOutput
from coliags_plugin.core.settings import Settings


class AnchorGrowthSettings(Settings):
    """Options of anchor growth (docs/methods.md 4.3 lists Scaffold-GS's values). Steps scale with the run."""

    statistics_from: int = Field(default=500, ge=0)  # steps; first and last are themselves left out
    growth_from: int = Field(default=1500, ge=0)  # step after which events grow and prune
    until: int = Field(default=15_000, ge=0)  # step before which the last event is
    every: int = Field(default=100, ge=1)  # steps between events
    gradient_threshold: float = Field(default=0.0002, gt=0)  # of the centres' gradient, normalised image units
    # share of ``every`` steps with an anchor in view for pruning, half of it for growing (docs/methods.md 4.3)
    success_share: float = Field(default=0.8, gt=0, le=1)
    min_opacity: float = Field(default=0.005, ge=0)  # mean of an anchor's that stays
    levels: int = Field(default=3, ge=1)  # cells of the anchors' spacing, and each further level a quarter of that
    finest_cell: float = Field(default=0.25, ge=0)  # in voxels; finer levels are left out
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
            return (
                f"this run neither grows nor prunes anchors: its {self.schedule.steps} steps leave no multiple of "
                f"{every} between steps {self.schedule.at(self.settings.growth_from)} and {self.until}"
            )
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
            missing = anchors * per_anchor - len(values)
            setattr(self, name, torch.cat([values, values.new_zeros(missing)]) if missing else values)

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
            left = most_births - (len(field.anchors) - first_count)
            if left == 0 or cell < options.finest_cell * float(field.voxel_size):
                break
            slots = (ready & (gradient >= options.gradient_threshold * 2.0**level)).nonzero().squeeze(1)
            chosen = slots[one_per_free_cell(field.anchors, positions[slots], gradient[slots], cell, left)]
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
