"""Which frames are held out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from jaxtyping import Bool

Split = Literal["every-8th", "endogslam", "block", "all-train", "own"]

EVERY = 8


def held_out(split: Split, count: int, block: tuple[float, float] = (0.4, 0.6)) -> Bool[np.ndarray, "N"]:
    """Which of ``count`` frames, in video order, are test frames.

    Args:
        split: ``every-8th``: 0, 8, 16, ... (the paper, Gaussian Pancakes); ``endogslam``: 7, 15, 23, ... (EndoGSLAM,
            PR-Endo; docs/data.md 3); ``block``: one stretch of the video, which no training frame interrupts, so
            that test views are not merely in-betweens; ``all-train``: none. ``own`` is not a rule but what data say.
        count: Number of frames.
        block: Where the stretch begins and ends, as shares of the video.

    Returns:
        True for test frames. [N]
    """
    index = np.arange(count)
    if split == "every-8th":
        return np.asarray(index % EVERY == 0)
    if split == "endogslam":
        return np.asarray(index % EVERY == EVERY - 1)
    if split == "block":
        return np.asarray((index >= round(block[0] * count)) & (index < round(block[1] * count)))
    return np.zeros(count, bool)


def divide(
    split: Split,
    indices: Sequence[int],
    own: Mapping[str, Sequence[int]] | None = None,
    block: tuple[float, float] = (0.4, 0.6),
) -> tuple[list[int], list[int]]:
    """Indices to train on and indices to test on, among those of a video that are used.

    Args:
        split: As for :func:`held_out`.
        indices: Of the frames used, in video order.
        own: What the data say, ``{"train": ..., "test": ...}``; there must be some for split ``own``.
        block: As for :func:`held_out`.
    """
    if split == "own":
        if own is None:
            raise ValueError("split 'own' of data that have none")
        used = set(indices)
        train, test = ([index for index in own[part] if index in used] for part in ("train", "test"))
        return train, test
    is_test = held_out(split, len(indices), block)
    train = [index for index, held in zip(indices, is_test, strict=True) if not held]
    return train, [index for index, held in zip(indices, is_test, strict=True) if held]
