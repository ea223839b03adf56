"""A check that finds what is wrong: sound scenes pass, spoilt ones are called by name."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from coliags_plugin.api.runs import warn_of_suspect_data
from coliags_plugin.checks.data.check import check_scene, video_pairs
from coliags_plugin.checks.data.findings import findings_of, image_facts, lamp_facts, path_facts
from coliags_plugin.checks.data.hypotheses import CHANGES, FrameMatches, Pair, agreement, best_scale, supported
from coliags_plugin.checks.data.page import check_page
from coliags_plugin.cli.texts import depth_commands
from coliags_plugin.core.cameras import Camera
from coliags_plugin.core.intrinsics import Intrinsics
from coliags_plugin.core.scenes import Frame, PointCloud, Scene, SparseDepth
from coliags_plugin.datamanagers.c3vd import C3VDDataManager, C3VDSettings
from coliags_plugin.engine.data_formats import open_scene
from coliags_plugin.geometry.lenses.models import PinholeLens
from coliags_plugin.reconstruction.depth.scene import training_options
from coliags_plugin.reporting.colormaps import HATCH_GREYS
from coliags_plugin.reporting.text_formats import page_text
from tests.commands import run
from tests.datamanagers.wall_scenes import HEIGHT, WIDTH, write_wall
from tests.scenes import write_frames
from tests.textured_tube import tube_frames


@pytest.fixture(scope="module")
def frames():
    """A tube that a camera goes into, swaying and turning; 32 mm in 24 frames."""
    return tube_frames(24, 0.6)


@pytest.fixture(scope="module")
def folder(frames, tmp_path_factory):
    return write_frames(tmp_path_factory.mktemp("check") / "tube", frames)


@pytest.fixture(scope="module")
def scene(folder):
    return C3VDDataManager(C3VDSettings()).load(folder)


def each(scene: Scene, change) -> Scene:
    sets = {name: [change(frame.to("cpu")) for frame in frames] for name, frames in scene.test_sets.items()}
    return replace(scene, train=[change(frame.to("cpu")) for frame in scene.train], test_sets=sets)


def changed(scene: Scene, pose=None, depth=None, camera=None, image=None) -> Scene:
    """The scene with every frame's pose, depth, camera or image put through a function of it and its place."""

    def change(frame: Frame) -> Frame:
        cam = frame.camera
        cam = cam if pose is None else replace(cam, camera_to_world=pose(cam.camera_to_world))
        return replace(
            frame.with_maps(
                depth=frame.depth if depth is None else depth(frame.depth),
                image=frame.image if image is None else image(frame.image, frame.index),
            ),
            camera=cam if camera is None else camera(cam),
        )

    return each(scene, change)


def scene_of(frames) -> Scene:
    return Scene("made up", frames, {}, PointCloud(torch.zeros(0, 3)))


def whats(scene: Scene) -> str:
    return "; ".join(finding.what + ": " + finding.do for finding in check_scene(scene).findings)


def in_metres(pose):
    return torch.cat([torch.cat([pose[:3, :3], 1e-3 * pose[:3, 3:]], dim=1), pose[3:]])


def jumping(at, by):
    """A function of poses that moves those beyond ``at``, mm along z, sideways by ``by`` mm."""

    def jumped(pose):
        moved = pose.clone()
        moved[0, 3] += by * (pose[2, 3] > at)
        return moved

    return jumped


def test_a_sound_scene_is_not_suspected(scene):
    check = check_scene(scene)
    assert check.findings == []
    # Depth is stored in steps of 0.0015 mm and sampled at pixel centres: surfaces agree far below a percent.
    assert check.agreement["given"].depth_error < 0.005
    assert check.scale.factor == pytest.approx(1.0, abs=0.02)
    depth = check.facts["depth"]
    assert depth["nearest"] < depth["median"] < depth["farthest"] <= 100.0


READINGS = sorted(CHANGES.keys() - {"given", "no motion"})


def misread(reading):
    """The inverse of a change, which undoes itself, or done four times does nothing."""
    return lambda pose: CHANGES[reading](CHANGES[reading](CHANGES[reading](pose)))


@pytest.mark.thorough
@pytest.mark.parametrize("reading", READINGS)
def test_poses_in_another_convention_are_called_by_it(scene, reading):
    wrong = changed(scene, pose=misread(reading))
    assert f"read as: {reading}" in whats(wrong)
    if reading != "camera axes y up, z backward":
        assert "poses agree with the images when read as" in whats(changed(wrong, depth=lambda depth: None))


