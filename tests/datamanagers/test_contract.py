"""Contract of data managers: each kind of layout is read exactly, left as it is, and every fault is told."""

from __future__ import annotations

import json
import logging
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.registry import datamanagers
from coliags_plugin.core.scenes import Frame, Scene
from coliags_plugin.engine.data_formats import find_format, formats, recognised
from tests.datamanagers.kinds import (
    GROUPS,
    KINDS,
    REFUSED,
    WARNED,
    Spoil,
    change_frames,
    edit,
    files,
    remove,
    renumber,
    repaint,
)
from tests.datamanagers.wall_scenes import (
    FRAMES,
    HEIGHT,
    WIDTH,
    layout_of,
    manager,
    names,
    off_wall,
    poses,
    seen_from,
    write_wall,
)


def load(folder: Path, name: str, **options) -> Scene:
    return manager(KINDS[name].format, **options).load(folder)


def in_order(scene: Scene, name: str) -> list[Frame]:
    """Frames of the video: RotateColon's test frames are of another."""
    return scene.train if KINDS[name].has_own_tests else scene.video


def to_true_world(name: str) -> np.ndarray:
    """Transform from the world of the scene that is read: EndoGSLAM's is that of the first camera. [4, 4]"""
    return poses(1)[0] if KINDS[name].params else np.eye(4)


def equal(first: Frame, other: Frame) -> bool:
    """True if the pixels and poses of two frames are equal to the bit."""
    pairs = [(getattr(first, part), getattr(other, part)) for part in ("image", "depth", "mask", "seen")]
    pairs.append((first.camera.camera_to_world, other.camera.camera_to_world))
    return first.index == other.index and all(
        (a is None and b is None) or torch.equal(a.nan_to_num(), b.nan_to_num()) for a, b in pairs
    )


@pytest.mark.parametrize("name", KINDS)
def test_a_scene_is_read_as_it_was_written(walls, caplog, name):
    folder, kind, world = walls(name), KINDS[name], to_true_world(name)
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    assert list(recognised(folder)) == [kind.format]
    with caplog.at_level(logging.WARNING):
        scene = load(folder, name)
    assert caplog.records == []
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before
    frames, held_out = in_order(scene, name), () if kind.has_own_tests else scene.test_sets["test"]
    assert [frame.index for frame in frames] == list(range(FRAMES))
    assert tuple(frame.index for frame in held_out) == kind.test
    assert len(set(names([*scene.train, *(frame for part in scene.test_sets.values() for frame in part)]))) == sum(
        scene.provenance.frames[part] for part in ("train", *scene.test_sets)
    )
    pinhole = layout_of(kind.layout).lens(WIDTH, HEIGHT)[0].pinhole
    for frame in frames:
        assert vars(frame.camera.intrinsics) == pytest.approx(vars(pinhole), rel=1e-6)
        pose, valid = poses(FRAMES)[frame.index], frame.valid.numpy()
        np.testing.assert_allclose(world @ frame.camera.camera_to_world.double().numpy(), pose, atol=1e-4)
        depth, color = seen_from(frame, pose)
        assert frame.image.dtype == torch.uint8 and valid.all()
        off = np.abs(frame.image.numpy().astype(int) - color)
        assert off.max() <= (14 if kind.is_undistorted else 0) and off.mean() < 1.2
        assert (frame.depth is not None) == bool(kind.depths)
        assert (frame.sparse_depth is not None) == (kind.format == "colmap")
        if frame.sparse_depth is not None:
            column, row = frame.sparse_depth.pixels.floor().long().unbind(1)
            np.testing.assert_allclose(frame.sparse_depth.depth, depth[row, column], atol=0.5)
        if frame.depth is not None:
            assert frame.depth.dtype == torch.float32
            difference = np.abs(frame.depth.numpy() - depth)
            assert difference.max() < kind.accuracy and np.median(difference) < max(0.12, 0.6 * kind.accuracy)
    points = scene.points.positions.double().numpy() @ world[:3, :3].T + world[:3, 3]
    assert len(points) > 100 and off_wall(points).max() < 1e-3 + kind.accuracy
    record = json.loads(json.dumps(scene.provenance.record(), allow_nan=False))
    assert record["dataset"] == kind.format and record["stored_size"] == record["size"] == [WIDTH, HEIGHT]
    assert record["unit"] == "mm"


