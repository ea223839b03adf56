"""What lies in the folder of a reconstruction or of a segment: video, sub-maps, why frames have no pose, problems."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float, Float64
from pydantic import BaseModel

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.settings import invalid_reported
from coliags_plugin.datamanagers.atlas import AtlasJoin, AtlasRecord, read_atlas
from coliags_plugin.datamanagers.scene_settings import Unit
from coliags_plugin.pipeline.context import Submap
from coliags_plugin.pipeline.frames import IMAGES, FramesRecord
from coliags_plugin.pipeline.joins import ModelKey, SegmentJoin
from coliags_plugin.pipeline.stages import MADE, RECORD_FILE, Record, StageRecord
from coliags_plugin.pipeline.survey import SURVEY_FILE, Segment, Survey, Video

_FRAME_NAME = re.compile(r"frame_(\d+)")
#: Stages that are of no sub-map.
_OF_ALL = ("survey", "joins", "frames", "poses")
#: Figures that are words.
_TEXTS = ("unit", "depth_scale")

T = TypeVar("T")
ModelT = TypeVar("ModelT", bound=BaseModel)


@dataclass(frozen=True)
class SubmapContents:
    """A model of a segment: its frames, and what was made of it."""

    segment: str  # folder of the segment; empty: of the whole video
    model: str  # folder, relative to the segment's scene; of one without an atlas as if it had one
    stages: Mapping[str, StageRecord]  # by their names without its folder; none: too few frames to be reconstructed
    names: Mapping[int, str] = field(default_factory=dict)  # of its images, by their number in the video, ascending
    unit: Unit = "unknown"

    @property
    def key(self) -> ModelKey:
        """Segment and model."""
        return self.segment, self.model

    @property
    def number(self) -> int:
        """Number of the model within its segment."""
        return int(Path(self.model).name)

    @property
    def name(self) -> str:
        """What pages and folders call it: segment and number."""
        return f"{self.segment}/{self.number}" if self.segment else Submap(self.number).title

    @property
    def first(self) -> int:
        """First frame."""
        return min(self.names, default=0)

    @property
    def last(self) -> int:
        """Last frame."""
        return max(self.names, default=0)

    def place(self, path: str) -> str:
        """Path of one of its files or of its segment's, relative to the folder that the segment lies in."""
        return f"{self.segment}/{path}" if self.segment else path

    @property
    def figures(self) -> dict[str, Any]:
        """The numbers of all its stages; of a damaged record, those that are numbers."""
        found: dict[str, Any] = {
            name: value
            for stage in self.stages.values()
            for name, value in stage.figures.items()
            if isinstance(value, str) == (name in _TEXTS) and isinstance(value, int | float | str)
        }
        gap = {"gap": found["psnr_training"] - found["psnr"]} if {"psnr", "psnr_training"} <= found.keys() else {}
        return found | gap

    @property
    def failure(self) -> str:
        """Which stage failed, and why; empty where none did."""
        failed = (f"{name} failed: {stage.summary}" for name, stage in self.stages.items() if stage.state == "failed")
        return next(failed, "")


@dataclass(frozen=True)
class SegmentContents:
    """A segment, as far as it can be read."""

    span: Segment
    stages: Mapping[str, StageRecord]  # by their names within it
    submaps: Sequence[SubmapContents]  # the largest first
    places: Mapping[int, AtlasJoin]  # between two stretches of frames, by the last frame before
    images: Path  # folder of the frames of use
    kept: Mapping[int, str]  # their names, by their number in the video
    why: Mapping[int, str]  # why frames have no pose, by their numbers
    problem: str = ""  # what of it cannot be read, and why

    @property
    def failure(self) -> str:
        """Which stage failed, and why, or that it is not finished; empty where its largest sub-map is done."""
        own = {name: stage for name, stage in self.stages.items() if "/" not in name}
        for name, stage in own.items():
            if stage.state == "failed":
                of = "" if name in ("frames", "poses") else " of its largest sub-map"
                return f"{name}{of} failed: {stage.summary}"
        if self.problem:
            return self.problem
        if not self.stages:
            return "it was not begun"
        return "" if "report" in own and own["report"].state == "done" else "it is not finished"


