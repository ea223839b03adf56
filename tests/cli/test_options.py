"""Options that commands pass to functions by the names of their arguments."""

from __future__ import annotations

from dataclasses import fields
from inspect import signature

import pytest

from coliags_plugin.api.comparing import report
from coliags_plugin.api.runs import Run
from coliags_plugin.api.scenes import reconstruct
from coliags_plugin.api.training import import_splats, train
from coliags_plugin.cli.comparing import CompareCommand
from coliags_plugin.cli.making_runs import ImportCommand, TrainCommand
from coliags_plugin.cli.reconstruct import ReconstructCommand
from coliags_plugin.cli.results import ReportCommand
from coliags_plugin.cli.run_outputs import CoverageCommand, MeshCommand, RenderCommand
from coliags_plugin.comparison.compare import make_request
from coliags_plugin.execution.executors import ExecutionOptions


@pytest.mark.parametrize(
    ("command", "functions", "handled"),
    [
        (TrainCommand, [train], "set format logger view port json"),
        (ImportCommand, [import_splats], "format json"),
        (RenderCommand, [Run.write_renders], "path light flatten channel data device json"),
        (CoverageCommand, [Run.coverage], "path set data device json"),
        (MeshCommand, [Run.mesh], "path voxel color texture set format data device json"),
        (ReportCommand, [report], "paths format json"),
        (CompareCommand, [make_request, ExecutionOptions], "output dry_run set json"),
        (
            ReconstructCommand,
            [reconstruct],
            "camera params diameter start end every frames_per_second size method steps set json",
        ),
    ],
    ids=lambda value: getattr(value, "__name__", None),
)
def test_an_option_is_an_argument_of_the_function_or_handled_by_the_command(command, functions, handled):
    arguments = {name for function in functions for name in signature(function).parameters}
    assert {field.name for field in fields(command)} - arguments == set(handled.split())
