"""Contents of the folder of a reconstruction: video, segments, sub-maps, why frames have no pose, problems."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float, Float64
from pydantic import BaseModel

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scene_files import Unit
from coliags_plugin.core.settings import invalid_reported
from coliags_plugin.datamanagers.colmap import AtlasJoin, AtlasRecord, read_atlas
from coliags_plugin.pipeline.frames import IMAGES, FramesRecord
from coliags_plugin.pipeline.joins import ModelKey, SegmentJoin
from coliags_plugin.pipeline.stages import MADE, RECORD_FILE, SHARED, Record, StageRecord
from coliags_plugin.pipeline.survey import SURVEY_FILE, Segment, Survey, Video

_FRAME_NAME = re.compile(r"frame_(\d+)")
#: Figures that are words.
_TEXTS = ("unit", "depth_scale")

T = TypeVar("T")
ModelT = TypeVar("ModelT", bound=BaseModel)


@dataclass(frozen=True)
class SubmapContents:
    """A model of a segment: its frames, and the stages that were run on it."""

    segment: str  # folder of the segment; empty: the only one, which lies in the reconstruction's folder
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
        """Name on pages and in folders: segment and number."""
        return f"{self.segment}/{self.number}" if self.segment else f"sub-map {self.number}"

    @property
    def folder(self) -> str:
        """Folder of its results, relative to the reconstruction's."""
        return "/".join(filter(None, (self.segment, f"submap-{self.number}" if self.number else "")))

    @property
    def first(self) -> int:
        """First frame."""
        return min(self.names, default=0)

    @property
    def last(self) -> int:
        """Last frame."""
        return max(self.names, default=0)

    @cached_property
    def figures(self) -> dict[str, Any]:
        """The numbers of all its stages; of a damaged record, those that are numbers."""
        figures: dict[str, Any] = {
            name: value
            for stage in self.stages.values()
            for name, value in stage.figures.items()
            if isinstance(value, str) == (name in _TEXTS) and isinstance(value, int | float | str)
        }
        if {"psnr", "psnr_training"} <= figures.keys():
            figures["gap"] = figures["psnr_training"] - figures["psnr"]
        return figures

    @property
    def failure(self) -> str:
        """The stage that failed, and why; empty where none did."""
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
    used: Mapping[int, str]  # names of the frames of use, by their number in the video
    lost: Mapping[int, str]  # why frames have no pose, by their numbers
    problem: str = ""  # what of it cannot be read, and why

    @property
    def posed(self) -> set[int]:
        """Frames with a pose."""
        return {number for submap in self.submaps for number in submap.names}

    @property
    def failure(self) -> str:
        """The stage that failed, and why, or that it is not finished; empty where its largest sub-map is done."""
        largest = {name: stage for name, stage in self.stages.items() if "/" not in name}
        for name, stage in largest.items():
            if stage.state == "failed":
                return f"{name}{'' if name in SHARED else ' of its largest sub-map'} failed: {stage.summary}"
        if self.problem:
            return self.problem
        if not self.stages:
            return "it was not begun"
        return "" if "report" in largest and largest["report"].state == "done" else "it is not finished"


@dataclass(frozen=True)
class Contents:
    """The folder of a reconstruction."""

    folder: Path
    video: Video  # of a scene with poses without a list of its frames, of one frame
    stages: Mapping[str, StageRecord]
    segments: Sequence[SegmentContents]
    joins: Sequence[SegmentJoin] = ()
    survey: Survey | None = None
    problems: Sequence[str] = ()  # what cannot be read, and why

    @cached_property
    def submaps(self) -> list[SubmapContents]:
        """Sub-maps of all segments, by their first frames."""
        return sorted(
            (submap for segment in self.segments for submap in segment.submaps), key=lambda submap: submap.first
        )

    @property
    def posed(self) -> set[int]:
        """Frames with a pose."""
        return set().union(*(segment.posed for segment in self.segments))

    @property
    def used(self) -> set[int]:
        """Frames of use."""
        return set().union(*(segment.used for segment in self.segments))

    @property
    def has_frames(self) -> bool:
        """True if the frames are known one by one: not of a scene with poses without a list of them."""
        return self.video.size is not None or bool(self.used)

    def seconds(self, frames: Sequence[float] | np.ndarray) -> Float64[np.ndarray, "N"]:
        """Times of frames by their numbers, s; the numbers where neither times nor a rate are known."""
        times, first = None if self.survey is None else self.survey.times, self.video.first
        if times is not None:
            return np.asarray(np.interp(frames, np.arange(first, first + len(times)), times))
        return np.asarray(frames) / (self.video.rate or 1.0)


class _Joins(BaseModel):
    joins: list[SegmentJoin] = []


