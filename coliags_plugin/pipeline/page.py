"""The page of a reconstruction: time line, scenes, sub-maps, held-out views, stages and files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from urllib.parse import quote

import numpy as np
from markupsafe import escape

from coliags_plugin.comparison.report.study import Study, read_study
from coliags_plugin.comparison.report.views import view_section
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import read_rgb
from coliags_plugin.pipeline.contents import Contents, SubmapContents, common_frames, read_contents
from coliags_plugin.pipeline.joins import ModelKey
from coliags_plugin.pipeline.stages import OUTPUTS, PAGE_FILE, Record, StageRecord
from coliags_plugin.pipeline.timeline import State, clock_span, frame_states, span_text, timeline, with_times
from coliags_plugin.pipeline.verdict import VERDICTS
from coliags_plugin.reporting.html_page import write_html
from coliags_plugin.reporting.image_files import EncodedImage
from coliags_plugin.reporting.model import (
    Block,
    Bullet,
    Bullets,
    Column,
    Fact,
    Figures,
    Folded,
    Image,
    Page,
    Paragraph,
    Section,
    Table,
    TableCell,
    Template,
    Value,
    as_cell,
    ranked_cells,
    simple_table,
)
from coliags_plugin.reporting.numbers import area_text, counted, duration, letters
from coliags_plugin.surface.coverage.writing import RESEARCH_USE

#: Largest page, bytes, and how much of it are scenes.
_LIMIT, _SCENES = 50_000_000, 36_000_000
#: Sub-maps whose pictures are shown, and whose held-out views are; the number of these of each, beside the worst.
_SUBMAPS, _VIEWS = 8, 6
#: Where the stage *scene* writes, in the folder of a sub-map.
_SCENE, _PICTURES = OUTPUTS["scene"]
#: Pictures of a frame, in order.
_KINDS = ("recorded.png", "depth.png", "flattened light.png")
#: Items named in a sentence, and sentences about what limits the result; rows of a table above which it is folded.
_NAMED = 5
#: Columns that are left out where no sub-map has them.
_WHERE_KNOWN = ("span", "group", "psnr_pose_refined", "seen")
_TIMELINE = (
    "From left to right, the video. Each colour, with its number, is a sub-map, whose parts share one frame of "
    "reference; grey has no pose. Brackets are segments, dashed where they failed. Point at a place for frames and "
    "reasons."
)
#: How lengths get a unit.
_NO_UNIT = "the colon's inner diameter gives mm: `coliags reconstruct VIDEO --output OUT --diameter 40`"
#: What to do where the poses of a sub-map are suspect.
_SUSPECT = (
    "there the surface may be bent or torn. Compare the held-out views, and see check.html. Better poses may come from "
    "more frames (`every`), a part of the video without cuts, a mask of what does not move with the wall (`mask`), or "
    "the calibration of the camera (`camera`, `params`)."
)


def write_page(out: Path, record: Record | None = None) -> None:
    """Write ``index.html`` into the folder of a reconstruction: one file that opens offline.

    It has at most 50 MB; scenes and pictures that have no room in it are loaded from the folder.

    Raises:
        InputError: ``out`` is of no reconstruction, or a file in it is damaged; or the page cannot be written.
    """
    contents = read_contents(out, record)
    states = frame_states(contents)
    sections = [
        Section("Sub-maps", list(_submaps(contents))),
        Section("Scenes", list(_scenes(contents))),
        Section("Depth and light", list(_pictures(contents))),
        *_views(contents),
    ]
    if contents.has_frames:
        sections.insert(0, Section("Time line", [Paragraph(_TIMELINE), timeline(contents, states)]))
        sections.append(Section("Frames without a pose", [_without_pose(contents, states)]))
    sections.append(Section("Stages and files", list(_stages(contents))))
    title = f"Reconstruction of {contents.video.source}"
    cautions = [with_times(contents, remark) for remark in remarks(contents)]
    page = Page(title, sections, list(_facts(contents)), RESEARCH_USE, cautions)
    write_html(page, out / PAGE_FILE, _LIMIT)


def _facts(contents: Contents) -> Iterator[Fact]:
    video, used, posed = contents.video, contents.used, contents.posed
    length = "" if video.rate is None else duration(float(np.diff(contents.seconds([video.first, video.stop]))[0]))
    if video.size is not None:
        size = "{} x {} px".format(*video.size)
        parts = (counted(video.frames, "frame"), length, size, "deinterlaced" if video.deinterlace else "")
        yield Fact("Video", ", ".join(filter(None, parts)))
    if used:
        share = f"{100.0 * len(posed) / len(used):.0f} %"
        yield Fact("Frames with a pose", f"{len(posed):,} of {len(used):,} used ({share})")
    if (count := len(contents.segments)) != 1:
        failed = sum(bool(segment.failure) for segment in contents.segments)
        note = f"{failed} failed or not finished" if failed else ""
        yield Fact("Segments", f"{count - failed} of {count}", note=note)
    submaps = [submap for submap in contents.submaps if submap.counts]
    yield Fact("Geometry of sub-maps", verdicts_text(contents))
    if contents.joins:
        joined = {join.segments for join in contents.joins if join.joined}
        places = counted(len({join.segments for join in contents.joins}), "place")
        yield Fact("Joined", f"{len(joined)} of {places} between segments")
    yield Fact("Held-out PSNR", held_out_text(submaps))
    metric = [submap.figures for submap in submaps if submap.figures.get("unit") == "mm"]
    if areas := [figures["area"] for figures in metric if "area" in figures]:
        note = f"of {counted(len(areas), 'sub-map')}, usable or doubtful, with lengths in mm"
        yield Fact("Area", area_text(sum(areas), metric=True), note=note)
    if shares := [figures["seen"] for figures in metric if "seen" in figures]:
        mean = 100.0 * sum(shares) / len(shares)
        yield Fact("Wall seen", f"{mean:.0f} % in the mean over {counted(len(shares), 'sub-map')}, usable or doubtful")
    units = [submap.figures["unit"] for submap in contents.submaps if "unit" in submap.figures]
    if (known := units.count("mm")) < len(units):
        unit = f"mm of {known} of {len(units)} sub-maps" if known else "unknown"
        yield Fact("Unit of length", unit, note=_NO_UNIT)
    seconds = sum(stage.seconds for stage in contents.stages.values())
    yield Fact("Time of all stages", duration(seconds) if seconds else None)


def verdicts_text(contents: Contents) -> str:
    """Counts of sub-maps by the verdict on their geometry, and of others: ``3 usable, 1 not usable, 1 failed``."""
    words = Counter[str]()
    for submap in contents.submaps:
        unjudged = "failed" if submap.failure else "not judged yet" if submap.stages else "too small"
        words[submap.figures.get("verdict", unjudged)] += 1
    order = (*VERDICTS, "failed", "not judged yet", "too small")
    return ", ".join(f"{words[word]} {word}" for word in order if words[word])


def held_out_text(submaps: Sequence[SubmapContents]) -> str:
    """Mean held-out PSNR of usable and doubtful sub-maps, the least and the largest; empty where there is none."""
    values = [submap.figures["psnr"] for submap in submaps if submap.counts and "psnr" in submap.figures]
    if len(values) < 2:
        return "".join(f"{psnr:.2f} dB" for psnr in values)
    mean, least, largest = sum(values) / len(values), min(values), max(values)
    return f"{mean:.2f} dB in the mean over {len(values)} sub-maps, usable or doubtful, {least:.2f} to {largest:.2f}"


def remarks(contents: Contents) -> list[str]:
    """Limits of the result, and what to do: failures, suspect poses, warnings; the findings of checks are counted."""
    failures, warnings = list[str](), list[str]()
    for name, stage in contents.stages.items():
        if stage.state == "failed":
            failures.append(f"{name} failed: {stage.summary}")
        elif name.rpartition("/")[2] != "check":
            warnings += [f"{name}: {warning}" for warning in stage.warnings]
    if contents.has_frames and not contents.posed:
        causes = Counter(segment.failure for segment in contents.segments)
        causes += Counter(skipped.why for skipped in contents.video.skipped)
        why = "".join(f": {cause}" for cause, _ in causes.most_common(1))
        failures.insert(0, f"no frame of this video has a pose{why}")
    suspect = [submap for submap in contents.submaps if "check" in submap.stages and submap.stages["check"].warnings]
    if suspect:
        names = ", ".join(f"{submap.name} ({submap.stages['check'].summary})" for submap in suspect[:_NAMED])
        others = f", and {len(suspect) - _NAMED} others" if len(suspect) > _NAMED else ""
        failures.append(f"the poses of {names}{others}: {_SUSPECT}")
    texts = [*failures, *warnings]
    rest = len(texts) - _NAMED
    return texts if rest < 2 else [*texts[:_NAMED], f"{rest} more, under Stages and files of {PAGE_FILE}"]


def _joins(contents: Contents) -> Table:
    """Joins of segments."""
    head: list[str | Column] = [
        "Sub-maps",
        Column("Result", words=True),
        "Shared frames",
        Column("Rotation", unit="degrees"),
        Column("Position", unit="% of the depth"),
        Column("Why apart", words=True),
    ]
    rows: list[list[Value]] = [
        [
            " and ".join("/".join(filter(None, (name, Path(model).name))) for name, model in join.keys),
            "joined" if join.joined else "apart",
            join.frames,
            join.rotation_deg if join.joined else None,
            100.0 * join.position if join.joined else None,
            join.reason,
        ]
        for join in contents.joins
    ]
    return simple_table(head, rows, "joins")


def _groups(contents: Contents) -> dict[ModelKey, str]:
    """Letters of sub-maps that are joined to others, A to Z and then AA."""
    first_of = {key: first for key, (first, _) in common_frames(contents).items()}
    sizes = Counter(first_of.values())
    groups = {key: letters(number).upper() for number, key in enumerate(key for key in first_of if sizes[key] > 1)}
    return {key: groups[first] for key, first in first_of.items() if first in groups}


def _longest_first(contents: Contents) -> list[SubmapContents]:
    return sorted(contents.submaps, key=lambda submap: -len(submap.names))


def _scenes(contents: Contents) -> Iterator[Block]:
    """The scenes to fly through, the longest sub-maps first: within the page as far as there is room."""
    scenes, room = list[tuple[str, str, str | None]](), _SCENES
    for submap in _longest_first(contents):
        path, page = Path(submap.folder, _SCENE), None
        if not (file := contents.folder / path).is_file():
            continue
        if file.stat().st_size <= room:
            page = file.read_text(encoding="utf-8")
            size = len(escape(page).encode())
            room, page = (room - size, page) if size <= room else (room, None)
        scenes.append((_titled(contents, submap), quote(path.as_posix()), page))
    if any(page is None for _, _, page in scenes):
        yield Paragraph("The longest sub-maps are within this page, others are loaded from the folder it lies in.")
    if scenes:
        yield Template("scenes.html", {"scenes": scenes})


def _pictures(contents: Contents) -> Iterator[Block]:
    """Frames, their depth and the wall in flattened light, side by side, of the longest sub-maps."""
    for index, submap in enumerate(_longest_first(contents)[:_SUBMAPS]):
        scale = submap.figures.get("depth_scale")
        blocks: list[Block] = [Paragraph(f"Depth: {scale}; dark is near.")] if scale else []
        for frame in sorted(contents.folder.joinpath(submap.folder, _PICTURES).glob("*")):
            files = [file for kind in _KINDS for file in frame.glob(kind)]
            blocks.append(
                Figures(
                    [Image(EncodedImage.png(read_rgb(file)), file.stem) for file in files],
                    with_times(contents, frame.name),
                )
            )
        if blocks:
            yield Folded(_titled(contents, submap), blocks, is_open=index == 0)


def _views(contents: Contents) -> list[Section]:
    """Section of held-out views beside their renderings by sub-map; of many sub-maps, the best and the worst."""
    half, by_psnr = _SUBMAPS // 2, [submap for submap in contents.submaps if "psnr" in submap.figures]
    by_psnr.sort(key=lambda submap: submap.figures["psnr"])
    runs = []
    try:
        for submap in sorted([*by_psnr[:half], *by_psnr[half:][-half:]], key=lambda submap: submap.first):
            for path in submap.stages["evaluate"].files:
                evaluation = contents.folder / path
                run = read_study([evaluation.parent.parent], evaluation.name).runs[0]
                scene = run.result.scene.model_copy(update={"name": _titled(contents, submap)})
                runs.append(replace(run, result=run.result.model_copy(update={"scene": scene})))
        label = partial(with_times, contents)
        section = [view_section(Study(tuple(runs)), runs[0].method, _VIEWS, label)] if runs else []
    except InputError as error:
        why = str(error).replace(f"{contents.folder}/", "").replace(str(contents.folder), contents.folder.name)
        return [Section("Held-out views", [Paragraph(why, hint=False)])]
    if section and len(by_psnr) > _SUBMAPS:
        hint = Paragraph(f"Of {len(by_psnr)} sub-maps, the {half} with the lowest and with the highest PSNR.")
        return [replace(section[0], blocks=[hint, *section[0].blocks])]
    return section


def _submaps(contents: Contents) -> Iterator[Block]:
    """Verdicts on the sub-maps, their figures, and their joins."""
    if contents.submaps:
        yield verdicts(contents)
        yield submap_table(contents)
    else:
        yield Paragraph("No sub-map was reconstructed.", hint=False)
    if contents.joins:
        yield Folded("Joins of segments", [_joins(contents)], is_open=len(contents.joins) <= _NAMED)


def verdicts(contents: Contents) -> Bullets:
    """The verdict on the geometry of each sub-map and the reasons, or why there is none."""
    return Bullets([Bullet(submap.outcome, submap.name) for submap in contents.submaps])


def _titled(contents: Contents, submap: SubmapContents) -> str:
    """Name, times and verdict: ``sub-map 1, 0:05 to 0:06, doubtful``."""
    times = clock_span(contents, submap.first, submap.last) if submap.names else ""
    return ", ".join(filter(None, (submap.name, times, submap.figures.get("verdict", ""))))


def submap_table(contents: Contents) -> Table:
    """Table of the figures of the sub-maps, and of the means of those that are usable or doubtful."""
    columns = [
        Column("submap", "Sub-map", words=True),
        Column("verdict", "Geometry", words=True),
        Column("frames", "Frames"),
        Column("span", "In the video", words=True),
        Column("group", "Joined as", words=True),
        Column("held_out", "Held out"),
        Column("psnr", "PSNR", "dB", "higher"),
        Column("ssim", "SSIM", "1", "higher"),
        Column("psnr_pose_refined", "PSNR, pose refined", "dB", shown=False),
        Column("psnr_training", "PSNR of training views", "dB", shown=False),
        Column("gap", "Gap", "dB", "lower"),
        Column("area", "Area"),
        Column("seen", "Seen", words=True),
        Column("steps", "Steps", shown=False),
        Column("time", "Time"),
    ]
    submaps, groups = contents.submaps, _groups(contents)
    rows: list[dict[str, Value | TableCell]] = [
        {
            **{key: submap.figures.get(key) for key in ("verdict", "held_out", "steps")},
            "frames": submap.figures.get("frames", len(submap.names)),
            "submap": submap.name,
            "span": span_text(contents, submap.first, submap.last).removeprefix("frames ") if submap.names else None,
            "group": groups.get(submap.key),
            "area": _area_of(submap, "area"),
            "seen": _seen_of(submap),
            "time": duration(sum(stage.seconds for stage in submap.stages.values())) if submap.stages else None,
        }
        for submap in submaps
    ]
    if len(submaps) > 1:
        rows.append({"submap": "mean"})
    for column in columns:
        if not column.unit:
            continue
        values = [submap.figures.get(column.key) for submap in submaps]
        if len(submaps) > 1:
            numbers = [
                submap.figures[column.key] for submap in submaps if submap.counts and column.key in submap.figures
            ]
            values.append(sum(numbers) / len(numbers) if numbers else None)
        for row, cell in zip(rows, ranked_cells(values, column.unit, None), strict=True):
            row[column.key] = cell
    there = {key for row in rows for key, value in row.items() if as_cell(value).text}
    shown = [column for column in columns if column.key not in _WHERE_KNOWN or column.key in there]
    notes = ["Means are of the usable and the doubtful ones"] if len(submaps) > 1 else []
    return Table("", shown, rows, notes, name="submaps")


def _area_of(submap: SubmapContents, name: str) -> str | None:
    """An area among the figures of a sub-map, as text; None where it is unknown."""
    figures = submap.figures
    return area_text(figures[name], figures.get("unit") == "mm") if name in figures else None


def _seen_of(submap: SubmapContents) -> str | None:
    """Share of the wall seen, in per cent, or the seen area where the whole wall is unknown; None without a surface."""
    if not submap.counts:
        return None
    return f"{100.0 * submap.figures['seen']:.0f} %" if "seen" in submap.figures else _area_of(submap, "seen_area")


def _without_pose(contents: Contents, states: Sequence[State]) -> Block:
    """Reasons by how many frames they concern."""
    head: list[str | Column] = ["Why", Column("What", words=True), "Frames", Column("Share", unit="% of the video")]
    rows: list[list[Value | TableCell]] = []
    for state, count in Counter(state for state in states if state.style is None).most_common():
        share = 100.0 * count / contents.video.frames
        rows.append([state.why or state.what, state.what, count, TableCell(f"{share:.1f}", share)])
    return simple_table(head, rows, "reasons") if rows else Paragraph("Every frame has a pose.", hint=False)


def _stages(contents: Contents) -> Iterator[Block]:
    """The stages of each segment with what they warn of, and links to their files."""
    segments = {segment.span.name: segment for segment in contents.segments}
    stages: dict[str, dict[str, StageRecord]] = {name: {} for name in dict.fromkeys(("", *segments))}
    for name, stage in contents.stages.items():
        folder = name.partition("/")[0]
        stages[folder if folder in segments else ""][name] = stage
    for name, of_segment in stages.items():
        title = name or "Whole video"
        if name in segments and contents.has_frames:
            segment = segments[name]
            texts = (
                span_text(contents, segment.span.first, segment.span.last),
                f"{len(segment.posed):,} of {len(segment.used):,} used posed",
                counted(len(segment.submaps), "sub-map"),
                segment.failure,
            )
            title = f"{title}: {'; '.join(filter(None, texts))}"
        rows = ([name, stage.summary, duration(stage.seconds)] for name, stage in of_segment.items())
        warnings = [
            Bullet(with_times(contents, warning), name, quote(next(iter(stage.files), "")))
            for name, stage in of_segment.items()
            for warning in stage.warnings
        ]
        files = [Bullet(what, path, quote(path)) for stage in of_segment.values() for path, what in stage.files.items()]
        table = simple_table(["stage", Column("result", words=True), "time"], rows)
        blocks: list[Block] = [table, *(Bullets(items) for items in (warnings, files) if items)]
        if of_segment or name:
            yield Folded(title, blocks)
    if not segments:
        yield Paragraph("No stretch of this video is long enough for a segment.", hint=False)
