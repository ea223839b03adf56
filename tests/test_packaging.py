"""The wheel holds what it must, and nothing else."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from pathlib import Path

from coliags_plugin import __version__

ROOT = Path(__file__).parents[1]


def test_a_wheel_has_all_contents_and_finds_its_methods_where_it_is_installed(tmp_path):
    """Unpacked alone, as pip would install it: the configs come from inside the package."""
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(tmp_path), str(ROOT)]
    subprocess.run(command, check=True, capture_output=True, timeout=300)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        metadata = archive.read(next(name for name in names if name.endswith("METADATA"))).decode()
        scripts = archive.read(next(name for name in names if name.endswith("entry_points.txt"))).decode()
        archive.extractall(tmp_path)
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
    code = "import coliags_plugin.config.method_config as m; print(m.method_folder()); print(*m.method_files())"
    command = [sys.executable, "-I", "-c", f"import sys; sys.path.insert(0, {str(tmp_path)!r}); {code}"]
    shown = subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout.splitlines()
    assert shown[0] == str(tmp_path / "coliags_plugin" / "method_configs")
    assert {"coliags", "scaffold-gs", "scaffold-gs-depth", "ablations/none"} <= set(shown[1].split())
