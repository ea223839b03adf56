"""``coliags data check``: check the consistency of a scene's images, poses, depth and calibration."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import tyro

from coliags_plugin.cli.arguments import Assignments, DataFormat, OptionalPath


@dataclass(frozen=True)
class Data:
    """Describe a scene and check that images, poses, depth and calibration agree; exit status 1 if suspect."""

    action: tyro.conf.Positional[Literal["check"]]
    """What to do."""
    scene: tyro.conf.Positional[Path]
    """The scene's folder."""
    format: DataFormat = None
    """Dataset format (`coliags list datamanagers`); default: recognised from the files."""
    html: OptionalPath = None
    """Also write an HTML page with images and the trajectory."""
    json: OptionalPath = None
    """Also write the results as JSON."""
    anonymous: bool = False
    """Keep absolute paths out of the page and the JSON (docs/security.md 4)."""
    set: Assignments = ()
    """An option of the data manager, for instance split=block."""

    def run(self) -> None:
        """Run the checks and print the results."""
        from coliags_plugin.checks.data.check import check_scene
        from coliags_plugin.checks.data.page import check_page, verdict
        from coliags_plugin.core.files import write_json
        from coliags_plugin.engine.data_formats import open_scene
        from coliags_plugin.engine.progress import progress_callback
        from coliags_plugin.reporting.html_page import write_html
        from coliags_plugin.reporting.terminal import page_text

        with progress_callback() as progress:
            scene = open_scene(self.scene, self.format, self.set, progress)
            at_stored_size = partial(open_scene, self.scene, self.format, self.set, stored_size=True)
            check = check_scene(scene, progress, at_stored_size if scene.is_resized else None)
        if self.anonymous:
            check = check.anonymous()
        page = check_page(check)
        print(page_text(page), verdict(check), sep="\n\n")
        if self.html is not None:
            write_html(page, self.html)
            print(self.html.resolve())
        if self.json is not None:
            write_json(self.json, check.as_json())
        if check.findings:
            sys.exit(1)
