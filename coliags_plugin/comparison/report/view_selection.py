"""Which frames a report shows: some spread along the video, and the worst."""

from __future__ import annotations

from dataclasses import dataclass

from coliags_plugin.comparison.report.metric_columns import metric_title
from coliags_plugin.comparison.report.study import Part, Study
from coliags_plugin.core.errors import InputError

#: Metrics whose worst frame is shown as well.
_WORST_OF = ("psnr", "depth_mse")


@dataclass(frozen=True)
class ChosenFrame:
    """A frame to show."""

    part: Part
    scene: str
    position: int  # its index among the frames of the set
    name: str
    why: str = ""  # why it is shown, where not for being one of those spread along the video


def choose_frames(study: Study, reference: str, count: int) -> list[ChosenFrame]:
    """Frames of every scene and set: ``count`` spread evenly, first and last included, and the reference's worst."""
    if count < 1:
        raise InputError(f"{count} frames to show", "at least one")
    return [
        chosen
        for scene in study.scenes
        for part in study.parts
        if scene in part.scenes
        for chosen in _choose_of_set(part, scene, reference, count)
    ]


def _choose_of_set(part: Part, scene: str, reference: str, count: int) -> list[ChosenFrame]:
    names, worst_by = part.frames(scene), dict[int, list[str]]()
    for metric in _WORST_OF:
        values = part.frame_means(scene, reference, metric)
        if len(values) > 1:
            sign = 1.0 if part.study.metrics[metric].direction == "higher" else -1.0
            worst = min(values, key=lambda frame: sign * values[frame])
            worst_by.setdefault(names.index(worst), []).append(metric_title(metric))
    reasons = {position: f"worst {' and '.join(metrics)} of {reference}" for position, metrics in worst_by.items()}
    return [
        ChosenFrame(part, scene, position, names[position], reasons.get(position, ""))
        for position in sorted({*evenly(len(names), count), *reasons})
    ]


def evenly(length: int, count: int) -> list[int]:
    """``count`` evenly spaced indices below ``length``, first and last included; the middle one if ``count`` is 1."""
    if count >= length:
        return list(range(length))
    if count == 1:
        return [length // 2]
    return [round(index * (length - 1) / (count - 1)) for index in range(count)]
