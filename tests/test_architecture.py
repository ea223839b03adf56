"""The layers of the package, read from its imports."""

from __future__ import annotations

import ast
import re
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from coliags_plugin.results.hashing import code_files

PACKAGE = Path(__file__).parents[1] / "coliags_plugin"
ROOT = PACKAGE.name
#: Packages and top-level modules, from the bottom up. One of a layer imports lower layers and itself, never a sibling.
LAYERS = (
    {"core"},
    {"config"},
    {"contracts", "geometry"},
    {"datamanagers", "fields", "renderers", "modules", "strategies", "losses", "metrics"},
    {"reporting"},
    {"results"},
    {"engine", "phantom", "reconstruction"},
    {"surface"},
    {"export"},
    {"checks", "comparison"},
    {"pipeline", "testing"},
    {"api"},
    {"cli"},
)
RANK = {name: rank for rank, layer in enumerate(LAYERS) for name in layer}
#: Loaded when a command or component runs, never when a module is imported.
LAZY = {"open3d", "pycolmap", "numba", "triton", "gsply", "pooch", "requests", "viser", "nerfstudio", "ray"}
LAZY |= {"tensorboard", "wandb"}

SOURCES = {
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
}
#: Every module but the root.
COMPONENTS = [name for name in SOURCES if name != ROOT]


@cache
def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def imports(path: Path, top_level_only: bool = False) -> set[str]:
    """Every module that a file imports, absolute: at the top, within functions, and for type checkers alone."""
    tree = tree_of(path)
    modules = set()
    for node in tree.body if top_level_only else ast.walk(tree):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            parent = node.module or ""
            modules |= {
                f"{parent}.{alias.name}" if f"{parent}.{alias.name}" in SOURCES else parent for alias in node.names
            }
    return modules


@cache
def targets(path: Path) -> set[str]:
    """Modules of this package that a file names in strings, ``"module:Class"``, for them to be imported later."""
    constants = (node for node in ast.walk(tree_of(path)) if isinstance(node, ast.Constant))
    texts = {node.value for node in constants if isinstance(node.value, str)}
    return {text.partition(":")[0] for text in texts if ":" in text} & set(SOURCES)


def package_of(name: str) -> str:
    """The package, or top-level module, that a module belongs to."""
    return name.split(".")[1]


def test_imports_point_down():
    assert {package_of(name) for name in COMPONENTS} | {"modules"} == set(RANK)
    upwards = []
    for name in COMPONENTS:
        package = package_of(name)
        for imported in imports(SOURCES[name]):
            is_root = imported == ROOT  # which imports everything
            other = package if is_root or not imported.startswith(ROOT + ".") else package_of(imported)
            if is_root or (other != package and RANK[other] >= RANK[package]):
                upwards.append(f"{name} imports {imported}")
    assert upwards == []


def test_no_import_circle():
    graph = {name: {other for other in imports(path) if other in SOURCES} for name, path in SOURCES.items()}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" <- ".join(error.args[1]))


def test_only_the_registry_names_modules_in_strings():
    """A module imported by its name closes circles that no import statement shows; components are the one exception."""
    assert {name for name in COMPONENTS if targets(SOURCES[name])} == {f"{ROOT}.core.registry"}


def test_heavy_libraries_are_imported_late():
    early = []
    for name in COMPONENTS:
        path = SOURCES[name]
        loaded = {imported.split(".")[0] for imported in imports(path, top_level_only=True)}
        allowed = {name for name in ("numba", "triton") if f"{name}_kernels" in path.parts}
        early += [f"{name} imports {library}" for library in loaded & (LAZY - allowed)]
    assert early == []


def test_the_key_of_the_code_covers_all_that_the_engine_imports():
    """All but presentation, and those parts of results/ that compute none."""
    modules = set()
    todo = [name for name in COMPONENTS if package_of(name) == "engine"]
    while todo:
        name = todo.pop()
        if name in SOURCES and name != ROOT and name not in modules:
            modules.add(name)
            todo += imports(SOURCES[name]) | targets(SOURCES[name])
    left_out = {name for name in modules if SOURCES[name] not in code_files().values()}
    assert {package_of(name) for name in left_out} <= {"phantom", "reporting", "results"}
    assert "coliags_plugin.metrics.pixels" not in left_out


def test_habits():
    faults = []
    for name in COMPONENTS:
        text = SOURCES[name].read_text(encoding="utf-8")
        nodes = list(ast.walk(tree_of(SOURCES[name])))
        calls = {node.func.id for node in nodes if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)}
        bare = any(isinstance(node, ast.ExceptHandler) and node.type is None for node in nodes)
        seeded = "manual_seed(" in re.sub(r"Generator\([^)]*\)\.manual_seed\(", "", text)
        checks = {
            "device flows from inputs": ".cuda(" in text,
            "no global seeding": seeded,
            "no eval or exec": bool(calls & {"eval", "exec"}),
            "libraries log": package_of(name) != "cli" and "print" in calls,
            "no bare except": bare,
            "a method is a config, not a branch": "method ==" in text,
        }
        faults += [f"{name}: {rule}" for rule, broken in checks.items() if broken]
    assert faults == []
