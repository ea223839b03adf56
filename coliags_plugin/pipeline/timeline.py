"""The time line of a video: which frame has a pose in which sub-map, why others have none, what the survey saw."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import groupby, pairwise
from typing import Any

import numpy as np

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import read_rgb
from coliags_plugin.pipeline.contents import FRAME_NAME, Contents
from coliags_plugin.pipeline.frames import IMAGES, THINNED
from coliags_plugin.reporting.html_page import COLORS
from coliags_plugin.reporting.image_files import EncodedImage
from coliags_plugin.reporting.model import Template
from coliags_plugin.reporting.numbers import linear_ticks, tick_label

#: Columns of the ribbon and of the curves, and pictures above it.
_COLUMNS, _BINS, _PICTURES = 2000, 600, 24
#: Width of a picture, pixels.
_WIDTH = 144
#: Width of a letter on the ribbon of a wide page, per cent of it.
_LETTER = 0.7
#: Steps of the time axis, seconds, and most of its ticks.
_STEPS, _TICKS = (1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 1800, 3600, 7200), 9
#: Percentile of a curve at which its axis ends.
_TOP = 99.0
#: Titles of the survey's arrays, with units.
_CURVES = {
    "sharpness": ("Sharpness", "RMS of the Laplacian over mean brightness", 1.0),
    "followed": ("Corners followed from the frame before", "%", 100.0),
    "motion": ("Motion since the frame before", "% of the larger side", 100.0),
}


@dataclass(frozen=True)
class State:
    """State of a frame: its sub-map, or why it has no pose."""

    what: str  # for people; of a sub-map its name
    why: str = ""
    style: int | None = None  # colour index of a sub-map; None: no pose


def frame_states(contents: Contents) -> list[State]:
    """The state of each frame of a video.

    Frames that were not used, since of every n only one is, have the state of the used one before them. A frame that
    two sub-maps have posed belongs to the earlier one.
    """
    video, colors = contents.video, {submap.name: index % COLORS for index, submap in enumerate(contents.submaps)}
    states: list[State | None] = [None] * video.frames
    for skipped in video.skipped:
        place = slice(skipped.first - video.first, skipped.last + 1 - video.first)
        states[place] = [State("left out", skipped.why)] * skipped.count
    for segment in contents.segments:
        span, unknown = segment.span, State("no pose", segment.failure or "not among those that were posed")
        of_used = dict.fromkeys(segment.used, unknown)
        of_used |= {frame: State("no pose", why) for frame, why in segment.lost.items() if why != THINNED}
        for submap in segment.submaps:
            of_used |= dict.fromkeys(submap.names, State(submap.name, "", colors[submap.name]))
        state = of_used.get(min((frame for frame in of_used if frame >= span.first), default=span.first), unknown)
        for frame in range(span.first, span.last + 1):
            state, earlier = of_used.get(frame, state), states[frame - video.first]
            # An earlier segment that shares frames with this one keeps those that it has posed.
            if earlier is None or (earlier.style is None and state.style is not None):
                states[frame - video.first] = state
    return [state or State("left out", "in no segment") for state in states]


def _in_columns(states: Sequence[State]) -> list[State]:
    """The states of a long video with the commonest one in each of 2,000 columns, for a page of bounded size."""
    if len(states) <= _COLUMNS:
        return list(states)
    columns = ([states[index] for index in column] for column in np.array_split(np.arange(len(states)), _COLUMNS))
    return [state for column in columns for state in [Counter(column).most_common(1)[0][0]] * len(column)]


def clock(contents: Contents, frame: float) -> str:
    """Time of a frame in minutes and seconds, ``3:05``, with hours from the first one on; empty for an unknown rate."""
    if contents.video.rate is None:
        return ""
    minutes, seconds = divmod(int(contents.seconds([frame])[0] + 1e-6), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"


def clock_span(contents: Contents, first: int, last: int) -> str:
    """Times of the first and the last frame of a stretch: ``0:01 to 0:02``; empty for an unknown rate."""
    return " to ".join(filter(None, dict.fromkeys((clock(contents, first), clock(contents, last)))))


def span_text(contents: Contents, first: int, last: int) -> str:
    """Frames and times of a stretch: ``frames 30 to 60, 0:01 to 0:02``."""
    frames = f"frame {first}" if first == last else f"frames {first} to {last}"
    return ", ".join(filter(None, (frames, clock_span(contents, first, last))))


def with_times(contents: Contents, text: str) -> str:
    """A text with the names of frames of a video, ``frame_000030``, as numbers and times: ``frame 30 (0:01)``."""

    def numbered(name: re.Match[str]) -> str:
        time = clock(contents, int(name[1]))
        return f"frame {int(name[1])}{f' ({time})' if time else ''}"

    return FRAME_NAME.sub(numbered, text)


def picture_near(contents: Contents, first: int, last: int) -> EncodedImage | None:
    """The frame of use nearest to the middle of a stretch, as a small JPEG; None without one that can be read."""
    middle = (first + last) / 2
    for segment in contents.segments:
        near = min(segment.used, key=lambda frame: abs(frame - middle), default=None)
        if near is not None and first <= near <= last:
            file = contents.folder / segment.span.name / "frames" / IMAGES / segment.used[near]
            with suppress(InputError, OSError, ValueError):
                return EncodedImage.jpeg(read_rgb(file), 80, _WIDTH)
            return None
    return None


def timeline(contents: Contents, states: Sequence[State]) -> Template:
    """The time line: pictures, ribbon of sub-maps, segments and curves over one axis of time and frames."""
    video = contents.video

    def percent(frame: float) -> float:
        return round(100.0 * (frame - video.first) / video.frames, 3)

    def bar(first: int, last: int, name: str, why: str) -> dict[str, Any]:
        title = "; ".join(filter(None, (f"{name}: {span_text(contents, first, last)}", why)))
        return {"left": percent(first), "width": round(percent(last + 1) - percent(first), 3), "title": title}

    ribbon, first = list[dict[str, Any]](), video.first
    for state, run in groupby(_in_columns(states)):
        stop = first + sum(1 for _ in run)
        values = bar(first, stop - 1, state.what, state.why)
        name = "" if state.style is None else state.what.removeprefix("sub-map ").removeprefix("segment-")
        has_room = values["width"] >= _LETTER * len(name)
        ribbon.append({**values, "style": state.style, "name": name if has_room else ""})
        first = stop
    segments = [
        {
            **bar(span.first, span.last, span.name, segment.failure),
            "name": span.name.removeprefix("segment-"),
            "failed": bool(segment.failure),
        }
        for segment in contents.segments
        if (span := segment.span).name
    ]
    edges = [video.first + round(index * video.frames / _PICTURES) for index in range(_PICTURES + 1)]
    pictures = [
        {"image": picture_near(contents, first, stop - 1), "title": span_text(contents, first, stop - 1)}
        for first, stop in pairwise(edges)
        if stop > first
    ]
    return Template(
        "timeline.html",
        {
            "thumbs": pictures,
            "ribbon": ribbon,
            "rows": [row for row in (segments[::2], segments[1::2]) if row],
            "curves": list(_curves(contents)),
            "ticks": [{"left": percent(frame), "texts": texts} for frame, texts in _ticks(contents)],
            "axis": "frame number" if video.rate is None else "time, min:s; frame number",
        },
    )


def _ticks(contents: Contents) -> Iterator[tuple[float, list[str]]]:
    """Places on the axis by frame, and their labels: whole steps of time, or frame numbers for an unknown rate."""
    video = contents.video
    if video.rate is None:
        for tick in linear_ticks(video.first, video.stop):
            yield tick, [tick_label(tick)]
        return
    frames = np.arange(video.first, video.stop + 1)
    seconds = contents.seconds(frames)
    first, last = float(seconds[0]), float(seconds[-1])
    step = next((step for step in _STEPS if (last - first) / step <= _TICKS), math.ceil((last - first) / _TICKS))
    ticks = step * np.arange(math.ceil(first / step), int(last / step) + 1)
    for frame in np.interp(ticks, seconds, frames).tolist():
        yield frame, [clock(contents, frame), str(round(frame))]


def _curves(contents: Contents) -> Iterator[dict[str, Any]]:
    """Means of the survey's numbers over columns, as SVG paths in a box of 1000 x 100."""
    for name, (title, unit, factor) in _CURVES.items() if contents.survey is not None else ():
        values = factor * getattr(contents.survey, name).astype(np.float64)
        values[~np.isfinite(values)] = np.nan
        if not np.isfinite(values).any():
            continue
        bins = np.array_split(values, min(_BINS, len(values)))
        means = [float(np.nanmean(part)) if np.isfinite(part).any() else math.nan for part in bins]
        top = 100.0 if name == "followed" else float(np.nanpercentile(values, _TOP)) or 1.0
        points = [
            (1000.0 * (index + 0.5) / len(means), 100.0 * (1.0 - min(mean / top, 1.0)))
            for index, mean in enumerate(means)
        ]
        runs = [list(run) for is_known, run in groupby(points, lambda point: math.isfinite(point[1])) if is_known]
        # A point alone is drawn as a line of no length.
        lines = (run if len(run) > 1 else 2 * run for run in runs)
        path = "".join("M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in line) for line in lines)
        yield {"title": title, "unit": unit, "top": f"{top:.2g}" if top < 100.0 else "100", "path": path}
