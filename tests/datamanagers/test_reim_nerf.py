"""The reim-nerf data manager: the phantom's own layout against its truth, and what is refused."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from coliags_plugin.core.scenes import Scene
from coliags_plugin.datamanagers.reim_nerf.files import ray_cosines
from coliags_plugin.datamanagers.reim_nerf.reader import ReimNerfDataManager, ReimNerfDataSettings
from coliags_plugin.geometry.lenses.models import LENSES, undistortion_map
from tests.layouts.reim_nerf import SCENE_SCALE
from tests.phantom.phantom_layouts import distance_from_wall, in_video_order, read, true_poses, write_phantom

WIDTH, HEIGHT, FRAMES = 90, 72, 27
LENS = LENSES["fisheye"].resized(WIDTH, HEIGHT)
#: mm a step along the ray.
STEP = math.pi / 65535 / SCENE_SCALE


def load(folder: Path, **options) -> Scene:
    return ReimNerfDataManager(ReimNerfDataSettings(**options)).load(folder)


def names(frames) -> list[str]:
    return [frame.name for frame in frames]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_phantom(
        tmp_path_factory.mktemp("phantoms") / "reim", "reim-nerf", width=WIDTH, height=HEIGHT, frames=FRAMES
    )


@pytest.fixture(scope="module")
def scene(folder):
    return read(folder, "reim-nerf")


@pytest.fixture
def mine(folder, tmp_path):
    """A copy to spoil."""
    return Path(shutil.copytree(folder, tmp_path / "reim"))


class TestPhantom:
    def test_own_split_leaves_validation_out(self, scene):
        train = [0, 5, 10, 15, 20]
        assert [frame.index for frame in scene.train] == train
        assert names(scene.train) == [f"{index:04d}_color" for index in train]
        assert [frame.index for frame in scene.test_sets["test"]] == [i for i in range(FRAMES) if i % 5]
        assert scene.provenance["parts"] == {"train": 5, "val": 1, "test": FRAMES, "true_test": 21}

    def test_other_splits_use_every_frame(self, folder):
        scene = load(folder, split="every-8th")
        assert len(in_video_order(scene)) == FRAMES
        assert [frame.index for frame in scene.test_sets["test"]] == [0, 8, 16, 24]
        assert all(frame.seen is None for frame in scene.test_sets["test"])

    def test_stored_poses_are_normalised_and_opengl(self, folder):
        content = json.loads((folder / "transforms_test.json").read_text())
        stored = np.array([frame["transform_matrix"] for frame in content["frames"]])
        truth = true_poses(folder)
        assert np.abs(stored[:, :3, 3]).max() < 1.0
        np.testing.assert_allclose(stored[:, :3, 2], -truth[:, :3, 2], atol=1e-12)
        shift = np.array(content["scene_T"])[:3, 3]
        np.testing.assert_allclose(stored[:, :3, 3] / SCENE_SCALE - shift, truth[:, :3, 3], atol=1e-9)
        assert all(0.0 < frame["near"] < frame["far"] for frame in content["frames"])

    def test_intrinsics_are_the_lenss_pinhole(self, scene):
        k, camera = LENS.pinhole, scene.train[0].camera
        assert (camera.fx, camera.fy) == pytest.approx((k.fx, k.fy), rel=1e-12)
        assert (camera.cx, camera.cy) == pytest.approx((k.cx, k.cy), rel=1e-12)

    def test_stored_distances_end_on_the_wall(self, folder):
        """Through the lens itself: no resampling between file and wall."""
        row, column = np.mgrid[:HEIGHT, :WIDTH] + 0.5
        rays = LENS.unproject(np.stack([column.ravel(), row.ravel()], 1))
        stored = cv2.imread(str(folder / "distmaps" / "0010_color.png"), cv2.IMREAD_UNCHANGED).ravel()
        depth = stored * STEP * ray_cosines(LENS).ravel()
        known = (stored > 0) & (depth < 99.9)
        assert known.sum() > 3000
        local = rays[known] * depth[known, None]
        pose = true_poses(folder)[10]
        world = torch.from_numpy(local @ pose[:3, :3].T + pose[:3, 3])
        # Half a step along the ray, and float32 of open3d.
        assert distance_from_wall(folder, world).max() < 0.5 * STEP + 1e-4

    def test_working_depth_is_that_of_the_nearest_stored_pixel(self, folder, scene):
        frame = scene.train[2]
        stored = cv2.imread(str(folder / "distmaps" / f"{frame.name}.png"), cv2.IMREAD_UNCHANGED)
        # An independent way from distance to z: OpenCV's own fisheye, which counts from integers, at integers + 0.5.
        row, column = np.mgrid[:HEIGHT, :WIDTH] + 0.5
        k, calibrated = LENS.pinhole, LENSES["fisheye"]
        matrix = k.opencv_matrix()
        bends = np.array([calibrated.k1, calibrated.k2, calibrated.k3, calibrated.k4])
        tangents = cv2.fisheye.undistortPoints(np.stack([column.ravel(), row.ravel()], 1)[None], matrix, bends)[0]
        length = np.hypot(1.0, np.linalg.norm(tangents, axis=1)).reshape(HEIGHT, WIDTH)
        depth = stored * STEP / length
        columns, rows = (np.rint(part).astype(int) for part in undistortion_map(LENS, k))
        expected = depth[rows, columns]
        known = torch.isfinite(frame.depth).numpy()
        assert known.mean() > 0.9
        np.testing.assert_allclose(frame.depth.numpy()[known], expected[known], atol=2e-4)

    def test_images_are_undistorted(self, folder, scene):
        # The middle of the image is hardly bent: there it is the stored one.
        frame = scene.train[3]
        stored = cv2.imread(str(folder / "images" / f"{frame.name}.png"))[..., ::-1].astype(float)
        middle = np.s_[HEIGHT // 2 - 5 : HEIGHT // 2 + 5, WIDTH // 2 - 5 : WIDTH // 2 + 5]
        assert np.abs(frame.image.numpy().astype(float)[middle] - stored[middle]).mean() < 4.0

    def test_outside_the_circle_nothing_counts(self, folder):
        frame = load(folder, focal_scale=0.4).train[0]
        assert 0.3 < frame.mask.float().mean() < 0.95
        assert torch.isnan(frame.depth[~frame.mask]).all()
        assert frame.image[frame.mask].amax(dim=-1).min() > 0
        whole = load(folder, focal_scale=0.4, mask=False).train[0]
        assert whole.mask is None or whole.mask.sum() > frame.mask.sum()

    def test_seen_masks_belong_to_the_own_split(self, folder, scene):
        assert all(frame.seen is not None for frame in scene.test_sets["test"])
        assert all(frame.seen is None for frame in scene.train)
        assert 0.3 < np.mean([frame.seen.float().mean() for frame in scene.test_sets["test"]]) <= 1.0
        for options in ({"frame_step": 2}, {"max_frames": 20}):
            assert all(frame.seen is None for frame in load(folder, **options).test_sets["test"])

    def test_provenance(self, scene):
        json.dumps(scene.provenance, allow_nan=False)
        assert scene.provenance["dataset"] == "reim-nerf"
        assert scene.provenance["pose_convention"]["scene_scale"] == SCENE_SCALE
        assert scene.provenance["mask"] == "rgb_mask.png"


def test_cosines_are_those_of_the_rays_the_preprocessing_takes():
    lens = LENSES["fisheye"].resized(45, 36)
    cosine = ray_cosines(lens)
    assert cosine.dtype == np.float32
    x, y, z = lens.unproject([[13.0, 8.0]])[0]
    assert cosine[7, 12] == pytest.approx(z / math.hypot(x, y, z), rel=1e-6)


class TestRange:
    @pytest.fixture
    def spoilt(self, mine):
        """Frame 5 with a wall at C3VD's 100 mm on the left, one just before it in the middle, and none on the right."""
        cosine = ray_cosines(LENS).astype(np.float64)
        z = np.full((HEIGHT, WIDTH), 99.9)
        z[:, : WIDTH // 3] = 100.0
        steps = np.floor(z / np.maximum(cosine, 0.05) / STEP)
        steps[:, 2 * WIDTH // 3 :] = 0
        cv2.imwrite(str(mine / "distmaps" / "0005_color.png"), steps.astype(np.uint16))
        return load(mine).train[1]

    def test_what_ends_at_c3vds_range_is_there_or_beyond(self, spoilt):
        left, middle, right = (np.s_[20:50, start : start + 15] for start in (5, 38, 70))
        depth, bound = spoilt.depth, spoilt.depth_at_least
        assert torch.isnan(depth[left]).all()
        assert torch.isnan(depth[right]).all()
        torch.testing.assert_close(depth[middle], torch.full((30, 15), 99.9), atol=STEP, rtol=0)
        torch.testing.assert_close(bound[left], torch.full((30, 15), 100.0), atol=STEP, rtol=0)
        assert torch.isnan(bound[middle]).all()
        assert torch.isnan(bound[right]).all()

    def test_nothing_clipped(self, mine):
        steps = np.full((HEIGHT, WIDTH), 9000, np.uint16)
        cv2.imwrite(str(mine / "distmaps" / "0005_color.png"), steps)
        assert load(mine).train[1].depth_at_least is None


class TestWithoutDistances:
    def test_points_come_from_a_file(self, mine):
        for path in mine.glob("transforms_*.json"):
            content = json.loads(path.read_text())
            for frame in content["frames"]:
                del frame["distmap_path"]
            path.write_text(json.dumps(content))
        np.savez(mine / "points.npz", positions=np.ones((3, 3)))
        scene = load(mine, initial_points="file", points_file="points.npz")
        assert scene.train[0].depth is None
        assert len(scene.points) == 3


class TestRefused:
    def test_test_frames_are_only_needed_by_the_own_split(self, mine):
        (mine / "transforms_true_test.json").unlink()
        assert len(in_video_order(load(mine, split="every-8th"))) == FRAMES

    def test_only_its_own_folder_is_recognised(self, mine):
        assert ReimNerfDataManager.recognise(mine) == "transforms_train.json beside distmaps"
        (mine / "transforms_train.json").unlink()
        assert ReimNerfDataManager.recognise(mine) is None
        assert ReimNerfDataManager.recognise(mine / "rgb_mask.png") is None


def test_files_as_the_preprocessing_writes_them(mine, scene):
    """Its mask is an RGB image of equal channels; numbers in file names are not padded like those in the JSON files."""
    mask = cv2.imread(str(mine / "rgb_mask.png"), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(mine / "rgb_mask.png"), np.repeat(mask[..., None], 3, axis=2))
    for part in ("images", "distmaps"):
        for index in range(FRAMES):
            (mine / part / f"{index:04d}_color.png").rename(mine / part / f"{index}_color.png")
    found = load(mine)
    assert names(found.train) == [f"{index}_color" for index in (0, 5, 10, 15, 20)]
    for frame, expected in zip(found.train, scene.train, strict=True):
        assert torch.equal(frame.image, expected.image)
        assert torch.equal(frame.valid, expected.valid)
        assert torch.equal(frame.depth.nan_to_num(), expected.depth.nan_to_num())
