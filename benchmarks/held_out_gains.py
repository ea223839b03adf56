"""How far gains of held-out frames are off when they are interpolated in time: by straight lines and by cubic splines.

``python benchmarks/held_out_gains.py RUN`` takes the learned gains of a run with the module ``exposure``, leaves out
windows of training frames, and prints the root mean square error of their logarithm, by the length of the window.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Float
from machine import markdown_table
from scipy.interpolate import Akima1DInterpolator, CubicSpline, make_interp_spline

from coliags_plugin import load_run

Values = Float[np.ndarray, "N"]

INTERPOLATIONS: dict[str, Callable[[Values, Values], Callable[[Values], Values]]] = {
    "linear": partial(make_interp_spline, k=1),
    "Akima": Akima1DInterpolator,
    "cubic": CubicSpline,
}
#: Training frames that remain at either end, and by how many windows are apart.
MARGIN, STRIDE = 6, 3


@dataclass(frozen=True)
class Options:
    """Compare interpolations of gains."""

    run: tyro.conf.Positional[Path]
    """Folder of a trained run of a method with the module ``gain``, such as coliags-plus."""
    lengths: tuple[int, ...] = (1, 3, 7, 14, 21)
    """Training frames that are left out at a time."""


def errors(times: Values, gains: Values, length: int) -> dict[str, float]:
    """Root mean square error of each interpolation over all windows of a length."""
    off: dict[str, list[Values]] = {name: [] for name in INTERPOLATIONS}
    for start in range(MARGIN, len(times) - length - MARGIN, STRIDE):
        window = slice(start, start + length)
        known = (np.delete(times, window), np.delete(gains, window))
        for name, interpolation in INTERPOLATIONS.items():
            off[name].append(interpolation(*known)(times[window]) - gains[window])
    return {name: float(np.sqrt(np.mean(np.square(np.concatenate(each))))) for name, each in off.items()}


def main(options: Options) -> None:
    """Print a row for every length."""
    module = load_run(options.run).load().model.view_modules["exposure"]
    times = np.array(module.times)
    gains = module.log_gains().detach().double().mean(1).numpy()
    rows: Sequence[dict[str, object]] = [
        {"frames held out": length} | {name: f"{each:.4f}" for name, each in errors(times, gains, length).items()}
        for length in options.lengths
        if len(times) > length + 2 * MARGIN
    ]
    print(markdown_table(rows))


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
