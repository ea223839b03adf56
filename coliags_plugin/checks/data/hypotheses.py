"""Hypotheses of wrong pose conventions, as the transforms that would correct them."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

Change = Callable[[Float[Tensor, "4 4"]], Float[Tensor, "4 4"]]

#: The poses as they are.
GIVEN = "given"
#: Identity poses, the baseline that the given poses must beat.
NO_MOTION = "no motion"


def _transposed(pose: Tensor) -> Tensor:
    turned = pose.clone()
    turned[:3, :3] = pose[:3, :3].T
    return turned


CHANGES: dict[str, Change] = {
    GIVEN: lambda pose: pose,
    NO_MOTION: lambda pose: torch.eye(4, dtype=pose.dtype),
    "world-to-camera": torch.linalg.inv,
    "rotation transposed": _transposed,
    "translation of opposite sign": lambda pose: pose * pose.new_tensor([[1.0, 1.0, 1.0, -1.0]] * 3 + [[1.0] * 4]),
    "camera axes y up, z backward": lambda pose: pose * pose.new_tensor([1.0, -1.0, -1.0, 1.0]),
}

#: Advice where a hypothesis fits.
ADVICE = {
    "world-to-camera": "The poses look like world-to-camera transforms; write camera-to-world, their inverses",
    "rotation transposed": "The rotations look transposed: the program that wrote the file confused rows and columns",
    "translation of opposite sign": "The translations look negated: check the sign in the program that wrote the file",
    "camera axes y up, z backward": "The camera axes look like OpenGL's; negate the second and third column",
}
