"""The wheel holds what it must, and nothing else."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from coliags_plugin import __version__

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder), str(ROOT)]
    subprocess.run(command, check=True, capture_output=True, timeout=300)
    (path,) = folder.glob("*.whl")
    return path


def test_wheel_contents(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        metadata = archive.read(next(name for name in names if name.endswith("METADATA"))).decode()
        scripts = archive.read(next(name for name in names if name.endswith("entry_points.txt"))).decode()
    sources = {path.relative_to(ROOT).as_posix() for path in (ROOT / "coliags_plugin").rglob("*.py")}
    configs = {
        f"coliags_plugin/{path.relative_to(ROOT).as_posix()}" for path in (ROOT / "method_configs").rglob("*.yaml")
    }
    assets = {path.relative_to(ROOT).as_posix() for path in (ROOT / "coliags_plugin/reporting/assets").iterdir()}
    assert len(assets) > 2 and sources | configs | assets | {"coliags_plugin/py.typed"} <= names
    assert {name.split("/")[0] for name in names} == {"coliags_plugin", f"coliags_plugin-{__version__}.dist-info"}
    assert "License-Expression: Apache-2.0" in metadata
    assert f"Version: {__version__}" in metadata
    assert "coliags = coliags_plugin.cli:main" in scripts
    assert any(name.endswith("licenses/LICENSE") for name in names)


def test_methods_are_found_inside_an_installed_wheel(wheel, tmp_path):
    """Unpacked alone, as pip would install it: the configs come from inside the package."""
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path)
    code = "import coliags_plugin.config.method_files as m; print(m.method_folder()); print(*m.method_names())"
    shown = subprocess.run(
        [sys.executable, "-I", "-c", f"import sys; sys.path.insert(0, {str(tmp_path)!r}); {code}"],
        check=True,
        capture_output=True,
        text=True,
        timeout=60,
    ).stdout.splitlines()
    assert shown[0] == str(tmp_path / "coliags_plugin" / "method_configs")
    assert {"coliags", "scaffold-gs", "scaffold-gs-depth", "ablations/none"} <= set(shown[1].split())
