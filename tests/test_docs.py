"""The documentation is true: examples run, commands parse, tables are the code's, citations lead somewhere."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from functools import cache
from pathlib import Path
from runpy import run_path
from typing import Any

import pytest
import yaml

from coliags_plugin import cli
from coliags_plugin.cli.checks import CheckMethodCommand
from coliags_plugin.cli.methods import ConfigCommand
from coliags_plugin.cli.runs import TrainCommand
from coliags_plugin.cli.scenes import PhantomCommand
from coliags_plugin.cli.texts import depth_commands
from coliags_plugin.config.method_config import MethodConfig, OptimizerSettings, ScheduleSettings, load_method
from coliags_plugin.config.reference import meanings, type_text
from coliags_plugin.core.registry import REGISTRIES
from coliags_plugin.core.render_output import OUTPUTS
from coliags_plugin.core.splits import held_out
from coliags_plugin.engine.samplers import PURPOSES
from coliags_plugin.phantom.settings import PRESETS
from tests.commands import run
from tests.scenes import SETS, write_wall

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))]
SOURCES = sorted(
    path
    for folder in ("coliags_plugin", "tests", "method_configs", "benchmarks", "docs")
    for path in (ROOT / folder).rglob("*")
    if path.suffix in (".py", ".yaml", ".md") and path != Path(__file__) and path.parent != DOCS / "tools"
)


def name_of(path: Path) -> str:
    return str(path.relative_to(ROOT))


def fenced(page: Path, language: str) -> list[str]:
    """The page's code blocks of one language, indented ones included."""
    blocks = re.findall(rf"^( *)```{language}\n(.*?)^\1```$", page.read_text(), re.DOTALL | re.MULTILINE)
    return [re.sub(rf"^{indent}", "", block, flags=re.MULTILINE) for indent, block in blocks]


def table_rows(page: str, header: str) -> list[list[str]]:
    """Cells of the table whose first line is ``header``, without code marks."""
    lines = (DOCS / page).read_text().splitlines()
    start = lines.index(header) + 2
    rows = []
    for line in lines[start:]:
        if not line.startswith("|"):
            break
        rows.append([cell.strip().replace("`", "") for cell in line.strip("|").split("|")])
    return rows


# Citations


