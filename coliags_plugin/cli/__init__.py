"""The ``coliags`` command: one small file per subcommand; nothing heavy is imported before a command runs."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import Annotated

import tyro

from coliags_plugin.cli.config import Config
from coliags_plugin.cli.doctor import Doctor
from coliags_plugin.cli.evaluate import Evaluate
from coliags_plugin.cli.list import List
from coliags_plugin.cli.phantom import Phantom
from coliags_plugin.cli.render import Render
from coliags_plugin.cli.report import Report
from coliags_plugin.cli.run import run_command
from coliags_plugin.cli.train import Train

Command = (
    Annotated[Phantom, tyro.conf.subcommand("phantom")]
    | Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Evaluate, tyro.conf.subcommand("eval")]
    | Annotated[Render, tyro.conf.subcommand("render")]
    | Annotated[Report, tyro.conf.subcommand("report")]
    | Annotated[List, tyro.conf.subcommand("list")]
    | Annotated[Config, tyro.conf.subcommand("config")]
    | Annotated[Doctor, tyro.conf.subcommand("doctor")]
)

DESCRIPTION = "Gaussian splatting for colonoscopy: reconstruct, compare, take the result away."


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point of the ``coliags`` script. Exits with 0, 2 (bad input), 1 (failure) or 130 (interrupted)."""
    # OpenMP threads that spin while they wait stall a busy machine: beside two other jobs on two cores, decoding took
    # 2000 ms with spinning threads and 90 ms with sleeping ones. It is read when torch is first imported.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    command = tyro.cli(
        Command,
        prog="coliags",
        description=DESCRIPTION,
        args=argv,
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    sys.exit(run_command(command))
