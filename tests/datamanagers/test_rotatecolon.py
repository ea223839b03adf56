"""Particular to RotateColon: EXR depth and its divisor, test views without depth, frames named by number."""

from __future__ import annotations

import math
from functools import partial

import cv2
import numpy as np
import OpenEXR
import pytest
import torch

from coliags_plugin.datamanagers.file_formats import ExrDepth, read_exr_channel
from tests.datamanagers.kinds import change_exr, change_json, files, remove, renumber
from tests.datamanagers.wall_scenes import FRAMES, HEIGHT, WIDTH, load_scene, names, poses
from tests.layouts import write_exr

Z = "ViewLayer.Depth.Z"

KIND = "rotatecolon"
load = partial(load_scene, "rotatecolon")


def test_test_views_have_images_but_no_depth(walls):
    scene = load(walls("rotatecolon"))
    assert names(scene.test_sets["test"]) == ["test-0000", "test-0001"]
    for frame in scene.test_sets["test"]:
        assert frame.depth is None and frame.depth_at_least is None
        stored = cv2.imread(str(walls("rotatecolon") / f"test_views_1/{frame.name[5:]}.png"))[..., ::-1]
        np.testing.assert_array_equal(frame.image, stored)
    # PR-Endo's colour.
    assert scene.points.colors.unique(dim=0).tolist() == [[188, 99, 76]]


def test_a_split_of_the_training_views_leaves_the_test_views_another_name(walls):
    scene = load(walls("rotatecolon"), split="every-8th")
    assert names(scene.test_sets["test"]) == ["0000", "0008"]
    assert names(scene.test_sets["rotation"]) == ["test-0000", "test-0001"]
    assert scene.test_sets["test"][0].depth is not None
    scene_of_own = load(walls("rotatecolon"), split="own")
    assert len(scene_of_own.train) == FRAMES and len(scene_of_own.test_sets["test"]) == 2


def test_without_points_they_come_from_depth(mine):
    (mine / "init_point_cloud.ply").unlink()
    assert load(mine).provenance.points.source == "depth of the training frames"


def test_numbers_decide_the_order_and_may_be_written_as_paths(mine):
    def change(content: dict) -> None:
        for index, frame in enumerate(content["frames"]):
            frame["file_path"] = ("./train_views/%04d.png" if index % 2 else "%d") % (index + 2)
        content["frames"].reverse()

    change_json("transforms.json", change)(mine)
    renumber("train_views/*.png", "depth_train/*.exr", change=lambda number: number + 2)(mine)
    scene = load(mine)
    assert names(scene.train) == [str(index) for index in range(2, FRAMES + 2)]
    matrices = [frame.camera.camera_to_world for frame in scene.train]
    np.testing.assert_allclose(matrices, poses(FRAMES), atol=1e-5)


def test_test_views_may_be_elsewhere_of_another_camera_or_none(mine):
    change_json("transforms_test.json", camera_angle_x=math.pi / 2)(mine)
    (mine / "test_views_1").rename(mine / "test_views_2")
    scene = load(mine, test_folder="test_views_2")
    assert scene.test_sets["test"][0].camera.fx == pytest.approx(WIDTH / 2)
    assert scene.train[0].camera.fx == pytest.approx(WIDTH / 2 * 200.8769 / 169.0)
    remove("transforms_test.json")(mine)
    assert load(mine).test_sets == {}


# EXR


def test_what_is_no_depth_is_unknown(tmp_path):
    stored = np.array([[2.8, 0.0, -1.0, 1e10], [np.nan, np.inf, 14.0, 9e5]], np.float32)
    write_exr(tmp_path / "z.exr", {Z: stored})
    form = ExrDepth(Z, 1.4)
    depth, bound = form.decode(form.read(tmp_path / "z.exr"))
    nan = math.nan
    np.testing.assert_allclose(depth, [[2.0, nan, nan, nan], [nan, nan, 10.0, 9e5 / 1.4]], rtol=1e-6)
    assert depth.dtype == np.float32 and bound is None


@pytest.mark.parametrize("kind", [np.float16, np.float32])
@pytest.mark.parametrize("parts", [1, 2])
def test_the_named_channel_is_taken_from_many_in_any_part(tmp_path, kind, parts):
    stored = np.arange(12.0).reshape(3, 4).astype(kind)
    color = np.full((3, 4), 0.5, np.float16)
    channels = {"ViewLayer.Combined.R": color, Z: stored, "Z": color}
    if parts == 1:
        write_exr(tmp_path / "z.exr", channels)
    else:
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        split = ({"Y": color}, "one"), (channels, "two")
        OpenEXR.File([OpenEXR.Part(dict(header), *part) for part in split]).write(str(tmp_path / "z.exr"))
    np.testing.assert_array_equal(read_exr_channel(tmp_path / "z.exr", Z, ""), stored.astype(np.float32))


def test_another_channel_and_divisor_may_be_chosen(mine):
    for path in files(mine, "depth_train/*"):
        change_exr(path, lambda name, pixels: (name.replace(Z, "V"), np.full((HEIGHT, WIDTH), 28.0, np.float32)))
    for options, depth in (({}, 20.0), ({"depth_divisor": 2.5}, 11.2)):
        read = load(mine, depth_channel="V", **options).train[0].depth
        torch.testing.assert_close(read, torch.full((HEIGHT, WIDTH), depth))
