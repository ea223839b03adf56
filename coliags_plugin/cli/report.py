"""``coliags report``: compare methods in an HTML page, and in tables for a paper."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from coliags_plugin.cli import arguments
from coliags_plugin.cli.summaries import print_summary

FormatName = Literal["html", "markdown", "latex", "csv", "json", "all"]


@dataclass(frozen=True)
class ReportCommand:
    """Compare evaluated methods: tables with statistics, held-out views, errors, curves and costs."""

    paths: tyro.conf.Positional[tuple[Path, ...]]
    """Evaluated run folders, results files (`eval/PROTOCOL/result.json`), or the folder of a `coliags compare`."""
    output: arguments.OptionalOutput = None
    """File to write; with several formats, its suffix is replaced by that of each; default: report.html, .md, ..."""
    methods: arguments.OptionalText = None
    """Names of methods to show, in this order, separated by commas; default: all."""
    columns: arguments.OptionalText = None
    """Metrics to show, separated by commas, or `all`; default: psnr,ssim,lpips,depth_mse,depth_mse_inner,
    depth_median_error."""
    reference: arguments.OptionalText = None
    """Method that the others are compared with; default: coliags, or the best where it is not there."""
    protocol: str = "paper"
    """Evaluation protocol to read; NAME-truth: evaluations by `coliags eval RUN --truth SCENE`."""
    frames: int = 4
    """Held-out frames to show per scene and test set; the worst ones are added."""
    title: arguments.OptionalText = None
    """Heading; default: methods and scenes."""
    note: arguments.OptionalText = None
    """A remark shown at the top."""
    scene: arguments.OptionalPath = None
    """Run folder whose scene the HTML page lets its reader fly through, offline; needs the extra `viewer`."""
    format: Annotated[
        tuple[Literal["html", "markdown", "latex", "csv", "json", "all"], ...], tyro.conf.UseAppendAction
    ] = ()
    """What to write, repeatable: html (default), markdown, latex (booktabs), csv (every frame), json (tables), all."""
    anonymous: bool = False
    """Leave out absolute paths that results hold (docs/security.md 4)."""
    json: arguments.AsJson = False

    def run(self) -> None:
        """Write the report and print the paths."""
        from coliags_plugin.api.reports import report
        from coliags_plugin.comparison.report.report import FORMATS

        named = tuple(name for name in self.format if name != "all") or FORMATS[:1]
        files = report(
            self.paths,
            self.output,
            formats=FORMATS if "all" in self.format else named,
            methods=_listed(self.methods),
            columns=_listed(self.columns),
            reference=self.reference,
            protocol=self.protocol,
            frames=self.frames,
            title=self.title,
            note=self.note,
            scene=self.scene,
            anonymous=self.anonymous,
        )
        print_summary(written=[file.resolve() for file in files], as_json=self.json)


def _listed(text: str | None) -> tuple[str, ...]:
    return tuple(filter(None, (part.strip() for part in (text or "").split(","))))