@pytest.mark.parametrize(
    "factor", [25.4, *(pytest.param(factor, marks=pytest.mark.thorough) for factor in (0.001, 0.5))]
)
def test_depth_in_another_unit_than_poses(scene, factor):
    findings = whats(changed(scene, depth=lambda depth: depth * factor))
    assert "depth and poses are in different units" in findings
    measured = float(findings.split("depth seems to be ")[1].split(" times")[0])
    assert measured == pytest.approx(factor, rel=0.1)


@pytest.fixture(scope="module")
def estimate(scene):
    """The scene with depth as estimated: 3 % wrong where it is confident, and anything in a corner where it is not."""
    generator = torch.Generator().manual_seed(0)

    def of(frame: Frame) -> Frame:
        depth = frame.depth * (1.0 + 0.03 * torch.randn(frame.depth.shape, generator=generator))
        confidence = torch.full_like(depth, 0.9)
        depth[:80, :100], confidence[:80, :100] = 7.0, 0.3
        return frame.with_maps(depth=depth, depth_confidence=confidence)

    return each(scene, of)


@pytest.mark.thorough
def test_estimated_depth_is_judged_where_it_is_confident(estimate):
    check = check_scene(estimate)
    assert check.findings == []
    assert 0.02 < check.agreement["given"].depth_error < 0.04
    assert "confidence of 0.8 or more" in page_text(check_page(check))
    true = each(estimate, lambda frame: frame.with_maps(depth_confidence=None))
    assert "frames do not agree on the surface" in whats(true)


def test_estimated_depth_contradicts_wrong_poses(estimate):
    poses = iter([frame.camera.camera_to_world for frame in estimate.train][::-1])
    train = [replace(frame, camera=replace(frame.camera, camera_to_world=next(poses))) for frame in estimate.train]
    assert "frames do not agree on the surface" in whats(replace(estimate, train=train, test_sets={}))


@pytest.mark.thorough
def test_depth_that_is_not_confident_anywhere_leaves_poses_to_the_images(estimate):
    check = check_scene(each(estimate, lambda frame: frame.with_maps(depth_confidence=0.0 * frame.depth_confidence)))
    assert (check.findings, check.agreement, check.matched_by) == ([], {}, "features")


NOISE = torch.rand(128, 160, generator=torch.Generator().manual_seed(0))


def of_twice_the_size(camera):
    return replace(camera, fx=2 * camera.fx, fy=2 * camera.fy, cx=2 * camera.cx, cy=2 * camera.cy)


@pytest.mark.parametrize(
    ("spoil", "found"),
    [
        ({"pose": in_metres, "depth": lambda depth: depth * 1e-3}, "depth looks like metres"),
        ({"camera": of_twice_the_size}, "principal point is far from the middle"),
        ({"depth": lambda depth: torch.full_like(depth, 30.0)}, "depth is the same everywhere: "),
        ({"depth": lambda depth: 30.0 + 0.1 * NOISE}, ""),
        ({"depth": lambda depth: torch.full_like(depth, torch.nan)}, "most of the depth is unknown"),
    ],
)
def test_spoilt_scenes_are_called_by_name(scene, spoil, found):
    findings = whats(changed(scene, **spoil))
    assert found in findings and "different units" not in findings
    assert "everywhere" not in found or "; " not in findings


@pytest.mark.thorough
def test_lengths_of_unknown_unit(scene):
    metres = changed(scene, pose=in_metres, depth=lambda depth: depth * 1e-3)
    unknown = replace(metres, provenance=metres.provenance.model_copy(update={"unit": "unknown"}))
    check = check_scene(unknown)
    assert check.findings == []
    assert "depth error, units" in (text := page_text(check_page(check))) and " mm;" not in text


def test_depth_of_other_frames(frames):
    mixed = [frame.with_maps(depth=frames[7 * frame.index % len(frames)].depth) for frame in frames]
    assert "frames do not agree on the surface" in whats(scene_of(mixed))


@pytest.mark.parametrize(
    ("spoil", "about", "expected"),
    [
        ({"pose": jumping(7.0, 500.0)}, "path", "the camera jumps"),
        ({"pose": lambda pose: torch.eye(4)}, "path", "the camera does not move"),
        ({"image": lambda image, index: image * (index != 5)}, "images", "an image is black"),
        ({"image": lambda image, index: 0 * image + 90 if index in (1, 2, 3) else image}, "images", "images repeat"),
    ],
)
def test_suspect_paths_and_images(scene, spoil, about, expected):
    video = changed(scene, **spoil).video
    facts = path_facts(video) if about == "path" else image_facts(video) | {"repeats": 2}
    assert findings_of(about, facts)[0].what == expected


