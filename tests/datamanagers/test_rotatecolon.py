"""The rotatecolon data manager, EXR depth, and test views that have none: read, trained on, evaluated, refused."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
import torch

from coliags_plugin.config.method_config import load_method
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import Scene
from coliags_plugin.datamanagers.rotatecolon.exr_depth import ExrDepth, read_exr_channel
from coliags_plugin.datamanagers.rotatecolon.reader import RotateColonDataManager, RotateColonSettings
from coliags_plugin.engine.evaluator import evaluate
from coliags_plugin.engine.run_folder import RunFolder
from coliags_plugin.engine.trained import load_trained
from coliags_plugin.engine.trainer import Trainer
from tests.phantom.phantom_layouts import distance_from_wall, read, true_poses, write_phantom
from tests.scenes import SMALL

Z = "ViewLayer.Depth.Z"


def load(folder: Path, **options) -> Scene:
    return RotateColonDataManager(RotateColonSettings(**options)).load(folder)


def write_exr(path: Path, **channels: np.ndarray) -> None:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, channels).write(str(path))


@pytest.fixture(scope="module")
def phantom(tmp_path_factory):
    return write_phantom(tmp_path_factory.mktemp("phantoms") / "rotate", "rotatecolon", 64, 48)


@pytest.fixture
def mine(phantom, tmp_path):
    """A copy to spoil."""
    return Path(shutil.copytree(phantom, tmp_path / "rotate", ignore=shutil.ignore_patterns("mesh.ply", "*.npz")))


def change(path: Path, update) -> None:
    content = json.loads(path.read_text())
    update(content)
    path.write_text(json.dumps(content))


class TestPhantom:
    def test_frames_are_the_phantoms(self, phantom):
        scene = read(phantom, "rotatecolon")
        assert [frame.name for frame in scene.train] == [f"{index:04d}" for index in range(9)]
        camera = scene.train[0].camera
        assert camera.fx == camera.fy == pytest.approx(32.0 * 200.8769 / 169.0)
        # The middle of the image, where pixel centres lie at integers + 0.5.
        assert (camera.cx, camera.cy) == (32.0, 24.0)

    def test_test_views_have_images_and_marks_but_no_depth(self, phantom):
        scene = read(phantom, "rotatecolon")
        assert [frame.name for frame in scene.test_sets["test"]] == ["test-0000", "test-0001"]
        for frame in scene.test_sets["test"]:
            assert frame.depth is None and frame.depth_at_least is None
            assert frame.seen is not None
            stored = cv2.imread(str(phantom / f"test_views_1/{frame.name[5:]}.png"))[..., ::-1]
            np.testing.assert_array_equal(frame.image, stored)

    def test_initial_points_are_the_datas_own_in_one_colour(self, phantom):
        points = read(phantom, "rotatecolon").points
        assert distance_from_wall(phantom, points.positions).max() < 1e-3
        assert points.colors.unique(dim=0).tolist() == [[188, 99, 76]]

    def test_a_split_of_the_training_views_leaves_the_test_views_another_name(self, phantom):
        scene = read(phantom, "rotatecolon", split="every-8th")
        assert [frame.name for frame in scene.test_sets["test"]] == ["0000", "0008"]
        assert [frame.name for frame in scene.test_sets["rotation"]] == ["test-0000", "test-0001"]
        assert scene.test_sets["test"][0].depth is not None
        # Marks say what all training views see.
        assert scene.test_sets["rotation"][0].seen is None

    def test_split_own_is_all_train(self, phantom):
        scene = read(phantom, "rotatecolon", split="own")
        assert len(scene.train) == 9 and len(scene.test_sets["test"]) == 2


class TestDepthDivisor:
    def test_the_points_confirm_it(self, phantom, caplog):
        compared = load(phantom).provenance["depth_against_points"]
        assert compared["best_divisor"] == pytest.approx(1.4, rel=0.01)
        assert compared["ratio"] == pytest.approx(1.0, abs=0.01)
        assert not caplog.records

    @pytest.mark.parametrize("divisor", [1.0, 2.5])
    def test_the_points_contradict_another(self, phantom, caplog, divisor):
        scene = load(phantom, depth_divisor=divisor)
        compared = scene.provenance["depth_against_points"]
        assert compared["best_divisor"] == pytest.approx(1.4, rel=0.01)
        assert compared["ratio"] == pytest.approx(divisor / 1.4, rel=0.01)
        assert "init_point_cloud.ply" in caplog.text and "consider depth_divisor" in caplog.text
        right = load(phantom).train[2].depth
        torch.testing.assert_close(scene.train[2].depth, right * (1.4 / divisor))

    def test_points_anywhere_contradict_nothing(self, mine, caplog):
        content = "\n".join(f"{x} {y} {z}" for x, y, z in np.random.default_rng(0).uniform(-60, 60, (500, 3)))
        header = "ply\nformat ascii 1.0\nelement vertex 500\n" + "".join(f"property float {axis}\n" for axis in "xyz")
        (mine / "init_point_cloud.ply").write_text(f"{header}end_header\n{content}\n")
        assert load(mine).provenance["depth_against_points"]["median_distance_over_depth"] > 0.1
        assert not caplog.records

    def test_without_points_or_without_depth_there_is_nothing_to_compare(self, mine):
        (mine / "init_point_cloud.ply").unlink()
        scene = load(mine)
        assert scene.provenance["depth_against_points"] is None
        assert scene.provenance["points"]["source"] == "depth of the training frames"
        shutil.rmtree(mine / "depth_train")
        with pytest.raises(InputError, match="neither depth files nor"):
            load(mine)


class TestEvaluation:
    def test_depth_figures_of_views_without_depth_are_null_with_a_reason(self, phantom, tmp_path):
        """Not 0, and not taken against another frame's depth; training has its depth loss all the same."""
        method = load_method("coliags", [*SMALL, "schedule.steps=2", "datamanager.name=rotatecolon"])
        trainer = Trainer(method, load(phantom), str(phantom), RunFolder(tmp_path / "run"), 0, torch.device("cpu"))
        trainer.start()
        trainer.train()
        rows = [json.loads(line) for line in trainer.run.log_file.read_text().splitlines()]
        assert rows[-1]["terms"]["depth"] > 0.0
        trained = load_trained(tmp_path / "run", torch.device("cpu"), phantom)
        for protocol in ("paper", "authors-code"):
            folder = evaluate(trained, protocol)
            found = json.loads((folder / "metrics.json").read_text())
            depth = [name for name in found["directions"] if name.startswith("depth_")]
            assert "depth_mse" in depth
            for name in depth:
                assert found["sets"]["test"][name] is None
                assert found["reasons"][name] == "this frame has no ground-truth depth"
            assert found["depth_mse"] is None
            assert found["psnr"] > 0.0 and found["sets"]["test"]["psnr_seen"] > 0.0
            assert not (folder / "depth").exists() and not (folder / "errors").exists()
            header, *rows = (folder / "per_frame.csv").read_text().splitlines()
            place = header.split(",").index("depth_mse")
            assert [row.split(",")[place] for row in rows] == ["", ""]


