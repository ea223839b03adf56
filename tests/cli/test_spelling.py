"""Every command spells and orders its options alike, and ends alike."""

from __future__ import annotations

import dataclasses
import json
import re
import typing
from pathlib import Path

import pytest
import tyro

from coliags_plugin.cli import COMMANDS
from coliags_plugin.cli.arguments import hint, in_flags, subcommands, translate_for
from coliags_plugin.cli.summaries import print_summary
from coliags_plugin.core import __version__
from tests.commands import run

#: Options that come last, in this order.
TAIL = ("set", "format", "overwrite", "data", "device", "json")
#: Options of other names among these.
NAMES = dict.fromkeys(("layout", "estimate_format", "reference_format", "from_format", "data_format"), "format")
NAMES |= {"settings": "set", "formats": "format"}


def commands() -> dict[str, type]:
    """Every command by the name of its class."""
    kinds = [inner for kind in COMMANDS.values() for inner in subcommands(kind).values() or [kind]]
    return {kind.__name__: kind for kind in kinds}


@pytest.mark.parametrize("kind", commands().values(), ids=commands())
def test_options_come_in_one_order(kind):
    hints = typing.get_type_hints(kind, include_extras=True)
    positional = [name for name, hint in hints.items() if tyro.conf.Positional in getattr(hint, "__metadata__", ())]
    options = [field for field in dataclasses.fields(kind) if field.name not in positional]
    required = [field.name for field in options if field.default is dataclasses.MISSING]
    names = [NAMES.get(field.name, field.name) for field in options]
    assert not {"out", "save"} & set(hints) and "output" not in positional
    if "output" in names:
        assert set(names[: names.index("output")]) <= {"scenes", "data"} & set(required), "the subject comes first"
    tail = [name for name in names if name in TAIL and name not in required]
    assert tail == sorted(tail, key=TAIL.index)


def test_a_summary_for_people_and_for_scripts(capsys):
    argv = {"written": [Path("a b")], "then": ["coliags eval 'a b'"]}
    print_summary("two lines\nof text", {"step": 3}, **argv)
    assert capsys.readouterr().out == "two lines\nof text\nwritten: a b\nnext:    coliags eval 'a b'\n"
    print_summary("two lines\nof text", {"step": 3}, **argv, as_json=True)
    assert json.loads(capsys.readouterr().out) == {"step": 3, "written": ["a b"], "next": ["coliags eval 'a b'"]}
    print_summary("text", as_json=True)
    assert json.loads(capsys.readouterr().out) == {"summary": "text", "written": [], "next": []}


@pytest.mark.parametrize(
    ("argv", "meant"),
    [
        ("trian coliags --data SCENE", "train"),
        ("poses sfn FRAMES", "sfm"),
        ("train coliags --data SCENE --stepz=5", "--steps"),
        ("render RUN --no-vido", "--no-video"),
        ("weights lpips --form FOLDER", "--from"),
        ("data check SCENE --htm page.html", "--html"),
    ],
)
def test_the_nearest_command_or_option_is_named(argv, meant, capsys):
    assert run(*argv.split()) == 2
    assert capsys.readouterr().err.splitlines()[-1] == f"coliags: Did you mean '{meant}'?"


def test_nothing_is_suggested_where_nothing_is_near():
    for argv in ("", "xylophone", "train coliags", "train coliags --zzzzzz", "poses"):
        assert hint(argv.split(), COMMANDS) == ""


@pytest.mark.parametrize(
    ("message", "typed"),
    [
        ("Pass `resume=True`, or another `output`", "Pass --resume, or another --output"),
        ("`steps=3` and `data_format=c3vd`", "--steps 3 and --format c3vd"),
        ("Remove it with `losses.depth=null`", "Remove it with --set losses.depth=null"),
        ('`optimizers."field.x"={lr: 0.001}`', "--set 'optimizers.\"field.x\"={lr: 0.001}'"),
        ("no key `wants`; see `coliags eval RUN` and `method`", "no key `wants`; see `coliags eval RUN` and `method`"),
    ],
)
def test_options_that_a_message_quotes_are_flags_of_the_command(message, typed):
    translate_for(commands()["TrainCommand"]("coliags", Path("scene")))
    assert in_flags(message) == typed


def test_the_version(capsys):
    assert run("--version") == 0
    assert capsys.readouterr() == (f"coliags {__version__}\n", "")
    assert run("--help") == 0
    assert "--version" in capsys.readouterr().out


@pytest.mark.parametrize("kind", commands().values(), ids=commands())
def test_a_negated_flag_says_what_it_does(kind, capsys):
    with pytest.raises(SystemExit):
        tyro.cli(kind, args=["--help"], config=(tyro.conf.FlagCreatePairsOff,))
    rows = re.findall(r"--no-\S+ +(.*)", capsys.readouterr().out)
    assert all(row.startswith("Do not ") for row in rows)
