"""Tone curve of a phantom's camera."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

#: Linear level above which the soft shoulder of phantoms approaches 1.
KNEE = 0.7


def encode(linear: Float[np.ndarray, "..."], gamma: float, knee: float = KNEE) -> Float[np.ndarray, "..."]:
    """Linear light to pixel values in [0, 1): a power law with a soft shoulder above the linear level ``knee``."""
    linear = np.maximum(linear, 0.0)
    room = 1.0 - knee
    bent = np.where(linear > knee, 1.0 - room * np.exp(np.minimum(knee - linear, 0.0) / room), linear)
    return np.asarray(bent ** (1.0 / gamma))
