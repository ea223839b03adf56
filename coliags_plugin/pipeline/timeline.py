"""The time line of a video: which frame has a pose in which sub-map, why others have none, what the survey saw."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any
from urllib.parse import quote

import cv2
import numpy as np
from jaxtyping import Int

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import read_rgb
from coliags_plugin.pipeline.contents import Contents, SubmapContents
from coliags_plugin.pipeline.frame_selection import THINNED
from coliags_plugin.pipeline.stages import PAGE_FILE
from coliags_plugin.reporting.charts import COLORS
from coliags_plugin.reporting.image_files import encode_jpeg
from coliags_plugin.reporting.model import EncodedImage, Template
from coliags_plugin.reporting.numbers import counted, linear_ticks, tick_label

#: Columns of the ribbon and of the curves, and pictures above it.
_COLUMNS, _BINS, _PICTURES = 2000, 600, 24
#: Width of a picture, pixels.
_WIDTH = 144
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
    """What became of frames."""

    what: str  # for people; of a sub-map its name
    why: str = ""
    style: int | None = None  # colour index of a sub-map; None: no pose


@dataclass(frozen=True)
class Stretch:
    """Frames that follow each other and share a state."""

    first: int
    last: int  # inclusive
    state: State


def styles(contents: Contents) -> dict[str, int]:
    """Colour index of each sub-map, by name: neighbours differ."""
    return {submap.name: index % COLORS for index, submap in enumerate(contents.submaps)}


def clock(contents: Contents, frame: float) -> str:
    """Time of a frame in minutes and seconds, ``3:05``, with hours from the first one on; empty for an unknown rate."""
    if contents.video.rate is None:
        return ""
    minutes, seconds = divmod(int(contents.seconds([frame])[0] + 1e-6), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"


def span_text(contents: Contents, first: int, last: int) -> str:
    """Frames and times of a stretch: ``frames 30 to 60, 0:01 to 0:02``."""
    frames = f"frame {first}" if first == last else f"frames {first} to {last}"
    times = [clock(contents, first), clock(contents, last)]
    return frames if not times[0] else f"{frames}, {' to '.join(dict.fromkeys(times))}"


def frame_states(contents: Contents) -> tuple[list[State], Int[np.ndarray, "N"]]:
    """States, and which of them each frame of the video has. [N]

    Frames that were not used, since of every n only one is, have the state of the used one before them. A frame that
    two sub-maps have posed belongs to the earlier one.
    """
    video, kinds = contents.video, dict[State, int]()
    codes = np.full(video.frames, -1)
    posed = np.zeros(video.frames, bool)
    colors = styles(contents)

    def code(state: State) -> int:
        return kinds.setdefault(state, len(kinds))

    def number(first: int, last: int) -> slice:
        return slice(first - video.first, last + 1 - video.first)

    for skipped in video.skipped:
        codes[number(skipped.first, skipped.last)] = code(State("left out", skipped.why))
    for segment in contents.segments:
        span = segment.span
        why = segment.failure or "not among those that were posed"
        own = dict.fromkeys(segment.kept, code(State("no pose", why)))
        own |= {frame: code(State("no pose", why)) for frame, why in segment.why.items() if why != THINNED}
        with_pose = set[int]()
        for submap in segment.submaps:
            own |= dict.fromkeys(submap.names, code(State(submap.name, "", colors[submap.name])))
            with_pose |= set(submap.names)
        known = sorted(frame for frame in own if span.first <= frame <= span.last)
        if not known:
            own, known = {span.first: code(State("no pose", why))}, [span.first]
        # An earlier segment that shares frames with this one keeps those that it has posed.
        for frame, stop in zip([span.first, *known[1:]], [*known[1:], span.last + 1], strict=True):
            source = frame if frame in own else known[0]
            place = number(frame, stop - 1)
            free = ~posed[place] if source in with_pose else codes[place] < 0
            codes[place][free] = own[source]
            posed[place] |= source in with_pose
    codes[codes < 0] = code(State("left out", "in no segment"))
    return list(kinds), codes


def stretches(contents: Contents, states: Sequence[State], codes: Int[np.ndarray, "N"]) -> Iterator[Stretch]:
    """Runs of one state, along the video."""
    edges = np.flatnonzero(np.diff(codes)) + 1
    first = contents.video.first
    for start, stop in zip([0, *edges.tolist()], [*edges.tolist(), len(codes)], strict=True):
        yield Stretch(first + start, first + stop - 1, states[int(codes[start])])


def picture_near(contents: Contents, first: int, last: int) -> EncodedImage | None:
    """The frame of use nearest to the middle of a stretch, as a small JPEG; None without one that can be read."""
    middle = (first + last) / 2
    for segment in contents.segments:
        if segment.span.last < first or segment.span.first > last:
            continue
        near = min(segment.kept, key=lambda frame: abs(frame - middle), default=None)
        if near is not None and first <= near <= last:
            return small_picture([segment.images / segment.kept[near]], _WIDTH)
    return None


def small_picture(files: Sequence[Path], width: int) -> EncodedImage | None:
    """Images of one size above each other, reduced to a width in pixels, as JPEG; None if one cannot be read."""
    try:
        image = np.concatenate([read_rgb(file) for file in files])
    except (InputError, OSError, ValueError):
        return None
    if image.shape[1] > width:
        size = (width, max(1, round(image.shape[0] * width / image.shape[1])))
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))
    return EncodedImage(encode_jpeg(image, 80), "image/jpeg", image.shape[1], image.shape[0])


def timeline(contents: Contents, states: Sequence[State], codes: Int[np.ndarray, "N"]) -> Template:
    """The time line: pictures, ribbon of sub-maps, segments and curves over one axis of time and frames."""
    video = contents.video

    def percent(frame: float) -> float:
        return round(100.0 * (frame - video.first) / video.frames, 3)

    def bar(first: int, last: int) -> dict[str, Any]:
        return {"left": percent(first), "width": round(percent(last + 1) - percent(first), 3)}

    ribbon = [
        bar(one.first, one.last)
        | {
            "style": one.state.style,
            "title": f"{one.state.what}: {span_text(contents, one.first, one.last)}"
            + (f"; {one.state.why}" if one.state.why else ""),
        }
        for one in stretches(contents, states, _thinned(codes))
    ]
    parts = [
        bar(span.first, span.last)
        | {
            "name": span.name.removeprefix("segment-"),
            "href": quote(page) if (contents.folder / (page := f"{span.name}/{PAGE_FILE}")).is_file() else "",
            "failed": bool(segment.failure),
            "title": "; ".join(
                filter(None, (f"{span.name}: {span_text(contents, span.first, span.last)}", segment.failure))
            ),
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
            "rows": [row for row in (parts[::2], parts[1::2]) if row],
            "curves": list(_curves(contents)),
            "ticks": [{"left": percent(frame), "texts": texts} for frame, texts in _ticks(contents)],
            "axis": "frame number" if video.rate is None else "time, min:s; frame number",
        },
    )


def _thinned(codes: Int[np.ndarray, "N"]) -> Int[np.ndarray, "N"]:
    """The states of a long video with the commonest one in each of 2,000 columns, for a page of bounded size."""
    if len(codes) <= _COLUMNS:
        return codes
    shown = codes.copy()
    for part in np.array_split(shown, _COLUMNS):  # views
        part[:] = Counter(part.tolist()).most_common(1)[0][0]
    return shown


def _ticks(contents: Contents) -> Iterator[tuple[float, list[str]]]:
    video = contents.video
    if video.rate is None:
        for tick in linear_ticks(video.first, video.stop):
            yield tick, [tick_label(tick)]
        return
    first, last = contents.seconds([video.first, video.stop]).tolist()
    step = next((step for step in _STEPS if (last - first) / step <= _TICKS), math.ceil((last - first) / _TICKS))
    ticks = step * np.arange(math.ceil(first / step), int(last / step) + 1)
    for frame in contents.frames_at(ticks).tolist():
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
        runs = groupby(enumerate(means), lambda item: math.isfinite(item[1]))
        path = "".join(
            "M"
            + "L".join(
                f"{1000.0 * (index + 0.5) / len(means):.1f} {100.0 * (1.0 - min(mean / top, 1.0)):.1f}"
                for index, mean in [*own, *own][: max(2, len(own))]
            )
            for is_known, run in runs
            if is_known and (own := list(run))
        )
        yield {"title": title, "unit": unit, "top": f"{top:.2g}" if top < 100.0 else "100", "path": path}


def submap_between(contents: Contents, one: SubmapContents, other: SubmapContents) -> tuple[bool, str]:
    """Whether a sub-map and the one that follows it are joined, and how well, or why they are not, as far as known."""
    between = [join for join in contents.joins if {one.segment, other.segment} == set(join.segments)]
    for join in between:
        if {one.key, other.key} == set(join.keys):
            turn, apart = f"cameras turned by {join.rotation_deg:.2g} degrees", f"{100.0 * join.position:.2g} %"
            how = f"{counted(join.frames, 'shared frame')}, {turn}, {apart} of the depth apart"
            return join.joined, how if join.joined else join.reason
    if between and not any(join.joined for join in between):
        return False, between[0].reason  # of the models that share most frames
    for segment in contents.segments:
        place = segment.places.get(one.last)
        if segment.span.name == one.segment == other.segment and place is not None and not place.joined:
            return False, place.reason
    return False, _lost_between(contents, one.last, other.first)


def _lost_between(contents: Contents, last: int, first: int) -> str:
    """The commonest reason why frames between two have no pose."""
    reasons = Counter(
        why for segment in contents.segments for frame, why in segment.why.items() if last < frame < first
    )
    for skipped in contents.video.skipped:
        if last < skipped.first < first:
            reasons[skipped.why] += skipped.last - skipped.first + 1
    gap = max(0, first - last - 1)
    why = f", most: {reasons.most_common(1)[0][0]}" if reasons else ""
    return f"{counted(gap, 'frame')} without a pose in between{why}" if gap else "no frame has a pose in both"