@pytest.mark.parametrize("name", KINDS)
def test_a_scene_is_the_same_again_read_from_disk_each_time_or_at_once(walls, name):
    scene = load(walls(name), name, points_count=150)
    for again in (load(walls(name), name, points_count=150, keep_pixels=keep) for keep in (True, False)):
        assert torch.equal(scene.points.positions, again.points.positions)
        assert all(equal(*pair) for pair in zip(in_order(scene, name), in_order(again, name), strict=True))
        assert again.provenance == scene.provenance
    other = load(walls(name), name, points_count=150, seed=1).points.positions
    assert len(other) == 150 and not torch.equal(other, scene.points.positions)


@pytest.mark.parametrize("name", KINDS)
def test_the_fingerprint_is_that_of_the_files(walls, copied, name):
    kind, folder = KINDS[name], copied(name)
    reader = manager(kind.format)
    hashes = [reader.fingerprint(walls(name)), reader.fingerprint(folder)]
    (folder / "notes.txt").write_text("hello")
    assert {*hashes, reader.fingerprint(folder)} == {hashes[0]}
    (folder / kind.poses).open("ab").write(b"\n") if kind.poses else None
    hashes.append(reader.fingerprint(folder))
    repaint(kind.images, 3, lambda pixels: 0 * pixels)(folder)
    hashes.append(reader.fingerprint(folder))
    assert len(set(hashes)) == (3 if kind.poses else 2)


@pytest.mark.parametrize("name", KINDS)
def test_another_size_keeps_the_geometry(walls, name):
    """Nearest depth lies up to half a stored pixel beside its ray."""
    kind = KINDS[name]
    scene = load(walls(name), name, width=23, height=15)
    pinhole = layout_of(kind.layout).lens(WIDTH, HEIGHT)[0].pinhole.resized(23, 15)
    for frame in in_order(scene, name):
        assert vars(frame.camera.intrinsics) == pytest.approx(vars(pinhole), rel=1e-6)
        depth, color = seen_from(frame, poses(FRAMES)[frame.index])
        assert np.abs(frame.image.numpy().astype(int) - color).mean() < 5.0
        assert frame.depth is None or np.abs(frame.depth.numpy() - depth).max() < 2.5


@pytest.mark.parametrize(
    ("name", "file"), [("c3vd", "camera.json"), ("rgbd", "camera.json"), ("reim-nerf", "transforms_train.json")]
)
def test_pixel_centres_are_counted_at_integers(walls, name, file):
    """Files of COLMAP, nerfstudio, EndoGSLAM and Vicalib are read by others' code, or pinned beside their readers."""
    pinhole = layout_of(KINDS[name].layout).lens(WIDTH, HEIGHT)[0].pinhole
    assert json.loads((walls(name) / file).read_text())["cx"] == pytest.approx(pinhole.cx - 0.5, rel=1e-6)


NAN = float("nan")


