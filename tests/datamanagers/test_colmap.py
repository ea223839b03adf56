"""Particular to COLMAP: every camera of it, sparse depth, where models lie, damaged models, and real ones."""

from __future__ import annotations

import json
import shutil
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
import torch

from coliags_plugin.checks.data.findings import findings_of
from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import write_json
from coliags_plugin.core.scene_files import sidecar_files
from coliags_plugin.core.scenes import Frame
from coliags_plugin.datamanagers.colmap import find_models, read_model
from coliags_plugin.datamanagers.recorded import Recording
from coliags_plugin.engine.data_formats import find_format
from coliags_plugin.phantom.layouts import SeenPoints, add_points
from tests.datamanagers.kinds import change_lines, change_model
from tests.datamanagers.wall_scenes import colors, load_scene, look, manager, off_wall, poses, seen_from

WIDTH, HEIGHT, COUNT = 64, 48, 5
#: Off-centre; pixel centres at integers + 0.5. One set of parameters for every model that takes images.
_F, _FF, _C = [61.0], [61.0, 55.0], [33.5, 21.5]
CAMERAS = {
    "SIMPLE_PINHOLE": [*_F, *_C],
    "PINHOLE": [*_FF, *_C],
    "SIMPLE_RADIAL": [*_F, *_C, -0.12],
    "RADIAL": [*_F, *_C, -0.15, 0.03],
    "OPENCV": [*_FF, *_C, -0.15, 0.03, 0.003, -0.004],
    "FULL_OPENCV": [*_FF, *_C, -0.15, 0.03, 0.003, -0.004, 0.01, 0.02, 0.01, 0.005],
    "FOV": [*_FF, *_C, 0.7],
    "SIMPLE_RADIAL_FISHEYE": [*_F, *_C, -0.05],
    "RADIAL_FISHEYE": [*_F, *_C, -0.05, 0.01],
    "OPENCV_FISHEYE": [*_FF, *_C, -0.05, 0.01, 0.003, -0.001],
    "THIN_PRISM_FISHEYE": [*_FF, *_C, -0.05, 0.01, 0.002, -0.001, 0.0, 0.0, 0.001, -0.002],
    "RAD_TAN_THIN_PRISM_FISHEYE": [*_FF, *_C, -0.05, 0.01, 0, 0, 0, 0, 0.002, -0.001, 0.001, 0, -0.001, 0],
    "SIMPLE_DIVISION": [*_F, *_C, -0.1],
    "DIVISION": [*_FF, *_C, -0.1],
    "SIMPLE_FISHEYE": [*_F, *_C],
    "FISHEYE": [*_FF, *_C],
    "EUCM": [*_FF, *_C, 0.5, 1.1],
}
#: Points on the wall, all of them seen in every image that they fall into.
POINTS = 120
NAMES = [f"{index}.png" for index in range(COUNT)]


def camera(model: str = "PINHOLE", number: int = 1, width: int = WIDTH, height: int = HEIGHT) -> pycolmap.Camera:
    return pycolmap.Camera(camera_id=number, model=model, width=width, height=height, params=CAMERAS[model])


def taken(cam: pycolmap.Camera, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """z-depth and colour as a camera takes them; pycolmap says where its pixels look."""
    columns, rows = np.meshgrid(np.arange(cam.width) + 0.5, np.arange(cam.height) + 0.5)
    xy = cam.cam_from_img(np.stack([columns.ravel(), rows.ravel()], axis=1).astype(float))
    directions = np.concatenate([xy, np.ones((len(xy), 1))], axis=1).reshape(cam.height, cam.width, 3)
    return look(pose, directions)


def write_colmap(
    folder: Path,
    cameras: list[pycolmap.Camera] | None = None,
    names: list[str] = NAMES,
    place: str = "sparse/0",
    text: bool = False,
) -> Path:
    """The wall; image i is taken from pose i by camera i, round and round. The model is in ``place``."""
    cameras, model, seen = cameras or [camera()], pycolmap.Reconstruction(), []
    for cam in cameras:
        model.add_camera_with_trivial_rig(cam)
    # Points that the first camera sees from the first pose.
    pixels = np.random.default_rng(0).uniform(2, [cameras[0].width - 2, cameras[0].height - 2], (POINTS, 2))
    directions = np.concatenate([cameras[0].cam_from_img(pixels), np.ones((POINTS, 1))], axis=1)
    start = poses(1)[0]
    points = start[:3, 3] + look(start, directions)[0][:, None] * directions @ start[:3, :3].T
    for index, (name, pose) in enumerate(zip(names, poses(len(names)), strict=True)):
        cam, rotation = cameras[index % len(cameras)], pose[:3, :3].T
        places = cam.img_from_cam((points - pose[:3, 3]) @ pose[:3, :3])
        inside = (places > 0).all(axis=1) & (places < (cam.width, cam.height)).all(axis=1)
        seen.append(SeenPoints(places[inside], np.flatnonzero(inside)))
        image = pycolmap.Image(name=name, camera_id=cam.camera_id, image_id=index + 1)
        world_to_camera = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ pose[:3, 3])
        model.add_image_with_trivial_frame(image, world_to_camera)
        path = folder / "images" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), taken(cam, pose)[1][..., ::-1])
    add_points(model, seen, points, colors(points))
    (folder / place).mkdir(parents=True, exist_ok=True)
    (model.write_text if text else model.write_binary)(str(folder / place))
    return folder