def test_carrying_a_plane_is_exact(tmp_path):
    """Two cameras before a plane: depth there is known in closed form."""
    frames = []
    for index, z in enumerate((0.0, 2.0, 4.0)):
        pose = torch.eye(4, dtype=torch.float64)
        pose[2, 3] = z
        camera, image = Camera(60.0, 60.0, 40.0, 30.0, 80, 60, pose), torch.full((60, 80, 3), 90, dtype=torch.uint8)
        frames.append(Frame.of(f"{index:04d}", index, image, camera, torch.full((60, 80), 20.0 - z)))
    write_frames(tmp_path / "plane", frames)
    plane = C3VDDataManager(C3VDSettings(split="all-train")).load(tmp_path / "plane")
    pairs = [Pair(a, b) for a, b in video_pairs(plane.train)]
    assert agreement(pairs).depth_error < 1e-4
    assert agreement(pairs, "no motion").depth_error == pytest.approx(np.median([2 / 18, 2 / 16]), rel=0.07)
    assert best_scale(pairs).factor == pytest.approx(1.0, abs=0.02)
    # The image of a camera 2 ahead holds the middle 18 / 20 of the first one's, each way.
    assert agreement(pairs[:1]).share == pytest.approx(0.9**2, abs=0.03)


def paused(frames: list[Frame], pauses=(6, 15), length=40, jitter=0.002) -> Scene:
    """The frames with long pauses, in which the poses waver by ``jitter`` mm, without depth."""
    counts = [1 + length * (frame.index in pauses) for frame in frames]
    rng = np.random.default_rng(0)
    video = []
    for frame in [frame for frame, count in zip(frames, counts, strict=True) for _ in range(count)]:
        pose = frame.camera.camera_to_world.clone()
        pose[:3, 3] += torch.from_numpy(rng.normal(size=3) * jitter)
        noise = torch.from_numpy(rng.integers(0, 2, frame.image.shape, dtype=np.uint8))
        camera = replace(frame.camera, camera_to_world=pose)
        name, index, image = f"{len(video):04d}", len(video), frame.image + noise
        video.append(replace(frame.with_maps(depth=None, image=image), name=name, index=index, camera=camera))
    return scene_of(video)


@pytest.mark.thorough
def test_a_camera_that_pauses_is_not_suspected_and_its_pauses_are_not_compared(frames):
    sound = paused(frames)
    check = check_scene(sound)
    assert (check.findings, check.undecided) == ([], [])
    assert check.facts["path"]["moving_step"] > 1.0
    ways = [(b.camera.center - a.camera.center).norm().item() for a, b in check.pairs]
    assert min(ways) > 2.0
    assert "world-to-camera" in whats(changed(sound, pose=CHANGES["world-to-camera"]))

    jumped = findings_of("path", path_facts(changed(sound, pose=jumping(7.0, 100.0)).video))
    assert [finding.what for finding in jumped] == ["the camera jumps"]


def test_a_camera_that_hardly_moves_is_undecided(frames):
    still = paused(frames[:1], pauses=(0,), length=20)
    check = check_scene(still)
    assert [doubt.what for doubt in check.undecided] == ["poses may be right or wrong"]
    assert check.matches["given"].in_front is None
    assert not any("poses" in finding.what for finding in check.findings)
    assert "Undecided\nposes may be right or wrong: " in page_text(check_page(check))


def lit(frames: list[Frame]) -> list[Frame]:
    """The frames under a lamp at the camera: brightness falls with the square of the depth."""
    factors = [(18.0 / frame.depth.clamp(min=18.0)).square()[..., None] for frame in frames]
    return [frame.with_maps(image=(frame.image * factor).byte()) for frame, factor in zip(frames, factors, strict=True)]


