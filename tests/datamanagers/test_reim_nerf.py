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

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.scenes import Scene
from coliags_plugin.datamanagers.reim_nerf.files import ray_cosines, read_sequence
from coliags_plugin.datamanagers.reim_nerf.reader import ReimNerfDataManager, ReimNerfSettings
from coliags_plugin.geometry.lenses.models import LENSES, undistortion_map
from coliags_plugin.phantom.layouts.reim_nerf import SCENE_SCALE
from tests.phantom.phantom_layouts import depth_gap, distance_from_wall, in_video_order, read, true_poses, write_phantom

WIDTH, HEIGHT, FRAMES = 90, 72, 27
LENS = LENSES["fisheye"].resized(WIDTH, HEIGHT)
#: mm a step along the ray.
STEP = math.pi / 65535 / SCENE_SCALE


def load(folder: Path, **options) -> Scene:
    return ReimNerfDataManager(ReimNerfSettings(**options)).load(folder)


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

    def test_poses_are_the_truth_in_mm(self, folder, scene):
        truth = true_poses(folder)
        for frame in in_video_order(scene):
            np.testing.assert_allclose(frame.camera.camera_to_world, truth[frame.index], rtol=1e-6, atol=1e-5)

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

    def test_depth_of_one_frame_reprojects_onto_another(self, scene):
        gap, share = depth_gap(scene.train[1], scene.test_sets["test"][4])
        assert scene.test_sets["test"][4].index == 6
        assert gap < 0.3
        assert share > 0.5

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

    def test_fusion_lies_near_the_wall(self, folder, scene):
        # Depth of the nearest stored pixel, seen along the working pixel's ray: up to half a stored pixel beside it.
        assert np.median(distance_from_wall(folder, scene.points.positions)) < 0.25


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


def _json(change, *parts: str):
    def spoil(folder):
        for part in parts or ("train", "val", "test", "true_test"):
            path = folder / f"transforms_{part}.json"
            content = json.loads(path.read_text())
            change(content)
            path.write_text(json.dumps(content))

    return spoil


def _set(key, value, *parts: str):
    return _json(lambda content: content.__setitem__(key, value), *parts)


def _frame(index, change, *parts):
    return _json(lambda content: change(content["frames"][index]), *parts)


def _image(name, array):
    return lambda folder: cv2.imwrite(str(folder / name), array)


def _matrix(change):
    def spoil(frame):
        matrix = np.array(frame["transform_matrix"])
        change(matrix)
        frame["transform_matrix"] = matrix.tolist()

    return spoil


def _flip(matrix):
    matrix[:3, 0] *= -1


def _stretch(matrix):
    matrix[:3, :3] *= 2


def _move(matrix):
    matrix[0, 3] += 0.1


def _turned():
    matrix = np.eye(4)
    matrix[:2, :2] = [[0, -1], [1, 0]]
    return matrix.tolist()


