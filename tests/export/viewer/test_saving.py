"""A scene as one page."""

from __future__ import annotations

import re
import shutil
from html import unescape

import numpy as np
import pytest

import coliags_plugin as cp
from coliags_plugin.config.options import PageOptions, bytes_of
from coliags_plugin.core.errors import InputError
from coliags_plugin.export.baking import distillation
from coliags_plugin.export.viewer.page import most_visible, scene_page
from coliags_plugin.geometry.meshes.files import write_mesh
from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from coliags_plugin.surface.coverage.visibility import Level
from tests.commands import refused, run
from tests.export.splats.clouds import random_cloud


@pytest.fixture(autouse=True)
def few_steps(monkeypatch):
    monkeypatch.setattr(distillation, "STEPS", 3)


def test_the_command_writes_a_page_that_needs_no_network(anchors, tmp_path, capsys):
    page = tmp_path / "out" / "scene.html"
    assert run("view", anchors.path, "--output", page, "--size", "4.5MB") == 0
    text = page.read_text(encoding="utf-8")
    assert len(text.encode()) < 4_500_000
    summary, written = capsys.readouterr().out.strip().splitlines()
    assert written == f"written: {page}" and summary.partition(", ")[2] in text
    assert re.search(
        r"step 2; ([\d,]+) of \1 Gaussians; recorded light; \d+\.\d\d dB in that light on 2 held-out", summary
    )
    assert "<title>coliags on wall</title>" in text
    assert 'id="scene">{"layers":[{"about":"step 2; ' in text
    assert not re.search(r"""(?:src|href)\s*=\s*["']?(?:https?:)?//""", text)
    assert not re.findall(r"https?://", text)


def test_a_small_page_has_the_most_visible_gaussians(anchors):
    trained = anchors.load()
    whole = scene_page(trained)
    assert whole.facts["gaussians"] == whole.facts["baking"]["visible"]
    with pytest.raises(InputError) as error:
        scene_page(trained, PageOptions(size="1000"))
    empty = int(re.search(r"more than (\d+) bytes", str(error.value))[1])
    largest = empty + 10 * whole.facts["gaussians"]  # room for about half of them
    small = scene_page(trained, PageOptions(size=str(largest)))
    assert len(small.html.encode()) <= largest
    assert 0.4 < small.facts["gaussians"] / whole.facts["gaussians"] < 0.6
    assert small.facts["cost"]["test"]["export"]["psnr"] > 10


def test_sizes():
    sizes = {"20MB": 20_000_000, "1.5 mb": 1_500_000, "800kB": 800_000, "5000": 5000, "7b": 7}
    assert {text: bytes_of(text) for text in sizes} == sizes
    for text in ("", "MB", "-5MB", "5 MiB", "five"):
        with pytest.raises(InputError, match="a size in bytes, kB, MB or GB"):
            bytes_of(text)


def test_what_cannot_be_saved(run_of, tmp_path, capsys):
    run, radiance = run_of("coliags").path, run_of("reim-nerf-small", "field.width=8").path
    for argv, message in (
        ((run, "--output", tmp_path / "a.html", "--size", "1kB"), "a page of 1000 bytes"),
        ((run, "--output", tmp_path), "is a folder"),
        ((radiance, "--output", tmp_path / "a.html"), "has no Gaussians to draw in a browser"),
    ):
        assert message in refused(capsys, "view", *argv)
    assert list(tmp_path.iterdir()) == []


def test_a_report_embeds_a_scene(anchors, tmp_path):
    anchors.evaluate()
    (page,) = cp.report(anchors, tmp_path / "report.html", scene=anchors)
    text = page.read_text(encoding="utf-8")
    (embedded,) = re.findall(r'<iframe title="coliags on wall, seed 0" [^>]*data-page="([^"]*)"', text)
    assert 'id="scene"' in unescape(embedded) and "<title>coliags on wall</title>" in unescape(embedded)
    (plain,) = cp.report(anchors, tmp_path / "plain.html")
    assert "<iframe" not in plain.read_text(encoding="utf-8")


def test_a_page_of_a_method_without_a_lamp_speaks_of_no_light(run_of):
    text = scene_page(run_of("3dgs").load()).text
    assert "Gaussians; " in text and "recorded light" not in text


@pytest.mark.thorough
def test_meshes_of_the_run_are_layers_of_the_page(run_of):
    run = run_of("2dgs")
    mesh = TriangleMesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]]), np.full((3, 3), 200, np.uint8))
    write_mesh(run.path / "mesh" / "mesh.ply", mesh)
    text = scene_page(run.load()).html
    assert re.findall(r'value="\d"[^>]*>([\w ]+)</label>', text) == ["Gaussians", "surface"]
    assert '"about":"1 triangle","legend":[]' in text


def test_maps_of_coverage_have_a_legend_of_the_colours_that_they_have(run_of):
    run = run_of("2dgs")
    colors = np.array([Level.SEEN.color, Level.SEEN.color, Level.UNSEEN.color], np.uint8)
    file = run.path / "coverage" / "coverage.ply"
    write_mesh(file, TriangleMesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]]), colors))
    text = scene_page(run.load()).html
    shutil.rmtree(file.parent)
    assert '"legend":[["seen",[150,200,190]],["not seen",[213,62,0]]]' in text


def test_the_most_visible_are_the_opaque_and_large_ones():
    splats = random_cloud(4, 0)
    splats.scales[:] = [[1.0, 2.0, 0.1], [1.0, 1.0, 0.9], [3.0, 0.1, 2.0], [1.0, 1.0, 1.0]]
    splats.opacities[:] = [0.5, 0.9, 0.1, 0.8]  # they cover 1, 0.9, 0.6 and 0.8
    np.testing.assert_array_equal(most_visible(splats, 2).means, splats.means[:2])
    np.testing.assert_array_equal(most_visible(splats, 3).means, splats.means[[0, 1, 3]])
    assert len(most_visible(splats, 9)) == 4