@pytest.mark.thorough
def test_reversed_depth_contradicts_the_lamp(frames):
    def only_points(frame):
        pixels = torch.rand(200, 2, generator=torch.Generator().manual_seed(frame.index)) * torch.tensor([160, 128])
        column, row = pixels.long().unbind(1)
        return replace(frame.with_maps(depth=None), sparse_depth=SparseDepth(pixels, frame.depth[row, column]))

    sound = lit(frames)
    reverse = [frame.with_maps(depth=600.0 / frame.depth) for frame in sound]
    assert lamp_facts(sound)["correlation"] < -0.5
    assert lamp_facts(reverse)["correlation"] > 0.5
    assert lamp_facts([only_points(frame) for frame in sound])["correlation"] < -0.5
    check = check_scene(scene_of(sound))
    assert "the far is brighter" not in [finding.what for finding in check.findings]
    assert "rank correlation -" in page_text(check_page(check))
    assert "the far is brighter" in whats(scene_of(reverse))
    assert "the far is brighter" in whats(scene_of([only_points(frame) for frame in reverse]))
    assert lamp_facts([frame.with_maps(depth=None) for frame in sound]) is None


def test_features_are_matched_at_the_stored_size(frames, tmp_path, capsys, caplog):
    """At a quarter of the size, the texture is too fine for features."""
    write_frames(tmp_path / "tube", frames[:12], depth=False)
    size = ("--set", "width=40", "--set", "datamanager.height=32")  # with and without the prefix
    with caplog.at_level(logging.INFO):
        status = run("check", "data", tmp_path / "tube", *size)
    out, log = capsys.readouterr().out, [record.getMessage() for record in caplog.records]
    assert status == 0
    assert "40 x 32 px, stored 160 x 128" in out
    row = next(line for line in out.splitlines() if line.startswith("given"))
    assert int(row.split()[-1]) > 500
    for fact in ("format c3vd", "12 frames"):  # the scene is read twice, and told once
        assert sum(fact in line for line in log) == 1


@pytest.mark.thorough
@pytest.mark.parametrize(("name", "step"), [("colmap_23img", 1), ("c3vd_cecum_t1_a", 16)])
def test_real_scenes_are_not_suspected(shared_data, capsys, name, step):
    assert run("check", "data", shared_data / name, "--set", "max_frames=4", "--set", f"frame_step={step}") == 0
    assert "nothing suspect" in capsys.readouterr().out


def test_random_matches_and_those_that_opencv_cannot_explain_are_not_taken_for_right_ones(monkeypatch):
    rng = np.random.default_rng(0)
    for count in (10, 20, 40, 90):
        here, there = rng.uniform(0, 384, (2, count, 2))
        assert supported(here, there) is None
    moved = here + [12.0, 0.0] + [0.0, 0.3] * rng.normal(size=(90, 2))
    assert supported(here, np.where(np.arange(90)[:, None] < 60, moved, there)).sum() > 50

    def degenerate(*_):
        raise cv2.error("-215:Assertion failed")

    monkeypatch.setattr(cv2, "findFundamentalMat", degenerate)
    assert supported(here, moved) is None


@pytest.fixture
def unmatched(scene, monkeypatch):
    """The scene without depth, in which features are not found again."""
    monkeypatch.setattr("coliags_plugin.checks.data.check.match", lambda pairs: [])
    return changed(scene, depth=lambda depth: None)


def test_where_features_fail_points_are_followed(unmatched):
    check = check_scene(unmatched)
    assert (check.findings, check.undecided, check.matched_by) == ([], [], "tracks")
    assert check.matches["given"].error < 1.0
    assert check.matches["given"].count > 500
    assert "Points followed through" in page_text(check_page(check))


def test_a_scene_without_dense_depth_is_to_be_given_it(unmatched, monkeypatch, capsys):
    monkeypatch.setattr("coliags_plugin.engine.data_formats.open_scene", lambda *arguments, **options: unmatched)
    assert run("check", "data", "SCENE", "--set", "split=block") == 0
    expected = depth_commands(Path("SCENE"), ["--set", "split=block"], training_options(unmatched))
    assert capsys.readouterr().out.splitlines()[-2:] == [f"next:    {command}" for command in expected]


@pytest.mark.thorough
def test_where_features_contradict_right_poses_points_are_followed(scene, monkeypatch):
    def wrong(pairs):
        rng = np.random.default_rng(0)
        return [FrameMatches(source, target, *rng.uniform(20, 120, (2, 60, 2))) for source, target in pairs]

    monkeypatch.setattr("coliags_plugin.checks.data.check.match", wrong)
    check = check_scene(changed(scene, depth=lambda depth: None))
    assert (check.findings, check.matched_by) == ([], "tracks")
    monkeypatch.setattr("coliags_plugin.checks.data.check.follow", lambda stretches, progress: [])
    assert "images do not agree with the poses" in whats(changed(scene, depth=lambda depth: None))


