"""A scene as one page: what is packed into it, what a browser draws of it, and how it is written."""

from __future__ import annotations

import json
import re
import shutil
import zlib
from base64 import b64decode
from dataclasses import replace
from html import unescape

import cv2
import numpy as np
import pytest
import torch

import coliags_plugin as cp
from coliags_plugin.config.options import PageOptions, bytes_of
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.gaussians import rotation_of_vector
from coliags_plugin.core.images import read_rgb
from coliags_plugin.core.scenes import Frame
from coliags_plugin.export.baking import distillation
from coliags_plugin.export.splats.cloud import field_of_cloud
from coliags_plugin.export.splats.formats import read_splats
from coliags_plugin.export.viewer.page import Layer, packed_path, page_html, scene_page
from coliags_plugin.fields.spherical_harmonics import Y0
from coliags_plugin.geometry.meshes.mesh import TriangleMesh, write_mesh
from coliags_plugin.renderers.torch_renderer import TorchRenderer, TorchRendererSettings
from coliags_plugin.surface.coverage.visibility import MAP_LEGEND
from tests.commands import refused, run
from tests.export.splats.clouds import random_cloud

CUBE = TriangleMesh(
    np.array([[x, y, z] for x in (0, 2) for y in (0, 2) for z in (8, 10)], np.float32),
    np.array([[0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 4, 2], [2, 4, 6]]),
    np.arange(24, dtype=np.uint8).reshape(8, 3) * 10,
)


def frame(index, turn=(0.0, 0.0, 0.0), center=(0.0, 0.0, -20.0)):
    pose = torch.eye(4)
    pose[:3, :3] = rotation_of_vector(torch.tensor(turn))
    pose[:3, 3] = torch.tensor(center)
    camera = Camera(120.0, 118.0, 66.0, 50.0, 128, 96, pose)
    image = torch.full((96, 128, 3), 40 * index, dtype=torch.uint8)
    return Frame.of(name=f"f{index}", index=index, camera=camera, image=image)


FRAMES = [frame(0), frame(1, (0.3, -0.2, 0.1), (4.0, 2.0, -18.0)), frame(2, (-0.2, 0.4, 0.5), (-6.0, 1.0, -16.0))]


def cloud_of(count, degree, seed=0):
    """Within 10 mm of the origin."""
    random, cloud = np.random.default_rng(seed), random_cloud(count, degree, seed=seed)
    cloud.means[:], cloud.scales[:] = random.uniform(-10.0, 10.0, (count, 3)), random.uniform(0.1, 1.0, (count, 3))
    cloud.harmonics[:, 0] = random.uniform(-0.5, 0.5, (count, 3)) / Y0
    return cloud


def attenuated(cloud):
    """The cloud, half as bright, with colours that fall, or rise, with the distance to the camera."""
    random, harmonics = np.random.default_rng(1), 0.5 * cloud.harmonics
    harmonics[:, 0] -= 0.25 / Y0
    columns = [random.uniform(12.0, 30.0, len(cloud)), random.uniform(-0.5, 1.0, len(cloud))]
    return replace(cloud, harmonics=harmonics, attenuation=np.stack(columns, axis=1).astype(np.float32))


def page_of(*layers):
    path = packed_path(FRAMES, [frame.camera for frame in FRAMES], {"f0", "f2"})
    return page_html("a <scene>", layers, path, 1, 20.0, 0.3, 0.2)


def gaussians(cloud, about=""):
    layer, _ = Layer.of_cloud(cloud)
    return replace(layer, about=about)


def data_of(text):
    return json.loads(re.search(r'id="scene">(.*?)</script>', text, re.S)[1])


def test_a_page_holds_the_path_the_pictures_and_nothing_from_elsewhere():
    text = page_of(gaussians(cloud_of(10, 0), "ten </script>"))
    data = data_of(text)
    assert "<title>a &lt;scene&gt;</title>" in text and text.count("</script>") == 2
    assert [(entry["name"], entry["held_out"]) for entry in data["frames"]] == [
        ("f0", False),
        ("f1", True),
        ("f2", False),
    ]
    assert data["start"] == 1 and data["camera"]["fy"] == 118.0
    np.testing.assert_allclose(data["frames"][1]["center"], [4.0, 2.0, -18.0])
    jpeg = np.frombuffer(b64decode(data["frames"][2]["picture"].partition(",")[2]), np.uint8)
    np.testing.assert_allclose(cv2.imdecode(jpeg, cv2.IMREAD_COLOR), 80, atol=1)
    assert not re.search(r"""(?:src|href)\s*=\s*["']?(?:https?:)?//|https?://""", text)


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e4])
def test_gaussians_are_an_spz_in_a_unit_of_their_own(tmp_path, size):
    cloud = cloud_of(50, 2)
    cloud = replace(cloud, means=cloud.means * np.float32(size), scales=cloud.scales * np.float32(size))
    (layer,) = data_of(page_of(gaussians(cloud)))["layers"]
    (tmp_path / "a.spz").write_bytes(b64decode(layer["data"]))
    read = read_splats(tmp_path / "a.spz")
    _, drawn = Layer.of_cloud(cloud)
    np.testing.assert_allclose(drawn.means, read.means * layer["unit"], rtol=1e-6)
    np.testing.assert_allclose(drawn.scales, read.scales * layer["unit"], rtol=1e-6)
    np.testing.assert_allclose(read.means * layer["unit"], cloud.means, atol=2e-5 * 10 * size)
    np.testing.assert_allclose(read.scales * layer["unit"], cloud.scales, rtol=0.033)


