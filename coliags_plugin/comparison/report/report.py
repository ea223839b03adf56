"""Reports of evaluated runs as HTML, Markdown, LaTeX, CSV and JSON: their pages, made of a study."""

from __future__ import annotations

from base64 import b64encode
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from coliags_plugin.comparison.report.charts import frame_charts, profiles, training
from coliags_plugin.comparison.report.metric_tables import (
    ALL_COLUMNS,
    EXPLANATION,
    choose_reference,
    compare,
    cost_table,
    lead_table,
    means_table,
    metric_columns,
    statistics_text,
    training_device,
)
from coliags_plugin.comparison.report.study import MissingResult, Study, StudyRun, cautions, grouped, read_study
from coliags_plugin.comparison.report.views import view_section
from coliags_plugin.config.options import ReportOptions
from coliags_plugin.core.errors import InputError, check_name
from coliags_plugin.core.files import atomic_write, refuse_existing, write_json
from coliags_plugin.reporting.html_page import pictures_folder, refuse_folder, write_html
from coliags_plugin.reporting.model import (
    Block,
    Column,
    Fact,
    Folded,
    Page,
    Paragraph,
    Section,
    Table,
    TableCell,
    Template,
    Value,
    leaves,
    record,
)
from coliags_plugin.reporting.numbers import counted
from coliags_plugin.reporting.text_formats import latex_text, markdown_text, page_text, page_values
from coliags_plugin.results.reading import csv_text, frame_rows
from coliags_plugin.results.record import Result

_TIMES = "\N{MULTIPLICATION SIGN}"
#: Scenes listed by name; of more, only their number is given.
_LISTED = 12

#: Formats of files with their suffixes.
SUFFIXES = {"html": ".html", "markdown": ".md", "latex": ".tex", "csv": ".csv", "json": ".json"}


@dataclass(frozen=True)
class WrittenReport:
    """A report of results: its files; ``print`` shows it as text, without figures."""

    files: list[Path]
    results: list[Result]
    page: Page

    def __str__(self) -> str:
        """The page as text."""
        return page_text(self.page)


def write_report(paths: Sequence[Path], options: ReportOptions, scene: Section | None = None) -> WrittenReport:
    """Write a report of run folders, results files and folders of comparisons.

    Files are the output, or that with the suffix of each of several formats. Markdown and LaTeX have the means of the
    metrics, JSON all tables, CSV every metric of every frame, HTML all of it and the scene to fly through.
    """
    for name in options.formats:
        check_name("format", name, (*SUFFIXES, "all", "text"))
    formats = [each for each in SUFFIXES if not {each, "all"}.isdisjoint(options.formats)]
    if not formats and (options.output is not None or not options.formats):
        raise InputError("no format of files", f"{', '.join(SUFFIXES)} or all; or, without `output`, text")
    output = options.output or Path("report")
    is_whole = options.output is not None and len(formats) == 1
    files = {each: output if is_whole else output.with_suffix(SUFFIXES[each]) for each in formats}
    for file in files.values():
        refuse_folder(file)
    for place in [*files.values(), *(pictures_folder(file) for each, file in files.items() if each == "html")]:
        refuse_existing(place, options.overwrite, "a new file")
    study = read_study(paths, options.protocol, options.methods)
    page = report_page(study, options, screen="html" in files, scene=scene)
    for each, file in files.items():
        match each:
            case "html":
                write_html(page, file)
            case "csv":
                atomic_write(file, per_frame_csv(study))
            case "json":
                write_json(file, page_values(page))
            case _:
                atomic_write(file, latex_text(page) if each == "latex" else markdown_text(page))
    return WrittenReport([*files.values()], [run.result for run in study.runs], page)


