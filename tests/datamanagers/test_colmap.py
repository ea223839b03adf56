"""The colmap data manager: every camera of COLMAP's, its phantom, real models, and what is refused."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
import torch
from pydantic import ValidationError

from coliags_plugin.checks.data.findings import points_findings
from coliags_plugin.core.errors import InputError
from coliags_plugin.datamanagers.colmap.files import find_models, read_model
from coliags_plugin.datamanagers.colmap.reader import ColmapDataManager, ColmapSettings
from coliags_plugin.datamanagers.recognition import find_format
from coliags_plugin.datamanagers.units import write_unit
from coliags_plugin.geometry.poses import colmap as colmap_poses
from tests.datamanagers.colmap_scenes import CAMERAS, HEIGHT, POINTS, WIDTH, camera, taken, wall_model, write_colmap
from tests.datamanagers.wall_scenes import look, off_wall, poses
from tests.phantom.phantom_layouts import distance_from_wall, in_video_order, read, write_phantom


def load(folder: Path, **options):
    return ColmapDataManager(ColmapSettings(**options)).load(folder)


def opened(folder: Path, **options):
    return ColmapDataManager(ColmapSettings(**options)).open(folder)


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory) -> Path:
    """Nine images of the wall, never changed."""
    return write_colmap(tmp_path_factory.mktemp("colmap") / "wall")


@pytest.fixture
def folder(scene_folder, tmp_path) -> Path:
    """A copy to be spoilt."""
    return Path(shutil.copytree(scene_folder, tmp_path / "wall"))


def sparse_points(frame) -> np.ndarray:
    """World positions of a frame's sparse depth. [K, 3]"""
    camera, sparse = frame.camera, frame.sparse_depth
    xy = (sparse.pixels - torch.tensor([camera.cx, camera.cy])) / torch.tensor([camera.fx, camera.fy])
    local = torch.cat([xy, torch.ones(len(xy), 1)], dim=1) * sparse.depth[:, None]
    return (local @ camera.camera_to_world[:3, :3].T + camera.center).double().numpy()


# What is read


def test_the_list_of_cameras_is_colmaps():
    assert set(pycolmap.CameraModelId.__members__) == {*CAMERAS, "INVALID", "EQUIRECTANGULAR"}


@pytest.mark.parametrize("model", CAMERAS)
def test_images_of_every_camera_become_pinhole_images(model, tmp_path):
    scene = load(write_colmap(tmp_path, [camera(model)], [f"{index}.png" for index in range(4)]))
    fx, fy = CAMERAS[model][0], CAMERAS[model][0 if camera(model).focal_length_x == camera(model).focal_length_y else 1]
    for frame in in_video_order(scene):
        cam = frame.camera
        assert (cam.fx, cam.fy, cam.cx, cam.cy, cam.width, cam.height) == (fx, fy, 33.5, 21.5, WIDTH, HEIGHT)
        np.testing.assert_allclose(cam.camera_to_world, poses(4)[frame.index], atol=1e-6)
        columns, rows = np.meshgrid((np.arange(WIDTH) + 0.5 - cam.cx) / fx, (np.arange(HEIGHT) + 0.5 - cam.cy) / fy)
        _, color = look(poses(4)[frame.index], np.stack([columns, rows, np.ones_like(rows)], -1))
        off = np.abs(color.astype(int) - frame.image.numpy())[frame.valid.numpy()]
        assert np.mean(off) < 0.6 and np.quantile(off, 0.999) <= 4
        assert frame.valid.float().mean() > 0.75
        assert len(frame.sparse_depth.depth) > 50
        assert off_wall(sparse_points(frame)).max() < 1e-4


def test_observations_that_poses_do_not_explain_are_counted(folder):
    assert load(folder).provenance["misplaced_observations"] == 0
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    for image in model.images.values():
        pose = image.cam_from_world()
        image.frame.set_cam_from_world(image.camera_id, pycolmap.Rigid3d(pose.rotation, 3.0 * pose.translation))
    model.write(folder / "sparse" / "0")
    wrong = load(folder)
    facts = wrong.provenance
    assert facts["misplaced_observations"] > 0.7 * facts["observations"]
    assert "poses and points of the model contradict each other" in [found.what for found in points_findings(facts)]