load = partial(load_scene, "colmap")


def opened(folder: Path, **options) -> Recording:
    return manager("colmap", **options).open(folder)


@pytest.fixture(scope="module")
def wall(tmp_path_factory) -> Path:
    """Five images of the wall, never changed."""
    return write_colmap(tmp_path_factory.mktemp("colmap") / "wall")


@pytest.fixture
def mine(wall, tmp_path) -> Path:
    return Path(shutil.copytree(wall, tmp_path / "wall"))


def sparse_points(frame: Frame) -> np.ndarray:
    """World positions of a frame's sparse depth. [K, 3]"""
    camera, sparse = frame.camera, frame.sparse_depth
    xy = (sparse.pixels - torch.tensor([camera.cx, camera.cy])) / torch.tensor([camera.fx, camera.fy])
    local = torch.cat([xy, torch.ones(len(xy), 1)], dim=1) * sparse.depth[:, None]
    return (local @ camera.camera_to_world[:3, :3].T + camera.center).double().numpy()


# Cameras and images


def test_the_list_of_cameras_is_colmaps():
    assert set(pycolmap.CameraModelId.__members__) == {*CAMERAS, "INVALID", "EQUIRECTANGULAR"}


@pytest.mark.parametrize("model", CAMERAS)
def test_images_of_every_camera_become_pinhole_images(model, tmp_path):
    scene = load(write_colmap(tmp_path, [camera(model)], NAMES[:2]), split="all-train", min_track_length=2)
    fx, fy = CAMERAS[model][0], CAMERAS[model][0 if camera(model).focal_length_x == camera(model).focal_length_y else 1]
    for frame in scene.train:
        cam = frame.camera
        assert (cam.fx, cam.fy, cam.cx, cam.cy, cam.width, cam.height) == (fx, fy, 33.5, 21.5, WIDTH, HEIGHT)
        _, color = seen_from(frame, poses(2)[frame.index])
        off = np.abs(color.astype(int) - frame.image.numpy())[frame.valid.numpy()]
        assert np.mean(off) < 0.6 and np.quantile(off, 0.999) <= 4
        assert frame.valid.float().mean() > 0.75
        assert len(frame.sparse_depth.depth) > 50 and off_wall(sparse_points(frame)).max() < 1e-4


def test_cameras_of_different_sizes_each_have_their_view(tmp_path):
    cameras = [camera(), camera("OPENCV", 2, 60, 44), camera("SIMPLE_RADIAL", 3)]
    frames = load(write_colmap(tmp_path, cameras)).video
    assert [(frame.camera.width, frame.camera.height) for frame in frames[:3]] == [(64, 48), (60, 44), (64, 48)]
    for frame in (*frames, *load(tmp_path, width=41, height=33, focal_scale=0.7).train):
        assert frame.image.shape[:2] == (frame.camera.height, frame.camera.width)
        assert off_wall(sparse_points(frame)).max() < 1e-4
    assert {frame.camera.width for frame in load(tmp_path, width=41, height=33).video} == {41}