@cache
def headings(page: Path) -> list[str]:
    prose = re.sub(r"^ *```.*?^ *```$", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    return re.findall(r"^#+ (.+)$", prose, re.MULTILINE)


@cache
def sections(page: Path) -> set[str]:
    """Numbers that head a section; a page's title, such as "5 methods compared", heads none."""
    return {matches.group() for title in headings(page)[1:] if (matches := re.match(r"\d+(\.\d+)*(?= )", title))}


def cited(text: str) -> list[tuple[str, list[str]]]:
    """Pages named in a text, each with the section numbers that follow it, over the ends of commented lines too."""
    text = re.sub(r"\s*\n\s*(?:#:?|\|)?\s*", " ", text)
    number = r"\d+(?:\.\d+)*(?!\w)"
    named = r"(?<![\w/-])((?:docs/)?(?:layouts/|rivals/)?[\w-]+\.md)"
    pattern = rf"{named}(?:`*,? +({number}(?:(?:, | and ){number})*))?"
    return [(page, re.findall(number, numbers or "")) for page, numbers in re.findall(pattern, text)]


def wrong_citations(
    text: str, folders: tuple[Path, ...], elsewhere: tuple[str, ...] = ()
) -> list[tuple[str, set[str]]]:
    """Citations of a text that lead nowhere: a page in none of the folders, or sections that the page lacks."""
    wrong = []
    for page, numbers in cited(text):
        target = next((folder / page for folder in folders if (folder / page).is_file()), None)
        missing = set(numbers) if target is None else set(numbers) - sections(target)
        if missing or (target is None and page not in elsewhere):
            wrong.append((page, missing))
    return wrong


def test_citations_and_links_lead_to_a_section():
    wrong = {}
    for path in {*SOURCES, *PAGES}:
        text, is_page = path.read_text(), path.suffix == ".md"
        wrong[path] = wrong_citations(text, (ROOT, path.parent, DOCS) if is_page else (ROOT,))
        titles = re.findall(r"docs/([\w/-]+\.md)`*, section \"([^\"]+)\"", text)
        wrong[path] += [(page, title) for page, title in titles if title not in headings(DOCS / page)]
        if is_page:
            links = re.findall(r"\]\(([^)#:]+)\)", text)
            wrong[path] += [target for target in links if not (path.parent / target).exists()]
            wrong[path] += re.findall(r"/work\b|\.\./shared|\bspec/|/tmp/", text, re.IGNORECASE)  # not of the project
    assert {path: faults for path, faults in wrong.items() if faults} == {}


@pytest.mark.parametrize("name", ["options", "methods"])
def test_generated_pages_cite_rightly(name):
    assert wrong_citations(generated(name), (ROOT, DOCS), ("options.md", "method_table.md")) == []


@pytest.mark.parametrize("page", sorted(DOCS.rglob("*.md")), ids=name_of)
def test_sections_are_numbered_in_order_and_references_lead_to_one(page):
    matches = [re.match(r"\d+(\.\d+)*(?= )", title) for title in headings(page)]
    numbers = [tuple(map(int, each.group().split("."))) for each in matches if each]
    assert numbers == sorted(set(numbers))
    referred = re.findall(r"(?<!\w)\((\d(?:\.\d)?)\)", page.read_text())
    assert not sections(page) or set(referred) <= sections(page)


# Commands


def commands() -> list[tuple[str, str]]:
    """Every ``coliags`` command of README and docs: lines of shell blocks, and code in running text."""
    typed = []
    for page in PAGES:
        lines = [line for block in fenced(page, "sh") for line in block.splitlines()]
        prose = re.sub(r"^ *```.*?^ *```$", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
        lines += re.findall(r"`(coliags [^`]+)`", prose)
        typed += [(name_of(page), line.strip()) for line in lines if re.match(r"(\w+=\S+ +)*coliags ", line.strip())]
    return typed


@pytest.mark.parametrize("page", ["../README.md", "data.md", "depth.md", "poses.md", "layouts/c3vd-v2.md"])
def test_pages_tell_the_same_way_to_depth_as_messages(page):
    lines = [line for block in fenced(DOCS / page, "sh") for line in block.splitlines()]
    for command in depth_commands(Path("SCENE")):
        assert any(line.startswith(command) for line in lines)


#: Commands that running text names alone.
ALONE = {*cli.COMMANDS, "check method", "check installation"}
#: Methods that docs/example_package adds; tests/test_third_party_package.py trains them.
OF_THE_EXAMPLE = {path.stem for path in (DOCS / "example_package").rglob("*.yaml")}


@pytest.mark.parametrize(("page", "command"), commands(), ids=lambda value: value.replace("/", "."))
def test_commands_parse(page, command, monkeypatch, capsys):
    words, caught = shlex.split(command, comments=True), []
    argv = words[words.index("coliags") + 1 : words.index(">") if ">" in words else None]
    if " ".join(argv) in ALONE:
        argv.append("--help")  # the subcommand's name alone, in running text
    monkeypatch.setattr(cli, "run_command", lambda command: caught.append(command) or 0)
    assert run(*argv) == 0
    parsed_command = getattr(caught[0], "subcommand", caught[0]) if caught else None
    is_of_method = isinstance(parsed_command, (TrainCommand, ConfigCommand, CheckMethodCommand))
    if is_of_method and parsed_command.method not in OF_THE_EXAMPLE and not parsed_command.method.endswith(".yaml"):
        # A format's page speaks of scenes in that format.
        format_of_page = [f"datamanager.name={Path(page).stem}"] if "layouts" in page else []
        changes = parsed_command.settings if isinstance(parsed_command, TrainCommand) else parsed_command.set
        assert load_method(parsed_command.method, [*format_of_page, *changes]).config
    if isinstance(parsed_command, PhantomCommand):
        made = []
        monkeypatch.setattr("coliags_plugin.phantom.generate.generate", lambda *a, **k: made.append(a))
        parsed_command.run()
        assert made


def test_every_command_is_documented():
    typed = {re.sub(r".*?\bcoliags ", "", command).split()[0] for _, command in commands()}
    assert typed >= set(cli.COMMANDS)


# The tutorial


#: Commands, in one process, which loads torch once.
ONE_AFTER_THE_OTHER = """
import json, sys
from coliags_plugin.cli import main
for words in json.loads(sys.argv[1]):
    try:
        main(words)
    except SystemExit as ended:
        if ended.code:
            raise
"""


@pytest.mark.thorough
def test_the_tutorial_runs_as_written(tmp_path):
    scene = write_wall(tmp_path / "SCENE")
    for language, name in (("python", "edges.py"), ("yaml", "coliags-edges.yaml")):
        (block,) = [block for block in fenced(DOCS / "configs.md", language) if block.startswith(f"# {name}\n")]
        (tmp_path / name).write_text(block)
    (shell,) = [block for block in fenced(DOCS / "configs.md", "sh") if "coliags-edges.yaml" in block]
    environment, commands = dict(os.environ), []
    for line in shell.splitlines():
        words = shlex.split(line)
        if words[0] == "export":
            environment.update([words[1].split("=", maxsplit=1)])
            continue
        assert words.pop(0) == "coliags"
        if words[0] == "train":
            words += SETS
        commands.append(words)
    argv = [sys.executable, "-c", ONE_AFTER_THE_OTHER, json.dumps(commands)]
    options = {"cwd": tmp_path, "env": environment, "capture_output": True, "text": True, "timeout": 120}
    process = subprocess.run(argv, check=False, **options)
    assert process.returncode == 0, process.stderr
    assert re.search(r"^ *edges\b", process.stdout, re.MULTILINE), "listed"
    last = json.loads((tmp_path / "RUN" / "metrics.jsonl").read_text().splitlines()[-1])
    assert last["step"] == 2
    assert 0.0 < last["terms"]["edges"] < 0.5
    assert yaml.safe_load((tmp_path / "RUN" / "config.yaml").read_text())["losses"]["edges"]["apart"] == 1
    assert (tmp_path / "RUN" / "eval" / "paper" / "metrics.json").is_file()
    assert scene.is_dir()


def test_yaml_examples_are_valid_methods(tmp_path):
    examples = [block for block in fenced(DOCS / "configs.md", "yaml") if "name: edges" not in block]
    assert len(examples) == 3
    for number, block in enumerate(examples):
        (tmp_path / f"{number}.yaml").write_text(block)
        assert load_method(str(tmp_path / f"{number}.yaml")).config


# Tables


def as_written(value: Any) -> str:
    """A default as the tables write it."""
    if isinstance(value, tuple):
        value = list(value)
    return value if isinstance(value, str) else json.dumps(value)


def test_the_table_of_presets_is_the_presets():
    cells = {row[0]: row[1:] for row in table_rows("phantom.md", "| | `c3vd`, the default | `strong` |")}
    for column, name in enumerate(("c3vd", "strong")):
        preset = PRESETS[name]
        assert cells["light_offset, mm"][column] == f"({', '.join(f'{value:g}' for value in preset.light_offset)})"
        assert cells["spread_law, spread"][column] == f"{preset.spread_law}, {preset.spread:g}"
        for setting in ("vignetting", "white_balance_drift", "gain"):
            assert cells[setting][column] == f"{getattr(preset, setting)}".removesuffix(".0")
        assert cells["tilt, degrees"][column] == f"{preset.tilt:g}"
        turns = ", ".join(f"{value:g}" for value in preset.turn)
        assert cells["yaw, pitch, roll of the pullback, degrees"][column] == turns
        assert cells["turn of the rotation path, degrees"][column] == f"{preset.scan:g}"
        assert cells["sideways, mm"][column] == f"{preset.wobble[0]:g} to {preset.wobble[1]:g}"


def test_every_key_of_a_method_is_in_the_table():
    keys = [row[0] for row in table_rows("configs.md", "| key | what |")]
    assert sorted(keys) == sorted(["base", *MethodConfig.model_fields])
    options = [(row[0], row[1]) for row in table_rows("configs.md", "| option | default | what |")]
    fields = OptimizerSettings.model_fields
    assert options == [(key, "" if field.is_required() else as_written(field.default)) for key, field in fields.items()]
    text_of_page = (DOCS / "configs.md").read_text()
    for key, field in ScheduleSettings.model_fields.items():
        assert re.search(rf"`{key}`\s+\({field.default}\b", text_of_page), key


def test_rates_in_the_table_are_coliags():
    rows_told = table_rows("methods.md", "| group | rate | final rate | |")
    rates = load_method("coliags").config.optimizers
    assert [row[0] for row in rows_told] == list(rates)
    for name, rate, final, _ in rows_told:
        assert float(rate) == rates[name].lr
        assert (float(final) if final else None) == rates[name].final_lr


def test_outputs_purposes_exit_statuses_and_protocols_are_all_told():
    assert [row[0] for row in table_rows("conventions.md", "| output | what |")] == list(OUTPUTS)
    assert [row[0] for row in table_rows("conventions.md", "| purpose | decides |")] == list(PURPOSES)
    assert [row[0] for row in table_rows("conventions.md", "| status | meaning |")] == ["0", "1", "2", "130"]
    page = (DOCS / "protocols.md").read_text()
    for name in REGISTRIES["protocols"]:
        assert f"`{name}` (version {REGISTRIES['protocols'].get(name).version})" in page


def test_test_frames_of_the_sequences_are_counted_rightly():
    rows = table_rows("layouts/c3vd.md", "| sequence | frames | test | sequence | frames | test |")
    counts = [tuple(map(int, row[at + 1 : at + 3])) for row in rows for at in (0, 3)]
    assert len(counts) == 22
    assert sum(frames for frames, _ in counts) == 10_015
    for frames, test in counts:
        assert held_out("every-8th", frames).sum() == test


# Pages of the site that are generated

METHODS = sorted(path.stem for path in (ROOT / "method_configs").glob("*.yaml"))


@cache
def tool(name: str) -> dict[str, Any]:
    """A program of docs/tools."""
    return run_path(str(DOCS / "tools" / f"{name}.py"))


@cache
def generated(name: str) -> str:
    """The page that a program of docs/tools makes."""
    return tool(name)["page"]()


@pytest.mark.parametrize("kind", REGISTRIES)
def test_the_page_of_options_has_each_with_its_range_and_meaning(kind):
    text = generated("options")
    for name in REGISTRIES[kind]:
        if REGISTRIES[kind].source(name) != "built in":  # of tests that ran before
            continue
        assert f"### {kind}: {name}\n" in text
        settings = getattr(REGISTRIES[kind].get(name), "Settings", None)
        for option, field in {} if settings is None else settings.model_fields.items():
            rows = re.findall(rf"^\| `{option}` \| (.+) \| (.+) \| (.+) \|$", text, re.MULTILINE)
            assert rows, f"{name}: {option} is not there"
            assert any(
                range_text.startswith(type_text(field.annotation, field.metadata).replace("|", "\\|"))
                for range_text, _, _ in rows
            )
            for limit in field.metadata:
                bounds = [f"{getattr(limit, side):g}" for side in ("ge", "le", "gt", "lt") if hasattr(limit, side)]
                assert any(all(bound in range_text for bound in bounds) for range_text, _, _ in rows), (
                    f"{name}: range of {option}"
                )


def test_the_page_of_options_has_the_settings_of_commands_with_their_meaning():
    text = generated("options")
    for name, settings in tool("options")["COMMANDS"].items():
        section = text.split(f"\n### {name}\n")[1].split("\n### ")[0]
        for option, field in settings.model_fields.items():
            row = f"| `{option}` | {type_text(field.annotation, field.metadata)} | "
            assert row in section, f"{name}: {option}"
            assert tool("options")["as_markdown"](meanings(settings)[option]) in section


@pytest.mark.parametrize("name", METHODS)
def test_the_table_of_methods_has_every_method_and_constant_with_its_source(name):
    text = generated("methods")
    assert f"\n### {name}\n" in text and f"| `{name}` | " in text
    for path, _, source in tool("methods")["constants"](name):
        assert source and f"`{path[-1]}` " in text and source in text, ".".join(path)


# Tables of results


@pytest.mark.thorough
def test_tables_of_the_page_are_those_of_the_archive():
    assert tool("results")["main"]("tables", "--check") == 0
