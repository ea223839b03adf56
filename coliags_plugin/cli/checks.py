"""``coliags check``: its subcommands, which check a method, a scene's data, or the installation."""

from __future__ import annotations

import logging
import shutil
import sys
import tempfile
from dataclasses import asdict, dataclass
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated

import tyro

from coliags_plugin.cli.texts import depth_commands, in_flags, print_summary, train_command
from coliags_plugin.config import options


@dataclass(frozen=True)
class CheckMethodCommand:
    """Check that a method trains, resumes, renders and fails as it should, on the CPU; exit status 1 if not."""

    method: options.Method
    """Name of a method (`coliags list methods`) or path of a YAML file."""
    steps: int = 20
    """Length of the runs; schedules are scaled to it."""
    keep: bool = False
    """Keep the folder with the phantom and the runs, and print its path."""
    traceback: bool = False
    """Print the whole traceback of every exception."""
    set: options.Assignments = ()
    """Change a value of the method config, as for train."""
    data_format: options.DataFormat = None
    data: options.OptionalPath = None
    """A scene's folder; default: a small phantom."""
    json: options.AsJson = False

    def run(self) -> None:
        """Print one line per check, then a summary."""
        logger = logging.getLogger("coliags_plugin")
        level, folder = logger.level, Path(tempfile.mkdtemp(prefix="coliags-check-"))
        logger.setLevel(logging.WARNING)  # the plans of a dozen runs
        try:
            failed = self._print_results(folder)
        finally:
            logger.setLevel(level)
            if not self.keep:
                shutil.rmtree(folder, ignore_errors=True)
        if failed:
            sys.exit(1)

    def _print_results(self, folder: Path) -> bool:
        """Print each result; True if a check failed."""
        from coliags_plugin.checks.results import line, summary, tracebacks
        from coliags_plugin.testing import METHOD_CHECKS, CheckContext, name_of_check

        if isinstance(sys.stdout, TextIOWrapper):
            sys.stdout.reconfigure(errors="backslashreplace")  # where an encoding has no ticks
        width = max(len(name_of_check(check)) for check in METHOD_CHECKS)
        context = CheckContext(self.method, folder, self.set, self.data, self.data_format, self.steps)
        results = []
        for check in METHOD_CHECKS:
            results.append(context.outcome(check))
            if not self.json:
                print(in_flags(line(results[-1], width)), flush=True)
        text = summary(results)
        if self.traceback:
            text += "\n" + "".join(tracebacks(results))
        facts = {"checks": [asdict(result) for result in results]}
        print_summary(text, facts, written=[folder] if self.keep else [], as_json=self.json)
        return any(result.status == "failed" for result in results)


@dataclass(frozen=True)
class CheckDataCommand(options.CheckDataOptions):
    """Describe a scene and check that images, poses, depth and calibration agree; exit status 1 if suspect."""

    json: options.AsJson = False

    def run(self) -> None:
        """Run the checks and print the results."""
        from coliags_plugin.api.scenes import check_data
        from coliags_plugin.reconstruction.depth.scene import training_options

        check = check_data(self)
        chosen = [f"datamanager.{key.removeprefix('datamanager.')}" for key in self.settings]
        chosen += [] if self.data_format is None else [f"datamanager.name={self.data_format}"]
        reading = [word for item in self.settings for word in ("--set", item)]
        reading += [] if self.data_format is None else ["--data-format", self.data_format]
        then = [train_command(self.scene, chosen)]
        if check.facts["depth"] is None:
            then = depth_commands(self.scene, reading, training_options(check.scene))
        print_summary(
            str(check),
            check.as_json(),
            written=[] if self.html is None else [self.html],
            then=[] if check.findings else then,
            as_json=self.json,
        )
        if check.findings:
            sys.exit(1)


@dataclass(frozen=True)
class CheckInstallationCommand:
    """Report versions and devices, which renderer would be used and why, and where the weights of LPIPS are.

    On a CUDA device the renderers are tried: their errors on small views, and frames per second.
    """

    device: Annotated[str, tyro.conf.arg(metavar="auto|cpu|cuda|cuda:N")] = "auto"
    """Device whose renderers are tried; auto: the first CUDA device, or none."""
    json: options.AsJson = False

    def run(self) -> None:
        """Print the results; exit with status 1 where a requirement is missing or a renderer is wrong."""
        from coliags_plugin.checks.installation import check_installation
        from coliags_plugin.reporting.model import Fact, FactList
        from coliags_plugin.reporting.text_formats import terminal_text

        results = check_installation(self.device)
        marks = {"passed": "ok ", "failed": "BAD", "skipped": "-  "}
        facts = [Fact(f"{marks[each.status]} {each.name}", each.detail) for each in results]
        text = terminal_text([FactList(facts)])
        print_summary(text, {"checks": [asdict(each) for each in results]}, as_json=self.json)
        if any(each.status == "failed" for each in results):
            sys.exit(1)


Subcommand = (
    Annotated[CheckMethodCommand, tyro.conf.subcommand("method")]
    | Annotated[CheckDataCommand, tyro.conf.subcommand("data")]
    | Annotated[CheckInstallationCommand, tyro.conf.subcommand("installation")]
)


@dataclass(frozen=True)
class CheckCommand:
    """Check a method, the data of a scene, or this installation; exit status 1 if something is wrong."""

    subcommand: tyro.conf.OmitArgPrefixes[tyro.conf.OmitSubcommandPrefixes[Subcommand]]
    """Subcommand."""

    def run(self) -> None:
        """Execute the subcommand."""
        self.subcommand.run()
