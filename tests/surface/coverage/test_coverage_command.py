"""``coliags coverage`` on phantoms: files, truth, lenses, and errors."""

from __future__ import annotations

import csv
import html
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import tests.layouts  # noqa: F401  (registers c3vd-raw)
from coliags_plugin.api.scenes import make_phantom
from coliags_plugin.core.images import read_8_bit, write_image
from coliags_plugin.core.provenance import Provenance
from coliags_plugin.geometry.meshes.files import read_mesh, write_mesh
from coliags_plugin.surface.coverage.page import RESEARCH_USE
from coliags_plugin.surface.coverage.visibility import CoverageSettings, Level, recorded_views
from coliags_plugin.surface.coverage.writing import measure_scene, open_recording
from tests.commands import refused, run

SMALL = {"seed": 3, "frames": 9, "rotation_views": 0, "supersampling": 1, "mesh_spacing": 3.0, "texture_spacing": 1.0}


def made(folder, layout, width):
    return make_phantom(
        folder / layout, layout=layout, width=width, height=80, interreflection=0.0, path_length=30.0, **SMALL
    )


@pytest.fixture(scope="module")
def phantom(tmp_path_factory):
    return made(tmp_path_factory.mktemp("coverage"), "c3vd", 96)


@pytest.fixture(scope="module", params=["c3vd", "c3vd-raw"])
def recorded(request, phantom, tmp_path_factory):
    """Also one through a lens that bends rays, with dark corners."""
    return phantom if request.param == "c3vd" else made(tmp_path_factory.mktemp("raw"), request.param, 100)


def true_mesh(phantom):
    return phantom / "truth" / "mesh.ply"


def test_hidden_pixels_see_nothing(recorded, tmp_path):
    scene = Path(shutil.copytree(recorded, tmp_path / "scene"))
    before = recorded_views(open_recording(recorded))[0]
    shown = np.arange(before.lens.width) >= 40
    for path in scene.rglob("*.png"):
        if (image := read_8_bit(path)).shape[:2] == (before.lens.height, before.lens.width):
            write_image(path, np.dstack([image, np.broadcast_to(np.uint8(255) * shown, image.shape[:2])]))
    mask = recorded_views(open_recording(scene))[0].mask
    np.testing.assert_array_equal(mask, np.broadcast_to(shown, mask.shape) & (before.mask is None or before.mask))


def test_the_true_mesh_has_its_true_coverage(recorded, tmp_path):
    """One ray at the centre of each pixel is what the truth of a phantom without supersampling is made of."""
    scene = open_recording(recorded)
    lens = recorded_views(scene)[0].lens
    # The truth counts wall at any distance.
    settings = CoverageSettings(rays=lens.width * lens.height, max_distance=500.0)
    mesh = read_mesh(true_mesh(recorded))
    measured = measure_scene(scene, mesh, tmp_path / "made", settings)
    true = np.load(recorded / "truth" / "mesh_seen.npz")["face_seen_by_any_frame"]
    in_view, areas = measured.coverage.level[~measured.coverage.guessed] != Level.UNSEEN, mesh.areas
    # Only triangles between the rays, seen by their centroids, differ.
    assert areas[true & ~in_view].sum() < 2e-3 * areas[~in_view].sum()
    assert areas[~true & ~in_view].sum() > 0.9 * areas[~true].sum()


def test_the_command_writes_a_folder(phantom, tmp_path, capsys):
    # Wall that nobody saw is cut out, as in a reconstruction.
    in_view = np.load(phantom / "truth" / "mesh_seen.npz")["face_seen_by_any_frame"]
    wall, out = tmp_path / "wall.ply", tmp_path / "out"
    write_mesh(wall, read_mesh(true_mesh(phantom)).part(in_view))
    assert run("coverage", phantom, "--mesh", wall, "--output", out, "--set", "rays=8000") == 0
    printed = capsys.readouterr().out
    assert RESEARCH_USE in printed and printed.splitlines()[-1] == f"written: {out}"
    values = json.loads((out / "coverage.json").read_text())
    assert sum(values["shares"].values()) == pytest.approx(1.0)
    assert values["guessed_share"] > 0.05 and values["note"] == RESEARCH_USE
    rows = list(csv.DictReader((out / "regions.csv").open()))
    areas = [region["area"] for region in values["regions"]]
    assert [float(row["area_mm2"]) for row in rows] == pytest.approx(areas, abs=1e-3)
    assert len(rows) >= 1 and all(float(row["diameter_mm"]) > 5.0 for row in rows)
    page = (out / "coverage.html").read_text()
    assert RESEARCH_USE in page and "http" not in page.replace("http://www.w3.org", "")
    assert (out / "map.png").is_file() and read_mesh(out / "coverage.ply").colors is not None
    assert "already exists" in refused(capsys, "coverage", phantom, "--mesh", wall, "--output", out)


def test_bad_input_is_one_clear_error(phantom, tmp_path, capsys):
    mesh, out = true_mesh(phantom), tmp_path / "out"
    for arguments, message in (
        ((phantom,), "is not a run folder"),
        ((phantom, "--mesh", tmp_path / "none.ply", "--output", out), "none.ply"),
        ((phantom, "--mesh", mesh, "--output", out, "--set", "farr=3"), "'farr'"),
        ((tmp_path / "gone", "--mesh", mesh, "--output", out), "gone"),
    ):
        assert message in refused(capsys, "coverage", *arguments), arguments
    assert not out.exists()


def test_of_a_short_video_the_seen_wall_is_written_and_why_there_is_no_section(phantom, tmp_path, capsys):
    # A patch of the wall before the first camera is no tube.
    scene, whole = open_recording(phantom), read_mesh(true_mesh(phantom))
    camera = recorded_views(scene)[0]
    local = (whole.centers - camera.center) @ camera.camera_to_world[:3, :3]
    wall, out = tmp_path / "wall.ply", tmp_path / "out"
    write_mesh(wall, whole.part((local[:, 0] > 5.0) & (local[:, 2] > 5.0) & (local[:, 2] < 25.0)))
    assert run("coverage", phantom, "--mesh", wall, "--output", out, "--set", "rays=8000") == 0
    printed = capsys.readouterr().out
    values = json.loads((out / "coverage.json").read_text())
    assert values["unit"] == "mm" and 0.0 < values["seen_area"] <= values["area"] and sum(values["shares"].values())
    assert (
        f"none ({values['no_section']})" in printed and values["section"] is values["regions"] is values["seen"] is None
    )
    page = (out / "coverage.html").read_text()
    assert html.escape(values["no_section"]) in page.replace("&#39;", "&#x27;") and RESEARCH_USE in page
    assert {file.name for file in out.iterdir()} == {"coverage.html", "coverage.json", "coverage.ply", "map.png"}


@pytest.mark.thorough
def test_a_scene_of_unknown_unit_has_its_areas_in_square_units(phantom, tmp_path):
    scene = replace(open_recording(phantom), provenance=Provenance(unit="unknown"))
    measured = measure_scene(scene, read_mesh(true_mesh(phantom)), tmp_path / "out", CoverageSettings(rays=8000))
    assert measured.values["unit"] == "unknown" and measured.values["settings"]["far"] is None
    assert "square units" in measured.summary and "unit of length is unknown" in measured.values["no_section"]
