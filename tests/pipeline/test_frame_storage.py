"""Frames that the video has are removed, and decoded again."""

import json

import pytest

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import write_json
from coliags_plugin.core.images import read_rgb, write_image
from coliags_plugin.pipeline.frame_sources import Span, frame_source
from coliags_plugin.pipeline.frame_storage import remove_frames, restore_frames
from coliags_plugin.pipeline.frames import write_frames
from coliags_plugin.pipeline.procedure.export import export_atlas
from coliags_plugin.pipeline.settings import FrameSettings
from tests.commands import refused, run
from tests.pipeline.films import film, write_avi
from tests.pipeline.procedures import SPANS, procedure_content, write_procedure

PLACES = range(0, 96, 6)


@pytest.fixture
def video(tmp_path):
    return write_avi(film(PLACES), tmp_path / "film.avi", 10)


def write_part(video, folder, **span):
    """Frames of use of a reconstruction, and a scene of all but the last."""
    source = frame_source(video, Span(**span))
    write_frames(source, folder / "frames", FrameSettings(least_motion=0.0, every=2))
    images = sorted((folder / "frames" / "images").iterdir())
    for image in images[:-1]:
        write_image(folder / "poses" / "images" / image.name, read_rgb(image))
    return {file: file.read_bytes() for file in sorted(folder.rglob("*.png"))}


def test_what_is_restored_is_what_was_removed(video, tmp_path, capsys):
    before = write_part(video, tmp_path / "out", first=3)
    size = sum(len(data) for file, data in before.items() if "frames" in file.parts)
    assert run("frames", "remove", tmp_path / "out", video, "--json") == 0
    assert json.loads(capsys.readouterr().out)["freed_bytes"] == size
    assert not list((tmp_path / "out").rglob("*.png"))
    assert remove_frames(tmp_path / "out", video) == 0
    assert run("frames", "restore", tmp_path / "out", video) == 0
    assert "7 frames restored" in capsys.readouterr().out
    assert {file: file.read_bytes() for file in sorted((tmp_path / "out").rglob("*.png"))} == before
    name = next(iter(before)).name
    assert (tmp_path / "out/frames/images" / name).samefile(tmp_path / "out/poses/images" / name)
    assert restore_frames(tmp_path / "out", video) == 0


def test_a_killed_removal_goes_on(video, tmp_path):
    before = write_part(video, tmp_path / "out")
    remove_frames(tmp_path / "out", video)
    for file, data in [*before.items()][:3]:
        file.write_bytes(data)
    assert remove_frames(tmp_path / "out", video) > 0
    restore_frames(tmp_path / "out", video)
    assert {file: file.read_bytes() for file in sorted((tmp_path / "out").rglob("*.png"))} == before


def test_nothing_is_removed_that_the_video_does_not_have(video, tmp_path):
    before = write_part(video, tmp_path / "out")
    for other, message in (
        (write_avi(film(PLACES, seed=1), tmp_path / "other.avi", 10), "has another frame than"),
        (write_avi(film(PLACES)[:8], tmp_path / "short.avi", 10), "does not have 4 frames"),
    ):
        with pytest.raises(InputError, match=message):
            remove_frames(tmp_path / "out", other)
        assert all(file.read_bytes() == data for file, data in before.items())
    remove_frames(tmp_path / "out", video)
    with pytest.raises(InputError, match="has another frame"):
        restore_frames(tmp_path / "out", tmp_path / "other.avi")
    with pytest.raises(InputError, match="does not have 4 removed frames"):
        restore_frames(tmp_path / "out", tmp_path / "short.avi")
    assert restore_frames(tmp_path / "out", video) == len(PLACES) / 2


def test_segments_of_a_procedure(video, tmp_path, capsys):
    out = tmp_path / "out"
    for name, first, last in (("segment-000", 0, 8), ("segment-001", 6, 15)):
        write_part(video, out / name, first=first, last=last)
    before = {file: file.read_bytes() for file in sorted(out.rglob("*.png"))}
    spans = [{"name": name, "first": first, "last": last} for name, (first, last) in SPANS.items()]
    write_json(out / "procedure.json", procedure_content(segments=spans))
    assert remove_frames(out, video) > 0
    assert not list(out.rglob("*.png"))
    assert restore_frames(out, video) == 5 + 5
    assert {file: file.read_bytes() for file in sorted(out.rglob("*.png"))} == before
    assert "has no frames of a video" in refused(capsys, "frames", "restore", tmp_path, video)


def test_what_needs_removed_frames_tells_how_to_restore_them(tmp_path):
    out = write_procedure(tmp_path / "out")
    write_json(out / "segment-001" / "frames" / "removed.json", {"checksums": {}, "posed": []})
    with pytest.raises(InputError, match=r"segment-001/frames were removed.*coliags frames restore"):
        export_atlas(out, tmp_path / "export")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", r"removed\.json"),
        ('{"checksums": {"../x": 1}, "posed": []}', "pattern"),
        ('{"checksums": {"x": 1}, "posed": ["y"]}', "y is posed, and has no checksum"),
    ],
)
def test_a_damaged_list_is_refused(tmp_path, text, message):
    out = write_procedure(tmp_path / "out")
    (out / "segment-000" / "frames" / "removed.json").write_text(text)
    for command in (remove_frames, restore_frames):
        with pytest.raises(InputError, match=message):
            command(out, tmp_path / "film.avi")


def test_frames_are_not_their_own_source(video, tmp_path):
    before = write_part(video, tmp_path / "out")
    (tmp_path / "link").symlink_to(tmp_path / "out" / "frames" / "images")
    for source in (tmp_path / "out" / "frames" / "images", tmp_path / "link"):
        with pytest.raises(InputError, match="apart from"):
            remove_frames(tmp_path / "out", source)
    assert all(file.read_bytes() == data for file, data in before.items())
