"""``coliags depth check``: compare estimated with true depth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from coliags_plugin.cli import arguments
from coliags_plugin.cli.summaries import print_summary

_Format = Annotated[str | None, tyro.conf.arg(metavar="NAME")]


@dataclass(frozen=True)
class DepthCheckCommand:
    """Compare estimated with true depth: error, bias, coverage, and whether the stated confidence is right."""

    estimate: tyro.conf.Positional[Path]
    """Estimated depth: a scene, or a folder of float32 TIFF or .npy files of z-depth in mm."""
    truth: tyro.conf.Positional[Path]
    """The same with true depth, dense or at single points."""
    align_scale: bool = False
    """Multiply the estimate by the median of true / estimated depth."""
    html: arguments.OptionalPath = None
    """Also write an HTML page with images."""
    maps: arguments.OptionalPath = None
    """Also write maps of the error, PNG, to this folder, which must be new or empty."""
    set: arguments.Assignments = ()
    """An option of both data managers, for instance max_frames=20."""
    estimate_format: _Format = None
    """Dataset format of the estimate (`coliags list datamanagers`); default: recognised from the files."""
    truth_format: _Format = None
    """Dataset format of the truth; default: recognised from the files."""
    anonymous: bool = False
    """Keep absolute paths out of the JSON (docs/security.md 4)."""
    json: arguments.AsJson = False

    def run(self) -> None:
        """Compare, and print the results."""
        from coliags_plugin.checks.depth.check import check_depth
        from coliags_plugin.checks.depth.page import depth_page, write_error_maps
        from coliags_plugin.checks.depth.sources import open_depth
        from coliags_plugin.core.anonymity import without_places
        from coliags_plugin.engine.progress import progress_callback
        from coliags_plugin.reporting.html_page import write_html
        from coliags_plugin.reporting.terminal import page_text

        with progress_callback() as progress:
            estimate = open_depth(self.estimate, self.estimate_format, self.set, progress)
            truth = open_depth(self.truth, self.truth_format, self.set, progress)
            check = check_depth(estimate, truth, self.align_scale, progress)
        page = depth_page(check)
        if self.html is not None:
            write_html(page, self.html)
        if self.maps is not None:
            write_error_maps(check, self.maps)
        facts = check.as_json()
        print_summary(
            page_text(page),
            without_places(facts) if self.anonymous else facts,
            written=[path for path in (self.html, self.maps) if path is not None],
            as_json=self.json,
        )