def test_pinhole_images_are_left_alone(scene_folder):
    frame = load(scene_folder).train[0]
    np.testing.assert_array_equal(frame.image.numpy(), taken(camera(), poses(9)[1])[1])
    assert frame.mask is None and frame.depth is None


def test_text_is_binary(scene_folder, tmp_path):
    one, other = read_model(scene_folder / "sparse/0"), read_model(write_colmap(tmp_path, text=True) / "sparse/0")
    assert [image.name for image in one.images] == [image.name for image in other.images]
    assert one.cameras == other.cameras
    for name in ("camera_to_world", "positions", "colors", "track_lengths"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=1e-12, atol=1e-12)
    for first, second in zip(one.images, other.images, strict=True):
        np.testing.assert_allclose(first.observed, second.observed, rtol=1e-12)
        np.testing.assert_array_equal(first.points, second.points)


def test_points_are_initial_points(scene_folder):
    scene = load(scene_folder)
    assert len(scene.points) == POINTS
    assert off_wall(scene.points.positions.double().numpy()).max() < 1e-4
    model = pycolmap.Reconstruction(str(scene_folder / "sparse/0"))
    known = {tuple(np.float32(point.xyz)): tuple(point.color) for point in model.points3D.values()}
    for position, color in zip(scene.points.positions.numpy(), scene.points.colors.numpy(), strict=True):
        assert known[tuple(position)] == tuple(color)


def test_points_that_test_frames_observe_are_told(scene_folder):
    scene = load(scene_folder)
    observing = [frame.name for frame in scene.test_sets["test"] if frame.sparse_depth is not None]
    assert observing
    assert scene.provenance["held_out_used"] == {"points": observing}
    assert "held_out_used" not in load(scene_folder, split="all-train").provenance


def test_scale_makes_millimetres(tmp_path):
    write_colmap(tmp_path, unit=25.0)
    raw, metric = load(tmp_path), load(tmp_path, scale=25.0)
    assert raw.train[2].camera.center.norm() == pytest.approx(float(metric.train[2].camera.center.norm()) / 25.0)
    assert off_wall(metric.points.positions.double().numpy()).max() < 1e-4
    frame = metric.train[2]
    np.testing.assert_allclose(frame.camera.camera_to_world, poses(9)[frame.index], atol=1e-5)
    assert off_wall(sparse_points(frame)).max() < 1e-4
    torch.testing.assert_close(raw.train[2].sparse_depth.depth * 25.0, frame.sparse_depth.depth)
    torch.testing.assert_close(raw.train[2].sparse_depth.pixels, frame.sparse_depth.pixels)
    assert metric.provenance["scale"] == 25.0


def test_the_unit_is_unknown_until_it_is_stated(folder):
    assert not load(folder).is_metric
    write_unit(folder, "mm")
    assert load(folder).is_metric
    unknown, raw, metric = load(folder, unit="unknown"), load(folder), load(folder, unit="cm")
    assert not unknown.is_metric and metric.is_metric
    torch.testing.assert_close(metric.points.positions, 10.0 * raw.points.positions)
    for frame, given in zip(metric.train, raw.train, strict=True):
        torch.testing.assert_close(frame.camera.center, 10.0 * given.camera.center)
        torch.testing.assert_close(frame.sparse_depth.depth, 10.0 * given.sparse_depth.depth)
    with pytest.raises(ValidationError, match="inch"):
        load(folder, unit="inch")


def test_cameras_of_different_sizes_each_have_their_view(tmp_path):
    cameras = [camera(), camera("OPENCV", 2, 60, 44), camera("SIMPLE_RADIAL", 3)]
    frames = in_video_order(load(write_colmap(tmp_path, cameras)))
    assert [(frame.camera.width, frame.camera.height) for frame in frames[:3]] == [(64, 48), (60, 44), (64, 48)]
    for frame in frames:
        assert frame.image.shape[:2] == (frame.camera.height, frame.camera.width)
        assert off_wall(sparse_points(frame)).max() < 1e-4
    shared = [frame.camera for frame in in_video_order(load(tmp_path, width=32, height=24))]
    assert {(cam.width, cam.height) for cam in shared} == {(32, 24)}


def test_sparse_depth_follows_the_working_size_and_focal_scale(tmp_path):
    write_colmap(tmp_path, [camera("OPENCV")])
    for frame in load(tmp_path, width=41, height=33, focal_scale=0.7).train:
        assert off_wall(sparse_points(frame)).max() < 1e-4


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