REFUSED = {
    "no train file": (lambda folder: (folder / "transforms_train.json").unlink(), r"Add transforms_train.json"),
    "no test file for the own split": (
        lambda folder: (folder / "transforms_true_test.json").unlink(),
        r"has no transforms_true_test.json.*choose another split",
    ),
    "no JSON": (lambda folder: (folder / "transforms_val.json").write_text("{"), r"transforms_val.json is not JSON"),
    "no frames": (_set("frames", [], "train"), r"transforms_train.json has no frames"),
    "no file_path": (_frame(1, lambda frame: frame.pop("file_path"), "train"), r"_train.json, frame 1: no file_path"),
    "no matrix": (
        _frame(1, lambda frame: frame.pop("transform_matrix"), "train"),
        r"_train.json, frame 1 \(images/0005_color.png\): transform_matrix is missing",
    ),
    "left-handed": (
        _frame(1, _matrix(_flip), "train"),
        r"_train.json, frame 1 \(images/0005_color.png\): a left-handed transform",
    ),
    "not rigid": (_frame(1, _matrix(_stretch), "train"), r"frame 1 \(images/0005_color.png\): not a rigid transform"),
    "two poses of a frame": (
        _frame(0, _matrix(_move), "test"),
        r"_test.json: pose or distance map of images/0000_color.png differs",
    ),
    "a frame twice": (
        _json(lambda content: content["frames"].append(content["frames"][0]), "train"),
        r"_train.json: 'images/0000_color.png' is repeated",
    ),
    "two scales": (_set("scene_scale", 0.5, "val"), r"_val.json: scene_scale differs from transforms_train.json"),
    "no scale": (_json(lambda content: content.pop("scene_scale")), r"_train.json: scene_scale = None"),
    "a scale of nothing": (_set("scene_scale", 0.0), r"_train.json: scene_scale = 0"),
    "a distance of nothing": (_set("distmap_scale", -1.0), r"_train.json: distmap_scale = -1"),
    "a turned world": (_set("scene_T", _turned()), r"_train.json: scene_T is not a translation"),
    "no shift": (_json(lambda content: content.pop("scene_T")), r"_train.json: scene_T is not a translation"),
    "another camera model": (_set("camera_model", "OPENCV"), r"camera_model 'OPENCV'.*FISHEYE_OPENCV"),
    "no size": (_json(lambda content: content.pop("w")), r"_train.json: w = None"),
    "half pixels": (_set("h", 71.5), r"an image of 90 x 71.5"),
    "tangential distortion": (_set("p1", 0.01), r"_train.json: p1 = 0.01"),
    "an image that is gone": (
        lambda folder: (folder / "images" / "0005_color.png").unlink(),
        r"_train.json names .*images/0005_color.png, which does not exist",
    ),
    "a distance map that is gone": (
        lambda folder: (folder / "distmaps" / "0005_color.png").unlink(),
        r"_train.json names .*distmaps/0005_color.png, which does not exist",
    ),
    "distances for some frames only": (
        _json(
            lambda content: [f.pop("distmap_path", None) for f in content["frames"] if "0005" in f["file_path"]],
        ),
        r"images/0005_color.png has no distmap_path, but others have",
    ),
    "no mask": (lambda folder: (folder / "rgb_mask.png").unlink(), r"no file .*rgb_mask.png.*mask: false"),
    "a mask of another size": (
        _image("rgb_mask.png", np.zeros((36, 45), np.uint8)),
        r"rgb_mask.png is 45 x 36.*90 x 72",
    ),
    "a mask in colour": (
        _image("rgb_mask.png", np.arange(HEIGHT * WIDTH * 3, dtype=np.uint8).reshape(HEIGHT, WIDTH, 3)),
        r"rgb_mask.png is a colour image.*three equal ones",
    ),
    "intrinsics of another resolution": (
        _json(lambda content: content.update(w=180, h=144), "train", "val", "test", "true_test"),
        r"rgb_mask.png is 90 x 72.*180 x 144",
    ),
    "an image of another size": (
        _image("images/0005_color.png", np.zeros((36, 45, 3), np.uint8)),
        r"images/0005_color.png is 45 x 36, but .*transforms_train.json says 90 x 72",
    ),
    "an image cut short": (
        lambda folder: (folder / "images/0005_color.png").write_bytes(
            (folder / "images/0005_color.png").read_bytes()[:-50]
        ),
        r"images/0005_color.png \(\d+ bytes\) cannot be decoded",
    ),
    "a distance map of 8 bits": (
        _image("distmaps/0005_color.png", np.ones((HEIGHT, WIDTH), np.uint8)),
        r"distmaps/0005_color.png is an image of 1 channel of uint8",
    ),
    "a distance map of three channels": (
        _image("distmaps/0005_color.png", np.ones((HEIGHT, WIDTH, 3), np.uint16)),
        r"distmaps/0005_color.png is an image of 3 channels of uint16",
    ),
}


class TestRefused:
    @pytest.mark.parametrize("name", sorted(REFUSED))
    def test_names_the_file(self, mine, name):
        spoil, message = REFUSED[name]
        spoil(mine)
        with pytest.raises(InputError, match=message):
            load(mine)

    def test_no_folder(self, tmp_path):
        with pytest.raises(InputError, match=r"no folder .*nothing"):
            load(tmp_path / "nothing")

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


def test_frames_are_in_the_order_that_people_count_in(mine):
    for path in mine.glob("transforms_*.json"):
        text = path.read_text()
        for index in range(FRAMES):
            text = text.replace(f"{index:04d}_color", f"{index}_color")
        path.write_text(text)
    for part in ("images", "distmaps"):
        for index in range(FRAMES):
            (mine / part / f"{index:04d}_color.png").rename(mine / part / f"{index}_color.png")
    frames = read_sequence(mine).frames
    assert [frame.image.stem for frame in frames] == [f"{index}_color" for index in range(FRAMES)]
