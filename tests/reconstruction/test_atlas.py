"""Sub-maps of a video: weak places, parts of models, tests by held-out tracks, rigidity, joins, and what is written."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.images import read_rgb, write_image
from coliags_plugin.reconstruction.structure import adjustment, joining, sfm
from coliags_plugin.reconstruction.structure.adjustment import (
    TEST_EVERY,
    Rays,
    adjust,
    held_out_error,
    rigid_frames,
    rigidity,
)
from coliags_plugin.reconstruction.structure.atlas import Link, contradictions, held_part, part_of, weak_links
from coliags_plugin.reconstruction.structure.colmap_scene import write_sfm_scene
from coliags_plugin.reconstruction.structure.features import quiet_colmap
from coliags_plugin.reconstruction.structure.hypotheses import Hypothesis
from coliags_plugin.reconstruction.structure.image_files import list_images
from coliags_plugin.reconstruction.structure.joining import join_models, stretches_of
from coliags_plugin.reconstruction.structure.sfm import Atlas, reconstruct
from coliags_plugin.reconstruction.structure.sfm_settings import (
    CameraSettings,
    SfmSettings,
    TrackSettings,
    candidate_cameras,
)
from coliags_plugin.reconstruction.structure.video import read_video
from coliags_plugin.reporting.image_files import write_png
from tests.reconstruction.seen_points import COMMON, COUNT, GAP, frame_points, seen_points
from tests.textured_tube import INTRINSICS, tube_frames, write_tube

TRACKED = SfmSettings(camera=CameraSettings(model="PINHOLE", params=INTRINSICS), matching="tracks")


def test_a_model_is_weak_where_few_points_are_common_or_sides_have_another_scale():
    (link,) = weak_links(seen_points()[0])
    assert (link.after, link.points) == (GAP, COMMON) and link.log_scale == pytest.approx(0.0, abs=1e-6)
    assert link.holds and f"{COMMON} points seen from both sides" in link.reason
    links = {link.after: link for link in weak_links(seen_points(shift=25.0)[0])}
    assert links[GAP].log_scale > 0.3 and not links[GAP].holds


@pytest.mark.parametrize(("long", "is_weak"), [(3, True), (4, False)])
def test_points_that_are_seen_for_long_carry_the_scale(long, is_weak):
    """Before the gap 40 points are seen on both sides of every place, and few of them from the last frame."""
    model = part_of(seen_points()[0], range(GAP + 2))
    lasting = [number for number, point in model.points3D.items() if point.track.length() == GAP + 2]
    for number in lasting[long:]:
        model.delete_point3D(number)
    links = {link.after: link for link in weak_links(model)}
    assert (GAP - 1 in links) == is_weak
    if is_weak:
        assert (links[GAP - 1].points, links[GAP - 1].spanning) == (40 + long, long)
        assert not links[GAP - 1].holds


def test_too_few_common_points_tell_no_scale():
    for link, holds, reason in (
        (Link(0, 19, None, None, spanning=4), False, ""),
        (Link(0, 20, None, None, spanning=4), True, ""),
        (Link(0, 99, None, None, spanning=3), False, ""),
        (Link(0, 7, 0.1, 0.1), False, ""),
        (Link(0, 8, 0.1, 0.1), True, ""),
        (Link(0, 9, 0.0, 0.2), False, ""),
        (Link(0, 3, None, None), False, "too few to compare"),
        (Link(0, 99, None, None), False, "not mapped together"),
    ):
        assert link.holds == holds and reason in link.reason


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_held_out_tracks_measure_the_poses(noise):
    model, observed = seen_points()
    rng = np.random.default_rng(0)
    tracks = [
        frame_points(TEST_EVERY * points.points, points.pixels + rng.normal(0.0, noise, points.pixels.shape))
        for points in observed
    ]
    error = held_out_error(model, tracks)
    # The median length of a normal vector in the plane is 1.18; part of the noise is fitted by the point.
    assert error == pytest.approx(1.0 * noise, abs=0.25 if noise else 1e-3)
    assert held_out_error(model, [replace(frame, ids=frame.ids + 1) for frame in tracks]) is None


def test_images_of_another_scale_or_of_few_points_are_not_held():
    model, _ = seen_points()
    assert held_part(model) is model
    for observation in range(37):
        model.delete_observation(8, observation)
    assert sorted(held_part(model).reg_image_ids()) == list(range(1, COUNT))
    model = part_of(seen_points()[0], range(1, COUNT))
    for point in model.points3D.values():
        if {element.image_id for element in point.track.elements} <= {2, 3, 4}:
            point.xyz = 1000.0 * point.xyz  # what the first three images see alone
    assert sorted(held_part(model).reg_image_ids()) == list(range(5, COUNT + 1))


@pytest.mark.parametrize(("turn", "until", "leaps"), [(40.0, 4, True), (25.0, 4, False), (40.0, COUNT, False)])
def test_an_image_turned_far_from_both_neighbours_is_not_held(turn, until, leaps):
    """A turn of all that follow is one of the camera."""
    model, _ = seen_points()
    for number in range(4, until + 1):
        pose = model.images[number].cam_from_world().matrix()
        pose = Rotation.from_euler("z", turn, degrees=True).as_matrix() @ pose
        model.frames[model.images[number].frame_id].rig_from_world = pycolmap.Rigid3d(pose)
    expected = [number for number in range(1, COUNT + 1) if not (leaps and number == 4)]
    assert sorted(held_part(model).reg_image_ids()) == expected


def test_rays_of_exact_observations_meet_in_the_points():
    model, _ = seen_points()
    rays = Rays.of_points(model)
    points = rays.triangulated()
    expected = np.array([model.points3D[number].xyz for number in rays.ids])
    np.testing.assert_allclose(points, expected, atol=1e-4)
    lines = points[0] - rays.centers[rays.tracks == 0]
    lines /= np.linalg.norm(lines, axis=1, keepdims=True)
    widest = np.degrees(np.arccos((lines @ lines.T).min()))
    assert widest <= rays.angles(points)[0] <= 1.5 * widest


def test_adjustment_brings_poses_back_and_leaves_outliers_out():
    model, observed = seen_points()
    true = [model.images[number].cam_from_world().matrix() for number in range(1, COUNT + 1)]
    ids = [points.points for points in observed]
    rng = np.random.default_rng(0)
    for number in range(3, COUNT + 1):  # of two cameras the gauge is fixed
        pose = true[number - 1].copy()
        pose[:, 3] += rng.normal(0.0, 0.3, 3)
        model.frames[model.images[number].frame_id].rig_from_world = pycolmap.Rigid3d(pose)
    wrong = model.images[5].points2D[3]
    wrong.xy = wrong.xy + np.array([40.0, 0.0])
    moved = model.images[5].points2D[3].xy
    adjust(model, ids)
    for number in range(1, COUNT + 1):
        np.testing.assert_allclose(model.images[number].cam_from_world().matrix(), true[number - 1], atol=0.02)
    np.testing.assert_array_equal(model.images[5].points2D[3].xy, moved)
    assert not model.images[5].points2D[3].has_point3D()


@pytest.mark.thorough
def test_blurred_images_get_no_poses(tmp_path):
    images = list_images(write_tube(tmp_path / "scene", 8, 2.0) / "images")
    for path in images:
        write_png(path, cv2.GaussianBlur(read_rgb(path), (0, 0), 5.0))
    with pytest.raises(InputError, match=r"no model from 8 images .* \(8 images: blurred, as most images of its model"):
        reconstruct(images, TRACKED)


@pytest.mark.thorough
def test_places_between_models_are_told(tmp_path):
    images = list_images(write_tube(tmp_path / "scene", 16, 2.0) / "images")
    windows = TRACKED.model_copy(update={"tracks": TrackSettings(longest_window=8)})
    atlas = reconstruct(images, windows)
    first, second = (span for _, span in atlas.submaps())
    (link,) = atlas.refused
    assert link.after == first[-1] == second[0] - 1 and link.points > 30


@pytest.mark.thorough
def test_a_wall_that_moves_is_split(tmp_path, monkeypatch, caplog):
    """Into stretches of 12 images at least."""
    images = list_images(write_tube(tmp_path / "scene", 25, 1.0) / "images")
    for module in (sfm, joining):
        monkeypatch.setattr(module, "rigid_frames", lambda model, tracks: 10)
    atlas = reconstruct(images, TRACKED)
    assert [model.registered for model in atlas.models] == [tuple(range(13)), tuple(range(13, 25))]
    assert atlas.lost == {}
    (link,) = atlas.refused
    assert link.after == 12 and link.again.agreeing >= 10
    assert link.reason.startswith("what is seen moves too far for one rigid model; ")
    assert "what is seen moves, as rigid for 10 frames: split in 2 models" in caplog.text


def test_tracks_give_every_frame_a_pose_and_the_atlas_is_written(tmp_path):
    tracked = reconstruct(list_images(write_tube(tmp_path / "tube", 8, 2.0) / "images"), TRACKED)
    assert tracked.lost == {} and tracked.submaps() == [(0, range(8))]
    assert tracked.largest.registered == tuple(range(8)) and tracked.largest.test_error < 0.6
    half = replace(
        tracked.largest, registered=(4, 5, 6), camera_to_world=tracked.largest.camera_to_world[4:7], links=()
    )
    first = replace(tracked.largest, registered=(0, 1, 2, 3), links=(Link(1, 9, 0.0, 0.01),))
    atlas = Atlas(tracked.images, (first, half), {7: "blurred"}, (Link(3, 2, None, None),))
    write_sfm_scene(tmp_path / "scene", atlas)
    record = json.loads((tmp_path / "scene" / "atlas.json").read_text())
    assert [(submap["model"], submap["frames"]) for submap in record["submaps"]] == [
        ("sparse/0", [0, 1]),
        ("sparse/0", [2, 3]),
        ("sparse/1", [4, 5, 6]),
    ]
    assert [(join["after"], join["joined"]) for join in record["joins"]] == [(1, True), (3, False)]
    assert record["lost"] == [{"frame": 7, "reason": "blurred"}]
    assert record["frames"] == [path.name for path in tracked.images]
    assert pycolmap.Reconstruction(str(tmp_path / "scene" / "sparse" / "1")).num_reg_images() == 8
    write_sfm_scene(tmp_path / "linked", atlas, link=True)
    for folder, is_same in (("scene", False), ("linked", True)):
        image = tmp_path / folder / "images" / tracked.images[0].name
        assert image.samefile(tracked.images[0]) == is_same and image.read_bytes() == tracked.images[0].read_bytes()


@pytest.mark.thorough
def test_tracks_choose_the_lens_that_took_the_video(tmp_path):
    images = list_images(write_tube(tmp_path / "scene", 16, 2.0) / "images")
    atlas = reconstruct(images, SfmSettings(matching="tracks"))
    (camera,) = atlas.largest.model.cameras.values()
    assert camera.model_name == "SIMPLE_RADIAL_FISHEYE"
    assert camera.params[3] == pytest.approx(0.333)  # of the three, the nearest to the tube's pinhole
    assert len(atlas.largest.registered) == 16


def test_sides_that_give_points_another_depth_contradict_each_other():
    model, _ = seen_points()
    assert contradictions(model) == []
    first = model.images[GAP + 1].projection_center()
    for number in range(GAP + 2, COUNT + 1):  # moves three times as far as what it sees tells
        pose = model.images[number].cam_from_world().matrix()
        center = first + 3.0 * (model.images[number].projection_center() - first)
        pose[:, 3] = -pose[:, :3] @ center
        model.frames[model.images[number].frame_id].rig_from_world = pycolmap.Rigid3d(pose)
    (link,) = contradictions(model)
    assert abs(link.after - GAP) <= 1 and link.log_scale == pytest.approx(np.log(3.0), abs=0.2)
    assert not link.holds
    assert contradictions(model, [Link(GAP, 9, None, None)]) == []


def measured(noise=0.0, speed=0.0):
    """Rigidity of points seen with noise, px, each moving through the image in a direction of its own, px a frame."""
    model, observed = seen_points()
    rng = np.random.default_rng(0)
    motion = speed * rng.normal(0.0, 1.0, (len(model.points3D) + 1, 2))
    tracks = []
    for index, points in enumerate(observed):
        moved = points.pixels + rng.normal(0.0, noise, points.pixels.shape) + index * motion[points.points]
        tracks.append(frame_points(points.points, moved))
    return rigidity(model, tracks)


def test_the_residual_of_a_rigid_motion_is_that_of_noise_or_grows_with_time():
    assert set(measured()) == {1, 2}  # farther apart too few points are common
    assert max(measured().values()) < 1e-3
    noisy, moving = measured(noise=0.5), measured(speed=1.0)
    # Both ends of a track are noisy, and a part of the distance to the line is fitted: 0.67 times the deviation.
    assert noisy[1] == pytest.approx(0.34, rel=0.4) and noisy[2] == pytest.approx(noisy[1], rel=0.5)
    assert moving[1] > 0.3 and moving[2] > 1.4 * moving[1]
    assert rigid_frames(pycolmap.Reconstruction(), []) is None


@pytest.mark.parametrize(
    ("residuals", "frames"),
    [
        ({}, None),
        ({1: 0.4, 2: 0.8, 4: 1.0, 8: 1.19}, None),
        # 1.2 px, three times that of neighbours, are reached at 10 frames, which lie on either side of the middle one.
        ({1: 0.4, 4: 0.9, 8: 1.0, 12: 1.4, 16: 1.0}, 21),
        ({1: 0.1, 4: 0.3, 8: 0.69}, None),  # below 0.7 px, 0.007 of the focal length, whatever neighbours have
        ({2: 0.1, 4: 0.6, 8: 0.8}, 13),
        ({2: 2.0, 4: 9.0}, 7),
    ],
)
def test_a_model_is_as_long_as_what_it_shows_is_rigid(residuals, frames, monkeypatch):
    monkeypatch.setattr(adjustment, "rigidity", lambda model, tracks: residuals)
    camera = pycolmap.Camera(model="PINHOLE", width=160, height=128, params=[100.0, 100.0, 80.0, 64.0])
    assert rigid_frames(SimpleNamespace(cameras={1: camera}), ()) == frames


LONG, HALF = 26, 13
#: Of the second half's model, from the world of the first.
SCALE, TURN, MOVE = 2.5, Rotation.from_euler("xyz", [20.0, -50.0, 130.0], True).as_matrix(), np.array([3.0, -7.0, 40.0])


def images_of(folder, frames):
    for index, frame in enumerate(frames):
        # Lit from the camera, as an image of one brightness is not told from its reversal in depth.
        light = (30.0 / frame.depth.numpy()[..., None]) ** 0.9
        write_image(folder / f"{index:04d}.png", np.clip(frame.image.numpy() * light, 0, 255).astype(np.uint8))
    return tuple(list_images(folder))


@pytest.fixture(scope="module")
def halves(tmp_path_factory):
    """A video, its model, and that model cut into two, the second in another frame and scale."""
    folder = tmp_path_factory.mktemp("tube")
    images = images_of(folder, tube_frames(LONG, 1.0))
    with quiet_colmap(0):
        video = read_video(images, TRACKED)
        (whole,) = video.mapped(candidate_cameras(TRACKED.camera, tracked=True)[0][0])
    parts = [part_of(whole, range(HALF)), part_of(whole, range(HALF, LONG))]
    parts[1].transform(pycolmap.Sim3d(SCALE, pycolmap.Rotation3d(TURN), MOVE))
    return video, whole, [Hypothesis.of(part, video.brightness) for part in parts]


@pytest.mark.thorough
def test_models_of_the_same_wall_become_one(halves):
    video, whole, parts = halves
    with quiet_colmap(0):
        extended, (joined,), apart = join_models(video, parts)
    assert apart == {}
    assert joined.frames == list(range(LONG))
    again = joined.joins[HALF - 1]
    assert again.before == HALF
    assert again.agreeing >= 20  # of 32
    assert again.spread < 0.05 and again.similarity is None
    centers = [
        np.array([model.images[number].projection_center() for number in range(1, LONG + 1)])
        for model in (joined.model, whole)
    ]
    # In the frame and scale of the first half, of as many frames as the second.
    np.testing.assert_allclose(centers[0], centers[1], atol=0.02 * np.ptp(centers[1], axis=0).max())
    for pixels, more, light, ids in zip(
        video.keypoints, extended.keypoints, extended.brightness, extended.track_ids, strict=True
    ):
        np.testing.assert_array_equal(more[: len(pixels)], pixels)
        assert len(more) == len(light) == len(np.unique(ids))


@pytest.mark.thorough
@pytest.mark.parametrize("moves", [False, True])
def test_models_that_are_too_long_together_are_related(halves, moves, monkeypatch):
    video, _, parts = halves
    if moves:
        monkeypatch.setattr(joining, "rigid_frames", lambda model, tracks: LONG - 1)
    else:
        short = TRACKED.model_copy(update={"tracks": TrackSettings(longest_window=LONG - 1)})
        video = replace(video, settings=short)
    with quiet_colmap(0):
        same, models, apart = join_models(video, parts)
    assert same is video
    assert [part.frames for part in models] == [list(range(HALF)), list(range(HALF, LONG))]
    matrix = np.array(apart[HALF - 1].similarity)
    assert np.cbrt(np.linalg.det(matrix[:, :3])) == pytest.approx(1.0 / SCALE, rel=0.03)
    np.testing.assert_allclose(SCALE * matrix[:, :3], TURN.T, atol=0.03)
    cameras = [parts[1].model.images[number].projection_center() for number in range(HALF + 1, LONG + 1)]
    np.testing.assert_allclose(
        np.array(cameras) @ matrix[:, :3].T + matrix[:, 3],
        (np.array(cameras) - MOVE) @ TURN / SCALE,
        atol=0.03 * np.ptp(cameras, axis=0).max() / SCALE,
    )


@pytest.mark.thorough
def test_what_is_split_and_joined_again_is_told_as_joined(tmp_path, monkeypatch):
    monkeypatch.setattr(sfm, "rigid_frames", lambda model, tracks: HALF)
    atlas = reconstruct(images_of(tmp_path, tube_frames(LONG, 1.0)), TRACKED)
    assert [model.registered for model in atlas.models] == [tuple(range(LONG))]
    assert [(link.after, link.again.before) for link in atlas.largest.links if link.again] == [(HALF - 1, HALF)]
    assert atlas.refused == ()


@pytest.mark.thorough
def test_unrelated_walls_are_not_joined(tmp_path):
    frames = [*tube_frames(HALF, 1.0), *tube_frames(HALF, 1.0, coarseness=1.4)]
    atlas = reconstruct(images_of(tmp_path, frames), TRACKED)
    assert [len(model.registered) for model in atlas.models] == [HALF, HALF]
    assert [link.again for link in atlas.refused] == [None]


def test_stretches_end_at_other_models_and_at_cuts():
    models = [[0, 1, 2, 6, 7, 8, 9], [3, 4]]
    assert stretches_of(models, set()) == [range(3), range(3, 5), range(6, 10)]
    assert stretches_of(models, {7}) == [range(3), range(3, 5), range(6, 8), range(8, 10)]
    assert stretches_of([[0, 4]], {2}) == [range(1), range(4, 5)] and stretches_of([], set()) == []
