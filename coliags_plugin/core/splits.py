"""Splits of a video into training and test frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from jaxtyping import Bool

Split = Literal["every-8th", "inner-8th", "endogslam", "block", "all-train", "own"]

EVERY = 8


def held_out(split: Split, count: int, block: tuple[float, float] = (0.4, 0.6)) -> Bool[np.ndarray, "N"]:
    """Mask of the test frames among ``count`` frames in video order.

    ``every-8th``: 0, 8, 16, ... (the paper, Gaussian Pancakes); ``inner-8th``: 4, 12, 20, ... without the last frame,
    so that every one is between training frames; ``endogslam``: 7, 15, 23, ... (EndoGSLAM, PR-Endo; docs/data.md 3);
    ``block``: one contiguous block, given by fractions of the video, so that test views are not between neighbouring
    training views; ``all-train``: none. ``own`` is handled by :func:`divide`.
    """
    index = np.arange(count)
    if split == "every-8th":
        return np.asarray(index % EVERY == 0)
    if split == "inner-8th":
        return np.asarray((index % EVERY == EVERY // 2) & (index < count - 1))
    if split == "endogslam":
        return np.asarray(index % EVERY == EVERY - 1)
    if split == "block":
        return np.asarray((index >= round(block[0] * count)) & (index < round(block[1] * count)))
    return np.zeros(count, bool)


def split_options(split: str, block: Sequence[float] = (0.4, 0.6)) -> list[str]:
    """Options of training that choose a split, none for ``every-8th``; ``block``: that of split ``block``."""
    chosen = [] if split == "every-8th" else [f"datamanager.split={split}"]
    return [*chosen, f"datamanager.block=[{block[0]:g}, {block[1]:g}]"] if split == "block" else chosen


def divide(
    split: Split,
    indices: Sequence[int],
    own_split: Mapping[str, Sequence[int]] | None = None,
    block: tuple[float, float] = (0.4, 0.6),
) -> tuple[list[int], list[int]]:
    """Training and test indices among the used frames of a video, given in video order.

    ``own_split`` is the dataset's split, ``{"train": ..., "test": ...}``, for split ``own``; the others are as for
    :func:`held_out`.
    """
    if split == "own":
        if own_split is None:
            raise ValueError("split 'own' needs the dataset's own split")
        used = set(indices)
        train, test = ([index for index in own_split[part] if index in used] for part in ("train", "test"))
        return train, test
    is_test = held_out(split, len(indices), block)
    train = [index for index, is_held in zip(indices, is_test, strict=True) if not is_held]
    return train, [index for index, is_held in zip(indices, is_test, strict=True) if is_held]