def test_a_rig_of_two_cameras(tmp_path):
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 2, 3, 30
    model = pycolmap.synthesize_dataset(options)
    (tmp_path / "sparse").mkdir()
    model.write_binary(str(tmp_path / "sparse"))
    read_back = read_model(tmp_path / "sparse")
    by_name = {image.name: image for image in model.images.values()}
    assert len(read_back.images) == 6 and len(read_back.cameras) == 2
    for image, pose in zip(read_back.images, read_back.camera_to_world, strict=True):
        expected = by_name[image.name].cam_from_world().matrix()
        np.testing.assert_allclose(np.linalg.inv(pose)[:3], expected, atol=1e-9)


@pytest.mark.parametrize(
    "pattern",
    ["masks/{}.png.png", "masks/{}.png", "mask/{}.PNG", "masks/{}.png.JPG", "masks/{}.jpg", "mask/{}.tif"],
)
def test_masks_in_every_way_of_naming_them_hide_what_they_and_alpha_hide(mine, caplog, pattern):
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:8, :16] = 0
    (mine / pattern).parent.mkdir()
    cv2.imwrite(str(mine / pattern.format(1)), mask)
    (mine / pattern.format("1").replace("/", "/._")).touch()  # macOS's
    scene = load(mine)
    assert f"1 of {COUNT} frames have a mask\n" in caplog.text
    cv2.imwrite(str((mine / pattern).parent / "9.png"), mask)
    load(mine)
    assert f"1 of {COUNT} frames have a mask; 1 other files beside the masks" in caplog.text
    np.testing.assert_array_equal(scene.train[0].mask.numpy(), mask > 0)
    assert scene.train[1].mask is None and scene.provenance.masks == 1
    alpha = np.full_like(mask, 255)
    alpha[-8:] = 0
    cv2.imwrite(str(mine / "images/1.png"), np.dstack([cv2.imread(str(mine / "images/1.png")), alpha]))
    np.testing.assert_array_equal(load(mine).train[0].mask.numpy(), np.minimum(mask, alpha) > 0)


def test_files_of_images_with_names_of_windows(tmp_path):
    for name in ("a/1.png", "a/2.jpg.png", r"a\3.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    paths = sidecar_files(tmp_path, [r"a\1.jpg", r"a\2.jpg", r"a\3.jpg", r"b\4.jpg"], (".png",))
    assert [path and path.name for path in paths.values()] == ["1.png", "2.jpg.png", r"a\3.png", None]


@pytest.mark.parametrize("name", ["1_mask.png", "frames/1.png", "1.png.txt"])
def test_masks_of_no_image_are_refused(mine, name):
    (mine / "masks" / name).parent.mkdir(parents=True)
    (mine / "masks" / name).touch()
    with pytest.raises(InputError, match=r"masks holds .*no mask of any image.*0\.png\.png"):
        load(mine)


def test_depth_files(mine):
    (mine / "depths").mkdir()
    expected = [taken(camera(), pose)[0].astype(np.float32) for pose in poses(COUNT)]
    for index, depth in enumerate(expected):
        np.save(mine / f"depths/{index}.npy", 500.0 * depth[..., None])
    scene = load(mine, depth_unit=0.002, initial_points="depth")
    for frame in scene.train:
        np.testing.assert_allclose(frame.depth.numpy(), expected[frame.index], rtol=1e-6)
    assert len(scene.points) > 1000 and len(load(mine, depth_unit=0.002).points) == POINTS
    (mine / "depths/4.npy").unlink()
    with pytest.raises(InputError, match=r"depths: 4 of 5 frames have a file NAME\.png, .*; 4\.png has none"):
        load(mine)


@pytest.fixture
def inverse(mine):
    """Depth as the reference code of 3DGS stores it, and its parameters by image."""
    (mine / "depths").mkdir()
    entries = {
        f"{i}": {"scale": 0.2 / (1.0 + 0.25 * i), "offset": (-1) ** i * 1e-3, "med_scale": 0.1} for i in range(COUNT)
    }
    for index, pose in enumerate(poses(COUNT)):
        inverse_depth, (scale, offset, _) = 1.0 / taken(camera(), pose)[0], entries[f"{index}"].values()
        steps = np.rint(65536.0 * (inverse_depth - offset) / scale).astype(np.uint16)
        steps[0, 0] = 0  # as far as the offset says; unknown where that is negative
        cv2.imwrite(str(mine / f"depths/{index}.png"), steps)
    write_json(mine / "sparse/0/depth_params.json", entries | {"med_scale": 0.1})
    return mine, entries


def test_inverse_depth_with_its_parameters(inverse, caplog):
    folder, entries = inverse
    scenes = {1.0: load(folder), 2.0: load(folder, scale=2.0), 1000.0: load(folder, unit="m")}
    for factor, scene in scenes.items():
        for frame in scene.video:
            expected = taken(camera(), poses(COUNT)[frame.index])[0]
            expected[0, 0] = np.nan if frame.index % 2 else 1000.0
            np.testing.assert_allclose(frame.depth.numpy(), factor * expected, rtol=1e-3)
    assert not caplog.records
    entries["3"]["scale"] = -1.0
    write_json(folder / "sparse/0/depth_params.json", entries)
    unknown = [bool(frame.depth.isnan().all()) for frame in load(folder).video]
    assert unknown == [False, False, False, True, False] and "1 images have no depth" in caplog.text
    shutil.rmtree(folder / "depths")
    assert load(folder).video[0].depth is None and "depth_params.json is not used" in caplog.text


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        (lambda entries: "{", {}, r"depth_params\.json is not JSON"),
        (lambda entries: json.dumps([entries]), {}, r"depth_params\.json has no 0\. Expected scale and offset"),
        (lambda entries: json.dumps(entries | {"3": None}), {}, r"depth_params\.json has no 3\. .*for this model"),
        (lambda entries: json.dumps(entries | {"3": {"scale": 1.0}}), {}, r"depth_params\.json, 3: offset is None"),
        (lambda entries: json.dumps(entries | {"3": {"scale": "1"}}), {}, r"depth_params\.json, 3: scale is '1'"),
        (json.dumps, {"depth_unit": 1.0}, r"depth_unit = 1, but .*depth_params\.json.*one of the two"),
        (lambda entries: None, {}, r"has depths/, but .*not given.*datamanager\.depth_unit=0\.001"),
    ],
)
def test_what_depth_files_hold_is_said_wholly_or_asked_for(inverse, change, options, message):
    (folder, entries), file = inverse, inverse[0] / "sparse/0/depth_params.json"
    text = change(entries)
    file.unlink() if text is None else file.write_text(text)
    with pytest.raises(InputError, match=message):
        load(folder, **options)


