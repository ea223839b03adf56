"""Mean of a metric over scenes, and its spread over scenes and over seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

#: A metric of one method: value by scene and seed.
BySeed = Mapping[str, Mapping[int, float]]


@dataclass(frozen=True)
class Spread:
    """Mean and spread of a method's metric.

    Attributes:
        over_seeds: Root mean square, over the scenes with two seeds or more, of the standard deviation (n - 1) over the
            seeds of a scene; None where there is no such scene.
    """

    mean: float  # mean over scenes of the means over seeds
    over_scenes: float | None  # standard deviation (n - 1) of these means; None for a single scene
    over_seeds: float | None
    scenes: int


def scene_means(values: BySeed) -> dict[str, float]:
    """Mean over seeds of each scene that has a value."""
    return {scene: float(np.mean([*seeds.values()])) for scene, seeds in values.items() if seeds}


def spread(values: BySeed, scenes: Sequence[str]) -> Spread:
    """Mean and spread over one or more scenes that all have a value."""
    means = [float(np.mean([*values[scene].values()])) for scene in scenes]
    variances = [np.var([*values[scene].values()], ddof=1) for scene in scenes if len(values[scene]) > 1]
    return Spread(
        mean=float(np.mean(means)),
        over_scenes=float(np.std(means, ddof=1)) if len(means) > 1 else None,
        over_seeds=float(np.sqrt(np.mean(variances))) if variances else None,
        scenes=len(means),
    )


def common_scenes(methods: Sequence[BySeed]) -> list[str]:
    """Scenes for which every method has a value, in the order of the first method."""
    known = [{scene for scene, seeds in values.items() if seeds} for values in methods]
    return [scene for scene in methods[0] if all(scene in scenes for scenes in known)] if methods else []