@pytest.mark.parametrize(
    ("name", "steps", "depth", "bound"),
    [
        ("c3vd", np.uint16([0, 30000, 65535, 1]), [NAN, 30000 * 100 / 65535, NAN, 100 / 65535], [NAN, NAN, 100.0, NAN]),
        ("c3vd-endogslam", np.uint8([0, 51, 255, 1]), [NAN, 20.0, NAN, 100 / 255], [NAN, NAN, 100.0, NAN]),
        ("rgbd", np.uint16([0, 30000, 65535, 1]), [NAN, 60.0, 131.07, 0.002], None),
    ],
)
def test_depth_is_unknown_at_0_and_bounded_at_the_end_of_its_range(copied, name, steps, depth, bound):
    folder, pattern = copied(name), KINDS[name].depths
    for place in range(FRAMES):
        repaint(pattern, place, lambda pixels: np.resize(steps, pixels.shape))(folder)
    frame = load(folder, name).train[0]
    expected = torch.tensor(depth).repeat(WIDTH * HEIGHT // 4).reshape(HEIGHT, WIDTH)
    torch.testing.assert_close(frame.depth, expected, equal_nan=True)
    if bound is None:
        assert frame.depth_at_least is None
    else:
        torch.testing.assert_close(frame.depth_at_least[0, :4], torch.tensor(bound), equal_nan=True)


@pytest.mark.parametrize("name", KINDS)
def test_lengths_are_in_millimetres_where_their_unit_is_known(walls, name):
    unknown, scene, *larger = (load(walls(name), name, unit=unit) for unit in ("unknown", "mm", "cm"))
    assert not unknown.is_metric and scene.is_metric and larger[0].is_metric
    if "scale" in manager(KINDS[name].format).Settings.model_fields:
        larger.append(load(walls(name), name, unit="mm", scale=10.0))
    for other in larger:
        torch.testing.assert_close(other.points.positions, 10.0 * scene.points.positions)
        for frame, ours in zip(in_order(other, name), in_order(scene, name), strict=True):
            torch.testing.assert_close(frame.camera.center, 10.0 * ours.camera.center)
            if ours.depth is not None:
                torch.testing.assert_close(frame.depth, 10.0 * ours.depth, equal_nan=True)
            if ours.sparse_depth is not None:
                torch.testing.assert_close(frame.sparse_depth.depth, 10.0 * ours.sparse_depth.depth)
                torch.testing.assert_close(frame.sparse_depth.pixels, ours.sparse_depth.pixels)


@pytest.mark.parametrize("name", ["c3vd-raw", "c3vd-v2", "reim-nerf", "endomapper"])
def test_a_wide_view_is_masked_where_the_lens_shows_nothing(walls, name):
    frame = load(walls(name), name, focal_scale=0.4).train[0]
    assert 0.15 < frame.mask.float().mean() < 0.95
    assert torch.isnan(frame.depth[~frame.mask]).all() and frame.image[frame.mask].amax(dim=-1).min() > 0
    if name != "endomapper":  # whose masks are files
        whole = load(walls(name), name, focal_scale=0.4, mask=False).train[0]
        assert whole.mask is None or whole.mask.sum() > frame.mask.sum()


def paint_alpha(pattern: str, alpha: np.ndarray) -> Spoil:
    """Give all images an alpha channel, and a glaring colour where it is 0."""

    def paint(pixels: np.ndarray) -> np.ndarray:
        return np.dstack([np.where(alpha[..., None] == 0, np.uint8([255, 0, 255]), pixels[..., :3]), alpha])

    return lambda folder: [repaint(pattern, place, paint)(folder) for place in range(len(files(folder, pattern)))]


@pytest.mark.parametrize("name", KINDS)
def test_alpha_is_a_mask_and_said_once(copied, caplog, name):
    caplog.set_level(logging.INFO)
    folder, kind = copied(name), KINDS[name]
    before = load(folder, name).train[0]
    assert "an alpha channel" not in caplog.text
    height, width = cv2.imread(str(files(folder, kind.images)[0])).shape[:2]
    alpha = np.full((height, width), 255, np.uint8)
    paint_alpha(kind.images, alpha)(folder)
    opaque = load(folder, name).train[0]
    assert equal(before, opaque) and (opaque.mask is None) == (before.mask is None)
    alpha[:, : width // 4], alpha[:, width // 4 : width // 2], alpha[:, width // 2 :] = 0, 127, 128
    paint_alpha(kind.images, alpha)(folder)
    caplog.clear()
    frame = load(folder, name).train[0]
    assert sum("alpha below 128" in record.getMessage() for record in caplog.records) == 1
    middle = frame.mask.shape[1] // 2
    if not kind.is_undistorted:  # else the middle of the working image may be beside that of the stored one
        expected = before.valid & torch.from_numpy(alpha >= 128)
        assert torch.equal(frame.mask, expected)
    assert not frame.mask[:, : middle - 4].any() and frame.mask.any()
    assert torch.equal(frame.mask[:, middle + 4 :], before.valid[:, middle + 4 :])
    assert frame.depth is None or torch.isnan(frame.depth[~frame.mask]).all()


@pytest.mark.parametrize("size", [(20, 16), (80, 64), (33, 29)])
@pytest.mark.parametrize("name", ["nerfstudio", "c3vd-raw"])
def test_no_working_pixel_mixes_in_the_colour_of_a_hidden_one(copied, name, size):
    folder, pattern = copied(name), KINDS[name].images
    shape = cv2.imread(str(files(folder, pattern)[0])).shape
    hidden = np.random.default_rng(0).uniform(size=shape[:2]) < 0.02
    alpha = np.where(hidden, np.uint8(0), np.uint8(255))
    for place in range(len(files(folder, pattern))):
        repaint(pattern, place, lambda pixels: np.full(shape, (0, 200, 0), np.uint8))(folder)
    paint_alpha(pattern, alpha)(folder)
    frame = load(folder, name, width=size[0], height=size[1]).train[0]
    off = (frame.image[frame.mask].int() - torch.tensor([0, 200, 0])).abs()
    assert 0.05 < frame.mask.float().mean() < 1.0 and off.max() <= 1  # of rounding


@pytest.mark.parametrize("name", KINDS)
def test_masks_that_are_not_used_are_named(copied, caplog, name):
    folder = copied(name)
    place = folder / ("lens_mask.png" if name == "endomapper" or name.startswith("rgbd") else "Masks")
    if place.suffix:  # masks/ is what these read
        cv2.imwrite(str(place), np.full((HEIGHT, WIDTH), 255, np.uint8))
    else:
        place.mkdir()
    load(folder, name)
    assert f"{place.name} not used: format {KINDS[name].format} reads" in caplog.text


# Seen masks


def seen_warnings(caplog) -> list[str]:
    return [record.getMessage() for record in caplog.records if "seen masks" in record.getMessage()]


def apart(scene: Scene) -> list[Frame]:
    """Frames of the video that are held out, and rotation views."""
    return [frame for frames in scene.test_sets.values() for frame in frames]


@pytest.mark.parametrize("name", KINDS)
def test_seen_masks_are_read_for_the_training_frames_that_they_are_for(walls, caplog, name):
    kind, folder = KINDS[name], walls(name)
    scene = load(folder, name)
    has_rotation = layout_of(kind.layout).has_rotation and not kind.has_own_tests
    assert len(scene.test_sets.get("rotation", ())) == (2 if has_rotation else 0)
    for frame in apart(scene):
        mask = frame.seen.numpy()
        assert mask[:, : WIDTH // 2 - 1].all() and not mask[:, WIDTH // 2 + 1 :].any()
    assert all(frame.seen is None for frame in scene.train)
    for options in ({"max_frames": 6}, {"frame_step": 2}, {"split": "block"}):
        caplog.clear()
        scene = load(folder, name, initial_points="none", **options)
        assert all(frame.seen is None for frame in (*scene.train, *apart(scene)))
        assert seen_warnings(caplog) == [
            f"{folder}: seen masks are for split '{kind.seen_split}' of all frames; this "
            "run trains on other frames, so metrics on seen pixels are unavailable"
        ] * bool(apart(scene))


@pytest.mark.parametrize(
    ("name", "options"),
    [
        # All frames; those that are left out, the last one, is trained on by none.
        ("c3vd", {"max_frames": FRAMES}),
        ("rotatecolon", {"split": "own", "max_frames": 100}),
        # Frame 7 alone.
        ("c3vd-endogslam", {"split": "block", "block": (7 / FRAMES, 8 / FRAMES)}),
    ],
)
def test_other_options_with_the_same_training_frames_keep_seen_masks(walls, caplog, name, options):
    assert all(frame.seen is not None for frame in apart(load(walls(name), name, **options)))
    assert not seen_warnings(caplog)


@pytest.mark.parametrize("name", ["colmap", "nerfstudio", "rotatecolon"])
def test_images_without_a_pose_put_seen_masks_out_of_step(copied, caplog, name):
    folder = copied(name)
    WARNED["an image without a pose", name][0](folder)
    assert all(frame.seen is None for frame in apart(load(folder, name)))
    assert len(seen_warnings(caplog)) == 1 and "are for all images, but some are left out" in caplog.text
    remove("truth/seen/*")(folder)
    caplog.clear()
    load(folder, name, split="all-train")


# Faults


@pytest.mark.parametrize("row", REFUSED, ids=" of ".join)
def test_a_fault_is_one_clear_error(copied, row):
    spoil, pattern = REFUSED[row]
    folder = copied(row[1])
    spoil(folder)
    # Whatever is in the folder, looking which format it is does not fail.
    recognised(folder)
    with pytest.raises(InputError) as caught:
        load(folder, row[1])
    message = str(caught.value)
    assert caught.value.expected and "\n" not in message
    assert re.search(pattern, message), message


@pytest.mark.parametrize("row", WARNED, ids=" of ".join)
def test_what_may_be_wrong_is_one_warning(copied, caplog, row):
    spoil, pattern = WARNED[row]
    folder = copied(row[1])
    spoil(folder)
    load(folder, row[1])
    (warning,) = [record.getMessage() for record in caplog.records if re.search(pattern, record.getMessage())]
    assert str(folder) in warning


@pytest.mark.parametrize("format", formats())
def test_a_folder_that_is_not_there(tmp_path, format):
    assert any(kind.format == format for kind in KINDS.values()), "it is read in some layout"
    with pytest.raises(InputError, match=r"no (folder|file) .*nowhere"):
        manager(format).load(tmp_path / "nowhere")
    assert datamanagers.get(format).recognise(tmp_path / "nowhere") is None


def test_a_file_in_the_place_of_a_folder(copied, tmp_path):
    folder = copied("nerfstudio")
    (folder / "a clip.MP4").touch()
    (tmp_path / "notes.txt").touch()
    for path, message in (
        (folder / "transforms.json", rf"transforms.json is a file of a scene. .* Give {folder}\.$"),
        (folder / "a clip.MP4", rf"is a video\. .* coliags reconstruct '{folder}/a clip.MP4' --output FOLDER"),
        (tmp_path / "notes.txt", r"notes.txt is a file\. Expected a scene's folder, as docs/data.md describes\.$"),
    ):
        with pytest.raises(InputError, match=message):
            find_format(path)


# What is unusual, and no fault


def without_zeros(name: str) -> str:
    return re.sub(r"0*(\d+)", r"\1", name, count=1)


def unpadded(pattern: str, *globs: str) -> Spoil:
    """Take zeros out of the names of files and of their mentions in JSON."""

    def change(index: int, frame: dict) -> None:
        for key in {"file_path", "depth_file_path", "distmap_path"} & frame.keys():
            frame[key] = without_zeros(frame[key])
        if KINDS["nerfstudio"].poses == pattern:  # which may name images without suffix
            frame["file_path"] = "./" + frame["file_path"].removesuffix(".png")

    return lambda folder: [renumber(*globs)(folder), change_frames(pattern, change)(folder)]


def in_a_folder(folder: Path) -> None:
    """Move images into a sub-folder, as the names in the model say it on Windows."""
    (folder / "images" / "sub").mkdir()
    for path in files(folder, "images/*.png"):
        path.rename(path.parent / "sub" / path.name)
    edit("sparse/0/images.txt", r"(\d+\.png)", r"sub\\\1")(folder)


#: Kinds, and what makes the names of their files, or those in a file, others.
RENAMED = [
    *((name, renumber(KINDS[name].images, KINDS[name].depths)) for name in (*GROUPS["paired"], "rotatecolon")),
    ("endomapper", renumber("rgb/*.png", "depth/*.png", "mask/*.png")),
    (
        "colmap-text",
        lambda folder: [
            renumber("images/*.png")(folder),
            edit("sparse/0/images.txt", r"\b0*(\d+)\.png", r"\1.png")(folder),
        ],
    ),
    ("nerfstudio", unpadded("transforms.json", "images/*.png", "depth/*.png")),
    # Its preprocessing writes names that are not padded like those in the JSON files, and a mask of three channels.
    (
        "reim-nerf",
        lambda folder: [
            renumber("images/*.png", "distmaps/*.png")(folder),
            repaint("rgb_mask.png", 0, lambda mask: np.dstack([mask] * 3))(folder),
        ],
    ),
    # Names of Windows.
    ("nerfstudio", edit("transforms.json", r"(path\": \"(images|depth))/", r"\1\\\\")),
    (
        "reim-nerf",
        lambda folder: [
            edit(path.name, "(images|distmaps)/", r"\1\\\\")(folder)
            for path in files(folder, "transforms_*.json")
            if "images/" in path.read_text()
        ],
    ),
    ("colmap-text", in_a_folder),
]


@pytest.mark.parametrize(("name", "rename"), RENAMED)
def test_names_without_leading_zeros_or_of_windows_make_the_same_scene_in_the_same_order(copied, walls, name, rename):
    folder = copied(name)
    rename(folder)
    frames, expected = (in_order(load(place, name), name) for place in (folder, walls(name)))
    assert all(equal(*pair) for pair in zip(frames, expected, strict=True))
    assert [without_zeros(frame.name) for frame in frames] == [without_zeros(frame.name) for frame in expected]


# The size that images have by default


RAW, PREPARED, PAPER, FIFTH = (1350, 1080), (675, 540), (338, 270), (270, 216)


@pytest.mark.parametrize("format", formats())
def test_the_default_size_is_the_one_published_as_the_page_says(format):
    kind = datamanagers.get(format)
    assert kind.seen_split == kind.Settings().split
    page = (Path(__file__).parents[2] / "docs/data.md").read_text()
    rows = page.split("| format | default size | published by |")[1].split("\n\n")[0].replace("`", "").splitlines()[2:]
    cells = [re.split(r" *\| *", row) for row in rows]
    fits = {name: size for _, formats, size, *_ in cells for name in formats.split(", ")}
    size = fits.get(format, fits["others"])
    assert size.split(",")[0] == ("as stored" if kind.fits is None else "x".join(map(str, kind.fits)))
    stored = [RAW, PREPARED, PAPER, FIFTH, (1920, 1080), (169, 135)]
    expected = {None: stored, FIFTH: [FIFTH] * 4 + [(270, 152), (169, 135)]}.get(
        kind.fits, [PAPER] * 3 + [FIFTH, (338, 190), (169, 135)]
    )
    assert [manager(format).working_size(*each) for each in stored] == expected
    assert manager(format, width=338, height=270).working_size(1, 1) == PAPER


def test_smaller_images_are_told_once_where_no_size_is_set(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    folder = write_wall(tmp_path, "rgbd", 3, 400, 320)
    for size in ({}, {"width": 200, "height": 150}):
        load(folder, "rgbd", **size)
    change = "`datamanager.width=W` and `datamanager.height=H` set another size"
    assert [record.getMessage() for record in caplog.records if "stored at" in record.getMessage()] == [
        f"{folder}: images stored at 400 x 320 are used at 338 x 270; {change}"
    ]
