"""The ``coliags`` command line, one module per subcommand; heavy libraries are imported when a command runs."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import Annotated

import tyro

from coliags_plugin.cli.ablate import AblateCommand
from coliags_plugin.cli.arguments import renamed_argument
from coliags_plugin.cli.check import CheckCommand
from coliags_plugin.cli.compare import CompareCommand
from coliags_plugin.cli.config import ConfigCommand
from coliags_plugin.cli.coverage import CoverageCommand
from coliags_plugin.cli.data import DataCommand
from coliags_plugin.cli.depth import DepthCommand
from coliags_plugin.cli.doctor import DoctorCommand
from coliags_plugin.cli.evaluate import EvaluateCommand
from coliags_plugin.cli.export import ExportCommand
from coliags_plugin.cli.import_splats import ImportCommand
from coliags_plugin.cli.list import ListCommand
from coliags_plugin.cli.mesh import MeshCommand
from coliags_plugin.cli.phantom import PhantomCommand
from coliags_plugin.cli.poses import PosesCommand
from coliags_plugin.cli.reconstruct import ReconstructCommand
from coliags_plugin.cli.render import RenderCommand
from coliags_plugin.cli.report import ReportCommand
from coliags_plugin.cli.results import ResultsCommand
from coliags_plugin.cli.run import run_command
from coliags_plugin.cli.train import TrainCommand
from coliags_plugin.cli.view import ViewCommand
from coliags_plugin.cli.weights import WeightsCommand

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

#: Exit status for arguments that cannot be parsed.
_USAGE_ERROR = 2
DESCRIPTION = "Gaussian splatting for colonoscopy: training, evaluation and comparison of reconstruction methods."


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point of the ``coliags`` script. Exits with 0, 2 (bad input), 1 (failure) or 130 (interrupted)."""
    # OpenMP threads spin for milliseconds while they wait, which stalls a busy machine: beside other jobs on two cores,
    # decoding took up to 2000 ms instead of 40. A short spin keeps the speed of an idle machine and loses little on a
    # busy one. It is read when torch is first imported.
    os.environ.setdefault("GOMP_SPINCOUNT", "10000")
    try:
        command = tyro.cli(
            Command, prog="coliags", description=DESCRIPTION, args=argv, config=(tyro.conf.FlagCreatePairsOff,)
        )
    except SystemExit as refused:
        if refused.code == _USAGE_ERROR and (hint := renamed_argument(sys.argv[1:] if argv is None else argv)):
            print(f"coliags: {hint}", file=sys.stderr)
        raise
    except BrokenPipeError:  # the reader of the help has closed the pipe, as `head` does
        sys.stderr.close()
        sys.exit(1)
    sys.exit(run_command(command))