class TestFiles:
    def test_alpha_is_dropped(self, mine):
        image = cv2.imread(str(mine / "train_views/0003.png"))
        alpha = np.full(image.shape[:2], 7, np.uint8)
        cv2.imwrite(str(mine / "train_views/0003.png"), np.dstack([image, alpha]))
        np.testing.assert_array_equal(load(mine).train[3].image, image[..., ::-1])

    def test_numbers_decide_the_order_and_may_be_written_as_paths(self, mine):
        def renumber(content):
            for index, frame in enumerate(content["frames"]):
                frame["file_path"] = ("./train_views/%04d.png" if index % 2 else "%d") % (index + 2)
            content["frames"].reverse()

        change(mine / "transforms.json", renumber)
        for kind, suffix in (("train_views", "png"), ("depth_train", "exr")):
            for index in reversed(range(9)):
                (mine / kind / f"{index:04d}.{suffix}").rename(mine / kind / f"{index + 2}.{suffix}")
        scene = load(mine)
        assert [frame.name for frame in scene.train] == [str(index) for index in range(2, 11)]
        np.testing.assert_allclose([frame.camera.camera_to_world for frame in scene.train], true_poses(mine), atol=1e-5)

    def test_images_without_pose_are_left_out_and_counted(self, mine, caplog):
        change(mine / "transforms.json", lambda content: content["frames"].pop(4))
        scene = load(mine)
        assert [frame.name for frame in scene.train] == [f"{index:04d}" for index in range(9) if index != 4]
        assert scene.provenance["images_without_pose"] == 1
        assert "1 images of train_views have no pose" in caplog.text

    def test_without_test_views_there_is_no_test_set(self, mine):
        (mine / "transforms_test.json").unlink()
        assert load(mine).test_sets == {}

    def test_the_test_folder_may_be_another(self, mine):
        (mine / "test_views_1").rename(mine / "test_views_2")
        with pytest.raises(
            InputError, match=r"transforms_test.json but no folder test_views_1.*datamanager.test_folder="
        ):
            load(mine)
        assert len(load(mine, test_folder="test_views_2").test_sets["test"]) == 2

    def test_test_views_may_have_another_camera(self, mine):
        change(mine / "transforms_test.json", lambda content: content.update(camera_angle_x=math.pi / 2))
        scene = load(mine)
        assert scene.test_sets["test"][0].camera.fx == pytest.approx(32.0)
        assert scene.train[0].camera.fx != pytest.approx(32.0)