# Points and sparse depth


def test_points_are_initial_points_in_their_colours(wall, walls):
    scene = load(wall)
    model = pycolmap.Reconstruction(str(wall / "sparse/0"))
    color_of = {tuple(np.float32(point.xyz)): tuple(point.color) for point in model.points3D.values()}
    pairs = zip(scene.points.positions.numpy(), scene.points.colors.numpy(), strict=True)
    assert {tuple(position): tuple(color) for position, color in pairs} == color_of and len(color_of) == POINTS
    observing = [frame.name for frame in scene.test_sets["test"] if frame.sparse_depth is not None]
    assert observing and scene.provenance.held_out_used == {"points": observing}
    assert not load(wall, split="all-train").provenance.held_out_used
    # What the phantom writes agrees with its poses.
    written = pycolmap.Reconstruction(str(walls("colmap") / "sparse/0"))
    written.update_point_3d_errors()
    assert written.compute_mean_reprojection_error() < 1e-3


def test_observations_that_poses_do_not_explain_are_counted(mine):
    assert load(mine).provenance.misplaced_observations == 0

    def stretch(model: pycolmap.Reconstruction) -> None:
        for image in model.images.values():
            pose = image.cam_from_world()
            image.frame.set_cam_from_world(image.camera_id, pycolmap.Rigid3d(pose.rotation, 3.0 * pose.translation))

    change_model(stretch)(mine)
    facts = load(mine).provenance
    assert facts.misplaced_observations > 0.7 * facts.observations
    assert "poses and points of the model contradict each other" in [
        found.what for found in findings_of("points", dict(vars(facts)))
    ]