def report_page(study: Study, options: ReportOptions, screen: bool = False, scene: Section | None = None) -> Page:
    """The page; with what only a screen shows, views, charts, provenance and a scene to fly through, if asked for."""
    for name in options.columns:
        check_name("metric", name, [*study.metrics, ALL_COLUMNS])
    reference = choose_reference(study, options.reference)
    title = f"{study.methods[0]} on" if len(study.methods) == 1 else f"{len(study.methods)} methods compared on"
    where = study.scenes[0] if len(study.scenes) == 1 else counted(len(study.scenes), "scene")
    metrics, statistics = _metrics(study, options, reference)
    sections, charts = [metrics, _missing(study.missing)], list[Folded]()
    if screen:
        sections += [view_section(study, reference, options.frames), *([scene] if scene else [])]
        charts = [profiles(study), training(study), _frames(study)]
    details = [statistics, Folded("Costs", [cost_table(study)]), _scenes(study, options), *charts, _provenance(study)]
    return Page(
        title=options.title if options.title is not None else f"{title} {where}",
        sections=[*sections, Section("Details", [each for each in details if each.blocks])],
        facts=_facts(study),
        note=options.note or "",
        cautions=cautions(study),
    )


def _facts(study: Study) -> list[Fact]:
    scenes, results = study.scenes, [run.result for run in study.runs]
    protocol = results[0].protocol  # of all
    sizes = dict.fromkeys(result.scene.size for result in results)
    versions = dict.fromkeys(str(result.software.get("package_version") or "") for result in results)
    seeds = sorted({result.seed for result in results})
    frames = {each.title: sum(len(each.frames(scene)) for scene in each.scenes) for each in study.test_sets}
    splits = dict.fromkeys(result.scene.split for result in results)
    facts = {
        "Scene" if len(scenes) == 1 else "Scenes": ", ".join(scenes) if len(scenes) <= _LISTED else str(len(scenes)),
        "Methods": ", ".join(study.methods),
        "Seeds" if len(seeds) > 1 else "Seed": ", ".join(map(str, seeds)),
        "Split": ", ".join(filter(None, splits)),
        "Held-out frames": "; ".join(f"{count} {title}" for title, count in frames.items()),
        "Image size": ", ".join(f"{width} {_TIMES} {height} px" for width, height in sizes),
        "Protocol": f"{protocol.name}, version {protocol.version}",
        "Evaluated with": ", ".join(f"coliags_plugin {version}" for version in versions if version),
    }
    return [Fact(name, value) for name, value in facts.items()]


def _metrics(study: Study, options: ReportOptions, reference: str) -> tuple[Section, Folded]:
    """Means of each test set with the notes that no earlier table has, and the leads of the reference."""
    text = "Means over scenes, of each the mean over its frames." if len(study.scenes) > 1 else "Means over frames."
    text += " ↑ higher is better, ↓ lower is better."
    if len(study.methods) > 1 and {*options.formats} != {"text"}:
        text += " Best in bold, second underlined, by the printed digits; equal values share a rank."
    blocks: list[Block] = [Paragraph(text)]
    leads: list[Table] = []
    notes: dict[str, None] = {}
    for test_set in study.test_sets:
        columns = metric_columns(test_set, options.columns)
        compared = {column.key: compare(test_set, column, reference) for column in columns}
        stars = {
            metric: {row.rival: row.stars for row in rows}
            for metric, rows in compared.items()
            if study.is_decided(reference, metric)
        }
        table = means_table(test_set, columns, stars=stars)
        shown = [column for column in columns if column.shown and compared[column.key]]
        said = [*table.notes, *([statistics_text(study, compared[shown[0].key], reference)] if shown else [])]
        blocks.append(replace(table, notes=[note for note in said if note and note not in notes]))
        notes |= dict.fromkeys(said)
        if len(test_set.scenes) > 1:
            leads += [lead_table(test_set, column, compared[column.key], reference) for column in shown]
    statistics = [Paragraph(EXPLANATION), *leads] if leads else []
    return Section("Metrics", blocks), Folded(f"Lead of {reference} over each method", statistics)


