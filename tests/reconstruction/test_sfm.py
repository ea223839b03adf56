"""Poses and points from images alone, and their scale."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
import torch

from coliags_plugin.core.images import read_rgb, write_image
from coliags_plugin.engine.data_formats import open_scene
from coliags_plugin.geometry.poses import colmap
from coliags_plugin.geometry.poses.alignment import align, associate
from coliags_plugin.geometry.poses.trajectory import Trajectory, rigid
from coliags_plugin.phantom.generate import generate
from coliags_plugin.phantom.settings import PhantomSettings
from coliags_plugin.reconstruction.structure.colmap_scene import write_sfm_scene
from coliags_plugin.reconstruction.structure.image_files import file_names, list_images, mask_of, masks_for
from coliags_plugin.reconstruction.structure.sfm import (
    Reconstruction,
    distances_beside,
    from_diameter,
    from_distance,
    reconstruct,
    scaled,
)
from coliags_plugin.reconstruction.structure.sfm_settings import CameraSettings, SfmSettings, distortion
from coliags_plugin.reporting.image_files import write_png
from tests.commands import refuses
from tests.textured_tube import INTRINSICS, tube_frames, write_tube

KNOWN = SfmSettings(camera=CameraSettings(model="PINHOLE", params=INTRINSICS))
COUNT = 6
TRUTH = np.stack([frame.camera.camera_to_world.numpy() for frame in tube_frames(COUNT, 3.0)])


@pytest.fixture(scope="module")
def tube(tmp_path_factory):
    return write_tube(tmp_path_factory.mktemp("tube") / "scene", COUNT, 3.0) / "images"


@pytest.fixture(scope="module")
def atlas(tube):
    return reconstruct(list_images(tube), KNOWN)


@pytest.fixture(scope="module")
def largest(atlas):
    return atlas.largest


def share_of_path(trajectory, poses):
    """ATE after Sim(3) alignment, as a share of the path; and the rotational RPE, degrees."""
    reference = Trajectory(poses)
    matches = associate(trajectory, reference, "index")
    result = align(trajectory, reference, matches, with_scale=True)
    return result.ate_share, result.rpe_rotation_deg.rmse


def test_a_known_camera_finds_its_path(atlas, largest):
    assert largest.registered == tuple(range(COUNT))
    assert (atlas.lost, len(atlas.models)) == ({}, 1)
    error, degrees = share_of_path(largest.trajectory, TRUTH)
    assert error < 0.005
    assert degrees < 0.2
    (camera,) = largest.model.cameras.values()
    assert tuple(camera.params) == INTRINSICS
    assert f"{COUNT} of {COUNT} images posed" in largest.summary()
    assert largest.trajectory.names == tuple(path.name for path in largest.images)
    depths = []
    for place, pose in zip(largest.registered, largest.camera_to_world, strict=True):
        for observation in largest.model.images[place + 1].get_observation_points2D():
            point = largest.model.points3D[observation.point3D_id].xyz
            depths.append(((point - pose[:3, 3]) @ pose[:3, :3])[2])
    assert largest.median_depth == pytest.approx(np.median(depths))


def test_the_written_scene_is_read_as_it_is(atlas, largest, tmp_path):
    mask = np.ones((128, 160), bool)
    mask[:20] = False
    write_sfm_scene(tmp_path / "scene", atlas, mask)
    for path in largest.images:
        assert (tmp_path / "scene" / "images" / path.name).read_bytes() == path.read_bytes()
    np.testing.assert_allclose(
        colmap.read(tmp_path / "scene" / "sparse" / "0").camera_to_world, largest.camera_to_world
    )
    scene = open_scene(tmp_path / "scene", options=["split=all-train"])
    assert len(scene.points) == largest.model.num_points3D()
    assert all(len(frame.sparse_depth.depth) > 20 and not frame.mask[:20].any() for frame in scene.train)
    # Points have the images' colours.
    assert scene.points.colors.float().std() > 20


@pytest.mark.thorough
def test_a_phantom_is_found_without_its_camera(tmp_path, caplog):
    phantom = tmp_path / "scene"  # with enough texture for features
    small = {"frames": 12, "width": 200, "height": 160, "rotation_views": 0, "mesh_spacing": 0.8}
    generate(PhantomSettings(**small, texture_spacing=0.2, interreflection=0.0, supersampling=1), phantom)
    images = list_images(phantom / "images")
    with caplog.at_level(logging.INFO):
        largest = reconstruct(images).largest
    assert len(largest.registered) == len(images)
    assert share_of_path(largest.trajectory, np.load(phantom / "truth" / "camera_to_world.npy"))[0] < 0.005
    (camera,) = largest.model.cameras.values()
    assert camera.model_name == "SIMPLE_RADIAL" and distortion(camera) < 0.1
    assert camera.focal_length == pytest.approx(json.loads((phantom / "camera.json").read_text())["fx"], rel=0.1)
    assert not [record for record in caplog.records if record.levelname == "WARNING"]
    # The lamp is at the lens.
    assert largest.correlation < -0.5


@pytest.mark.thorough
def test_an_implausible_focal_length_is_refused(tube):
    camera = CameraSettings(model="SIMPLE_PINHOLE", refine=False, focal_factors=(2.5,))
    message = r"implausible focal lengths \(SIMPLE_PINHOLE, focal length 400 px \(23 degrees\).*40 to 150 degrees"
    refusal(message, tube, SfmSettings(camera=camera))
    wide = camera.model_copy(update={"field_of_view": (20.0, 150.0)})
    assert reconstruct(list_images(tube), SfmSettings(camera=wide)).largest.registered


@pytest.mark.thorough
def test_features_of_a_long_video_are_those_of_its_sharpest_images(tube, tmp_path):
    for place, path in enumerate(list_images(tube)):
        image = read_rgb(path)
        soft = cv2.GaussianBlur(image, (0, 0), 3.0)
        first, second = (soft, image) if place % 2 else (image, soft)
        write_png(tmp_path / f"{2 * place}.png", torch.from_numpy(first))
        write_png(tmp_path / f"{2 * place + 1}.png", torch.from_numpy(second))
    settings = KNOWN.model_copy(update={"features_at_most": COUNT})
    sharp = reconstruct(list_images(tmp_path), settings)
    assert [path.stem for path in sharp.images] == ["0", "3", "4", "7", "8", "11"]
    assert share_of_path(sharp.largest.trajectory, TRUTH)[0] < 0.005


@pytest.mark.thorough
def test_images_of_something_else_are_left_out_and_named(tube, tmp_path, caplog):
    for path in list_images(tube):
        write_png(tmp_path / path.name, read_rgb(path))
    write_png(tmp_path / "9_other.png", np.random.default_rng(0).integers(0, 255, (128, 160, 3)).astype(np.uint8))
    atlas = reconstruct(list_images(tmp_path), KNOWN)
    assert [atlas.images[index].name for index in atlas.lost] == ["9_other.png"]
    assert f"1 of {COUNT + 1} images have no pose: 9_other.png" in caplog.text
    write_sfm_scene(tmp_path / "scene", atlas)
    assert not (tmp_path / "scene" / "images" / "9_other.png").exists()
    assert len(open_scene(tmp_path / "scene", options=["split=all-train"]).train) == COUNT


@pytest.mark.thorough
def test_models_of_other_cameras_keep_their_own(tube, tmp_path):
    """Two tubes in images of two sizes have no camera in common."""
    for index, frame in enumerate(tube_frames(COUNT, 3.0)):
        write_png(tmp_path / f"0_{index}.png", frame.image.numpy())
    for index, frame in enumerate(tube_frames(5, 3.0, (200, 160))):
        write_png(tmp_path / f"1_{index}.png", np.ascontiguousarray(frame.image.numpy()[::-1, :, ::-1]))
    camera = CameraSettings(model="SIMPLE_PINHOLE", focal_factors=(0.63,))
    atlas = reconstruct(list_images(tmp_path), SfmSettings(camera=camera))
    assert [model.registered for model in atlas.models] == [tuple(range(COUNT)), tuple(range(COUNT, COUNT + 5))]
    sizes = [{(camera.width, camera.height) for camera in model.model.cameras.values()} for model in atlas.models]
    assert sizes == [{(160, 128)}, {(200, 160)}]


@pytest.mark.thorough
def test_masked_parts_have_no_features(tube):
    mask = np.ones((128, 160), bool)
    mask[64:] = False
    half = reconstruct(list_images(tube), KNOWN, mask).largest
    rows = [point.y() for image in half.model.images.values() for point in image.get_observation_points2D()]
    assert max(rows) < 62


@pytest.mark.thorough
def test_nothing_is_said_by_the_library(tube, capfd):
    logging.getLogger("coliags_plugin").setLevel(logging.ERROR)
    try:
        reconstruct(list_images(tube), SfmSettings())
    finally:
        logging.getLogger("coliags_plugin").setLevel(logging.NOTSET)
    assert capfd.readouterr() == ("", "")


def test_interrupts_are_heard(tube):
    def interrupted(title, done, total):
        if title == "find poses":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reconstruct(list_images(tube), KNOWN, progress=interrupted)
    assert pycolmap.logging.minloglevel < 3


# Refusals


def refusal(match, tube, settings=KNOWN, masks=None):
    refuses(match, reconstruct, list_images(tube), settings, masks)


def test_images_without_motion_are_refused(tube, tmp_path):
    image, rng = read_rgb(list_images(tube)[0]), np.random.default_rng(0)
    for index in range(4):
        write_png(
            tmp_path / f"{index}.png", np.clip(image + rng.normal(0.0, 2.0, image.shape), 0, 255).astype(np.uint8)
        )
    refusal(r"no model from 4 images with \d+ points.*\(4 images: .*the camera has to move", tmp_path)


def test_images_that_repeat_are_left_out_and_named(largest, tube, tmp_path, caplog):
    for index, path in enumerate(list_images(tube)):
        for again in range(3):
            write_png(tmp_path / f"{index}_{again}.png", read_rgb(path))
    atlas = reconstruct(list_images(tmp_path), KNOWN)
    assert [path.name for path in atlas.images] == [f"{index}_0.png" for index in range(COUNT)]
    np.testing.assert_array_equal(atlas.largest.camera_to_world, largest.camera_to_world)
    assert "12 of 18 images repeat the one before and are left out: 0_1.png, 0_2.png, 1_1.png" in caplog.text
    for path in list_images(tmp_path)[3:]:
        path.unlink()
    refusal("all 3 images show the same", tmp_path)


@pytest.mark.thorough
def test_black_surroundings_move_the_cameras_centre(largest, tube, tmp_path):
    """An unknown camera has the same path as in the picture alone."""
    settings = SfmSettings(camera=CameraSettings(model="SIMPLE_PINHOLE", focal_factors=(0.63,), refine=False))
    alone = reconstruct(list_images(tube), settings).largest
    shown = np.zeros((150, 260), bool)
    shown[10:138, 80:240] = True
    for path in list_images(tube):
        image = np.zeros((150, 260, 3), np.uint8)
        image[10:138, 80:240] = read_rgb(path)
        write_png(tmp_path / path.name, image)
    framed = reconstruct(list_images(tmp_path), settings, shown).largest
    (camera,) = framed.model.cameras.values()
    assert (camera.width, camera.height) == (260, 150)
    assert tuple(camera.params) == pytest.approx((0.63 * 160, 80 + 80, 10 + 64))
    assert framed.summary().split(", ")[-1] == alone.summary().split(", ")[-1]
    assert share_of_path(framed.trajectory, alone.camera_to_world)[0] < 0.01


def test_cameras_that_are_none_are_refused(tube):
    settings = SfmSettings(camera=CameraSettings(model="PINHOLES"))
    refusal("camera model PINHOLES. Expected one of .*OPENCV_FISHEYE", tube, settings)


def test_images_and_masks_of_other_sizes_are_refused(tube, tmp_path):
    write_png(tmp_path / "0.png", read_rgb(list_images(tube)[0]))
    write_png(tmp_path / "1.png", np.zeros((20, 30, 3), np.uint8))
    refusal("1.png is 30 x 20, 0.png 160 x 128. Expected images of one size", tmp_path, KNOWN)
    refusal("the mask of .*0.png is 30 x 20, the image 160 x 128", tmp_path, KNOWN, np.ones((20, 30), bool))


def test_folders_without_images_are_refused(tmp_path):
    refuses(r"no folder .*nowhere", list_images, tmp_path / "nowhere")
    (tmp_path / "video.mp4").write_bytes(b"film")
    refuses(r"video.mp4 is a file. Expected a folder of images.*ffmpeg -i", list_images, tmp_path / "video.mp4")
    refuses(r"holds 0 images", list_images, tmp_path)
    (tmp_path / "0.png").write_bytes(b"")
    (tmp_path / "1.png").write_bytes(b"no image")
    refuses(r"0.png \(0 bytes\) cannot be decoded", reconstruct, list_images(tmp_path))
    refuses("1 image", reconstruct, [tmp_path / "0.png"])


# Images, masks and settings


KINDS = ("grey", "16 bits", "alpha")


@pytest.mark.parametrize(
    ("kind", "suffix"),
    [("grey", ".jpg"), ("grey", ".bmp"), *((kind, suffix) for kind in KINDS for suffix in (".png", ".tif"))],
)
def test_images_are_written_as_readers_take_them(atlas, largest, tmp_path, kind, suffix):
    expected = {path.stem: read_rgb(path) for path in largest.images}
    images = tuple(tmp_path / f"{stem}{suffix}" for stem in expected)
    for path, rgb in zip(images, expected.values(), strict=True):
        shown = np.where(np.arange(rgb.shape[1]) < 40, 0, 255).astype(np.uint8)[None].repeat(len(rgb), 0)
        kinds = {"grey": rgb[..., 1], "16 bits": rgb.astype(np.uint16) * 257, "alpha": np.dstack([rgb, shown])}
        write_image(path, kinds[kind])
    model = pycolmap.Reconstruction(largest.model)
    for image in model.images.values():
        image.name = Path(image.name).stem + suffix
    changed = replace(largest, model=model, images=images, names=tuple(path.name for path in images))
    write_sfm_scene(tmp_path / "scene", replace(atlas, images=images, models=(changed,)))
    for frame in open_scene(tmp_path / "scene", options=["split=all-train"]).train:
        rgb = expected[frame.name]
        rgb = np.dstack([rgb[..., 1]] * 3) if kind == "grey" else rgb
        np.testing.assert_allclose(frame.image.numpy().astype(int), rgb, atol=12 if suffix == ".jpg" else 0)
        assert frame.mask is None if kind != "alpha" else (~frame.mask[:, :40]).all() and frame.mask[:, 40:].all()


def test_images_in_order_what_hides_in_their_folder_and_what_is_not_read(tmp_path, caplog):
    for name in ("10.png", "2.JPG", "._1.png", "._2.JPG", "Thumbs.db", ".DS_Store", "3.webp"):
        (tmp_path / name).touch()
    assert [path.name for path in list_images(tmp_path)] == ["2.JPG", "3.webp", "10.png"]
    assert not caplog.records
    assert file_names(["2", "10"], ".png") == ["2.png", "10.png"]
    assert file_names(["b", "a/c"], "") == ["00000_b", "00001_a-c"]
    for index in range(4, 9):
        (tmp_path / f"{index}.HEIC").touch()
    assert len(list_images(tmp_path)) == len(list_images(tmp_path)) == 3
    assert caplog.messages == [f"{tmp_path}: 5 images are not read, as 4.HEIC: convert them"]
    for path in list_images(tmp_path):
        path.unlink()
    refuses(r"holds 0 images that are read, and .*4\.HEIC.*Convert them", list_images, tmp_path)


def test_masks_of_a_file_and_of_a_folder(tmp_path):
    images = [Path("a.jpg"), Path("b.jpg")]
    black, white = np.zeros((4, 6, 3), np.uint8), np.full((4, 6, 3), 255, np.uint8)
    write_png(tmp_path / "masks" / "a.jpg.png", black)
    write_png(tmp_path / "masks" / "b.png", white)
    masks = masks_for(tmp_path / "masks", images)
    assert not masks[images[0]].any() and masks[images[1]].all()
    assert masks_for(tmp_path / "masks" / "b.png", images).all()
    transparent = np.dstack([white, np.uint8([[0, 0, 0, 255, 255, 255]] * 4)])
    write_image(tmp_path / "b.png", transparent)
    np.testing.assert_array_equal(mask_of(tmp_path / "b.png", masks[images[1]]), transparent[..., 3] > 0)
    np.testing.assert_array_equal(mask_of(tmp_path / "b.png", None), transparent[..., 3] > 0)
    refuses(r"has no mask for c.jpg. Expected c.jpg.png or c.png", masks_for, tmp_path / "masks", [Path("c.jpg")])


RADIUS = 2.5


def straight(length=20.0, ahead=10.0):
    """A camera on the axis of a tube whose wall reaches ahead of it and behind."""
    rng = np.random.default_rng(0)
    z, turn = rng.uniform(-ahead, length + ahead, 400), rng.uniform(0, 2 * np.pi, 400)
    model = pycolmap.Reconstruction()
    for point in np.column_stack([RADIUS * np.cos(turn), RADIUS * np.sin(turn), z]):
        model.add_point3D(point, pycolmap.Track(), np.zeros(3, np.uint8))
    centers = np.column_stack([np.zeros((5, 2)), np.linspace(0.0, length, 5)])
    images = tuple(Path(f"folder/{index}.png") for index in range(6))
    poses = rigid(np.tile(np.eye(3), (5, 1, 1)), centers)
    return Reconstruction(images, tuple(range(5)), poses, tuple(path.name for path in images), model, (5,))


def test_the_scale_from_a_diameter_or_a_distance_and_models_of_it():
    before = straight()
    path = np.array([(0, 0, 0), (10, 0, 0), (10, 10, 0)], float)
    points = np.array([(5, 0, 3), (10, 5, -4), (12, -2, 1), (-1, 0, 2), (10, 11, 0)], float)
    np.testing.assert_allclose(distances_beside(path, points), [3.0, 4.0, 3.0])
    assert from_diameter(before, 45.0) == pytest.approx(45.0 / (2 * RADIUS))
    assert from_distance(before, "0.png", "4", 100.0) == pytest.approx(5.0)
    for scale, message in (
        (lambda: from_diameter(straight(length=0.5), 45.0), r"lie beside the camera's path. Expected at least 30"),
        (lambda: from_distance(before, "0.png", "5.png", 1.0), r"no image '5.png' with a pose"),
        (lambda: from_distance(before, "0.png", "0", 1.0), "coincide"),
    ):
        refuses(message, scale)
    after = scaled(before, 4.0)
    np.testing.assert_allclose(after.camera_to_world[:, :3, 3], 4.0 * before.camera_to_world[:, :3, 3])
    np.testing.assert_array_equal(after.camera_to_world[:, :3, :3], before.camera_to_world[:, :3, :3])
    for number, point in before.model.points3D.items():
        np.testing.assert_allclose(after.model.points3D[number].xyz, 4.0 * point.xyz)
