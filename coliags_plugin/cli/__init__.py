"""The ``coliags`` command line, its commands by what they are about; heavy libraries are imported when one runs."""

from __future__ import annotations

import logging
import os
import re
import sys
from collections.abc import Sequence
from typing import Annotated, Any, Protocol, Union

import tyro

from coliags_plugin.cli import checks, comparing, methods, poses, runs, scenes
from coliags_plugin.cli.texts import in_flags, translate_for
from coliags_plugin.core import __version__
from coliags_plugin.core.errors import ReportedError
from coliags_plugin.core.libraries import separate_stderr


class Runnable(Protocol):
    """Protocol of a parsed command."""

    def run(self) -> None:
        """Execute the command."""


#: Commands by their names, in the order of the help.
COMMANDS: dict[str, type[Runnable]] = {
    "reconstruct": scenes.ReconstructCommand,
    "phantom": scenes.PhantomCommand,
    "poses": poses.PosesCommand,
    "depth": scenes.DepthCommand,
    "train": runs.TrainCommand,
    "import": runs.ImportCommand,
    "eval": runs.EvaluateCommand,
    "render": runs.RenderCommand,
    "mesh": runs.MeshCommand,
    "coverage": runs.CoverageCommand,
    "export": runs.ExportCommand,
    "view": runs.ViewCommand,
    "compare": comparing.CompareCommand,
    "report": comparing.ReportCommand,
    "list": methods.ListCommand,
    "config": methods.ConfigCommand,
    "check": checks.CheckCommand,
    "weights": methods.WeightsCommand,
}
#: Any of them, for tyro.
Command: Any = Union[tuple(Annotated[kind, tyro.conf.subcommand(name)] for name, kind in COMMANDS.items())]  # noqa: UP007

#: A word, or the value after ``--option=``, that begins with ``~``. Settings are expanded where they are used.
_HOME = re.compile(r"((?:--[\w-]+=)?)(~[^=]*)")
DESCRIPTION = (
    "Gaussian splatting for colonoscopy: training, evaluation and comparison of reconstruction methods. "
    "--version prints the version."
)


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point of the ``coliags`` script. Exits with 0, 2 (bad input), 1 (failure) or 130 (interrupted)."""
    # OpenMP threads spin for milliseconds while they wait, which stalls a busy machine: beside other jobs on two cores,
    # decoding took up to 2000 ms instead of 40. A short spin keeps the speed of an idle machine and loses little on a
    # busy one. It is read when torch is first imported.
    os.environ.setdefault("GOMP_SPINCOUNT", "10000")
    if argv is None:
        separate_stderr()
    # The shell leaves a ~ that is quoted or comes after "=", as in --data=~/scene.
    arguments = sys.argv[1:] if argv is None else argv
    words = [f[1] + os.path.expanduser(f[2]) if (f := _HOME.fullmatch(word)) else word for word in arguments]
    if words == ["--version"]:
        print(f"coliags {__version__}")
        sys.exit(0)
    try:
        command = tyro.cli(
            Command, prog="coliags", description=DESCRIPTION, args=words, config=(tyro.conf.FlagCreatePairsOff,)
        )
    except BrokenPipeError:  # the reader of the help has closed the pipe, as `head` does
        sys.stderr.close()
        sys.exit(1)
    sys.exit(run_command(command))


def run_command(command: Runnable) -> int:
    """Execute a command; reported errors become one line on stderr and an exit status."""
    from coliags_plugin.engine.progress import LogLines

    translate_for(command)
    logging.basicConfig(level=logging.INFO, format="%(message)s", handlers=[LogLines(sys.stderr, in_flags)])
    try:
        command.run()
    except ReportedError as error:
        print(f"coliags: {in_flags(str(error))}", file=sys.stderr)
        return error.exit_status
    except KeyboardInterrupt:
        print("coliags: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        sys.stderr.close()
        return 1
    return 0