@dataclass(frozen=True)
class Contents:
    """The folder of a reconstruction, or of one of its segments."""

    folder: Path
    video: Video  # of a scene with poses without a list of its frames, of one frame
    segments: Sequence[SegmentContents]
    submaps: Sequence[SubmapContents]  # of all segments, by their first frames
    joins: Sequence[SegmentJoin] = ()
    survey: Survey | None = None
    problems: Sequence[str] = ()  # what cannot be read, and why

    @property
    def whole(self) -> SegmentContents | None:
        """The only segment, if this is its folder."""
        return self.segments[0] if self.segments and not self.segments[0].span.name else None

    @property
    def posed(self) -> set[int]:
        """Frames with a pose."""
        return {number for submap in self.submaps for number in submap.names}

    @property
    def kept(self) -> set[int]:
        """Frames of use."""
        return {number for segment in self.segments for number in segment.kept}

    def seconds(self, frames: Sequence[float] | np.ndarray) -> Float64[np.ndarray, "N"]:
        """Times of frames by their numbers, s; the numbers where neither times nor a rate are known."""
        times, first = None if self.survey is None else self.survey.times, self.video.first
        if times is not None:
            return np.asarray(np.interp(frames, np.arange(first, first + len(times)), times))
        return np.asarray(frames) / (self.video.rate or 1.0)

    def frames_at(self, seconds: Sequence[float] | np.ndarray) -> Float64[np.ndarray, "N"]:
        """Numbers of the frames at times: the inverse of :meth:`seconds`."""
        times, first = None if self.survey is None else self.survey.times, self.video.first
        if times is not None:
            return np.asarray(np.interp(seconds, times, np.arange(first, first + len(times))))
        return np.asarray(seconds) * (self.video.rate or 1.0)


class _Joins(BaseModel):
    joins: list[SegmentJoin] = []


def read_contents(out: Path, record: Record | None = None, segment: str = "", scene: Path | None = None) -> Contents:
    """Read the folder of a reconstruction, or of one segment; of damaged parts it is kept what is wrong with them.

    ``scene`` is where poses are, if they were given.

    Raises:
        InputError: Its record is damaged, or there is none.
    """
    record = record or Record.of(out)
    stages, folder, problems = record.within(segment), out / segment, list[str]()
    if not stages:
        raise InputError(f"no stage in {out / RECORD_FILE}", "the folder of a reconstruction, which has begun")
    joins = figures_as(stages, "joins", _Joins, folder).joins if "joins" in stages else []
    whole = record.stages.get("survey")
    given = scene if whole is None else None
    if whole is not None and whole.state == "done":
        video = figures_as(record.stages, "survey", Video, out)
        for span in video.segments if segment else ():
            if span.name == segment:
                own = (Segment(span.first, span.last, ""),)
                part = {"first": span.first, "frames": span.count, "segments": own, "skipped": ()}
                video = video.model_copy(update=part)
    else:
        atlas = None if given is None else _attempt(partial(read_atlas, given), folder, problems)
        count = len(atlas.frames) if atlas else 0
        name = (scene or folder).resolve().name
        video = Video(source=name, frames=max(1, count), segments=(Segment(0, max(0, count - 1), ""),))
    segments = [
        _read_segment(folder / span.name, span, record.within(segment or span.name), video, given)
        for span in video.segments
    ]
    problems += [": ".join(filter(None, (one.span.name, one.problem))) for one in segments if one.problem]
    survey = _attempt(partial(_read_survey, out, video), out, problems)
    submaps = sorted((submap for one in segments for submap in one.submaps), key=lambda submap: submap.first)
    return Contents(folder, video, segments, submaps, joins, survey, problems)


def figures_as(stages: Mapping[str, StageRecord], name: str, kind: type[ModelT], folder: Path) -> ModelT:
    """What a stage has found.

    Raises:
        InputError: What was recorded of it is damaged.
    """
    with invalid_reported(f"cannot read {folder / RECORD_FILE}: {name}: ", MADE):
        return kind.model_validate(stages[name].figures)


def _read_survey(out: Path, video: Video) -> Survey | None:
    """The survey of a video's frames; None without one."""
    if not (out / SURVEY_FILE).is_file():
        return None
    survey = Survey.read(out)
    if not survey.first <= video.first < video.stop <= survey.first + len(survey):
        raise InputError(f"{out / SURVEY_FILE} has {len(survey)} frames", f"a number for each of {video.frames} frames")
    return survey.part(video.first, video.stop - 1)


def _attempt(read: Callable[[], T], folder: Path, problems: list[str]) -> T | None:
    """What is read; None of what is damaged, which is said without the place of the folder, as that may be moved."""
    try:
        return read()
    except InputError as error:
        problems.append(str(error).replace(f"{folder}/", "").replace(str(folder), folder.name))
        return None


