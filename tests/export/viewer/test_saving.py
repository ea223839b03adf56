"""A scene as one page."""

from __future__ import annotations

import re
from html import unescape

import numpy as np
import pytest
import torch

import coliags_plugin as cp
from coliags_plugin.cli.arguments import bytes_of
from coliags_plugin.core.errors import InputError
from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from tests.commands import refused, run

pytest.importorskip("viser")

from coliags_plugin.export.baking import distillation
from coliags_plugin.export.viewer.content import ViewerContent
from coliags_plugin.export.viewer.saving import save_surface, scene_page


@pytest.fixture(autouse=True)
def few_steps(monkeypatch):
    monkeypatch.setattr(distillation, "STEPS", 3)


def test_the_command_writes_a_page_that_needs_no_network(anchors, tmp_path, capsys):
    page = tmp_path / "out" / "scene.html"
    assert run("view", anchors.path, "--output", page, "--size", "4.5MB") == 0
    text = page.read_text(encoding="utf-8")
    assert len(text.encode()) < 4_500_000
    told, written = capsys.readouterr().out.strip().splitlines()
    assert written == f"written: {page}" and f"{told}</div>" in text
    assert re.search(
        r"step 2; ([\d,]+) of \1 Gaussians; recorded light; \d+\.\d\d dB in that light on 2 held-out", told
    )
    assert "<title>coliags on wall</title>" in text
    assert "__VISER_EMBED_DATA__" in text
    assert not re.search(r"""(?:src|href)\s*=\s*["']?(?:https?:)?//""", text)
    assert set(re.findall(r"https?://[\w./-]+", text)) <= {"http://www.w3.org/2000/svg"}


def test_a_small_page_has_the_most_visible_gaussians(anchors):
    trained = anchors.load()
    whole = scene_page(trained)
    assert whole.facts["gaussians"] == whole.facts["baking"]["visible"]
    with pytest.raises(InputError) as error:
        scene_page(trained, 1000)
    empty = int(re.search(r"more than (\d+) bytes", str(error.value))[1])
    largest = empty + 14 * whole.facts["gaussians"]  # room for about half of them
    small = scene_page(trained, largest)
    assert len(small.html.encode()) <= largest
    assert 0.4 < small.facts["gaussians"] / whole.facts["gaussians"] < 0.6
    assert small.facts["cost"]["test"]["export"]["psnr"] > 10


@pytest.mark.parametrize(
    ("text", "size"), [("20MB", 20_000_000), ("1.5 mb", 1_500_000), ("800kB", 800_000), ("5000", 5000), ("7b", 7)]
)
def test_sizes(text, size):
    assert bytes_of(text, "--size") == size


@pytest.mark.parametrize("text", ["", "MB", "-5MB", "5 MiB", "five"])
def test_what_is_no_size(text):
    with pytest.raises(InputError, match="a size in bytes, kB, MB or GB"):
        bytes_of(text, "--size")


def test_what_cannot_be_saved(anchors, tmp_path, capsys):
    assert "a page of 1000 bytes" in refused(
        capsys, "view", anchors.path, "--output", tmp_path / "a.html", "--size", "1kB"
    )
    assert "is a folder" in refused(capsys, "view", anchors.path, "--output", tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_radiance_field_has_no_gaussians_to_save(run_of, tmp_path, capsys):
    radiance = run_of("reim-nerf-small", "field.width=8")
    message = refused(capsys, "view", radiance.path, "--output", tmp_path / "a.html")
    assert "has no Gaussians to draw in a browser" in message
    assert not (tmp_path / "a.html").exists()


def test_a_report_embeds_a_scene(anchors, tmp_path):
    anchors.evaluate()
    (page,) = cp.report(anchors, tmp_path / "report.html", scene=anchors)
    text = page.read_text(encoding="utf-8")
    (embedded,) = re.findall(r'<iframe title="coliags on wall, seed 0" [^>]*data-page="([^"]*)"', text)
    assert "__VISER_EMBED_DATA__" in embedded and "<title>coliags on wall</title>" in unescape(embedded)
    (plain,) = cp.report(anchors, tmp_path / "plain.html")
    assert "<iframe" not in plain.read_text(encoding="utf-8")


def test_a_page_of_a_method_without_a_lamp_speaks_of_no_light(run_of):
    text = scene_page(run_of("3dgs").load()).text
    assert "Gaussians; " in text and "recorded light" not in text


def test_a_surface_is_seen_first_from_where_most_of_it_is_in_view(anchors, tmp_path):
    trained = anchors.load()
    cameras = [frame.camera.to("cpu", torch.float64) for frame in trained.scene.train]
    center, axis = cameras[-1].center, cameras[-1].optical_axis
    near = torch.stack([center + depth * axis for depth in (5.0, 6.0, 7.0)]).numpy()
    seen = [int(camera.sees(torch.from_numpy(near))[1].sum()) for camera in cameras]
    mesh = TriangleMesh(near.astype(np.float32), np.array([[0, 1, 2]]), np.full((3, 3), 200, np.uint8))
    content = ViewerContent.of_mesh(trained, mesh)
    assert seen[content.first] == max(seen) == 3
    assert content.look_distance > 0.0
    save_surface(trained, mesh, tmp_path / "surface.html")
    text = (tmp_path / "surface.html").read_text(encoding="utf-8")
    assert ">1 triangle<" in text and "__VISER_EMBED_DATA__" in text and "<title>coliags on wall</title>" in text