def test_depth_only_of_points_that_are_seen_often_and_fall_where_they_were_seen(mine):
    def counts(**options) -> np.ndarray:
        return np.array([len(shot.sparse_depth.depth) for shot in opened(mine, **options).shots])

    def change(model: pycolmap.Reconstruction) -> None:
        moved, rare, often = [number for number, point in model.points3D.items() if point.track.length() == COUNT][:3]

        def place(number: int, image: int) -> int:
            return next(e.point2D_idx for e in model.point3D(number).track.elements if e.image_id == image)

        point = model.image(2).points2D[place(moved, 2)]
        point.xy = point.xy + np.array([1.5, -2.0])
        for number, images in ((rare, (1, 2, 3)), (often, (1, 2))):
            for image in images:
                model.delete_observation(image, place(number, image))

    before = {least: counts(min_track_length=least) for least in (2, 3, 4)}
    change_model(change)(mine)
    for least, options, lost in (
        (2, {"min_track_length": 2, "max_reprojection_error": 2.6}, [2, 2, 1, 0, 0]),
        (2, {"min_track_length": 2}, [2, 3, 1, 0, 0]),
        (3, {}, [2, 3, 1, 1, 1]),
        (4, {"min_track_length": 4}, [2, 3, 2, 2, 2]),
    ):
        np.testing.assert_array_equal(before[least] - counts(**options), lost)
    assert len(load(mine).points) == POINTS


def test_a_point_seen_twice_in_an_image_has_one_depth(copied):
    def again(rows: list[str]) -> list[str]:
        place = next(index for index, row in enumerate(rows) if row.endswith("0000.png")) + 1
        x, y, point = rows[place].split()[:3]
        return [*rows[:place], f"{rows[place]} {float(x) + 0.5} {float(y) + 0.5} {point}", *rows[place + 1 :]]

    folder = copied("colmap-text")
    before = opened(folder).shots[0].sparse_depth
    change_lines("sparse/0/images.txt", again)(folder)
    after = opened(folder).shots[0].sparse_depth
    torch.testing.assert_close(after.pixels.sort(dim=0).values, before.pixels.sort(dim=0).values)


def test_a_model_without_points_says_what_is_missing(mine):
    change_model(lambda model: model.delete_all_points2D_and_points3D())(mine)
    with pytest.raises(InputError, match="points for the initial Gaussians"):
        load(mine)
    assert all(shot.sparse_depth is None for shot in opened(mine).shots)


# Where a model is found


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "."])
@pytest.mark.parametrize("text", [False, True])
def test_places_of_a_model(tmp_path, place, text):
    write_colmap(tmp_path, names=NAMES[:2], place=place, text=text)
    assert find_models(tmp_path) == [tmp_path / place]
    assert find_format(tmp_path) == "colmap"
    assert opened(tmp_path).facts["model"] == str(tmp_path / place)


def test_the_first_of_several_models_is_read_unless_another_is_named(mine, caplog):
    for number in (10, 1):
        shutil.copytree(mine / "sparse/0", mine / f"sparse/{number}")
    assert opened(mine).facts["model"] == str(mine / "sparse/0")
    assert "sparse/1, sparse/10" in caplog.text
    assert opened(mine, model="sparse/10").facts["model"] == str(mine / "sparse/10")
    with pytest.raises(InputError, match="sparse/7 holds no COLMAP model"):
        opened(mine, model="sparse/7")
    (mine / "transforms.json").write_text("{}")
    assert find_format(mine) == "nerfstudio"


def test_binary_goes_before_text_and_images_may_be_elsewhere(mine, tmp_path):
    write_colmap(tmp_path / "text", names=["x.png"], text=True)
    for path in (tmp_path / "text/sparse/0").iterdir():
        shutil.copy(path, mine / "sparse/0")
    (mine / "images").rename(mine / "frames")
    assert len(opened(mine, images_folder="frames").shots) == COUNT
    with pytest.raises(InputError, match=r"no folder .*images.*images_folder"):
        load(mine)


@pytest.mark.thorough
def test_undistorting_is_what_colmap_did(shared_data):
    """Features of the SIMPLE_RADIAL model through our lens are the PINHOLE model's, which COLMAP undistorted."""
    before, after = (read_model(shared_data / "colmap_23img" / place) for place in ("distorted_sparse", "sparse"))
    for distorted, other in zip(before.images, after.images, strict=True):
        pinhole = after.cameras[other.camera].pinhole
        directions = before.cameras[distorted.camera].unproject(distorted.observed)[:, :2]
        pixels = directions * (pinhole.fx, pinhole.fy) + (pinhole.cx, pinhole.cy)
        np.testing.assert_allclose(pixels, other.observed, rtol=0, atol=1e-6)
