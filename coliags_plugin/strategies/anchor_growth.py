"""Scaffold-GS's way of growing and pruning anchors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from pydantic import Field
from torch import Tensor

from coliags_plugin.contracts import Strategy
from coliags_plugin.gaussians import RenderOutput
from coliags_plugin.settings import Settings
from coliags_plugin.strategies.parameter_rows import append_rows, keep_rows


class AnchorGrowthSettings(Settings):
    """Options of anchor growth; the defaults are Scaffold-GS's and ColIAGS's (docs/methods.md 4.3)."""

    statistics_from: int = Field(default=500, ge=0)  # steps; first and last are themselves left out
    growth_from: int = Field(default=1500, ge=0)
    until: int = Field(default=15_000, ge=0)
    every: int = Field(default=100, ge=1)
    gradient_threshold: float = Field(default=0.0002, gt=0)  # of the centres' gradient, normalised image units
    success_share: float = Field(default=0.8, gt=0, le=1)
    min_opacity: float = Field(default=0.005, ge=0)
    levels: int = Field(default=3, ge=1)
    coarsest_cell: int = Field(default=16, ge=1)  # in voxels; each further level is a quarter of the one before
    max_log_scale: float | None = 0.05  # cap on the children's base scales whenever anchors are pruned, log scene units


class AnchorGrowth(Strategy):
    """New anchors where children's image gradients stay large, none where they stay transparent (docs/methods.md 4.3).

    Counts only anchors that the view can see, as Scaffold-GS does; ColIAGS's released code counts all of them, so that
    its pruning test is an average over views that never saw the anchor.
    """

    Settings: ClassVar[type[Settings]] = AnchorGrowthSettings

    def __init__(self, settings: Any, generator: torch.Generator, steps: int) -> None:
        super().__init__(settings, generator, steps)
        # The published 15,000 are half of a run. What grows in the end of a shorter one would never be trained.
        self.until = min(settings.until, steps // 2)
        self.opacity_sum = torch.zeros(0)  # [M]
        self.seen = torch.zeros(0)  # [M]
        self.gradient_sum = torch.zeros(0)  # [M * K]
        self.drawn = torch.zeros(0)  # [M * K]

    def state_dict(self) -> dict[str, Tensor]:
        """The counters."""
        return {name: getattr(self, name) for name in ("opacity_sum", "seen", "gradient_sum", "drawn")}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore the counters."""
        for name in self.state_dict():
            setattr(self, name, state[name])

    @torch.no_grad()
    def after_backward(
        self, step: int, field: Any, optimizers: Mapping[str, torch.optim.Optimizer], output: RenderOutput
    ) -> dict[str, int]:
        """Count; every so often grow and prune."""
        options = self.settings
        if not options.statistics_from < step < self.until:
            return {}
        children = field.offsets.shape[1]
        self._resize(len(field.anchors), children, field.anchors.device)
        self._count(output, children)
        if step <= options.growth_from or step % options.every:
            return {}
        grown = self._grow(field, optimizers, children)
        pruned = self._prune(field, optimizers, children)
        return {"grown": grown, "pruned": pruned}

    def _resize(self, anchors: int, children: int, device: torch.device) -> None:
        """Make room for anchors that have no counters yet."""
        for name, per_anchor in (("opacity_sum", 1), ("seen", 1), ("gradient_sum", children), ("drawn", children)):
            old = getattr(self, name).to(device)
            if len(old) == anchors * per_anchor:
                setattr(self, name, old)
                continue
            setattr(self, name, torch.cat([old, old.new_zeros(anchors * per_anchor - len(old))]))

    def _count(self, output: RenderOutput, children: int) -> None:
        gaussians = output.gaussians
        self.seen[gaussians.visible_sources] += 1
        self.opacity_sum.index_add_(0, gaussians.source_index // children, gaussians.opacities)
        gradient = output.means2d.grad
        if gradient is None:
            return
        height, width = output.alpha.shape
        # In units of half the image, as the thresholds of the lineage are (docs/methods.md 4.3).
        lengths = torch.hypot(0.5 * width * gradient[:, 0], 0.5 * height * gradient[:, 1])
        drawn = output.radii > 0
        # Masks rather than selections: a selection's size would have to come back from a GPU first.
        self.gradient_sum.index_add_(0, gaussians.source_index, torch.where(drawn, lengths, 0.0))
        self.drawn.index_add_(0, gaussians.source_index, drawn.to(self.drawn.dtype))

    def _grow(self, field: Any, optimizers: Mapping[str, torch.optim.Optimizer], children: int) -> int:
        options = self.settings
        ready = self.drawn > options.every * options.success_share * 0.5
        gradient = self.gradient_sum / self.drawn.clamp_min(1.0)
        positions = field.child_positions().reshape(-1, 3)
        first_count = len(field.anchors)
        for level in range(options.levels):
            chosen = ready & (gradient >= options.gradient_threshold * 2.0**level)
            draw = torch.rand(len(chosen), generator=self.generator).to(chosen.device)
            chosen &= draw > 0.5 ** (level + 1)
            if level > 0 and len(field.anchors) == first_count:
                continue  # finer levels follow only where a coarser one found something (docs/methods.md 4.3)
            cell = float(field.voxel_size) * max(1, options.coarsest_cell // 4**level)
            slots = chosen.nonzero().squeeze(1)
            self._add_anchors(field, optimizers, positions[slots], slots // children, cell)
        self.gradient_sum[ready] = 0.0
        self.drawn[ready] = 0.0
        self._resize(len(field.anchors), children, field.anchors.device)
        return len(field.anchors) - first_count

    def _add_anchors(
        self,
        field: Any,
        optimizers: Mapping[str, torch.optim.Optimizer],
        positions: Tensor,
        parents: Tensor,
        cell: float,
    ) -> None:
        """One anchor in every cell that holds candidates and no anchor."""
        if len(positions) == 0:
            return
        taken = torch.unique(torch.round(field.anchors / cell), dim=0)
        cells, member_of = torch.unique(torch.round(positions / cell), dim=0, return_inverse=True)
        both, place = torch.unique(torch.cat([taken, cells]), dim=0, return_inverse=True)
        occupied = torch.zeros(len(both), dtype=torch.bool, device=cells.device)
        occupied[place[: len(taken)]] = True
        free = ~occupied[place[len(taken) :]]
        if not free.any():
            return
        features = field.features[parents]
        pooled = features.new_full((len(cells), features.shape[1]), -torch.inf)
        pooled = pooled.scatter_reduce(0, member_of[:, None].expand_as(features), features, "amax")[free]
        new = cells[free] * cell
        field.anchors = torch.cat([field.anchors, new])
        rows = {
            "offsets": field.offsets.new_zeros(len(new), *field.offsets.shape[1:]),
            "features": pooled,
            "scalings": field.scalings.new_full((len(new), field.scalings.shape[1]), cell).log(),
        }
        append_rows(field, optimizers, rows)

    def _prune(self, field: Any, optimizers: Mapping[str, torch.optim.Optimizer], children: int) -> int:
        options = self.settings
        judged = self.seen > options.every * options.success_share
        faint = judged & (self.opacity_sum < options.min_opacity * self.seen)
        self.opacity_sum[judged] = 0.0
        self.seen[judged] = 0.0
        keep = ~faint
        if not keep.any():
            return 0  # an empty field could never recover
        keep_children = keep.repeat_interleave(children)
        self.opacity_sum, self.seen = self.opacity_sum[keep], self.seen[keep]
        self.gradient_sum, self.drawn = self.gradient_sum[keep_children], self.drawn[keep_children]
        field.anchors = field.anchors[keep]
        keep_rows(field, optimizers, field.anchor_parameters, keep)
        if options.max_log_scale is not None:
            field.scalings[:, 3:].clamp_(max=options.max_log_scale)
        return int(faint.sum())
