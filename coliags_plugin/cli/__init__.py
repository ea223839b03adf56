"""The ``coliags`` command line, one module per subcommand; heavy libraries are imported when a command runs."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import Annotated

import tyro

from coliags_plugin.cli.ablate import Ablate
from coliags_plugin.cli.check import Check
from coliags_plugin.cli.compare import Compare
from coliags_plugin.cli.config import Config
from coliags_plugin.cli.coverage import Coverage
from coliags_plugin.cli.data import Data
from coliags_plugin.cli.depth import Depth
from coliags_plugin.cli.doctor import Doctor
from coliags_plugin.cli.evaluate import Evaluate
from coliags_plugin.cli.export import Export
from coliags_plugin.cli.import_splats import Import
from coliags_plugin.cli.list import List
from coliags_plugin.cli.mesh import Mesh
from coliags_plugin.cli.phantom import Phantom
from coliags_plugin.cli.poses import Poses
from coliags_plugin.cli.reconstruct import Reconstruct
from coliags_plugin.cli.render import Render
from coliags_plugin.cli.report import Report
from coliags_plugin.cli.results import Results
from coliags_plugin.cli.run import run_command
from coliags_plugin.cli.train import Train
from coliags_plugin.cli.view import View
from coliags_plugin.cli.weights import Weights

Command = (
    Annotated[Reconstruct, tyro.conf.subcommand("reconstruct")]
    | Annotated[Phantom, tyro.conf.subcommand("phantom")]
    | Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Evaluate, tyro.conf.subcommand("eval")]
    | Annotated[Render, tyro.conf.subcommand("render")]
    | Annotated[Coverage, tyro.conf.subcommand("coverage")]
    | Annotated[Mesh, tyro.conf.subcommand("mesh")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[Import, tyro.conf.subcommand("import")]
    | Annotated[View, tyro.conf.subcommand("view")]
    | Annotated[Compare, tyro.conf.subcommand("compare")]
    | Annotated[Ablate, tyro.conf.subcommand("ablate")]
    | Annotated[Report, tyro.conf.subcommand("report")]
    | Annotated[Results, tyro.conf.subcommand("results")]
    | Annotated[Poses, tyro.conf.subcommand("poses")]
    | Annotated[List, tyro.conf.subcommand("list")]
    | Annotated[Config, tyro.conf.subcommand("config")]
    | Annotated[Data, tyro.conf.subcommand("data")]
    | Annotated[Depth, tyro.conf.subcommand("depth")]
    | Annotated[Check, tyro.conf.subcommand("check")]
    | Annotated[Weights, tyro.conf.subcommand("weights")]
    | Annotated[Doctor, tyro.conf.subcommand("doctor")]
)

DESCRIPTION = "Gaussian splatting for colonoscopy: training, evaluation and comparison of reconstruction methods."


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point of the ``coliags`` script. Exits with 0, 2 (bad input), 1 (failure) or 130 (interrupted)."""
    # OpenMP threads spin for milliseconds while they wait, which stalls a busy machine: beside other jobs on two cores,
    # decoding took up to 2000 ms instead of 40. A short spin keeps the speed of an idle machine and loses little on a
    # busy one. It is read when torch is first imported.
    os.environ.setdefault("GOMP_SPINCOUNT", "10000")
    try:
        command = tyro.cli(
            Command,
            prog="coliags",
            description=DESCRIPTION,
            args=argv,
            config=(tyro.conf.FlagCreatePairsOff,),
        )
    except BrokenPipeError:  # the reader of the help has closed the pipe, as `head` does
        sys.stderr.close()
        sys.exit(1)
    sys.exit(run_command(command))
