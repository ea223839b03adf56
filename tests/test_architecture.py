"""The rules of the house, read from the sources."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "coliags_plugin"
COMPONENT_ROOMS = {"datamanagers", "fields", "renderers", "strategies", "losses", "metrics"}
UPPER_ROOMS = {"cli", "engine", "outputs"}
ROOMS = COMPONENT_ROOMS | UPPER_ROOMS
#: Folders of plain modules: like single ones, they know no room.
PLAIN = {"poses"}
#: Loaded when a command or component runs, never when a module is imported.
LAZY = {"open3d", "pycolmap", "numba", "gsplat", "viser", "nerfstudio"}

SOURCES = sorted(PACKAGE.rglob("*.py"))


def room_of(path: Path) -> str | None:
    """The room a file is in; None for the plain modules beside the rooms."""
    first = path.relative_to(PACKAGE).parts[0]
    return first if first in ROOMS else None


def imports(path: Path, top_level_only: bool = False) -> set[str]:
    """Every module a file imports, absolute."""
    tree = ast.parse(path.read_text())
    nodes = tree.body if top_level_only else ast.walk(tree)
    found = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found.add(node.module or "")
    return found


def rooms_imported(path: Path) -> set[str]:
    parts = (name.split(".") for name in imports(path))
    return {part[1] for part in parts if part[0] == "coliags_plugin" and len(part) > 1 and part[1] in ROOMS}


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_arrows_point_down(path):
    room, imported = room_of(path), rooms_imported(path)
    if room is None:
        assert not imported, "plain modules know no room"
    elif room in COMPONENT_ROOMS:
        assert imported <= {room}, "component rooms never import one another, nor what stands above them"
    elif room == "outputs":
        assert imported <= {"outputs"}, "outputs know neither engine nor components"
    elif room == "engine":
        assert "cli" not in imported


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_heavy_libraries_are_imported_late(path):
    loaded = {name.split(".")[0] for name in imports(path, top_level_only=True)}
    allowed = {"numba"} if "numba_kernels" in path.parts else set()
    assert not loaded & (LAZY - allowed)


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_habits(path):
    text = path.read_text()
    tree = ast.parse(text)
    assert ".cuda(" not in text, "device flows from inputs"
    assert "manual_seed(" not in re.sub(r"Generator\([^)]*\)\.manual_seed\(", "", text), "no global seeding"
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)]
    names = {call.func.id for call in calls}
    assert not names & {"eval", "exec"}
    if room_of(path) != "cli":
        assert "print" not in names, "libraries log"
    bare = [node for node in ast.walk(tree) if isinstance(node, ast.ExceptHandler) and node.type is None]
    assert not bare
    assert "method ==" not in text, "a method is a config, not a branch"


def test_rooms_are_where_they_should_be():
    assert {path.name for path in PACKAGE.iterdir() if path.is_dir() and path.name != "__pycache__"} == ROOMS | PLAIN