class TestExr:
    def test_what_is_no_depth_is_unknown(self, tmp_path):
        stored = np.array([[2.8, 0.0, -1.0, 1e10], [np.nan, np.inf, 14.0, 9e5]], np.float32)
        write_exr(tmp_path / "z.exr", **{Z: stored})
        form = ExrDepth(Z, 1.4)
        depth = form.z_depth(form.read(tmp_path / "z.exr"))
        nan = math.nan
        np.testing.assert_allclose(depth, [[2.0, nan, nan, nan], [nan, nan, 10.0, 9e5 / 1.4]], rtol=1e-6)
        assert depth.dtype == np.float32 and form.clipped_at(stored) is None

    @pytest.mark.parametrize("kind", [np.float16, np.float32])
    def test_the_named_channel_is_taken_from_many(self, tmp_path, kind):
        stored = np.arange(12.0).reshape(3, 4).astype(kind)
        color = np.full((3, 4), 0.5, np.float16)
        write_exr(tmp_path / "z.exr", **{"ViewLayer.Combined.R": color, "ViewLayer.Depth.Z": stored, "Z": color})
        np.testing.assert_array_equal(read_exr_channel(tmp_path / "z.exr", Z), stored.astype(np.float32))

    def test_channels_are_found_in_any_part(self, tmp_path):
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        stored = np.arange(12.0, dtype=np.float32).reshape(3, 4)
        parts = [
            OpenEXR.Part(dict(header), {"ViewLayer.Combined.R": stored + 1}, "one"),
            OpenEXR.Part(dict(header), {Z: stored}, "two"),
        ]
        OpenEXR.File(parts).write(str(tmp_path / "z.exr"))
        np.testing.assert_array_equal(read_exr_channel(tmp_path / "z.exr", Z), stored)

    def test_another_channel_name(self, mine):
        for path in (mine / "depth_train").iterdir():
            write_exr(path, **{"V": np.full((48, 64), 28.0, np.float32), "A.B": np.zeros((48, 64), np.float32)})
        with pytest.raises(InputError, match=r"0000.exr has the channels A.B, V. Expected a channel ViewLayer.Depth.Z"):
            load(mine)
        assert load(mine, depth_channel="V").train[0].depth.unique().tolist() == [20.0]

    @pytest.mark.parametrize("kept", [0, 3, 200, -10])
    def test_cut_short(self, mine, capfd, kept):
        path = mine / "depth_train/0000.exr"
        path.write_bytes(path.read_bytes()[:kept])
        with pytest.raises(InputError, match=r"0000.exr \(\d+ bytes\) cannot be decoded"):
            load(mine)

    def test_damaged(self, mine):
        path = mine / "depth_train/0004.exr"
        data = bytearray(path.read_bytes())
        data[len(data) // 2 : len(data) // 2 + 40] = bytes(40)
        path.write_bytes(data)
        with pytest.raises(InputError, match=r"0004.exr .* cannot be decoded"):
            load(mine)