def read_contents(out: Path, record: Record | None = None, scene: Path | None = None) -> Contents:
    """Read the folder of a reconstruction; of damaged parts, what is wrong with them becomes a problem.

    ``scene`` is where poses are, if they were given.

    Raises:
        InputError: Its record is damaged, or there is none.
    """
    record = record or Record.of(out)
    stages, problems = record.stages, list[str]()
    if not stages:
        raise InputError(f"no stage in {out / RECORD_FILE}", "the folder of a reconstruction, which has begun")
    posed = None if "survey" in stages else scene
    if record.is_done("survey"):
        video = figures_as(stages, "survey", Video, out)
    else:
        atlas = None if posed is None else _attempt(partial(read_atlas, posed), out, problems)
        count = len(atlas.frames) if atlas else 0
        segments = (Segment(0, max(0, count - 1), ""),)
        video = Video(source=(scene or out).resolve().name, frames=max(1, count), segments=segments)
    contents = [_read_segment(out / span.name, span, record.within(span.name), video, posed) for span in video.segments]
    problems += [
        ": ".join(filter(None, (segment.span.name, segment.problem))) for segment in contents if segment.problem
    ]
    survey = _attempt(partial(_read_survey, out, video), out, problems)
    joins = figures_as(stages, "joins", _Joins, out).joins if "joins" in stages else []
    return Contents(out, video, stages, contents, joins, survey, problems)


def figures_as(stages: Mapping[str, StageRecord], name: str, kind: type[ModelT], folder: Path) -> ModelT:
    """Read the figures that a stage has recorded.

    Raises:
        InputError: They are damaged.
    """
    with invalid_reported(f"cannot read {folder / RECORD_FILE}: {name}: ", MADE):
        return kind.model_validate(stages[name].figures)


def _read_survey(out: Path, video: Video) -> Survey | None:
    """Read the survey of a video's frames; None without one."""
    if not (out / SURVEY_FILE).is_file():
        return None
    survey = Survey.read(out)
    if not survey.first <= video.first < video.stop <= survey.first + len(survey):
        raise InputError(f"{out / SURVEY_FILE} has {len(survey)} frames", f"a number for each of {video.frames} frames")
    return survey.part(video.first, video.stop - 1)


def _attempt(read: Callable[[], T], folder: Path, problems: list[str]) -> T | None:
    """Read a file; None if it is damaged, which is noted without the place of the folder, as that may be moved."""
    try:
        return read()
    except InputError as error:
        problems.append(str(error).replace(f"{folder}/", "").replace(str(folder), folder.name))
        return None


def _read_segment(
    folder: Path, span: Segment, stages: Mapping[str, StageRecord], video: Video, posed: Path | None
) -> SegmentContents:
    """Read a segment; ``posed`` is a scene whose poses were given: its frames are those of its atlas."""
    problems, places, lost = list[str](), dict[int, AtlasJoin](), dict[int, str]()
    atlas = _attempt(partial(read_atlas, posed or folder / "poses"), folder, problems)
    if posed is not None:
        images, used = posed / IMAGES, dict(enumerate(atlas.frames if atlas else ()))
    else:
        images, used = folder / "frames" / IMAGES, {}
        if frames := _attempt(partial(FramesRecord.read, folder / "frames"), folder, problems):
            lost = {frame.frame: frame.why for frame in frames.dropped}
            used = {frame.frame: f"{frame.name}.png" for frame in frames.kept if span.first <= frame.frame <= span.last}
    by_submap: dict[int, dict[str, StageRecord]] = {}
    for name, stage in stages.items():
        place, _, step = name.rpartition("/")
        if step not in SHARED:
            by_submap.setdefault(int(place.removeprefix("submap-") or 0), {})[step] = stage
    submaps = {number: SubmapContents(span.name, f"sparse/{number}", steps) for number, steps in by_submap.items()}
    if atlas is not None:
        try:
            numbers = _frame_numbers(atlas, {Path(name).stem: number for number, name in used.items()}, video)
            lost |= {numbers[frame.frame]: frame.reason for frame in atlas.lost}
            places = {numbers[place.after]: place for place in atlas.joins}
            names: dict[str, dict[int, str]] = {}
            for stretch in atlas.submaps:
                in_stretch = {numbers[frame]: atlas.frames[frame] for frame in stretch.frames}
                names.setdefault(stretch.model, {}).update(in_stretch)
            units = {stretch.model: stretch.unit for stretch in atlas.submaps}
            for model, images_of in names.items():
                number = int(Path(model).name)
                ordered = dict(sorted(images_of.items()))
                submaps[number] = SubmapContents(span.name, model, by_submap.get(number, {}), ordered, units[model])
        except (LookupError, ValueError) as error:
            text = f"{error}".encode(errors="backslashreplace").decode()  # a name may be any text
            problems.append(f"poses/atlas.json does not fit the frames: {text}")
    largest_first = [submaps[number] for number in sorted(submaps)]
    return SegmentContents(span, stages, largest_first, places, images, used, lost, "; ".join(problems))


def _frame_numbers(atlas: AtlasRecord, numbers: Mapping[str, int], video: Video) -> list[int]:
    """Numbers in the video of an atlas's frames: by their names, in ``numbers`` or of the form ``frame_000123``."""
    in_video = []
    for file in atlas.frames:
        if Path(file).name != file:
            raise ValueError(f"the name '{file}'")
        name = Path(file).stem
        match = _FRAME_NAME.fullmatch(name)
        number = numbers.get(name, int(match.group(1)) if match else -1)
        if not video.first <= number < video.stop:
            raise ValueError(f"{file} is none of the frames {video.first} to {video.stop - 1}")
        in_video.append(number)
    return in_video


def common_frames(contents: Contents) -> dict[ModelKey, tuple[ModelKey, Float[np.ndarray, "4 4"]]]:
    """Place each sub-map with poses in the world of the first that it is joined to, by a similarity. [4, 4]

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
