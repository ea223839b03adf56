"""Page that leads to everything a reconstruction has made."""

from __future__ import annotations

from urllib.parse import quote

from coliags_plugin.pipeline.stages import Record
from coliags_plugin.reporting.html_page import write_html
from coliags_plugin.reporting.model import Bullet, Bullets, Column, Page, Section, Table
from coliags_plugin.reporting.numbers import duration

#: Name of the file.
PAGE_FILE = "index.html"


def write_index(record: Record, title: str) -> None:
    """Write ``index.html``: what each stage gave, and links to the files."""
    stages = record.stages.items()
    links = [Bullet(what, path, quote(path)) for _, stage in stages for path, what in stage.files.items()]
    columns = [Column("stage"), Column("result", words=True), Column("time")]
    rows = [{"stage": name, "result": stage.summary, "time": duration(stage.seconds)} for name, stage in stages]
    sections = [Section("Files", [Bullets(links)]), Section("Stages", [Table("", columns, rows)])]
    write_html(Page(title, sections, note="For research use only."), record.folder / PAGE_FILE)
