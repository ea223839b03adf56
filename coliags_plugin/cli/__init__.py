"""The ``coliags`` command line, its commands by what they are about; heavy libraries are imported when one runs."""

from __future__ import annotations

import logging
import os
import re
import sys
from collections.abc import Sequence
from typing import Annotated

import tyro

from coliags_plugin._version import __version__
from coliags_plugin.cli.arguments import Runnable
from coliags_plugin.cli.comparing import AblateCommand, CompareCommand, ReportCommand, ResultsCommand
from coliags_plugin.cli.flags import hint, in_flags, translate_for
from coliags_plugin.cli.methods import CheckCommand, ConfigCommand, DoctorCommand, ListCommand, WeightsCommand
from coliags_plugin.cli.poses import PosesCommand
from coliags_plugin.cli.reconstruct import ReconstructCommand
from coliags_plugin.cli.runs import (
    CoverageCommand,
    EvaluateCommand,
    ExportCommand,
    ImportCommand,
    MeshCommand,
    RenderCommand,
    TrainCommand,
    ViewCommand,
)
from coliags_plugin.cli.scenes import DataCommand, DepthCommand, PhantomCommand
from coliags_plugin.core.errors import ReportedError
from coliags_plugin.core.libraries import separate_stderr

Command = (
    Annotated[ReconstructCommand, tyro.conf.subcommand("reconstruct")]
    | Annotated[PhantomCommand, tyro.conf.subcommand("phantom")]
    | Annotated[TrainCommand, tyro.conf.subcommand("train")]
    | Annotated[EvaluateCommand, tyro.conf.subcommand("eval")]
    | Annotated[RenderCommand, tyro.conf.subcommand("render")]
    | Annotated[CoverageCommand, tyro.conf.subcommand("coverage")]
    | Annotated[MeshCommand, tyro.conf.subcommand("mesh")]
    | Annotated[ExportCommand, tyro.conf.subcommand("export")]
    | Annotated[ImportCommand, tyro.conf.subcommand("import")]
    | Annotated[ViewCommand, tyro.conf.subcommand("view")]
    | Annotated[CompareCommand, tyro.conf.subcommand("compare")]
    | Annotated[AblateCommand, tyro.conf.subcommand("ablate")]
    | Annotated[ReportCommand, tyro.conf.subcommand("report")]
    | Annotated[ResultsCommand, tyro.conf.subcommand("results")]
    | Annotated[PosesCommand, tyro.conf.subcommand("poses")]
    | Annotated[ListCommand, tyro.conf.subcommand("list")]
    | Annotated[ConfigCommand, tyro.conf.subcommand("config")]
    | Annotated[DataCommand, tyro.conf.subcommand("data")]
    | Annotated[DepthCommand, tyro.conf.subcommand("depth")]
    | Annotated[CheckCommand, tyro.conf.subcommand("check")]
    | Annotated[WeightsCommand, tyro.conf.subcommand("weights")]
    | Annotated[DoctorCommand, tyro.conf.subcommand("doctor")]
)

#: A word, or the value after ``--option=``, that begins with ``~``. Settings are expanded where they are used.
_HOME = re.compile(r"((?:--[\w-]+=)?)(~[^=]*)")
#: Exit status for arguments that cannot be parsed.
_USAGE_ERROR = 2
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
    given = sys.argv[1:] if argv is None else argv
    words = [f[1] + os.path.expanduser(f[2]) if (f := _HOME.fullmatch(word)) else word for word in given]
    if words == ["--version"]:
        print(f"coliags {__version__}")
        sys.exit(0)
    try:
        command = tyro.cli(
            Command, prog="coliags", description=DESCRIPTION, args=words, config=(tyro.conf.FlagCreatePairsOff,)
        )
    except SystemExit as refused:
        if refused.code == _USAGE_ERROR and (meant := hint(words, Command)):
            print(f"coliags: {meant}", file=sys.stderr)
        raise
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
