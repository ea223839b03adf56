"""The c3vd-v2 data manager: phantoms, closed-form walls, and what is refused."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.ply import point_properties, write_ply
from coliags_plugin.core.scenes import Scene
from coliags_plugin.datamanagers.c3vd_v2.lens import CANDIDATE_LENS, ORDER, read_camera_intrinsics
from coliags_plugin.datamanagers.c3vd_v2.reader import C3VDv2DataManager, C3VDv2Settings
from coliags_plugin.geometry.lenses.models import LENSES, Lens
from tests.datamanagers.wall_scenes import off_wall, poses, write_raw
from tests.phantom.phantom_layouts import in_video_order, read, true_poses, write_phantom

SMALL_LENS = CANDIDATE_LENS.resized(270, 216)


def load(folder: Path, **options) -> Scene:
    settings = C3VDv2Settings(**{"width": 90, "height": 72, **options})
    return C3VDv2DataManager(settings).load(folder)


def write_v2(folder: Path, lens: Lens = SMALL_LENS, **options) -> Path:
    """The wall in C3VDv2's layout."""
    write_raw(folder, lens, **options)
    (folder / "rgb").mkdir()
    (folder / "depth").mkdir()
    for path in sorted(folder.glob("*_color.png")):
        path.rename(folder / "rgb" / path.name.replace("_color", ""))
    for path in sorted(folder.glob("*_depth.tiff")):
        path.rename(folder / "depth" / path.name)
    return folder


#: As its file has it: pixel centres at integers.
CANDIDATE = {**vars(CANDIDATE_LENS), "cx": CANDIDATE_LENS.cx - 0.5, "cy": CANDIDATE_LENS.cy - 0.5, "a1": 0.0}


def as_text(**changes: float) -> str:
    values = {**CANDIDATE, **changes}
    return "\n".join(f"{name} = {values[name]!r}" for name in ORDER)


@pytest.fixture(scope="module")
def wall(tmp_path_factory):
    return write_v2(tmp_path_factory.mktemp("v2") / "wall", count=4)


@pytest.fixture
def mine(wall, tmp_path):
    """A copy to spoil."""
    return Path(shutil.copytree(wall, tmp_path / "wall"))


@pytest.fixture(scope="module")
def phantom(tmp_path_factory):
    return write_phantom(tmp_path_factory.mktemp("phantoms") / "v2", "c3vd-v2", 90, 72)


class TestPhantom:
    def test_frames_are_the_phantoms(self, phantom):
        scene = read(phantom, "c3vd-v2", width=90, height=72)
        frames = in_video_order(scene)
        np.testing.assert_allclose([f.camera.camera_to_world for f in frames], true_poses(phantom), atol=1e-5)
        assert [frame.name for frame in scene.test_sets["test"]] == ["0000", "0008"]
        assert scene.provenance["pose_convention"]["order"] == "column-major"
        assert scene.provenance["lens_source"] == str((phantom / "camera_intrinsics.txt").resolve())
        k, camera = CANDIDATE_LENS.resized(90, 72).pinhole, frames[0].camera
        assert (camera.fx, camera.fy) == pytest.approx((k.fx, k.fy))
        assert (camera.cx, camera.cy) == pytest.approx((k.cx, k.cy))

    def test_rotation_views_and_marks_come_along(self, phantom):
        scene = read(phantom, "c3vd-v2", width=90, height=72)
        turned = scene.test_sets["rotation"]
        assert [frame.name for frame in turned] == ["rotation-0000", "rotation-0001"]
        assert turned[0].depth is not None and turned[0].seen is not None
        assert all(frame.seen is not None for frame in scene.test_sets["test"])
        assert scene.train[0].seen is None