def _read_segment(
    folder: Path, span: Segment, stages: Mapping[str, StageRecord], video: Video, given: Path | None
) -> SegmentContents:
    """Read a segment; of a scene with poses, which is ``given``, its frames are those of its atlas."""
    problems, scene, places = list[str](), given or folder / "poses", dict[int, AtlasJoin]()
    atlas = _attempt(partial(read_atlas, scene), folder, problems)
    if given is not None:
        frames, kept, images = None, dict(enumerate(atlas.frames if atlas else ())), given / IMAGES
    else:
        frames, images = (
            _attempt(lambda: FramesRecord.read(folder / "frames"), folder, problems),
            folder / "frames" / IMAGES,
        )
        kept = {
            one.frame: f"{one.name}.png"
            for one in (frames.kept if frames else ())
            if span.first <= one.frame <= span.last
        }
    why = {one.frame: one.why for one in (frames.dropped if frames else ())}
    made: dict[int, dict[str, StageRecord]] = {}
    for name, stage in stages.items():
        place, _, step = name.rpartition("/")
        if step not in _OF_ALL:
            made.setdefault(int(place.removeprefix("submap-") or 0), {})[step] = stage
    submaps = {number: SubmapContents(span.name, f"sparse/{number}", known) for number, known in made.items()}
    if atlas is not None:
        try:
            numbers = _numbers(atlas, {Path(name).stem: number for number, name in kept.items()}, video)
            why |= {numbers[lost.frame]: lost.reason for lost in atlas.lost}
            places = {numbers[place.after]: place for place in atlas.joins}
            names: dict[str, dict[int, str]] = {}
            for stretch in atlas.submaps:
                own = {numbers[index]: atlas.frames[index] for index in stretch.frames}
                names[stretch.model] = names.get(stretch.model, {}) | own
            units = {stretch.model: stretch.unit for stretch in atlas.submaps}
            for model, own in names.items():
                known = made.get(number := int(Path(model).name), {})
                submaps[number] = SubmapContents(span.name, model, known, dict(sorted(own.items())), units[model])
        except (LookupError, ValueError) as error:
            told = f"{error}".encode(errors="backslashreplace").decode()  # a name may be any text
            problems.append(f"poses/atlas.json does not fit the frames: {told}")
    ordered = [submaps[number] for number in sorted(submaps)]
    return SegmentContents(span, stages, ordered, places, images, kept, why, "; ".join(problems))


def _numbers(atlas: AtlasRecord, known: Mapping[str, int], video: Video) -> list[int]:
    """Numbers in the video of an atlas's frames: by their names."""
    numbers = []
    for file in atlas.frames:
        if Path(file).name != file:
            raise ValueError(f"the name '{file}'")
        name = Path(file).stem
        named = _FRAME_NAME.fullmatch(name)
        number = known.get(name, int(named.group(1)) if named else -1)
        if not video.first <= number < video.stop:
            raise ValueError(f"{file} is none of the frames {video.first} to {video.stop - 1}")
        numbers.append(number)
    return numbers


def common_frames(contents: Contents) -> dict[ModelKey, tuple[ModelKey, Float[np.ndarray, "4 4"]]]:
    """For each sub-map with poses the first that it is joined to, and the similarity to that one's world. [4, 4]

    A sub-map that is joined to no other is its own first. Of several ways from one to another the shortest counts.
    """
    submaps = [submap for submap in contents.submaps if submap.names]
    neighbours: dict[ModelKey, list[tuple[ModelKey, np.ndarray]]] = {submap.key: [] for submap in submaps}
    for join in contents.joins:
        first, second = join.keys
        if join.joined and first in neighbours and second in neighbours:
            to_first = np.array(join.transform, dtype=np.float64)
            neighbours[first].append((second, to_first))
            neighbours[second].append((first, np.linalg.inv(to_first)))
    placed: dict[ModelKey, tuple[ModelKey, np.ndarray]] = {}
    for submap in submaps:
        if submap.key in placed:
            continue
        placed[submap.key] = submap.key, np.eye(4)
        reached = [submap.key]
        for key in reached:  # grows: breadth first
            for other, to_key in neighbours[key]:
                if other not in placed:
                    placed[other] = submap.key, placed[key][1] @ to_key
                    reached.append(other)
    return placed
