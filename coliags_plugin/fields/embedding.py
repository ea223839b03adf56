"""The cosine embedding gamma of IMVE and IMIA."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def cosine_embedding(x: Float[Tensor, "... D"], frequencies: int) -> Float[Tensor, "... E"]:
    """``[x, sin(x), cos(x), sin(2x), cos(2x), ..., sin(2^(L-1) x), cos(2^(L-1) x)]``.

    Frequency-major, sine before cosine, no factor pi: the paper's "dimension" is the number of frequencies L
    (docs/methods.md 3.2), so ten on a direction make 63 numbers and five on an angle make 11.

    Args:
        x: Anything bounded. [..., D]
        frequencies: L; 0 leaves ``x`` as it is.

    Returns:
        [..., D * (1 + 2 L)]
    """
    octaves = 2.0 ** torch.arange(frequencies, device=x.device, dtype=x.dtype)
    phases = octaves[:, None] * x[..., None, :]
    waves = torch.stack([phases.sin(), phases.cos()], dim=-2)
    return torch.cat([x, waves.flatten(start_dim=-3)], dim=-1)