class TestLens:
    def test_the_wall_is_where_it_is(self, wall, caplog):
        scene = load(wall)
        assert max(_worst_off_wall(frame) for frame in in_video_order(scene)) < 0.2
        assert scene.provenance["lens_source"] == "candidate calibration, unverified"
        assert "unverified" in caplog.text
        np.testing.assert_allclose(scene.train[0].camera.camera_to_world, poses(4)[1], atol=1e-5)

    def test_lens_v1_is_c3vds(self, tmp_path, caplog):
        folder = write_v2(tmp_path / "wall", LENSES["omnidirectional"].resized(270, 216), count=2)
        frame = load(folder, lens="v1").train[0]
        assert _worst_off_wall(frame) < 0.2
        assert frame.camera.fx == pytest.approx(769.243600037458 * 90 / 1350)
        assert not caplog.records

    def test_lens_v2_ignores_the_file(self, mine, caplog):
        (mine / "camera_intrinsics.txt").write_text("nobody knows")
        assert load(mine, lens="v2").provenance["lens_source"] == "candidate calibration, unverified"
        assert not caplog.records

    @pytest.mark.parametrize("up", [0, 1, 2])
    def test_the_file_decides_from_two_folders_up(self, tmp_path, up):
        folder = write_v2(tmp_path / "registered" / "c1" / "wall", LENSES["omnidirectional"].resized(270, 216), count=2)
        values = {**vars(LENSES["omnidirectional"]), "a1": 0.0}
        file = [folder, *folder.parents][up] / "camera_intrinsics.txt"
        file.write_text("\n".join(f"{name}: {values[name]}" for name in ORDER))
        scene = load(folder)
        assert _worst_off_wall(scene.train[0]) < 0.2
        assert scene.provenance["lens_source"] == str(file.resolve())


def _worst_off_wall(frame) -> float:
    points = frame.camera.unproject(frame.depth).reshape(-1, 3).double().numpy()
    return off_wall(points[np.isfinite(points).all(axis=1)]).max()


class TestIntrinsicsFile:
    @pytest.mark.parametrize(
        "text",
        [
            as_text(),
            as_text().replace(" = ", ": "),
            as_text().replace(" = ", "\t").upper(),
            "# calibration\n" + as_text() + "  # the last one",
            json.dumps({name: CANDIDATE[name] for name in ORDER}),
            "\n".join(line for line in as_text().splitlines() if line[:2] not in ("wi", "he", "a1", "c ", "d ", "e ")),
            ", ".join(line.split(" = ")[1] for line in as_text().splitlines()),
            "\n".join(line.split(" = ")[1] for line in as_text().splitlines()[2:]),
        ],
        ids=["equals", "colons", "tabs", "comments", "json", "only what is needed", "twelve numbers", "ten numbers"],
    )
    def test_unmistakable_forms(self, tmp_path, text):
        (tmp_path / "camera_intrinsics.txt").write_text(text)
        assert read_camera_intrinsics(tmp_path / "camera_intrinsics.txt") == CANDIDATE_LENS

    @pytest.mark.parametrize(
        ("text", "seen"),
        [
            ("see the paper", "text without names"),
            ("", "0 numbers without names"),
            ("767.7 677.7 543.1", "3 numbers without names"),
            ("767.7 0 677.7 0 767.7 543.1 0 0 1", "9 numbers without names"),
            (as_text().replace("a2 = ", "k2 = "), "no a2; unknown k2"),
            (as_text() + "\ncx = 1", "twice cx"),
            ("fx = 767.7\nfy = 767.7\ncx = 677.7\ncy = 543.1", "no a0, a2, a3, a4; unknown fx, fy"),
            (as_text(cx=337.0), "a centre (337, 543.058) far from the middle of 1350 x 1080"),
            (as_text(a0=4.0), "a focal length a0 = 4"),
            (as_text(a1=0.5), "a1 = 0.5"),
            (as_text(c=0.0, d=1.0), "c, d, e = 0, 1, 0"),
            (as_text(width=1350.5), "1350.5 x 1080 pixels"),
            (as_text(a3=float("inf")), "no a3"),
            (" ".join(line.split(" = ")[1] for line in as_text().splitlines()[::-1]), "an image of"),
        ],
    )
    def test_whatever_else_is_refused_and_the_way_out_named(self, tmp_path, text, seen):
        (tmp_path / "camera_intrinsics.txt").write_text(text)
        with pytest.raises(InputError, match="is ambiguous or implausible") as refused:
            read_camera_intrinsics(tmp_path / "camera_intrinsics.txt")
        assert seen in str(refused.value)
        assert re.search(r"camera_intrinsics\.txt .*datamanager.lens=v2.*or v1", str(refused.value))


def test_images_and_poses_are_enough_where_points_are_given(mine):
    shutil.rmtree(mine / "depth")
    write_ply(mine / "points3D.ply", point_properties(torch.rand(50, 3).numpy()))
    scene = load(mine)
    assert scene.train[0].depth is None
    assert len(scene.points) == 50


def test_other_files_of_the_release_are_left_alone(mine):
    for kind in ("normals", "optical_flow", "occlusions", "diffuse"):
        (mine / kind).mkdir()
        (mine / kind / "0000_x.tiff").write_text("not looked at")
    (mine / "coverage_mesh.obj").write_text("not looked at")
    assert len(in_video_order(load(mine))) == 4
