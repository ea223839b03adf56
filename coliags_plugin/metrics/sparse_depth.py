"""Relative depth error at single points of known depth, such as those of structure from motion."""

from __future__ import annotations

from typing import ClassVar

import torch
from pydantic import Field

from coliags_plugin.contracts import Comparison, Metric
from coliags_plugin.core.errors import UnavailableError
from coliags_plugin.core.settings import Settings


class SparseDepthErrorSettings(Settings):
    """Which quantile of the errors."""

    quantile: float = Field(default=0.5, ge=0.0, le=1.0, description="0.5: the median.")


class SparseDepthError(Metric[SparseDepthErrorSettings]):
    """A quantile of |D(p) - z| / z over a frame's points p of known depth z, in percent."""

    Settings: ClassVar[type[Settings]] = SparseDepthErrorSettings
    higher_is_better: ClassVar[bool] = False
    unit: ClassVar[str] = "%"

    def __call__(self, comparison: Comparison) -> float:
        """The metric of one frame; unavailable without points, or if nothing was drawn at any."""
        rendered, known = comparison.point_depth, comparison.true_point_depth
        if rendered is None or known is None:
            raise UnavailableError("this frame has no points of known depth")
        if not len(known):
            raise UnavailableError("nothing was drawn at the points of known depth")
        errors = (rendered.double() - known.double()).abs() / known.double()
        return 100.0 * float(torch.quantile(errors, self.settings.quantile))