@pytest.mark.parametrize(
    "reading", [READINGS[0], *(pytest.param(each, marks=pytest.mark.thorough) for each in READINGS[1:])]
)
def test_followed_points_tell_poses_in_another_convention(unmatched, reading):
    assert "poses agree with the images when read as" in whats(changed(unmatched, pose=misread(reading)))


def test_followed_points_tell_poses_of_other_frames(unmatched):
    poses = [frame.camera.camera_to_world for frame in unmatched.video]
    order = iter(np.random.default_rng(0).permutation(len(poses)))
    assert "images do not agree with the poses" in whats(changed(unmatched, pose=lambda _: poses[next(order)]))


def test_images_that_show_nothing_again_leave_poses_undecided(unmatched):
    rng = np.random.default_rng(0)
    noise = changed(
        unmatched, image=lambda image, _: torch.from_numpy(rng.integers(90, 130, image.shape, dtype=np.uint8))
    )
    check = check_scene(noise)
    assert [doubt.what for doubt in check.undecided] == ["the images cannot tell whether the poses are right"]
    assert check.findings == [] and check.matches == {}


@pytest.mark.parametrize(("layout", "is_suspect"), [("c3vd", False), ("c3vd-raw", False), ("endogslam", True)])
def test_training_on_endogslams_data_warns_of_their_calibration(tmp_path, caplog, layout, is_suspect):
    folder = write_wall(tmp_path / layout, layout, 3)
    warn_of_suspect_data(open_scene(folder))
    assert ("EndoGSLAM's calibration does not fit" in caplog.text) == is_suspect


def test_another_calibration_of_endogslams_data_is_not_suspected(tmp_path):
    lens = PinholeLens.of(Intrinsics(385.0, 385.0, 338.0, 270.0, 675, 540).resized(WIDTH, HEIGHT))
    scene = open_scene(write_wall(tmp_path / "wall", "endogslam", 3, lens=lens))
    assert "EndoGSLAM's calibration" not in whats(scene)


def test_frames_are_shown_reprojected_where_there_is_depth(scene):
    sections = {section.title: section.blocks for section in check_page(check_scene(scene)).sections}
    for group in sections["Reprojected frames"]:
        files = [np.frombuffer(figure.image.data, np.uint8) for figure in group.figures]
        frame, warped, difference = (cv2.imdecode(file, cv2.IMREAD_COLOR).astype(int) for file in files)
        hatched = np.isin(difference, HATCH_GREYS).all(axis=2)
        assert hatched.mean() < 0.5 and (warped[hatched] == difference[hatched]).all()
        assert np.abs(frame - warped)[~hatched].mean() < 10.0 < np.abs(frame - warped)[hatched].mean()
    assert [figure.equal_scales for figure in sections["Trajectory"][0].figures] == [False, True, True]
    bare = check_page(check_scene(each(scene, lambda frame: frame.with_maps(depth=None)), match_images=False))
    assert "Reprojected frames" in [section.title for section in bare.sections if not section.blocks]


@pytest.mark.thorough
def test_command_says_it_all(folder, scene, tmp_path, capsys):
    argv = ("check", "data", folder, "--html", tmp_path / "check.html")
    assert run(*argv) == 0
    out = capsys.readouterr().out
    assert "nothing suspect" in out
    assert "c3vd (undistorted layout)" in out
    assert out.endswith(f"written: {tmp_path / 'check.html'}\nnext:    coliags train coliags-plus --data {folder}\n")
    assert run(*argv, "--json") == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["suspect"] is False
    assert facts["data"]["frames"]["train"] == 21
    page = (tmp_path / "check.html").read_text()
    assert page.count("<img ") == 9
    assert "z, mm" in page


@pytest.mark.thorough
def test_command_fails_on_what_is_suspect(scene, tmp_path, capsys):
    inverted = changed(scene, pose=torch.linalg.inv)
    write_frames(tmp_path / "inverted", inverted.video)
    assert run("check", "data", tmp_path / "inverted") == 1
    assert "Suspect\nposes agree with depth when read as: world-to-camera: " in capsys.readouterr().out
    assert run("check", "data", tmp_path / "inverted", "--json") == 1
    assert json.loads(capsys.readouterr().out)["suspect"] is True