def test_images_come_in_the_order_of_their_numbers(tmp_path):
    names = ["cam1/10.png", "cam1/9.png", "cam0/100.png", "cam0/20.jpg"]
    shots = opened(write_colmap(tmp_path, names=names)).shots
    assert [shot.name for shot in shots] == ["cam0-20", "cam0-100", "cam1-9", "cam1-10"]
    for shot, index in zip(shots, (3, 2, 1, 0), strict=True):
        assert shot.image == tmp_path / "images" / names[index]
        np.testing.assert_allclose(shot.camera_to_world, poses(4)[index], atol=1e-12)


def test_names_keep_their_suffix_where_they_must(tmp_path):
    shots = opened(write_colmap(tmp_path, names=["a/1.png", "a/1.jpg"])).shots
    assert sorted(shot.name for shot in shots) == ["1.jpg", "1.png"]


@pytest.mark.parametrize("pattern", ["{}.png.png", "{}.png"])
def test_masks_in_both_ways_of_naming_them(folder, pattern):
    (folder / "masks").mkdir()
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:10, :20] = 0
    for index in (1, 3):
        cv2.imwrite(str(folder / "masks" / pattern.format(index)), mask)
    scene = load(folder)
    frames = {frame.index: frame for frame in scene.train}
    np.testing.assert_array_equal(frames[1].mask.numpy(), mask > 0)
    np.testing.assert_array_equal(frames[3].mask.numpy(), mask > 0)
    assert frames[2].mask is None
    assert scene.provenance["masks"] == 2


@pytest.mark.parametrize("suffix", [".png", ".npy", ".png.tiff"])
def test_depth_files(folder, suffix):
    (folder / "depths").mkdir()
    for index, pose in enumerate(poses(9)):
        depth, _ = taken(camera(), pose)
        depth[0, 0] = 0.0
        path = folder / "depths" / f"{index}{suffix}"
        if suffix == ".npy":
            depth[0, 1] = np.nan
            np.save(path, (depth / 0.002).astype(np.float32)[..., None])
        else:
            cv2.imwrite(str(path), np.rint(depth / 0.002).astype(np.uint16))
    scene = load(folder, depth_unit=0.002, initial_points="depth")
    for frame in scene.train:
        expected, _ = taken(camera(), poses(9)[frame.index])
        expected[0, 0] = np.nan
        if suffix == ".npy":
            expected[0, 1] = np.nan
        np.testing.assert_allclose(frame.depth.numpy(), expected, atol=0.0011)
    assert len(scene.points) > 1000
    assert len(load(folder, depth_unit=0.002).points) == POINTS
    (folder / "depths" / f"4{suffix}").unlink()
    with pytest.raises(InputError, match=r"depths has no file for 1 of 9 images, the first of them 4\.png"):
        load(folder)


def test_depth_only_of_points_that_are_seen_often_and_fall_where_they_were_seen(tmp_path):
    names = [f"{index}.png" for index in range(5)]
    write_colmap(tmp_path, names=names)
    model = wall_model([camera()], names)
    moved, rare, twice = [number for number, point in model.points3D.items() if point.track.length() == 5][:3]

    def place(number: int, image: int) -> int:
        return next(e.point2D_idx for e in model.point3D(number).track.elements if e.image_id == image)

    point = model.image(2).points2D[place(moved, 2)]
    point.xy = point.xy + np.array([1.5, -2.0])
    for number, images in ((rare, (1, 2, 3)), (twice, (1, 2))):
        for image in images:
            model.delete_observation(image, place(number, image))
    model.write_binary(str(tmp_path / "sparse/0"))

    def counts(**options) -> list[int]:
        return [len(shot.sparse_depth.depth) for shot in opened(tmp_path, **options).shots]

    def seen(least: int, less: int = 0) -> list[int]:
        """Points of each image with tracks of so many images, one less in the second."""
        lengths = {number: found.track.length() for number, found in model.points3D.items()}
        per_image = [
            sum(lengths[p.point3D_id] >= least for p in image.get_observation_points2D())
            for _, image in sorted(model.images.items())
        ]
        return [number - less * (index == 1) for index, number in enumerate(per_image)]

    assert counts(max_reprojection_error=2.6, min_track_length=2) == seen(2)
    assert counts(min_track_length=2) == seen(2, less=1)
    assert counts() == seen(3, less=1)
    assert counts(min_track_length=4) == seen(4, less=1)
    assert sum(seen(2)) > sum(seen(3)) > sum(seen(4))
    assert len(load(tmp_path).points) == POINTS