def test_attenuation_is_bytes_between_bounds_that_rare_values_do_not_move():
    cloud = attenuated(cloud_of(2000, 0))
    cloud.attenuation[7] = 20.0, 900.0
    layer, drawn = Layer.of_cloud(cloud)
    packed = layer.packed["attenuation"]
    levels = np.frombuffer(zlib.decompress(b64decode(packed["data"])), np.uint8).reshape(2, -1)
    read = np.array(packed["low"])[:, None] + np.array(packed["span"])[:, None] * levels / 255.0
    np.testing.assert_allclose(np.exp(read[0]), drawn.attenuation[:, 0], rtol=1e-5)
    np.testing.assert_allclose(read[1], drawn.attenuation[:, 1], atol=1e-5)
    usual = np.arange(2000) != 7
    np.testing.assert_allclose(drawn.attenuation[usual, 0], cloud.attenuation[usual, 0], rtol=0.01)
    np.testing.assert_allclose(drawn.attenuation[usual, 1], cloud.attenuation[usual, 1], atol=0.02)
    assert drawn.attenuation[7, 1] == pytest.approx(1.0, abs=0.02)
    assert "attenuation" not in Layer.of_cloud(cloud_of(10, 0))[0].packed


def test_a_mesh_is_quantised_in_its_box():
    (layer,) = data_of(page_of(Layer.of_mesh("surface", "", CUBE, 0.5)))["layers"]
    data = zlib.decompress(b64decode(layer["data"]))
    corners = np.frombuffer(data[: 8 * 6], "<u2").reshape(8, 3) / 65535.0 * layer["span"] + layer["low"]
    np.testing.assert_allclose(corners, CUBE.vertices, atol=1e-4)
    np.testing.assert_array_equal(np.frombuffer(data[8 * 9 :], "<u4").reshape(-1, 3), CUBE.triangles)