def _scenes(study: Study, options: ReportOptions) -> Folded:
    tables: dict[str, list[Block]] = {scene: [] for scene in study.scenes}
    for test_set in study.test_sets if len(tables) > 1 else ():
        columns = metric_columns(test_set, options.columns)
        for scene in test_set.scenes:
            tables[scene].append(means_table(test_set, columns, scene))
    hint = Paragraph("Means over the frames of a scene; of several seeds, ± is their standard deviation.")
    folded = [Folded(scene, blocks) for scene, blocks in tables.items() if blocks]
    return Folded("Every scene", [hint, *folded] if folded else [])


def _frames(study: Study) -> Folded:
    """PSNR along every video, and all values as CSV."""
    download = {
        "name": "per_frame.csv",
        "data": b64encode(per_frame_csv(study).encode()).decode("ascii"),
        "text": "every metric of every frame, method and seed.",
    }
    return Folded("Every frame", [Template("download.html", download), *frame_charts(study)])


def per_frame_csv(study: Study) -> str:
    """One line per scene, test set, frame, method and seed, one column per metric; empty where there is no value."""
    rows = (
        [run.scene, run.result.scene.split, set_name, frame, run.method, run.result.seed, *values]
        for run in study.runs
        for set_name, frame, *values in frame_rows(run.result, study.metrics)
    )
    return csv_text(["scene", "split", "set", "frame", "method", "seed", *study.metrics], rows)


def _missing(missing: Sequence[MissingResult]) -> Section:
    blocks: list[Block] = [Paragraph("Means and tests leave these out.")] if missing else []
    unfinished = Counter(cell.method for cell in missing if cell.reason is None)
    if unfinished:
        counts = ", ".join(f"{method} ({count})" for method, count in unfinished.items())
        blocks.append(Paragraph(f"{counted(unfinished.total(), 'cell')} not finished: {counts}."))
    rows: list[dict[str, Value]] = [
        {"method": cell.method, "scene": cell.scene, "seed": cell.seed, "reason": cell.reason}
        for cell in missing
        if cell.reason is not None
    ]
    if rows:
        columns = [Column(name, name.capitalize(), words=name != "seed") for name in rows[0]]
        title = f"{counted(len(rows), 'cell')} failed"
        blocks.append(Folded(title, [Table("", columns, rows, name="failed")]))
    return Section("Cells without a result", blocks)


def _provenance(study: Study) -> Folded:
    """Records of the protocol, of every scene, of one run of every method, and of all runs in a table."""
    blocks: list[Block] = [record("Protocol", study.runs[0].result.protocol.model_dump())]
    for scene, runs in grouped(study.runs, lambda run: run.scene).items():
        differ = any(leaves(run.data) != leaves(runs[0].data) for run in runs)
        for run in runs if differ else runs[:1]:
            blocks.append(record(f"Data of {scene}{f', {run.method}' if differ else ''}", run.data))
    for method, runs in study.by_method.items():
        run, result = runs[0], runs[0].result
        values = {"run": run.stamp, "steps": result.steps, "seed": result.seed, "software": result.software}
        provenance = {name: value for name, value in result.provenance.items() if name != "scene"}
        blocks.append(record(method, {**values, **provenance, "config": result.config}))
    rows = [_run_row(run, study.methods.index(run.method)) for run in study.runs]
    columns = [Column(name, words=name not in ("Seed", "Steps")) for name in rows[0]]
    table = Table("Runs", columns, rows, ["Key: hash of all that determines the result"], name="runs")
    blocks.append(Folded(counted(len(study.runs), "run"), [table]))
    return Folded("Provenance", blocks)


def _run_row(run: StudyRun, style: int) -> dict[str, TableCell | str | float]:
    result = run.result
    return {
        "Method": TableCell(run.method, style=style),
        "Scene": run.scene,
        "Split": result.scene.split,
        "Seed": result.seed,
        "Steps": TableCell(f"{result.steps:,}", result.steps),
        "Run": run.stamp,
        "Device": training_device(result.cost),
        "Version": str(result.software.get("package_version") or ""),
        "Code": run.code,
        "Key": result.key,
    }
