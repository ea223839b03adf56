"""Poses from images and depth: exact motions, moving lamps, lost frames, the pose graph, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.engine.data_formats import open_video
from coliags_plugin.geometry.poses.alignment import align
from coliags_plugin.geometry.poses.association import associate
from coliags_plugin.geometry.poses.rigid import inverse, rotation_angles_deg
from coliags_plugin.geometry.poses.trajectory import Trajectory
from coliags_plugin.reconstruction.libraries import deterministic_open3d
from coliags_plugin.reconstruction.odometry.chain import Bridge, chain, fill_gaps, power
from coliags_plugin.reconstruction.odometry.frames import (
    PreparedFrame,
    RgbdFrame,
    RgbdVideo,
    prepare,
    prepared_frames,
    typical_depth,
)
from coliags_plugin.reconstruction.odometry.pose_graph import optimise, revisit_pairs, skip_pairs
from coliags_plugin.reconstruction.odometry.registration import Edge, agreement, motion_by_features
from coliags_plugin.reconstruction.odometry.settings import TrackingSettings
from coliags_plugin.reconstruction.odometry.tracking import track
from tests.geometry.poses.winding import some_transform, winding
from tests.textured_tube import texture, tube_frames

#: Off-centre, and pixels that are not square.
PINHOLE = Intrinsics(101.0, 98.0, 83.0, 61.5, 160, 128)
#: The wall is where NORMAL . x = OFFSET (mm), with a dent in it unless it is flat.
NORMAL, OFFSET = np.array([0.2, -0.1, 1.0]), 40.0

Lamp = Callable[[int, np.ndarray], np.ndarray]


def swaying(count: int, step: float = 0.5) -> np.ndarray:
    """A camera that moves sideways and forward, and turns by half a degree a frame. [N, 4, 4]"""
    poses = np.tile(np.eye(4), (count, 1, 1))
    along = np.arange(count)
    poses[:, :3, 3] = step * np.stack([along, 2.0 * np.sin(along / 3.0), 0.6 * along], axis=1)
    turns = 0.5 * np.stack([np.sin(along / 2.0), along, 0.5 * along], axis=1)
    poses[:, :3, :3] = Rotation.from_euler("xyz", turns, degrees=True).as_matrix()
    return poses


def filmed_wall(poses: np.ndarray, lamp: Lamp | None = None) -> list[RgbdFrame]:
    """The wall as cameras see it.

    Args:
        poses: Camera-to-world. [N, 4, 4]
        lamp: Factor on the image's brightness from the frame's number and the distance of each pixel.
    """
    x = (np.arange(PINHOLE.width) + 0.5 - PINHOLE.cx) / PINHOLE.fx
    y = (np.arange(PINHOLE.height) + 0.5 - PINHOLE.cy) / PINHOLE.fy
    rays = np.stack([*np.meshgrid(x, y), np.ones((PINHOLE.height, PINHOLE.width))], axis=-1)
    frames = []
    for index, pose in enumerate(poses):
        world = rays @ pose[:3, :3].T
        depth = (OFFSET - NORMAL @ pose[:3, 3]) / (world @ NORMAL)
        color = texture(pose[:3, 3] + depth[..., None] * world)
        if lamp is not None:
            color = np.clip(color * lamp(index, depth * np.linalg.norm(rays, axis=-1))[..., None], 0, 255)
        frames.append(RgbdFrame(f"{index:04d}", np.rint(color).astype(np.uint8), depth.astype(np.float32)))
    return frames


FAST = TrackingSettings(method="hybrid", pose_graph=False)


def relative(poses: np.ndarray) -> np.ndarray:
    """Poses in the world of their first camera."""
    return inverse(poses[:1])[0] @ poses


def off(found: np.ndarray, poses: np.ndarray) -> tuple[float, float]:
    """Largest errors of found poses, without any alignment: mm and degrees."""
    wanted = relative(poses)
    distance = np.linalg.norm(found[:, :3, 3] - wanted[:, :3, 3], axis=1)
    turned = rotation_angles_deg(found[:, :3, :3].transpose(0, 2, 1) @ wanted[:, :3, :3])
    return float(distance.max()), float(turned.max())


def pixels_off(found: np.ndarray, poses: np.ndarray, video) -> float:
    """How far from where it belongs a pixel lands on the frame before; the worst pair's mean, px.

    A small turn and a small step look much alike on a wall: in pixels the two do not add up to a large error.
    """
    column, row = np.meshgrid(np.arange(0, PINHOLE.width, 4), np.arange(0, PINHOLE.height, 4))
    means = []
    for index in range(1, len(poses)):
        z = video[index].depth[row, column]
        x, y = (column + 0.5 - PINHOLE.cx) / PINHOLE.fx * z, (row + 0.5 - PINHOLE.cy) / PINHOLE.fy * z
        points = np.stack([x, y, z, np.ones_like(z)], axis=-1)
        seen = []
        for path in (found, poses):
            moved = points @ (inverse(path[index - 1 : index])[0] @ path[index]).T
            seen.append(moved[..., :2] / moved[..., 2:3] * (PINHOLE.fx, PINHOLE.fy))
        means.append(np.linalg.norm(seen[0] - seen[1], axis=-1).mean())
    return float(max(means))


# Motions that are known


@pytest.mark.parametrize(("enlarge", "pixels"), [(1, 0.25), (2, 0.07)])
def test_a_known_motion_is_found(enlarge, pixels):
    """Measured: 0.13 px and 0.03 px from frame to frame."""
    poses = swaying(4)
    video = filmed_wall(poses)
    found = track(video, PINHOLE, FAST.model_copy(update={"enlarge": enlarge}))
    assert found.tracked.all()
    assert found.failed == found.jumps == ()
    assert pixels_off(found.camera_to_world, poses, video) < pixels
    np.testing.assert_array_equal(found.camera_to_world[0], np.eye(4))


def test_the_pose_graph_lessens_drift():
    poses = swaying(7)
    video = filmed_wall(poses)
    without = off(track(video, PINHOLE, FAST).camera_to_world, poses)
    graph = track(video, PINHOLE, TrackingSettings(method="hybrid", skips=(2, 4)))
    assert len(graph.further) == 5 + 3
    assert off(graph.camera_to_world, poses)[0] < without[0]


def test_the_moving_lamp_is_not_taken_for_texture():
    """Inverse square from the camera, and an exposure that jumps: motions stay as they are under even light."""
    poses = swaying(4)
    gains = (1.0, 0.6, 1.3, 0.8)
    lit = filmed_wall(poses, lambda index, distance: gains[index] * (38.0 / distance) ** 2)
    assert pixels_off(track(lit, PINHOLE, FAST).camera_to_world, poses, lit) < 0.3  # measured 0.15 px


def test_highlights_are_left_out():
    poses = swaying(4)
    video = filmed_wall(poses)
    for frame in video:
        frame.image[40:60, 60:90] = 255  # it stays where it is in the image, as the lamp's mirror image does
    assert pixels_off(track(video, PINHOLE, FAST).camera_to_world, poses, video) < 0.3
    prepared = prepare(video[0], 40.0)
    assert (prepared.depth[39:61, 59:91] == 0.0).all()
    assert (prepared.depth > 0.0).mean() > 0.8


def test_masked_pixels_are_left_out():
    poses = swaying(4)
    mask = np.ones((PINHOLE.height, PINHOLE.width), bool)
    mask[:, 110:] = False
    video = [replace(frame, mask=mask) for frame in filmed_wall(poses)]
    for frame in video:
        frame.image[:, 110:] = np.random.default_rng(0).integers(0, 255, (PINHOLE.height, 50, 3))
    assert pixels_off(track(video, PINHOLE, FAST).camera_to_world, poses, video) < 0.4


@pytest.mark.parametrize("factor", [2.0**-10, 16.0])
def test_any_unit_of_length_will_do(factor):
    """Powers of two, so that nothing is rounded."""
    video = filmed_wall(swaying(3))
    scaled = [replace(frame, depth=frame.depth * np.float32(factor)) for frame in video]
    one, other = (track(frames, PINHOLE, FAST) for frames in (video, scaled))
    np.testing.assert_array_equal(other.camera_to_world[:, :3, 3], factor * one.camera_to_world[:, :3, 3])
    assert other.depth_rmse == pytest.approx(factor * one.depth_rmse, rel=1e-6)


def test_the_same_every_time():
    video = filmed_wall(swaying(3))
    one, other = (track(video, PINHOLE, TrackingSettings()) for _ in range(2))
    np.testing.assert_array_equal(one.camera_to_world, other.camera_to_world)


def test_depth_alone_is_not_believed_where_a_wall_slides_along_itself():
    """On a plane exact depth fits whatever slides along it; texture does not."""
    video = filmed_wall(swaying(3))
    assert track(video, PINHOLE, TrackingSettings(pose_graph=False)).term == "hybrid"


def test_motions_too_large_to_descend_to_are_found_by_features():
    poses = swaying(12)[[0, 11]]
    poses[1, 0, 3] += 6.0
    video = filmed_wall(poses)
    one, other = (prepare(frame, 40.0) for frame in video)
    wanted = relative(poses)[1]
    guess = motion_by_features(other, one, PINHOLE)
    assert np.linalg.norm(guess[:3, 3] - wanted[:3, 3] / 40.0) < 0.05
    found = track(video, PINHOLE, FAST)
    assert off(found.camera_to_world, poses)[0] < 0.5
    blank = PreparedFrame(np.full_like(one.intensity, 0.5), one.depth)
    assert motion_by_features(other, blank, PINHOLE) is None


# A phantom


@pytest.fixture(scope="module")
def phantom_video(phantom):
    scene, posed = open_video(phantom)
    assert posed
    return scene.train


@pytest.fixture(scope="module")
def phantom_tracked(phantom_video):
    return track(RgbdVideo(phantom_video), phantom_video[0].camera.intrinsics, TrackingSettings())


def test_a_phantom_of_long_steps(phantom_video, phantom_tracked):
    """Nearly 5 mm a frame. Measured: 0.27 % of the path."""
    given = Trajectory(np.stack([frame.camera.camera_to_world.numpy() for frame in phantom_video]))
    found = Trajectory(phantom_tracked.camera_to_world)
    path = np.linalg.norm(np.diff(given.centers, axis=0), axis=1).sum()
    assert align(found, given, associate(found, given, "index")).ate.rmse < 0.01 * path
    assert phantom_tracked.tracked.all()
    assert 0.5 < phantom_tracked.fitness <= 1.0
    assert phantom_tracked.depth_rmse < 0.5
    assert phantom_tracked.correlation > 0.8


def test_given_poses_do_not_matter():
    """Poses come with the frames, but only images and depth go in: scrambled ones change not one bit."""
    frames = tube_frames(4, step=0.5)
    scrambled = [
        replace(frame, camera=replace(frame.camera, camera_to_world=torch.from_numpy(some_transform(seed))))
        for seed, frame in enumerate(frames)
    ]
    one, other = (track(RgbdVideo(video), frames[0].camera.intrinsics, FAST) for video in (frames, scrambled))
    np.testing.assert_array_equal(one.camera_to_world, other.camera_to_world)


# Losing track


def blackened(video, *places):
    return [
        replace(frame, image=np.zeros_like(frame.image)) if index in places else frame
        for index, frame in enumerate(video)
    ]


def test_a_black_frame_is_bridged():
    poses = swaying(5)
    found = track(blackened(filmed_wall(poses), 2), PINHOLE, FAST)
    assert found.tracked.tolist() == [True, True, False, True, True]
    assert found.failed == ((1, 2),)
    assert found.jumps == ()
    distance, turned = off(found.camera_to_world, poses)
    assert distance < 0.6  # the black frame itself stands between its neighbours; 0.3 without it
    assert turned < 0.8


def test_black_frames_at_the_end_go_on_at_constant_velocity():
    video = blackened(filmed_wall(swaying(5)), 3, 4)
    found = track(video, PINHOLE, FAST)
    steps = inverse(found.camera_to_world[:-1]) @ found.camera_to_world[1:]
    np.testing.assert_allclose(steps[2:], np.stack([steps[1]] * 2), atol=1e-12)
    assert found.tracked.tolist() == [True, True, True, False, False]


def edge(source, target, motion):
    return Edge(source, target, motion, 1.0, 0.0, 1.0, 0.0)


def motion(poses, source, target):
    return inverse(poses[target][None])[0] @ poses[source]


def registering(poses, bad=(), blind=()):
    """A stand-in that finds exact motions, but nothing for bad frames or blind pairs."""

    def register(source, target, guess):
        if {source, target} & set(bad) or any({source, target} == set(pair) for pair in blind):
            return None
        return edge(source, target, motion(poses, source, target))

    return register


def test_a_chain_passes_lost_frames_over():
    poses = relative(winding(9).camera_to_world)
    found = chain(9, registering(poses, bad=(3, 4)), max_gap=4)
    assert found.posed == (0, 1, 2, 5, 6, 7, 8)
    np.testing.assert_allclose(found.camera_to_world, poses[list(found.posed)], atol=1e-9)
    assert [(one.source, one.target) for one in found.edges][2] == (5, 2)
    assert found.bridges == ()


def test_a_chain_begins_anew_where_the_camera_has_jumped():
    """What lies before 4 has nothing in common with what lies behind."""
    poses = relative(winding(8).camera_to_world)
    blind = [(early, late) for early in range(4) for late in range(4, 8)]
    found = chain(8, registering(poses, blind=blind), max_gap=4)
    assert found.posed == tuple(range(8))
    assert [(bridge.source, bridge.target) for bridge in found.bridges] == [(4, 3)]
    np.testing.assert_allclose(relative(found.camera_to_world[4:]), relative(poses[4:]), atol=1e-9)
    velocity = inverse(poses[2:3])[0] @ poses[3]
    np.testing.assert_allclose(found.camera_to_world[4], poses[3] @ velocity, atol=1e-9)
    assert found.failed == ((3, 4),)


def test_a_chain_goes_on_after_more_lost_frames_than_a_gap_may_have():
    poses = relative(winding(12).camera_to_world)
    found = chain(12, registering(poses, bad=(2, 3, 4, 5, 6)), max_gap=2)
    assert {0, 1, 7, 8, 9, 10, 11} <= set(found.posed)
    assert found.bridges
    assert [(one.source, one.target) for one in found.edges][1:] == [(8, 7), (9, 8), (10, 9), (11, 10)]


@given(seed=st.integers(0, 10_000), parts=st.integers(2, 5))
@settings(max_examples=20, deadline=None)
def test_a_part_of_a_motion_done_so_often_is_the_motion(seed, parts):
    motion = some_transform(seed)
    if Rotation.from_matrix(motion[:3, :3]).magnitude() > 3.0:
        return  # half turns have no part that is theirs alone
    whole = np.linalg.matrix_power(power(motion, 1.0 / parts), parts)
    np.testing.assert_allclose(whole, motion, atol=1e-6)
    np.testing.assert_allclose(power(motion, 2.0), motion @ motion, atol=1e-6)


def test_what_is_filled_in():
    poses = swaying(2, step=4.0)
    result = fill_gaps((0, 4), poses, 6)
    np.testing.assert_array_equal(result[[0, 4]], poses)
    steps = inverse(result[:-1]) @ result[1:]
    np.testing.assert_allclose(steps, np.stack([steps[0]] * 5), atol=1e-9)
    np.testing.assert_array_equal(fill_gaps((0,), np.eye(4)[None], 3), np.stack([np.eye(4)] * 3))


# The pose graph


def optimised(path, certain, uncertain, bridges=()):
    informed = [[(one, 1e4 * np.eye(6)) for one in edges] for edges in (certain, uncertain)]
    with deterministic_open3d() as open3d:
        return optimise(open3d, range(len(path)), path, *informed, bridges, 0.25)


def test_a_wrong_edge_is_dropped_and_the_others_mend_the_path():
    poses = relative(swaying(12, step=0.05))
    drift = np.eye(4)
    drift[:3, 3] = 0.0, 0.0, 0.004
    steps = [edge(frame, frame - 1, motion(poses, frame, frame - 1) @ drift) for frame in range(1, 12)]
    drifted = [np.eye(4)]
    for step in steps:
        drifted.append(drifted[-1] @ step.source_to_target)
    right = [edge(frame, frame - 4, motion(poses, frame, frame - 4)) for frame in range(4, 12)]
    wrong = edge(9, 2, some_transform(3, extent=1.0))
    found, dropped = optimised(np.stack(drifted), steps, [*right, wrong])
    assert dropped == (wrong,)
    np.testing.assert_array_equal(found[0], np.eye(4))
    before, after = (np.linalg.norm(path[-1][:3, 3] - poses[-1][:3, 3]) for path in (drifted, found))
    assert after < 0.5 * before


def test_a_bridge_gives_way_to_an_edge():
    poses = relative(swaying(6, step=0.05))
    wrong = motion(poses, 3, 2)
    wrong[0, 3] += 0.1
    steps = [edge(frame, frame - 1, motion(poses, frame, frame - 1)) for frame in (1, 2, 4, 5)]
    path = poses.copy()
    path[3:] = path[2] @ wrong @ inverse(poses[3:4])[0] @ poses[3:]
    found, dropped = optimised(path, steps, [edge(4, 1, motion(poses, 4, 1))], [Bridge(3, 2, wrong)])
    assert dropped == ()
    np.testing.assert_allclose(found, poses, atol=2e-3)


def test_pairs_of_further_edges():
    assert skip_pairs((0, 1, 2, 4), (2, 3)) == [(2, 0), (4, 2), (4, 1)]
    poses = np.tile(np.eye(4), (50, 1, 1))
    poses[:, 0, 3] = np.concatenate([np.arange(25), np.arange(25)[::-1]])  # there and back again
    pairs = revisit_pairs(range(50), poses, 20, 0.9, 20.0, 1)
    assert pairs[0] == (35, 14)
    assert pairs[-1] == (49, 0)
    assert all(source + target == 49 for source, target in pairs)
    poses[30:, :3, :3] = Rotation.from_euler("y", 30, degrees=True).as_matrix()
    assert revisit_pairs(range(50), poses, 20, 0.9, 20.0, 1) == []


def test_a_path_back_to_where_it_began_is_closed():
    """With revisits alone besides neighbours, so that nothing else can have closed it."""
    there = swaying(13, step=0.4)
    poses = np.concatenate([there, there[-2::-1]])
    video = filmed_wall(poses)
    found = track(video, PINHOLE, TrackingSettings(method="hybrid", skips=()))
    assert {edge.source - edge.target > 20 for edge in found.further} == {True}
    end = np.eye(4)
    for edge in found.edges:
        end = end @ edge.source_to_target
    assert np.linalg.norm(found.camera_to_world[-1, :3, 3]) < 0.5 * np.linalg.norm(end[:3, 3])


# Judging an edge


def test_agreement_knows_right_from_wrong():
    poses = swaying(2)
    one, other = (prepare(frame, 40.0) for frame in filmed_wall(poses))
    right = relative(poses)[1]
    right[:3, 3] /= 40.0
    fitness, rmse, correlation = agreement(other, one, right, PINHOLE)
    assert fitness > 0.9
    assert rmse < 1e-3
    assert correlation > 0.95
    slid = right.copy()
    slid[:3, 3] += np.array([1.0, 0.0, -0.2]) * 0.05  # along the wall: depth agrees as before
    fitness, rmse, correlation = agreement(other, one, slid, PINHOLE)
    assert rmse < 2e-3
    assert correlation < 0.5
    behind = np.eye(4)
    behind[2, 3] = -5.0
    assert agreement(other, one, behind, PINHOLE) == (0.0, 0.0, 0.0)


def test_a_flat_image_agrees_with_nothing():
    one, other = (prepare(frame, 40.0) for frame in blackened(filmed_wall(swaying(2)), 1))
    fitness, _, correlation = agreement(other, one, np.eye(4), PINHOLE)
    assert fitness > 0.5
    assert correlation == 0.0


def test_prepared_frames_are_made_once_and_let_go():
    class Counting(list):
        asked = 0

        def __getitem__(self, index):
            Counting.asked += 1
            return super().__getitem__(index)

    frame = prepared_frames(Counting(filmed_wall(swaying(4))), 40.0, keep=2)
    first = frame(0)
    assert frame(0) is first
    assert Counting.asked == 1
    for index in (1, 2):
        assert frame(index).depth.shape == (PINHOLE.height, PINHOLE.width)
    assert frame(0) is not first
    assert Counting.asked == 4


def test_the_unit_is_the_median_depth():
    video = filmed_wall(swaying(3))
    assert typical_depth(video) == pytest.approx(np.median([frame.depth[::4, ::4] for frame in video]))


# What is refused


def test_what_is_refused():
    video = filmed_wall(swaying(3))
    with pytest.raises(InputError, match=r"1 frame\. Expected two or more"):
        track(video[:1], PINHOLE, FAST)
    unknown = [replace(frame, depth=np.full_like(frame.depth, np.nan)) for frame in video]
    with pytest.raises(InputError, match="none has a pixel of known depth"):
        track(unknown, PINHOLE, FAST)
    small = replace(video[1], image=video[1].image[:64], depth=video[1].depth[:64])
    with pytest.raises(InputError, match=r"frame 1 \(0001\): image of 160 x 64\. Expected 160 x 128"):
        track([video[0], small, video[2]], PINHOLE, FAST)
    with pytest.raises(InputError, match="no two consecutive frames of 3 could be registered"):
        track(blackened(video, 0, 1, 2), PINHOLE, FAST)
    frames = [replace(frame, depth=None) for frame in tube_frames(2)]
    with pytest.raises(InputError, match=r"frame 0000 has no depth.*coliags poses sfm"):
        track(RgbdVideo(frames), frames[0].camera.intrinsics, FAST)
