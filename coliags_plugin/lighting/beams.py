"""Angular fall-off of a phantom's lamp."""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float

SpreadLaw = Literal["exponential", "cosine"]

#: cos psi below which the beam fades to 0 at 90 degrees: light guides only emit forward. No pixel looks there.
_EDGE = float(np.cos(np.radians(72.0)))


def beam(cosine: Float[np.ndarray, "N"], law: SpreadLaw, spread: float) -> Float[np.ndarray, "N"]:
    """Intensity at an angle psi from the beam's axis, 1 on it, from its cosine (docs/phantom.md 2).

    By law, cos psi to the power of the spread, or exp(-spread (1 - cos psi)).
    """
    shape = np.maximum(cosine, 0.0) ** spread if law == "cosine" else np.exp(-spread * (1.0 - cosine))
    return np.asarray(shape * smoothstep(cosine / _EDGE), dtype=cosine.dtype)


def smoothstep(x: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Cubic Hermite step: 0 below 0, 1 above 1."""
    x = np.clip(x, 0.0, 1.0)
    return np.asarray(x * x * (3.0 - 2.0 * x))
