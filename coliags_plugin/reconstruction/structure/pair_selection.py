"""Choice of the image pairs of a video that are worth matching."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from coliags_plugin.core.progress import Progress
from coliags_plugin.reconstruction.structure.features import Features
from coliags_plugin.reconstruction.structure.matching import all_pairs, mutual_matches
from coliags_plugin.reconstruction.structure.sfm_settings import SfmSettings

#: Features of an image that are compared first, those of the largest scale.
_LARGEST = 300
#: Images of the video that are compared with each other for loop closures, at most; and loop closures of each.
_LOOP_IMAGES, _LOOPS = 40, 2


def alike_pairs(
    features: Sequence[Features], settings: SfmSettings, progress: Progress | None = None
) -> list[tuple[int, int]]:
    """Pairs of images to match: all of a short video; else neighbours, and others whose largest features match.

    Each image is paired with the next two; with those 4, 8, 16, ... images ahead, up to the first that is not alike
    (every second or fourth image has the same pairs, therefore); and images evenly distributed over the video with the
    two most alike of each other's that are not reached this way, as loop closures.

    Args:
        features: Of each image, in video order.
        settings: Of matching.
        progress: Progress callback.
    """
    count = len(features)
    if count <= settings.exhaustive_up_to:
        return all_pairs(count)
    largest = [_largest(one) for one in features]

    def alikeness(first: int, second: int) -> int:
        return len(mutual_matches(largest[first], largest[second], settings.max_ratio, settings.max_distance))

    pairs = {(first, first + step) for step in (1, 2) for first in range(count - step)}
    reached = []
    for first in range(count):
        step = 4
        while first + step < count and alikeness(first, first + step) >= settings.min_alike:
            pairs.add((first, first + step))
            step *= 2
        reached.append(first + step)
        if progress is not None:
            progress("compare images", first + 1, count)
    distributed = range(0, count, -(-count // _LOOP_IMAGES))
    for row, first in enumerate(distributed):
        distant = [second for second in distributed[row + 1 :] if second > reached[first]]
        ranked = sorted(((alikeness(first, second), second) for second in distant), reverse=True)[:_LOOPS]
        pairs.update((first, second) for alike, second in ranked if alike >= settings.min_alike)
    return sorted(pairs)


def _largest(features: Features) -> Features:
    chosen = np.sort(np.argsort(-features.keypoints[:, 2], kind="stable")[:_LARGEST])
    return Features(features.keypoints[chosen], features.descriptors[chosen])
