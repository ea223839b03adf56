"""Options, whose classes the command line, the Python API and the engine share."""

from __future__ import annotations

from dataclasses import MISSING, fields
from inspect import signature
from pathlib import Path

import pytest

import coliags_plugin as cp
from coliags_plugin.cli import runs
from coliags_plugin.cli.comparing import CompareCommand, ReportCommand
from coliags_plugin.cli.reconstruct import ReconstructCommand
from coliags_plugin.config.options import Options, TrainOptions, takes


@pytest.mark.parametrize(
    ("command", "function", "own"),
    [
        (runs.TrainCommand, cp.train, "view port json"),
        (runs.ImportCommand, cp.import_splats, "json"),
        (runs.EvaluateCommand, cp.Run.evaluate, "path data device json"),
        (runs.RenderCommand, cp.Run.write_renders, "path data device json light flatten"),
        (runs.CoverageCommand, cp.Run.coverage, "path data device json"),
        (runs.MeshCommand, cp.Run.mesh, "path data device json"),
        (runs.ViewCommand, cp.Run.save_view, "path data device json host port open"),
        (CompareCommand, cp.compare, "dry_run json"),
        (ReportCommand, cp.report, "paths json"),
        (
            ReconstructCommand,
            cp.reconstruct,
            "camera params diameter start end every frames_per_second size method steps json",
        ),
    ],
    ids=lambda value: getattr(value, "__name__", None),
)
def test_a_command_has_the_options_of_its_function_whose_help_tells_them(command, function, own):
    shown = signature(function).parameters
    (kind,) = [base for base in command.__mro__ if Options in base.__bases__]
    assert {field.name for field in fields(command)} - {*shown} == set(own.split())
    for name in {field.name for field in fields(kind)} - {"data", "data_format", "device", "overwrite"}:
        assert name in shown and f"\n    {name}: " in function.__doc__


def test_options_are_given_as_an_object_or_by_name_with_texts_and_mappings():
    @takes(TrainOptions)
    def told(first, options, *, last=0):
        """What was given."""
        return first, options, last

    first, options, last = told(1, "coliags", "SCENE", settings={"a.b": None}, last=2)
    assert (first, options.data, options.settings, last) == (1, Path("SCENE"), ("a.b=null",), 2)
    assert told(1, options) == (1, options, 0)
    with pytest.raises(TypeError, match="seeds"):
        told(1, "coliags", "SCENE", seeds=1)


def test_comparisons_have_a_folder_where_none_is_named_and_their_commands_need_one():
    defaults = [signature(function).parameters["output"].default for function in (cp.compare, cp.ablate)]
    assert defaults == [Path("comparison"), Path("ablation")]
    (output,) = [field for field in fields(CompareCommand) if field.name == "output"]
    assert output.default is MISSING
