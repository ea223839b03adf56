"""``coliags check`` and ``coliags mesh`` as a user meets them."""

from __future__ import annotations

import io
import re
import sys
from pathlib import Path

import pytest

from coliags_plugin.api.runs import Run
from coliags_plugin.checks.results import CheckResult, line, summary
from coliags_plugin.core import registry
from coliags_plugin.testing import METHOD_CHECKS, name_of_check
from tests.commands import refused, run
from tests.scenes import write_wall
from tests.surface.meshing.exact import exact_run

PLUGIN = """
from coliags_plugin.contracts import Loss, LossSettings


class SharpLoss(Loss):
    Settings = LossSettings

    def __call__(self, step):
        return step.output.rgb.sharpness()


COMPONENTS = {"losses": {"sharp": SharpLoss}}
"""
#: Enough of a method to be checked in a second.
SMALL = ("--steps", 10, "--set", "datamanager.points_count=500")


@pytest.mark.thorough
def test_a_sound_method(tmp_path_factory, capsys, monkeypatch):
    temporary = tmp_path_factory.mktemp("temporary")  # where the phantom stays for other tests
    monkeypatch.setattr("tempfile.tempdir", str(temporary))
    assert run("check", "method", "3dgs", *SMALL) == 0
    *lines, last = capsys.readouterr().out.splitlines()
    names = sorted(map(name_of_check, METHOD_CHECKS), key=len, reverse=True)
    assert [re.match(rf"[✓-] ({'|'.join(names)}) ", text)[1] for text in lines] == [*map(name_of_check, METHOD_CHECKS)]
    assert re.fullmatch(r"20 passed, 0 failed, 1 skipped in \d+\.\d s", last)
    assert not list(temporary.glob("coliags-check-*"))


def test_a_crash_in_a_users_file_is_a_failed_check(tmp_path, capsys, monkeypatch):
    (tmp_path / "sharp.py").write_text(PLUGIN)
    monkeypatch.setenv("COLIAGS_PLUGIN_PATH", str(tmp_path / "sharp.py"))
    monkeypatch.setattr(registry, "losses", None)
    monkeypatch.setitem(registry.REGISTRIES, "losses", registry.Registry("losses", _BUILT_IN, "loss"))
    sharp = ("--set", "losses.sharp={name: sharp, weight: 0.1}", "--traceback")
    assert run("check", "method", "3dgs", *SMALL, *sharp) == 1
    out = capsys.readouterr().out
    (failed,) = re.findall(r"^✗ .*$", out, re.MULTILINE)
    assert re.search(
        r"trains .* AttributeError: 'Tensor' object has no attribute 'sharpness' \(.*sharp\.py:9\)$", failed
    )
    assert re.search(r"^- learns +needs 'trains'$", out, re.MULTILINE)
    assert re.search(r"^✓ groups ", out, re.MULTILINE)
    assert "Traceback (most recent call last)" in out.split(" failed,")[1]


_BUILT_IN = {name: registry.losses._targets[name] for name in ("l1", "d-ssim")}


def test_what_is_kept_can_be_looked_at(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert run("check", "method", "3dgs", "--data", write_wall(tmp_path / "wall", frames=17), *SMALL, "--keep") == 0
    folder = Path(capsys.readouterr().out.splitlines()[-1].removeprefix("written: "))
    assert (folder / "run" / "eval" / "paper" / "metrics.json").is_file()
    assert not (folder / "phantom").exists()


def test_input_that_cannot_be_checked(tmp_path, capsys):
    assert "Did you mean 'coliags'" in refused(capsys, "check", "method", "colliags")
    assert "Expected 10 or more" in refused(capsys, "check", "method", "coliags", "--steps", 9)
    assert "no folder" in refused(capsys, "check", "method", "coliags", "--data", tmp_path / "gone")


def test_results_are_lines_that_every_encoding_can_print(monkeypatch):
    results = [CheckResult("one", "passed", "µ", 0.04), CheckResult("three", "skipped", "no")]
    assert [line(result, 5) for result in results] == ["✓ one      0.0 s  µ", "- three           no"]
    assert summary(results) == "1 passed, 0 failed, 1 skipped in 0.0 s"
    written = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, encoding="ascii", write_through=True))
    assert run("check", "method", "coliags", "--set", "field.voxels=1") == 1
    first, *others, _ = written.getvalue().decode("ascii").splitlines()
    assert re.match(r"\\u2717 resolves .* unknown key 'voxels'", first) and {text[0] for text in others} == {"-"}


# Meshes


def test_the_mesh_of_a_run_and_options_that_are_refused_before_it_is_made(tmp_path, capsys, monkeypatch):
    folder = tmp_path / "run"
    monkeypatch.setattr(Run, "__init__", lambda self, path, **_: setattr(self, "path", folder))
    monkeypatch.setattr(Run, "load", lambda self: exact_run(frames=9))
    assert "Did you mean 'depth'" in refused(capsys, "mesh", folder, "--set", "dept=median")
    assert "voxel_size" in refused(capsys, "mesh", folder, "--voxel", -1)
    assert run("mesh", folder, "--format", "stl") == 2 and not folder.exists()
    options = ("--voxel", 0.4, "--format", "ply", "glb", "--set", "depth=expected", "--texture")
    assert run("mesh", folder, *options) == 0
    assert f"written: {folder / 'mesh'}\n" in capsys.readouterr().out
    assert {path.name for path in (folder / "mesh").iterdir()} == {"mesh.ply", "mesh.glb", "mesh.json"}
    text = (folder / "mesh/mesh.json").read_text()
    assert '"voxel_size": 0.4' in text and '"depth": "expected"' in text and '"texture": 4.0' in text
