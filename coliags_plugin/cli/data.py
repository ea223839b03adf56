"""``coliags data check``: check the consistency of a scene's images, poses, depth and calibration."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import partial
from typing import Literal

import tyro

from coliags_plugin.cli import arguments
from coliags_plugin.cli.summaries import print_summary, train_command


@dataclass(frozen=True)
class DataCommand:
    """Describe a scene and check that images, poses, depth and calibration agree; exit status 1 if suspect."""

    action: tyro.conf.Positional[Literal["check"]]
    """What to do."""
    scene: tyro.conf.Positional[arguments.SceneFolder]
    html: arguments.OptionalPath = None
    """Also write an HTML page with images and the trajectory."""
    set: arguments.Assignments = ()
    """An option of the data manager, for instance split=block."""
    format: arguments.DataFormat = None
    anonymous: bool = False
    """Keep absolute paths out of the page and the JSON (docs/security.md 4)."""
    json: arguments.AsJson = False

    def run(self) -> None:
        """Run the checks and print the results."""
        from coliags_plugin.checks.data.check import check_scene
        from coliags_plugin.checks.data.page import check_page, verdict
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
        if self.html is not None:
            write_html(page, self.html)
        chosen = [f"datamanager.{key}" for key in self.set]
        chosen += [] if self.format is None else [f"datamanager.name={self.format}"]
        is_ready = check.depth is not None and not check.findings
        print_summary(
            f"{page_text(page)}\n\n{verdict(check)}",
            check.as_json(),
            written=[] if self.html is None else [self.html],
            then=[train_command(self.scene, assignments=chosen)] if is_ready else [],
            as_json=self.json,
        )
        if check.findings:
            sys.exit(1)
