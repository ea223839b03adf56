"""``coliags mesh``: what it passes on, prints and refuses."""

from __future__ import annotations

import pytest

from coliags_plugin.api.runs import Run
from tests.commands import refused, run
from tests.surface.meshing.exact import exact_run


@pytest.fixture
def run_folder(tmp_path, monkeypatch):
    """A run whose depth is exact; ``Run`` finds it whatever folder it is given."""
    folder = tmp_path / "run"
    monkeypatch.setattr(Run, "__init__", lambda self, path, **_: setattr(self, "path", folder))
    monkeypatch.setattr(Run, "load", lambda self: exact_run(frames=9))
    return folder


def test_the_mesh_of_a_run(run_folder, capsys):
    assert (
        run("mesh", run_folder, "--voxel", 0.4, "--format", "ply", "glb", "--set", "depth=expected", "--texture") == 0
    )
    assert f"written: {run_folder / 'mesh'}\n" in capsys.readouterr().out
    assert {path.name for path in (run_folder / "mesh").iterdir()} == {"mesh.ply", "mesh.glb", "mesh.json"}
    text = (run_folder / "mesh/mesh.json").read_text()
    assert '"voxel_size": 0.4' in text and '"depth": "expected"' in text and '"texture": 4.0' in text


def test_options_are_refused_before_anything_is_made(run_folder, capsys):
    assert "Did you mean 'depth'" in refused(capsys, "mesh", run_folder, "--set", "dept=median")
    assert "voxel_size" in refused(capsys, "mesh", run_folder, "--voxel", -1)
    assert run("mesh", run_folder, "--format", "stl") == 2
    assert not run_folder.exists()