def test_a_point_seen_twice_in_an_image_has_one_depth(tmp_path):
    names = ["0.png", "1.png", "2.png"]
    write_colmap(tmp_path, names=names)
    before = opened(tmp_path).shots[0].sparse_depth
    model, doubled = wall_model([camera()], names), pycolmap.Reconstruction()
    doubled.add_camera_with_trivial_rig(camera())
    seen = model.image(1).points2D
    tracks = {number: list(point.track.elements) for number, point in model.points3D.items()}
    tracks[seen[0].point3D_id].append(pycolmap.TrackElement(1, len(seen)))
    for number, image in sorted(model.images.items()):
        places = [point.xy for point in image.points2D] + [seen[0].xy + 0.5] * (number == 1)
        copied = pycolmap.Image(name=image.name, camera_id=1, image_id=number)
        copied.points2D = pycolmap.Point2DList([pycolmap.Point2D(place) for place in places])
        doubled.add_image_with_trivial_frame(copied, image.cam_from_world())
    for number, track in sorted(tracks.items()):
        doubled.add_point3D(model.point3D(number).xyz, pycolmap.Track(track), model.point3D(number).color)
    doubled.write_binary(str(tmp_path / "sparse/0"))
    assert doubled.image(1).num_points3D == len(seen) + 1
    after = opened(tmp_path).shots[0].sparse_depth
    torch.testing.assert_close(after.pixels.sort(dim=0).values, before.pixels.sort(dim=0).values)


# Where a model is found


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "."])
@pytest.mark.parametrize("text", [False, True])
def test_places_of_a_model(tmp_path, place, text):
    write_colmap(tmp_path, place=place, text=text)
    assert find_models(tmp_path) == [tmp_path / place]
    assert find_format(tmp_path) == "colmap"
    assert opened(tmp_path).facts["model"] == str(tmp_path / place)


def test_a_model_of_ones_own_choice(folder, caplog):
    shutil.copytree(folder / "sparse/0", folder / "sparse/1")
    shutil.copytree(folder / "sparse/0", folder / "sparse/10")
    with caplog.at_level(logging.WARNING):
        assert opened(folder).facts["model"] == str(folder / "sparse/0")
    assert "sparse/1, sparse/10" in caplog.text
    assert opened(folder, model="sparse/10").facts["model"] == str(folder / "sparse/10")
    with pytest.raises(InputError, match="sparse/7 holds no COLMAP model"):
        opened(folder, model="sparse/7")


def test_a_scene_that_nerfstudio_made_is_nerfstudios(folder):
    (folder / "transforms.json").write_text("{}")
    assert find_format(folder) == "nerfstudio"


def test_binary_before_text(folder, tmp_path):
    write_colmap(tmp_path / "text", names=["x.png"], text=True)
    for path in (tmp_path / "text/sparse/0").iterdir():
        shutil.copy(path, folder / "sparse/0")
    assert len(opened(folder).shots) == 9


def test_another_folder_of_images(folder):
    (folder / "images").rename(folder / "frames")
    assert len(load(folder, images_folder="frames").train) == 7
    with pytest.raises(InputError, match=r"no folder .*images.*images_folder"):
        load(folder)


def test_the_fingerprint_sees_the_model(folder):
    before = opened(folder).fingerprint
    assert opened(folder).fingerprint == before
    model = wall_model([camera()], [f"{index}.png" for index in range(9)], unit=2.0)
    model.write_binary(str(folder / "sparse/0"))
    assert opened(folder).fingerprint != before


