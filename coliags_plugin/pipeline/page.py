"""The page of a reconstruction, or of one segment of a long video: time line, scenes, sub-maps, views, files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from urllib.parse import quote

import numpy as np
from jaxtyping import Int
from markupsafe import escape

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import read_rgb
from coliags_plugin.pipeline.contents import Contents, SegmentContents, SubmapContents, common_frames, read_contents
from coliags_plugin.pipeline.joins import ModelKey
from coliags_plugin.pipeline.stages import PAGE_FILE, Record
from coliags_plugin.pipeline.steps import PICTURES, SCENE
from coliags_plugin.pipeline.timeline import (
    State,
    clock,
    frame_states,
    picture_near,
    small_picture,
    span_text,
    stretches,
    styles,
    submap_between,
    timeline,
)
from coliags_plugin.reporting.html_page import write_html
from coliags_plugin.reporting.model import (
    Block,
    Bullet,
    Bullets,
    Column,
    EncodedImage,
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
)
from coliags_plugin.reporting.numbers import area_text, counted, duration
from coliags_plugin.results.reading import RESULT_FILE, read_result
from coliags_plugin.results.record import Result

#: Largest page, bytes, and how much of it are scenes.
_LIMIT, _SCENES = 50_000_000, 36_000_000
#: Frames shown as best and as worst, and their width, pixels; held-out views of each sub-map, beside the worst.
_EXTREMES, _WIDTH, _VIEWS = 4, 400, 6
#: Pictures of a frame, in order.
_KINDS = ("recorded.png", "depth.png", "flattened light.png")
#: Stretches without a pose that are listed, the longest.
_LISTED = 200
#: Items named in a sentence; rows of a table above which it is folded.
_NAMED = 5
#: Figures of a sub-map that have a mean over all, with their units.
_MEASURED = {"psnr": "dB", "ssim": "1", "psnr_pose_refined": "dB", "psnr_training": "dB", "gap": "dB"}
#: Columns that are left out where no sub-map has them.
_WHERE_KNOWN = ("span", "group", "psnr_pose_refined", "seen")
#: What the time line shows.
_TIMELINE = (
    "From left to right, the video. Each colour is a sub-map, whose parts share one frame of reference; grey has no "
    "pose. "
)
_BRACKETS = "Brackets are segments, dashed where they failed. "
#: What to do where the poses of a sub-map are suspect.
_SUSPECT = (
    "there the surface may be bent or torn. Compare the held-out views, and see check.html. Better poses may come from "
    "more frames (`every`), a part of the video without cuts, a mask of what does not move with the wall (`mask`), or "
    "the calibration of the camera (`camera`, `params`)."
)


def write_page(out: Path, record: Record | None = None, segment: str = "", scene: Path | None = None) -> None:
    """Write ``index.html`` into the folder of a reconstruction, or of one segment: one file that opens offline.

    It has at most 50 MB; scenes and pictures that have no room in it are loaded from the folder. Parts that are damaged
    or missing are said to be, and the others shown. ``scene`` is where poses are, if they were given.

    Raises:
        InputError: ``out`` is of no reconstruction, or its record is damaged; or the page cannot be written.
    """
    contents = read_contents(out, record, segment, scene)
    whole, sections = contents.whole, list[Section]()
    states, codes = frame_states(contents)
    groups = _groups(contents)
    has_frames = bool(contents.kept or contents.survey is not None or whole is None)
    if has_frames:
        told = Paragraph(_TIMELINE + ("" if whole else _BRACKETS) + "Point at a place for frames and reasons.")
        sections.append(Section("Time line", [told, timeline(contents, states, codes)]))
    sections.append(Section("Scenes", list(_scenes(contents))))
    if whole is None or len(contents.submaps) > 1:
        sections.append(Section("Map of the sub-maps", list(_map(contents, groups))))
    if whole is None:
        sections.append(Section("Worst and best held-out frames", list(_extremes(contents))))
    else:
        sections += [Section("Depth and light", list(_pictures(contents))), *_views(contents)]
    sections.append(Section("Sub-maps", list(_table(contents, groups))))
    if has_frames:
        sections.append(Section("Frames without a pose", list(_without_pose(contents, states, codes))))
    if whole is None:
        sections.append(Section("Segments", list(_segments(contents))))
    else:
        sections += [Section("Files", list(_files(whole))), Section("Stages", [_stage_table(whole)])]
    title, facts, cautions = f"Reconstruction of {contents.video.source}", list(_facts(contents)), _cautions(contents)
    page = Page(title, sections, facts, "For research use only.", list(cautions))
    write_html(page, contents.folder / PAGE_FILE, _LIMIT)


def _facts(contents: Contents) -> Iterator[Fact]:
    video, used, posed = contents.video, contents.kept, contents.posed
    length = "" if video.rate is None else duration(float(np.diff(contents.seconds([video.first, video.stop]))[0]))
    size = "" if video.size is None else "{} x {} px".format(*video.size)
    parts = (counted(video.frames, "frame"), length, size, "deinterlaced" if video.deinterlace else "")
    if video.size is not None:
        yield Fact("Video", ", ".join(filter(None, parts)))
    if used:
        share = f"{100.0 * len(posed) / len(used):.0f} %"
        yield Fact("Frames with a pose", f"{len(posed):,} of {len(used):,} used ({share})")
    if contents.whole is None:
        failed = sum(bool(segment.failure) for segment in contents.segments)
        note = f"{failed} failed or not finished" if failed else ""
        yield Fact("Segments", f"{len(contents.segments) - failed} of {len(contents.segments)}", note=note)
    known = [submap for submap in contents.submaps if submap.stages]
    failed = sum(bool(submap.failure) for submap in known)
    note = f"{failed} failed" if failed else ""
    yield Fact("Sub-maps", f"{len(known) - failed} reconstructed of {len(contents.submaps)}", note=note)
    if contents.joins:
        joined, places = (
            {join.segments for join in contents.joins if join.joined or not only} for only in (True, False)
        )
        yield Fact("Joined", f"{len(joined)} of {counted(len(places), 'place')} between segments")
    yield Fact("Held-out PSNR", held_out_text(known))
    figures = [submap.figures for submap in known]
    metric = [own for own in figures if own.get("unit") == "mm"]
    if areas := [own["area"] for own in metric if "area" in own]:
        note = f"of {counted(len(areas), 'sub-map')} with lengths in mm"
        yield Fact("Area", area_text(sum(areas), metric=True), note=note)
    if shares := [own["seen"] for own in metric if "seen" in own]:
        mean = 100.0 * sum(shares) / len(shares)
        yield Fact("Wall seen", f"{mean:.0f} % in the mean over {counted(len(shares), 'sub-map')}")
    if known and len(metric) < len(known):
        yield Fact("Unit of length", "unknown" if not metric else f"mm of {len(metric)} of {len(known)} sub-maps")
    seconds = sum(stage.seconds for segment in contents.segments for stage in segment.stages.values())
    yield Fact("Time of all stages", duration(seconds) if seconds else None)


def held_out_text(submaps: Sequence[SubmapContents]) -> str:
    """Mean held-out PSNR of sub-maps, and the least and the largest; empty where nothing was evaluated."""
    values = [psnr for submap in submaps if (psnr := submap.figures.get("psnr")) is not None]
    if len(values) < 2:
        return "".join(f"{psnr:.2f} dB" for psnr in values)
    mean = sum(values) / len(values)
    return f"{mean:.2f} dB in the mean over {len(values)} sub-maps, {min(values):.2f} to {max(values):.2f}"


def _cautions(contents: Contents) -> Iterator[str]:
    yield from contents.problems
    if contents.whole is not None:
        yield from remarks(contents.whole)
        return
    failures = {segment.span.name: segment.failure for segment in contents.segments if segment.failure}
    if not contents.posed:
        reasons = Counter(failures.values()) or Counter(skipped.why for skipped in contents.video.skipped)
        why = f": {reasons.most_common(1)[0][0]}" if reasons else ""
        yield f"No frame of this video has a pose{why}"
    if failures:
        yield f"Failed or not finished: {_named([f'{name} ({why})' for name, why in failures.items()])}"
    if names := [submap.name for submap in contents.submaps if _is_suspect(submap)]:
        yield f"The poses of {counted(len(names), 'sub-map')} ({_named(names)}): {_SUSPECT}"


def _named(items: Sequence[str]) -> str:
    rest = f", and {len(items) - _NAMED} others" if len(items) > _NAMED else ""
    return f"{', '.join(items[:_NAMED])}{rest}"


def _is_suspect(submap: SubmapContents) -> bool:
    return "check" in submap.stages and bool(submap.stages["check"].warnings)


def remarks(segment: SegmentContents) -> list[str]:
    """What limits the result of a segment, and what to do; findings of checks are only counted."""
    told = [
        f"{name} failed: {stage.summary}" if stage.state == "failed" else f"{name}: {warning}"
        for name, stage in segment.stages.items()
        if name.rpartition("/")[2] != "check" or stage.state == "failed"
        for warning in (stage.warnings or [""] * (stage.state == "failed"))
    ]
    suspect = [submap for submap in segment.submaps if _is_suspect(submap)]
    if names := [f"sub-map {submap.number} ({submap.stages['check'].summary})" for submap in suspect]:
        told.append(f"the poses of {', '.join(names)}: {_SUSPECT}")
    return told


def _map(contents: Contents, groups: Mapping[ModelKey, str]) -> Iterator[Block]:
    """The sub-maps one after the other, connected where they are joined, and the joins in a table."""
    submaps = [submap for submap in contents.submaps if submap.names]
    if not submaps:
        yield Paragraph("No sub-map has poses.", hint=False)
        return
    colors, blocks = styles(contents), []
    for index, submap in enumerate(submaps):
        figures, middle = submap.figures, list(submap.names)[len(submap.names) // 2]
        texts = [
            _times(contents, submap),
            counted(len(submap.names), "frame"),
            area_of(submap),
            f"{seen} seen" if (seen := seen_of(submap)) and "seen" in figures else None,
            "too few frames" if not submap.stages else "failed" if submap.failure else None,
        ]
        blocks.append(
            {
                "name": submap.name,
                "group": groups.get(submap.key, ""),
                "style": colors[submap.name],
                "share": round((submap.last - submap.first + 1) / contents.video.frames, 5),
                "image": picture_near(contents, middle, middle),
                "texts": [text for text in texts if text],
                "href": _page_of(contents, submap.segment),
                "link": submap_between(contents, submaps[index - 1], submap) if index else None,
            }
        )
    yield Paragraph(
        "The sub-maps by their first frames, as wide as they are long in time, but for those too short for that. A "
        "solid line joins two whose place and scale to each other are known, a dashed one says why they are not. "
        "Sub-maps with the same letter are in one frame of reference."
    )
    yield Template("submaps.html", {"blocks": blocks})
    if contents.joins:
        rows: list[list[Value | TableCell]] = [
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
        columns = [
            Column("Sub-maps"),
            Column("Result", words=True),
            Column("Shared frames"),
            Column("Rotation", unit="degrees"),
            Column("Position", unit="% of the depth"),
            Column("Why apart", words=True),
        ]
        yield Folded("Joins of segments", [_table_of(columns, rows, "joins")], is_open=len(rows) <= _NAMED)


def _page_of(contents: Contents, segment: str) -> str:
    """Address of the page of a segment; empty where there is none beside this one."""
    page = f"{segment}/{PAGE_FILE}"
    return quote(page) if segment and (contents.folder / page).is_file() else ""


def _times(contents: Contents, submap: SubmapContents) -> str:
    """From when to when a sub-map is; empty for an unknown rate."""
    if not submap.names:
        return ""
    return " to ".join(filter(None, dict.fromkeys((clock(contents, submap.first), clock(contents, submap.last)))))


def _groups(contents: Contents) -> dict[ModelKey, str]:
    """Letters of sub-maps that are joined to others, A to Z and then AA."""
    first_of = {key: first for key, (first, _) in common_frames(contents).items()}
    sizes = Counter(first_of.values())
    firsts = [key for key in first_of if sizes[key] > 1]
    letters = {key: _letter(number) for number, key in enumerate(firsts)}
    return {key: letters[first] for key, first in first_of.items() if first in letters}


def _letter(number: int) -> str:
    return (chr(ord("A") + number // 26 - 1) if number >= 26 else "") + chr(ord("A") + number % 26)


def _scenes(contents: Contents) -> Iterator[Block]:
    """The scenes to fly through, the longest sub-maps first: within the page as far as there is room."""
    shown, room = [], _SCENES
    for submap in sorted(contents.submaps, key=lambda one: -len(one.names)):
        for path in _made(contents, submap, SCENE):
            page: str | None = None
            if (contents.folder / path).stat().st_size <= room:
                page = (contents.folder / path).read_text(encoding="utf-8")
                size = len(escape(page).encode())
                room, page = (room - size, page) if size <= room else (room, None)
            shown.append((", ".join(filter(None, (submap.name, _times(contents, submap)))), quote(path), page))
    if any(page is None for _, _, page in shown):
        yield Paragraph("The longest sub-maps are within this page, others are loaded from the folder it lies in.")
    if shown:
        yield Template("scenes.html", {"scenes": shown})


def _made(contents: Contents, submap: SubmapContents, what: str) -> list[str]:
    """Paths of what the stage *scene* has made of one kind."""
    files = submap.stages["scene"].files if "scene" in submap.stages else {}
    places = (submap.place(path) for path, kind in files.items() if kind == what)
    return [path for path in places if (contents.folder / path).exists()]


def _pictures(contents: Contents) -> Iterator[Block]:
    """Frames, their depth and the wall in flattened light, side by side."""
    for submap in contents.submaps:
        for path in _made(contents, submap, PICTURES):
            scale = submap.figures.get("depth_scale")
            rows: list[Block] = [Paragraph(f"Colours: {scale}, dark is near.")] if scale else []
            for frame in sorted((contents.folder / path).iterdir()):
                files = [file for kind in _KINDS for file in frame.glob(kind)]
                rows.append(Figures([Image(EncodedImage.png(read_rgb(file)), file.stem) for file in files], frame.name))
            yield Folded(submap.name, rows, is_open=submap.number == 0)


def _evaluations(contents: Contents) -> Iterator[tuple[SubmapContents, Path, Result]]:
    """Sub-maps, folders of their evaluations, and results, as far as they can be read."""
    for submap in contents.submaps:
        for path in submap.stages["evaluate"].files if "evaluate" in submap.stages else ():
            evaluation = contents.folder / submap.place(path)
            with suppress(InputError):
                yield submap, evaluation, read_result(evaluation / RESULT_FILE)


def _views(contents: Contents) -> list[Section]:
    """The section of held-out views: those of each sub-map as of a scene of its own."""
    from coliags_plugin.comparison.report.sources import read_study
    from coliags_plugin.comparison.report.study import Study
    from coliags_plugin.comparison.report.views import view_section

    runs = []
    for submap, evaluation, _ in _evaluations(contents):
        run = read_study([evaluation.parent.parent], evaluation.name).runs[0]
        scene = run.result.scene.model_copy(update={"name": submap.name})
        runs.append(replace(run, result=run.result.model_copy(update={"scene": scene})))
    try:
        return [view_section(Study(tuple(runs)), runs[0].method, _VIEWS)] if runs else []
    except InputError as error:
        why = str(error).replace(f"{contents.folder}/", "").replace(str(contents.folder), contents.folder.name)
        return [Section("Held-out views", [Paragraph(why, hint=False)])]


def _extremes(contents: Contents) -> Iterator[Block]:
    """Held-out frames with the lowest and with the highest PSNR of all, beside their renderings."""
    found: list[tuple[float, SubmapContents, str, Path, str]] = []
    for submap, evaluation, result in _evaluations(contents):
        own = result.sets[result.main_set]
        values = zip(own.frames, own.values.get("psnr", ()), strict=False)
        found += [(psnr, submap, name, evaluation, result.main_set) for name, psnr in values if psnr is not None]
    found.sort(key=lambda one: one[0])
    half = min(_EXTREMES, len(found) // 2)
    for title, chosen in (("Lowest", found[:half]), ("Highest", found[::-1][:half])):
        images = []
        for psnr, submap, name, evaluation, frames in chosen:
            files = [evaluation / kind / frames / f"{name}.png" for kind in ("truth", "renders")]
            number = next((number for number, file in submap.names.items() if Path(file).stem == name), None)
            where = name if number is None else span_text(contents, number, number)
            if (image := small_picture(files, _WIDTH)) is not None:
                images.append(Image(image, f"{psnr:.2f} dB: {submap.name}, {where}"))
        if images:
            yield Figures(images, f"{title} PSNR: recorded above, rendered below")


def _table(contents: Contents, groups: Mapping[ModelKey, str]) -> Iterator[Block]:
    """Figures of the reconstructed sub-maps, and the findings of the checks of a segment in full."""
    known = [submap for submap in contents.submaps if submap.stages]
    if not known:
        yield Paragraph("No sub-map was reconstructed.", hint=False)
        return
    yield submap_table(known, lambda first, last: span_text(contents, first, last).removeprefix("frames "), groups)
    if few := len(contents.submaps) - len(known):
        yield Paragraph(f"{counted(few, 'model')} with poses have too few frames to be reconstructed.")
    found = [
        Bullet(warning, submap.name, quote(next(iter(submap.stages["check"].files), "")))
        for submap in known
        if contents.whole is not None and _is_suspect(submap)
        for warning in submap.stages["check"].warnings
    ]
    if found:
        yield Folded(f"Findings of the checks of images and poses ({len(found)})", [Bullets(found)])


def submap_table(
    submaps: Sequence[SubmapContents],
    span: Callable[[int, int], str] = "{} to {}".format,
    groups: Mapping[ModelKey, str] | None = None,
) -> Table:
    """Figures of the sub-maps and their means; ``span`` tells where in the video one is."""
    columns = [
        Column("submap", "Sub-map", words=True),
        Column("frames", "Frames"),
        Column("span", "In the video", words=True),
        Column("group", "Joined as", words=True),
        Column("held_out", "Held out"),
        Column("psnr", "PSNR", "dB", "higher"),
        Column("ssim", "SSIM", "1", "higher"),
        Column("psnr_pose_refined", "PSNR, pose refined", "dB"),
        Column("psnr_training", "PSNR of training views", "dB"),
        Column("gap", "Gap", "dB", "lower"),
        Column("area", "Area"),
        Column("seen", "Seen", words=True),
        Column("steps", "Steps"),
        Column("time", "Time"),
    ]
    rows: list[dict[str, Value | TableCell]] = [
        {
            **{key: own.figures.get(key) for key in ("frames", "held_out", "steps")},
            "submap": own.name,
            "span": span(own.first, own.last) if own.names else None,
            "group": (groups or {}).get(own.key),
            "area": area_of(own),
            "seen": seen_of(own),
            "time": duration(sum(stage.seconds for stage in own.stages.values())),
        }
        for own in submaps
    ]
    if len(submaps) > 1:
        rows.append({"submap": "mean"})
    for key, unit in _MEASURED.items():
        values = [own.figures.get(key) for own in submaps]
        if len(submaps) > 1:
            known = [value for value in values if value is not None]
            values.append(sum(known) / len(known) if known else None)
        for row, cell in zip(rows, ranked_cells(values, unit, None), strict=True):
            row[key] = cell
    for row, own in zip(rows, submaps, strict=False):
        if own.failure:
            row["psnr"] = replace(as_cell(row["psnr"]), note=own.failure)
    there = {key for row in rows for key, value in row.items() if as_cell(value).text}
    shown = [column for column in columns if column.key not in _WHERE_KNOWN or column.key in there]
    return Table("", shown, rows, name="submaps")


def area_of(submap: SubmapContents) -> str | None:
    """Area of the mesh; None where there is none."""
    figures = submap.figures
    return area_text(figures["area"], figures.get("unit") == "mm") if "area" in figures else None


def seen_of(submap: SubmapContents) -> str | None:
    """Share of the wall seen, in per cent, or the seen area where the whole wall is unknown."""
    figures = submap.figures
    if "seen" in figures:
        return f"{100.0 * figures['seen']:.0f} %"
    return area_text(figures["seen_area"], figures.get("unit") == "mm") if "seen_area" in figures else None


def _table_of(columns: Sequence[Column], rows: Iterable[Sequence[Value | TableCell]], name: str = "") -> Table:
    """A table of rows of as many values as there are columns."""
    keys = [column.key for column in columns]
    return Table("", columns, [dict(zip(keys, row, strict=True)) for row in rows], name=name)


def _without_pose(contents: Contents, states: Sequence[State], codes: Int[np.ndarray, "N"]) -> Iterator[Block]:
    """Reasons by how many frames they concern, and the stretches."""
    reasons = Counter[tuple[str, str]]()
    for code, count in Counter(codes.tolist()).items():
        if states[code].style is None:
            reasons[states[code].what, states[code].why] += count
    if not reasons:
        yield Paragraph("Every frame has a pose.", hint=False)
        return
    rows: list[list[Value | TableCell]] = [
        [why or what, what, count, TableCell(f"{share:.1f}", share)]
        for (what, why), count in reasons.most_common()
        for share in [100.0 * count / contents.video.frames]
    ]
    columns = [Column("Why"), Column("What", words=True), Column("Frames"), Column("Share", unit="% of the video")]
    yield _table_of(columns, rows, "reasons")
    lost = [one for one in stretches(contents, states, codes) if one.state.style is None]
    longest = sorted(lost, key=lambda one: one.first - one.last)[:_LISTED]
    has_time = contents.video.rate is not None
    head = ["Frames", *(["From"] if has_time else []), "Number", "Why"]
    listed: list[list[Value]] = [
        [
            f"{one.first} to {one.last}" if one.last > one.first else str(one.first),
            *([clock(contents, one.first)] if has_time else []),
            one.last - one.first + 1,
            one.state.why or one.state.what,
        ]
        for one in sorted(longest, key=lambda one: one.first)
    ]
    table = _table_of([Column(key, words=key != "Number") for key in head], listed, "stretches")
    shown = f"the {_LISTED} longest of {len(lost)}" if len(lost) > _LISTED else str(len(lost))
    yield Folded(f"Stretches without a pose ({shown})", [table])


def _segments(contents: Contents) -> Iterator[Block]:
    """The segments with links to their pages, and what they warn of."""
    items = []
    for segment in contents.segments:
        span = segment.span
        posed = len({number for submap in segment.submaps for number in submap.names})
        texts = [
            span_text(contents, span.first, span.last),
            f"{posed:,} of {len(segment.kept):,} used posed",
            counted(len(segment.submaps), "sub-map"),
            segment.failure,
        ]
        items.append(Bullet("; ".join(filter(None, texts)), span.name, _page_of(contents, span.name)))
    yield Bullets(items) if items else Paragraph("No stretch of this video is long enough for one.", hint=False)
    told = [Bullet(remark, segment.span.name) for segment in contents.segments for remark in remarks(segment)]
    if told:
        yield Folded(f"What the segments warn of ({len(told)})", [Bullets(told)])


def _files(segment: SegmentContents) -> Iterator[Block]:
    """Links to the files of a segment, those of its sub-maps apart where it has several."""
    parts: dict[str, list[Bullet]] = {}
    for name, stage in segment.stages.items():
        folder, _, own = name.rpartition("/")
        part = "" if own in ("frames", "poses") else folder or "sub-map 0"
        parts.setdefault(part.replace("submap-", "sub-map "), []).extend(
            Bullet(what, path, quote(path)) for path, what in stage.files.items()
        )
    for title, links in parts.items():
        if links:
            yield Folded(title, [Bullets(links)], is_open=title == "sub-map 0") if title else Bullets(links)


def _stage_table(segment: SegmentContents) -> Table:
    rows = ([name, stage.summary, duration(stage.seconds)] for name, stage in segment.stages.items())
    return _table_of([Column("stage"), Column("result", words=True), Column("time")], rows)