def drawn(browser, path):
    """Pixels of the canvas, once Gaussians are sorted."""
    browser.run(
        "new Promise(done => { const wait = () => byId('canvas').dataset.drawn === 'true' ? done()"
        " : setTimeout(wait, 50); wait(); })"
    )
    browser.run("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
    browser.screenshot(path)
    across, down, wide, high = browser.run(
        "(b => [b.left, b.top, b.width, b.height])(byId('canvas').getBoundingClientRect())"
    )
    return read_rgb(path)[round(down) : round(down + high), round(across) : round(across + wide)]


def as_canvas(camera, shape):
    """The camera in a canvas that holds its whole image."""
    height, width = shape[:2]
    scale = min(width / camera.width, height / camera.height)
    return scale, replace(
        camera,
        fx=scale * camera.fx,
        fy=scale * camera.fy,
        cx=0.5 * width + scale * (camera.cx - 0.5 * camera.width),
        cy=0.5 * height + scale * (camera.cy - 0.5 * camera.height),
        width=width,
        height=height,
    )


@pytest.mark.thorough
@pytest.mark.parametrize(("degree", "light"), [(0, replace), (1, replace), (2, attenuated), (3, attenuated)])
def test_a_browser_draws_what_our_renderer_draws(browser, tmp_path, degree, light):
    cloud = light(cloud_of(400, degree, seed=degree))
    page = tmp_path / "page.html"
    page.write_text(page_of(gaussians(cloud)), encoding="utf-8")
    browser.open(page, 700, 400)
    for index in (1, 2):
        if index != 1:
            browser.run(f"(s => (s.value = {index}, s.dispatchEvent(new Event('input'))))(byId('frame'))")
        pixels = drawn(browser, tmp_path / "seen.png")
        scale, camera = as_canvas(FRAMES[index].camera, pixels.shape)
        renderer = TorchRenderer(TorchRendererSettings(eps2d=0.3 * max(1.0, scale**2)))
        true = renderer.draw(field_of_cloud(cloud).gaussians(camera), camera, ("rgb", "alpha")).rgb.detach()
        error = pixels / 255.0 - true.clamp(0.0, 1.0).numpy()
        assert -10.0 * np.log10(np.mean(error**2)) > 34.0
    assert browser.run("byId('name').textContent") == "f2"
    assert all(url.startswith((page.resolve().as_uri(), "blob:")) for url in browser.requests())
    assert [one for one in browser.errors() if "ReadPixels" not in one] == []


@pytest.mark.thorough
@pytest.mark.parametrize("width", [900, 390])
def test_layers_path_and_looking_around(browser, tmp_path, width):
    page = tmp_path / "page.html"
    flat = replace(CUBE, colors=np.full((8, 3), (250, 10, 30), np.uint8))
    surface = replace(Layer.of_mesh("surface", "6 triangles", flat, 0.0), legend=[("red wall", (250, 10, 30))])
    layers = gaussians(cloud_of(50, 0), "many"), surface
    page.write_text(page_of(*layers), encoding="utf-8")
    browser.open(page, width, 600, phone=width < 500)
    drawn(browser, tmp_path / "seen.png")
    browser.run("document.querySelectorAll('input[name=layer]')[1].click()")
    browser.run("(s => (s.value = 0, s.dispatchEvent(new Event('input'))))(byId('frame'))")
    shown = drawn(browser, tmp_path / "seen.png") if width >= 500 else None
    assert browser.run("byId('about').textContent") == "6 triangles"
    assert browser.run("byId('legend').textContent") == "red wall"
    assert browser.run("byId('legend').querySelector('i').style.background") == "rgb(250, 10, 30)"
    if shown is not None:
        _, camera = as_canvas(FRAMES[0].camera, shown.shape)
        pixels, _ = camera.project(torch.tensor([[1.0, 1.0, 8.0]]))
        column, row = pixels[0].int().tolist()
        np.testing.assert_allclose(shown[row, column], (250, 10, 30), atol=2)
    browser.run("byId('play').click()")
    browser.run(
        "new Promise(done => { const look = () => byId('play').textContent === 'Play' ? done()"
        " : setTimeout(look, 50); look(); })"
    )
    assert browser.run("[byId('frame').value, byId('play').textContent]") == ["2", "Play"]
    browser.drag("#canvas", 0.5, 0.6, touch=width < 500)
    assert browser.run("document.documentElement.scrollWidth <= innerWidth")
    assert [one for one in browser.errors() if "ReadPixels" not in one] == []


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
        r"step 2; ([\d,]+) of \1 Gaussians; recorded light; in that light: \d+\.\d\d dB on 2 held-out", summary
    )
    assert "<title>wall (coliags)</title>" in text
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
    largest = empty + 15 * whole.facts["gaussians"]  # room for about half of them
    small = scene_page(trained, PageOptions(size=str(largest)))
    assert len(small.html.encode()) <= largest
    assert 0.4 < small.facts["gaussians"] / whole.facts["gaussians"] < 0.6
    assert small.facts["measured"]["test"]["in_light"]["psnr"] > 10


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
    (page,) = cp.report(anchors, tmp_path / "report.html", scene=anchors).files
    text = page.read_text(encoding="utf-8")
    (embedded,) = re.findall(r'<iframe title="coliags on wall, seed 0" [^>]*data-page="([^"]*)"', text)
    assert 'id="scene"' in unescape(embedded) and "<title>wall (coliags)</title>" in unescape(embedded)
    (plain,) = cp.report(anchors, tmp_path / "plain.html").files
    assert "<iframe" not in plain.read_text(encoding="utf-8")


def test_meshes_of_the_run_are_layers_and_maps_of_coverage_have_a_legend_of_their_colours(run_of):
    run = run_of("2dgs")
    colors = np.array([MAP_LEGEND[index][1] for index in (0, 0, 3)], np.uint8)
    for file in ("mesh/mesh.ply", "coverage/coverage.ply"):
        write_mesh(run.path / file, TriangleMesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]]), colors))
    page = scene_page(run.load())
    for folder in ("mesh", "coverage"):
        shutil.rmtree(run.path / folder)
    assert re.findall(r'value="\d"[^>]*>([\w ]+)</label>', page.html)[:2] == ["Gaussians", "surface"]
    assert '"about":"1 triangle","legend":[]' in page.html
    assert '"legend":[["seen well",[150,200,190]],["not seen",[213,62,0]]]' in page.html
    assert "Gaussians; " in page.text and "recorded light" not in page.text, "the method knows no lamp"