# What is refused


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_binary_files_cut_anywhere_are_refused(folder, name):
    path = folder / f"sparse/0/{name}.bin"
    data = path.read_bytes()
    for size in {0, 7, 8, 9, len(data) // 3, len(data) // 2, len(data) - 8, len(data) - 1}:
        path.write_bytes(data[:size])
        with pytest.raises(InputError, match=rf"{name}\.bin \({size} bytes\) is damaged or cut short"):
            opened(folder)
    path.write_bytes(data + b"\0")
    with pytest.raises(InputError, match=rf"{name}\.bin .* is damaged"):
        opened(folder)


def test_a_camera_model_that_is_none(folder):
    path = folder / "sparse/0/cameras.bin"
    data = bytearray(path.read_bytes())
    data[12:16] = (99).to_bytes(4, "little")
    path.write_bytes(bytes(data))
    with pytest.raises(InputError, match=r"cameras\.bin .* is damaged"):
        opened(folder)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_text_files_that_end_in_rubbish(tmp_path, name):
    write_colmap(tmp_path, text=True)
    with (tmp_path / f"sparse/0/{name}.txt").open("a") as file:
        file.write("1 hello world\n")
    with pytest.raises(InputError, match=r"sparse/0"):
        opened(tmp_path)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda words: ["0", "0", "0", "0", *words[4:]], r"is not a rotation"),
        (lambda words: [*words[:4], "inf", *words[5:]], r"images\.txt, line 5"),
    ],
    ids=["zero", "infinite"],
)
def test_poses_that_are_none(tmp_path, spoil, message):
    write_colmap(tmp_path, text=True)
    path = tmp_path / "sparse/0/images.txt"
    lines = path.read_text().splitlines()
    words = lines[4].split()
    lines[4] = " ".join([words[0], *spoil(words[1:8]), *words[8:]])
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(InputError, match=message):
        opened(tmp_path)


def test_a_panorama_is_refused_by_name(tmp_path):
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="EQUIRECTANGULAR", width=64, height=32, params=[64, 32])
    )
    model.add_image_with_trivial_frame(pycolmap.Image(name="0.png", camera_id=1, image_id=1), pycolmap.Rigid3d())
    (tmp_path / "sparse").mkdir()
    model.write_binary(str(tmp_path / "sparse"))
    with pytest.raises(InputError, match="camera 1 is EQUIRECTANGULAR"):
        opened(tmp_path)


def test_a_focal_length_that_is_none(tmp_path):
    write_colmap(tmp_path, text=True)
    path = tmp_path / "sparse/0/cameras.txt"
    path.write_text(path.read_text().replace("64 48 61 55", "64 48 -61 55"))
    with pytest.raises(InputError, match=r"(cameras\.txt|focal)"):
        opened(tmp_path)


def test_no_model_at_all(tmp_path):
    with pytest.raises(InputError, match="holds no COLMAP model"):
        opened(tmp_path)
    with pytest.raises(InputError, match="no folder"):
        opened(tmp_path / "nowhere")
    (tmp_path / "images.bin").write_bytes(b"")
    assert find_models(tmp_path) == []


def test_a_model_without_points_says_what_is_missing(tmp_path):
    write_colmap(tmp_path)
    model = pycolmap.Reconstruction(str(tmp_path / "sparse/0"))
    model.delete_all_points2D_and_points3D()
    model.write_binary(str(tmp_path / "sparse/0"))
    with pytest.raises(InputError, match="points for the initial Gaussians"):
        load(tmp_path)
    assert all(shot.sparse_depth is None for shot in opened(tmp_path).shots)


# The phantom's layout


@pytest.fixture(scope="module")
def phantom(tmp_path_factory) -> Path:
    return write_phantom(tmp_path_factory.mktemp("phantoms") / "colmap", "colmap")


@pytest.mark.thorough
def test_the_phantoms_sparse_depth_lies_on_its_wall(phantom):
    for frame in in_video_order(read(phantom, "colmap")):
        assert len(frame.sparse_depth.depth) > 100
        assert distance_from_wall(phantom, torch.from_numpy(sparse_points(frame))).max() < 1e-3


def test_the_phantoms_tracks_agree_with_its_poses(phantom):
    model = pycolmap.Reconstruction(str(phantom / "sparse/0"))
    assert model.num_reg_images() == 9
    assert min(point.track.length() for point in model.points3D.values()) >= 2
    assert model.compute_mean_reprojection_error() < 1e-3
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() < 1e-3


def test_the_phantom_is_the_same_bytes_again(phantom, tmp_path):
    again = write_phantom(tmp_path / "again", "colmap")
    for path in phantom.rglob("*"):
        if path.is_file():
            assert path.read_bytes() == (again / path.relative_to(phantom)).read_bytes(), path.name


# A real model, before and after COLMAP undistorted it


