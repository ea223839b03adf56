"""Options, whose classes the command line, the Python API and the engine share."""

from __future__ import annotations

from dataclasses import MISSING, fields
from functools import partial
from inspect import signature
from pathlib import Path

import pytest

import coliags_plugin as cp
from coliags_plugin.cli import COMMANDS
from coliags_plugin.cli.comparing import CompareCommand
from coliags_plugin.config.options import TrainOptions, takes

#: Functions of the Python API by the class of their options.
FUNCTIONS = {
    function.__options__: function
    for function in (*map(partial(getattr, cp), cp.__all__), *vars(cp.Run).values())
    if hasattr(function, "__options__")
}


@pytest.mark.parametrize(("options", "function"), FUNCTIONS.items(), ids=lambda value: value.__name__)
def test_a_command_and_a_function_have_the_same_options_and_the_help_tells_them(options, function):
    assert any(issubclass(command, options) for command in COMMANDS.values())
    shown = signature(function).parameters
    for name in {field.name for field in fields(options)} - {"data", "data_format", "device", "overwrite"}:
        assert name in shown
        assert f"\n    {name}: " in function.__doc__ or "options: See :func:`compare`." in function.__doc__


def test_options_are_given_as_an_object_or_by_name_with_texts_and_mappings():
    @takes(TrainOptions)
    def told(first, options, *, last=0):
        """Return the arguments."""
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
