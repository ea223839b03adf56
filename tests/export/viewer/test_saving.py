"""A scene as one page."""

from __future__ import annotations

import re
from html import unescape

import numpy as np
import pytest
import torch

import coliags_plugin as cp
from coliags_plugin.core.errors import InputError
from coliags_plugin.geometry.meshes.mesh import TriangleMesh
from tests.commands import refused, run

pytest.importorskip("viser")

from coliags_plugin.export.viewer.content import ViewerContent
from coliags_plugin.export.viewer.saving import LARGEST_PAGE, fitting_page, save_page, save_surface, scene_page


@pytest.fixture(scope="module")
def content(anchors):
    return ViewerContent.of(anchors.load())


def test_the_command_writes_a_page_that_needs_no_network(anchors, tmp_path, capsys):
    assert run("view", anchors.path, "--output", tmp_path / "out" / "scene.html") == 0
    page = tmp_path / "out" / "scene.html"
    assert capsys.readouterr().out.strip() == f"written: {page}"
    text = page.read_text(encoding="utf-8")
    assert len(text.encode()) < LARGEST_PAGE
    assert "<title>coliags on wall</title>" in text and "step 2; flattened light" in text
    assert "__VISER_EMBED_DATA__" in text and "merged" not in text
    assert not re.search(r"""(?:src|href)\s*=\s*["']?(?:https?:)?//""", text)
    assert set(re.findall(r"https?://[\w./-]+", text)) <= {"http://www.w3.org/2000/svg"}


def empty_size(content):
    """Of a page without Gaussians, bytes."""
    with pytest.raises(InputError) as error:
        fitting_page(content, 1000)
    return int(re.search(r"more than (\d+) bytes", str(error.value))[1])


def test_too_many_gaussians_are_merged(content):
    whole, page = fitting_page(content, LARGEST_PAGE)
    assert len(whole) == len(content.baked)
    empty, full = empty_size(content), len(page.encode())
    largest = empty + int(0.7 * (full - empty))
    fewer, smaller = fitting_page(content, largest)
    assert len(smaller.encode()) <= largest
    assert 0.4 * len(whole) < len(fewer) < len(whole)
    assert f"{len(whole):,} Gaussians merged into {len(fewer):,}" in smaller


def test_what_cannot_be_saved(anchors, tmp_path, capsys):
    with pytest.raises(InputError, match="a page of 1000 bytes"):
        save_page(anchors.load(), tmp_path / "a.html", largest=1000)
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
    text = scene_page(run_of("3dgs").load())
    assert "step 2</div>" in text and "flattened" not in text


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
