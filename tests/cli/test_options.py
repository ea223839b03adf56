"""Options, whose classes the command line, the Python API and the engine share; commands spell and order them alike."""

from __future__ import annotations

import json
import re
import typing
from dataclasses import MISSING, fields
from functools import partial
from inspect import signature
from pathlib import Path

import pytest
import tyro

import coliags_plugin as cp
from coliags_plugin.cli import COMMANDS, checks, poses
from coliags_plugin.cli.texts import depth_commands, in_flags, print_summary, translate_for
from coliags_plugin.config.options import TrainOptions, takes
from coliags_plugin.core import __version__
from coliags_plugin.core.scenes import TO_GET_DEPTH
from tests.commands import run

#: Functions of the Python API by the class of their options.
FUNCTIONS = {
    function.__options__: function
    for function in (*map(partial(getattr, cp), cp.__all__), *vars(cp.Run).values())
    if hasattr(function, "__options__")
}


@pytest.mark.parametrize(("options", "function"), FUNCTIONS.items(), ids=lambda value: value.__name__)
def test_a_command_and_a_function_have_the_same_options_and_the_help_tells_them(options, function):
    assert any(issubclass(command, options) for command in commands().values())
    shown = signature(function).parameters
    for name in {field.name for field in fields(options)} - {"data", "data_format", "device", "overwrite"}:
        assert name in shown
        assert f"\n    {name}: " in function.__doc__


def test_options_are_given_as_an_object_or_by_name_with_texts_and_mappings():
    @takes(TrainOptions)
    def arguments(first, options, *, last=0):
        """Return the arguments."""
        return first, options, last

    first, options, last = arguments(1, "coliags", "SCENE", settings={"a.b": None}, last=2)
    assert (first, options.data, options.settings, last) == (1, Path("SCENE"), ("a.b=null",), 2)
    assert arguments(1, options) == (1, options, 0)
    with pytest.raises(TypeError, match="seeds"):
        arguments(1, "coliags", "SCENE", seeds=1)


#: Options that come last, in this order.
TAIL = ("set", "format", "overwrite", "data", "device", "json")
#: Options of other names among these.
NAMES = dict.fromkeys(("layout", "estimate_format", "reference_format", "from_format", "data_format"), "format")
NAMES |= {"settings": "set", "formats": "format"}


def commands() -> dict[str, type]:
    """Every command by the name of its class."""
    groups = {poses.PosesCommand: poses.Subcommand, checks.CheckCommand: checks.Subcommand}
    parts = [typing.get_args(part)[0] for union in groups.values() for part in typing.get_args(union)]
    return {kind.__name__: kind for kind in (*COMMANDS.values(), *parts) if kind not in groups}


@pytest.mark.parametrize("kind", commands().values(), ids=commands())
def test_options_come_in_one_order(kind):
    hints = typing.get_type_hints(kind, include_extras=True)
    positional = [name for name, hint in hints.items() if tyro.conf.Positional in getattr(hint, "__metadata__", ())]
    options = [field for field in fields(kind) if field.name not in positional]
    required = [field.name for field in options if field.default is MISSING]
    names = [NAMES.get(field.name, field.name) for field in options]
    assert not {"out", "save"} & set(hints) and "output" not in positional
    if "output" in names:
        assert set(names[: names.index("output")]) <= {"scenes", "data"} & set(required), "the subject comes first"
    tail = [name for name in names if name in TAIL and name not in required]
    assert tail == sorted(tail, key=TAIL.index)


def test_commands_for_depth_are_those_of_the_messages():
    assert re.findall("`(.+?)`", TO_GET_DEPTH) == depth_commands(Path("SCENE"))
    assert in_flags(TO_GET_DEPTH) == TO_GET_DEPTH
    estimate, train = depth_commands(Path("my scene"), ["--set", "frame_step=2"], ["datamanager.split=block"])
    assert estimate == "coliags depth 'my scene' --output 'my scene-depth' --set frame_step=2"
    assert train == "coliags train coliags-plus --data 'my scene-depth' --set datamanager.split=block"


def test_a_summary_for_people_and_for_scripts(capsys):
    argv = {"written": [Path("a b")], "then": ["coliags eval 'a b'"]}
    print_summary("two lines\nof text", {"step": 3}, **argv)
    assert capsys.readouterr().out == "two lines\nof text\nwritten: a b\nnext:    coliags eval 'a b'\n"
    print_summary("two lines\nof text", {"step": 3}, **argv, as_json=True)
    assert json.loads(capsys.readouterr().out) == {"step": 3, "written": ["a b"], "next": ["coliags eval 'a b'"]}
    print_summary("text", as_json=True)
    assert json.loads(capsys.readouterr().out) == {"summary": "text", "written": [], "next": []}


@pytest.mark.parametrize(
    ("message", "typed"),
    [
        ("Pass `resume=True`, or another `output`", "Pass --resume, or another --output"),
        ("`steps=3` and `data_format=c3vd`", "--steps 3 and --data-format c3vd"),
        ("Remove it with `losses.depth=null`", "Remove it with --set losses.depth=null"),
        ('`optimizers."field.x"={lr: 0.001}`', "--set 'optimizers.\"field.x\"={lr: 0.001}'"),
        ("no key `wants`; see `coliags eval RUN` and `method`", "no key `wants`; see `coliags eval RUN` and `method`"),
    ],
)
def test_options_that_a_message_quotes_are_flags_of_the_command(message, typed):
    translate_for(commands()["TrainCommand"]("coliags", Path("scene")))
    assert in_flags(message) == typed


def test_a_negated_flag_says_what_it_does_and_the_version_is_told(capsys):
    for kind in commands().values():
        with pytest.raises(SystemExit):
            tyro.cli(kind, args=["--help"], config=(tyro.conf.FlagCreatePairsOff,))
    rows = re.findall(r"--no-\S+ +(.*)", capsys.readouterr().out)
    assert rows and all(row.startswith("Do not ") for row in rows)
    assert run("--version") == 0
    assert capsys.readouterr() == (f"coliags {__version__}\n", "")
    assert run("--help") == 0
    assert "--version" in capsys.readouterr().out
