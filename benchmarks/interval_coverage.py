"""Coverage of 95 % confidence intervals of the mean of small samples: percentile bootstrap, BCa and t.

python benchmarks/interval_coverage.py
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import tyro
from jaxtyping import Float
from machine import markdown_table
from scipy import stats

#: Samples at a time, and resamples of these, which bounds the memory.
CHUNK, BATCH = 500, 1000

Draw = Callable[[np.random.Generator, tuple[int, int]], Float[np.ndarray, "trials n"]]


def _with_outliers(rng: np.random.Generator, shape: tuple[int, int]) -> Float[np.ndarray, "trials n"]:
    """Nine of ten scenes normal with mean 0, the tenth with mean 6; standard deviation 1."""
    return rng.normal(size=shape) + np.where(rng.uniform(size=shape) < 0.1, 6.0, 0.0)


#: Distributions of a lead over scenes, and their true means.
LEADS: dict[str, tuple[Draw, float]] = {
    "normal": (lambda rng, shape: rng.normal(size=shape), 0.0),
    "lognormal, sigma 1": (lambda rng, shape: rng.lognormal(size=shape), float(np.exp(0.5))),
    "one scene in ten 6 sd off": (_with_outliers, 0.6),
}


@dataclass(frozen=True)
class Options:
    """Simulate the coverage of the percentile bootstrap, of BCa and of the t interval."""

    scenes: tuple[int, ...] = (6, 8, 10, 12, 22)
    """Sizes of samples."""
    trials: int = 4000
    """Samples of each size; the standard error of 95 % is 0.34 for 4,000."""
    resamples: int = 5000
    """Of the bootstraps."""


def coverage(draw: Draw, mean: float, scenes: int, options: Options) -> dict[str, float]:
    """Empirical coverage by method: the share of samples whose interval contains the true mean."""
    rng = np.random.default_rng(scenes)
    inside: dict[str, list[Float[np.ndarray, "trials"]]] = {}
    for begin in range(0, options.trials, CHUNK):
        sample = draw(rng, (min(CHUNK, options.trials - begin), scenes))
        intervals = {"t": stats.ttest_1samp(sample, 0.0, axis=1).confidence_interval(0.95)}
        for method in ("percentile", "BCa"):
            intervals[method] = stats.bootstrap(
                (sample,), np.mean, axis=1, method=method, n_resamples=options.resamples, batch=BATCH, random_state=rng
            ).confidence_interval
        for name, (low, high) in intervals.items():
            inside.setdefault(name, []).append((low <= mean) & (mean <= high))
    return {name: float(np.concatenate(parts).mean()) for name, parts in inside.items()}


def main(options: Options) -> None:
    """Print a row for each distribution and number of scenes."""
    rows = []
    for title, (draw, mean) in LEADS.items():
        for scenes in options.scenes:
            shares = coverage(draw, mean, scenes, options)
            row = {name: f"{100.0 * shares[name]:.1f} %" for name in ("percentile", "BCa", "t")}
            rows.append({"lead over scenes": title, "scenes": str(scenes), **row})
    print(markdown_table(rows))


if __name__ == "__main__":
    main(tyro.cli(Options))
