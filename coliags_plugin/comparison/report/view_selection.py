"""Which frames a report shows: some spread along the video, and the worst."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from coliags_plugin.comparison.report.frame_values import frame_means
from coliags_plugin.comparison.report.metric_columns import metric_title
from coliags_plugin.comparison.report.study import Part, Study
from coliags_plugin.core.errors import InputError

#: Metrics whose worst frame is shown as well.
_WORST_OF = ("psnr", "depth_mse")


@dataclass(frozen=True)
class ChosenFrame:
    """A frame to show.

    Attributes:
        part: Its test set and split.
        scene: Its scene.
        position: Its index among the frames of the set.
        name: Its name.
        why: Why it is shown, where not for being one of those spread along the video.
    """

    part: Part
    scene: str
    position: int
    name: str
    why: str = ""


def choose_frames(study: Study, reference: str, count: int) -> list[ChosenFrame]:
    """Frames of every scene and set: spread evenly, first and last included, and the reference's worst.

    Args:
        study: The results.
        reference: Method whose worst frames by PSNR and by depth error are added.
        count: Evenly spread frames per scene and set; all of a smaller set.

    Raises:
        InputError: ``count`` is not positive.
    """
    if count < 1:
        raise InputError(f"{count} frames to show", "at least one")
    return [
        chosen
        for scene in study.scenes()
        for part in study.parts
        if scene in study.scenes(part)
        for chosen in _of_set(study, part, scene, reference, count)
    ]


def _of_set(study: Study, part: Part, scene: str, reference: str, count: int) -> list[ChosenFrame]:
    names = study.frames(part, scene)
    spread = evenly(len(names), count)
    reasons = _worst(study, part, scene, reference, names)
    return [
        ChosenFrame(part, scene, position, names[position], reasons.get(position, ""))
        for position in sorted({*spread, *reasons})
    ]


def _worst(study: Study, part: Part, scene: str, reference: str, names: Sequence[str]) -> dict[int, str]:
    """Positions of the reference's worst frames, and by what they are."""
    found: dict[int, list[str]] = {}
    for metric in _WORST_OF:
        values = frame_means(study, part, scene, reference, metric)
        if len(values) > 1:
            sign = 1.0 if study.metrics[metric].direction == "higher" else -1.0
            worst = min(values, key=lambda frame: sign * values[frame])
            found.setdefault(names.index(worst), []).append(metric_title(metric))
    return {position: f"worst {' and '.join(metrics)} of {reference}" for position, metrics in found.items()}


def evenly(length: int, count: int) -> list[int]:
    """``count`` evenly spaced indices below ``length``, first and last included; the middle one if ``count`` is 1."""
    if count >= length:
        return list(range(length))
    if count == 1:
        return [length // 2]
    return [round(index * (length - 1) / (count - 1)) for index in range(count)]