@pytest.mark.parametrize("place", ["sparse", "distorted_sparse"])
def test_reprojection_error_is_the_one_colmap_finds(shared_data, place):
    folder = shared_data / "colmap_23img" / place
    model = read_model(folder)
    errors, numbers = [], []
    for image, pose in zip(model.images, model.camera_to_world, strict=True):
        local = (model.positions[image.points] - pose[:3, 3]) @ pose[:3, :3]
        seen = model.cameras[image.camera].project(local)
        errors.append(np.linalg.norm(seen - image.observed, axis=1))
        numbers.append(image.points)
    by_point = np.concatenate(numbers)
    mean = (np.bincount(by_point, np.concatenate(errors)) / np.bincount(by_point)).mean()
    reference = pycolmap.Reconstruction(str(folder))
    stored = reference.compute_mean_reprojection_error()
    reference.update_point_3d_errors()
    assert mean == pytest.approx(reference.compute_mean_reprojection_error(), rel=1e-9)
    if place == "distorted_sparse":  # the other model keeps the figure from before it was undistorted
        assert mean == pytest.approx(stored, rel=1e-9)


@pytest.mark.thorough
@pytest.mark.parametrize(("place", "model"), [("sparse", "PINHOLE"), ("distorted_sparse", "SIMPLE_RADIAL")])
def test_points_fall_where_they_were_seen_in_the_loaders_undistorted_images(shared_data, place, model):
    """As far from there as COLMAP says, in pixels of the stored image: scene cameras and views agree."""
    folder = shared_data / "colmap_23img"
    data = read_model(folder / place)
    shots = ColmapDataManager(ColmapSettings(model=place)).open(folder).shots
    assert {lens.model for lens in data.cameras.values()} == {model}
    errors, numbers = [], []
    for shot, image in zip(shots, data.images, strict=True):
        camera = shot.rectification.camera(shot.camera_to_world).to(dtype=torch.float64)
        found, depth = camera.project(torch.from_numpy(data.positions[image.points]))
        assert (depth > 0).all()
        k = shot.rectification.pinhole
        seen = data.cameras[image.camera].unproject(image.observed)[:, :2] * (k.fx, k.fy) + (k.cx, k.cy)
        stored = data.cameras[image.camera].pinhole.fx / k.fx
        errors.append(stored * np.linalg.norm(found.numpy() - seen, axis=1))
        numbers.append(image.points)
    by_point = np.concatenate(numbers)
    mean = (np.bincount(by_point, np.concatenate(errors)) / np.bincount(by_point)).mean()
    reference = pycolmap.Reconstruction(str(folder / place))
    reference.update_point_3d_errors()
    assert mean == pytest.approx(reference.compute_mean_reprojection_error(), abs=0.01)


@pytest.mark.thorough
def test_undistorting_is_what_colmap_did(shared_data):
    """Features of the SIMPLE_RADIAL model through our lens are the PINHOLE model's, which COLMAP undistorted."""
    before, after = (read_model(shared_data / "colmap_23img" / place) for place in ("distorted_sparse", "sparse"))
    for one, other in zip(before.images, after.images, strict=True):
        pinhole = after.cameras[other.camera].pinhole
        directions = before.cameras[one.camera].unproject(one.observed)[:, :2]
        pixels = directions * (pinhole.fx, pinhole.fy) + (pinhole.cx, pinhole.cy)
        np.testing.assert_allclose(pixels, other.observed, rtol=0, atol=1e-6)


def test_a_real_scene_loads(shared_data):
    folder = shared_data / "colmap_23img"
    assert find_format(folder) == "colmap"
    scene = load(folder)
    assert [frame.name for frame in scene.test_sets["test"]] == ["DSC_5283", "DSC_5291", "DSC_5299"]
    assert len(scene.train) == 20 and len(scene.points) == 1443
    assert scene.provenance["sparse_depths"] > 5500
    for frame in scene.train:
        assert frame.image.shape[:2] == (frame.camera.height, 338 if frame.camera.width == 338 else frame.camera.width)
        assert len(frame.sparse_depth.depth) > 150
    trajectory = colmap_poses.read(folder / "sparse")
    frames = in_video_order(scene)
    np.testing.assert_allclose(
        torch.stack([frame.camera.camera_to_world for frame in frames]).numpy(), trajectory.camera_to_world, atol=1e-6
    )
