"""The export of a sub-maps: what is written can be read back, and is what lies in the segments."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import write_json
from coliags_plugin.engine.data_formats import open_scene
from coliags_plugin.geometry.poses import colmap, tum
from coliags_plugin.pipeline.export import export_atlas
from coliags_plugin.pipeline.survey import Survey
from tests import commands
from tests.pipeline.reconstructions import JOINS, RATE, SUBMAPS, change_video, similarity


def test_every_sub_map_is_exported_with_its_trajectory_and_the_transform_to_the_first_of_those_joined(out, tmp_path):
    manifest = export_atlas(out, tmp_path / "export")
    assert json.loads((tmp_path / "export" / "manifest.json").read_text()) == manifest
    assert {entry["name"]: entry["frames"] for entry in manifest["submaps"]} == {
        name: [*folder] for name, folder in SUBMAPS.items()
    }
    assert (manifest["source"], manifest["rate"], manifest["timestamps"]) == (["withdrawal.mp4"], RATE, "s")
    for entry in manifest["submaps"]:
        segment, number = entry["name"].split("/")
        folder = tmp_path / "export" / entry["folder"]
        assert entry["folder"] == f"{segment}-{number}"
        path, model = tum.read(folder / "trajectory.txt"), colmap.read(out / segment / "poses" / "sparse" / number)
        np.testing.assert_array_equal(path.timestamps, np.array(entry["frames"]) / RATE)
        np.testing.assert_allclose(path.camera_to_world, model.camera_to_world, atol=1e-9)
        scene = open_scene(folder / "colmap", "colmap", ["initial_points=none"])
        assert len(scene.video) == len(entry["frames"]) == len(list((folder / "colmap" / "images").iterdir()))
        assert entry["nerfstudio"] == (number != "2") == (folder / "nerfstudio" / "transforms.json").is_file()
    by_name = {entry["name"]: entry for entry in manifest["submaps"]}
    joined = {name for name, entry in by_name.items() if entry["joined_to"] != name}
    assert joined == {"segment-001/0"}
    assert by_name["segment-001/0"]["joined_to"] == "segment-000/2"
    np.testing.assert_allclose(by_name["segment-001/0"]["to_joined"], similarity(1))
    np.testing.assert_array_equal(by_name["segment-000/2"]["to_joined"], np.eye(4))
    assert [entry["reason"] for entry in manifest["joins"]] == [entry["reason"] for entry in JOINS]


def test_a_short_video_is_exported_likewise(short, tmp_path):
    manifest = export_atlas(short, tmp_path / "export")
    assert [(entry["name"], entry["folder"], entry["nerfstudio"]) for entry in manifest["submaps"]] == [
        (f"sub-map {number}", f"submap-{number}", number != 2) for number in range(3)
    ]
    assert manifest["joins"] == [] and manifest["size"] == [40, 32]
    assert colmap.read(tmp_path / "export" / "submap-1" / "colmap" / "sparse" / "0").names


def test_timestamps_are_frame_numbers_where_the_rate_is_unknown_and_those_of_frames_where_it_varies(out, tmp_path):
    change_video(out, rate=None)
    assert export_atlas(out, tmp_path / "export")["timestamps"] == "frame number"
    assert tum.read(tmp_path / "export" / "segment-001-1" / "trajectory.txt").timestamps.tolist() == [*range(40, 52)]
    times = np.cumsum(np.random.default_rng(0).uniform(0.02, 0.3, 100))
    replace(Survey.read(out), times=times).write(out)
    for entry in export_atlas(out, tmp_path / "export", overwrite=True)["submaps"]:
        path = tum.read(tmp_path / "export" / entry["folder"] / "trajectory.txt")
        np.testing.assert_array_equal(path.timestamps, times[entry["frames"]])


@pytest.mark.parametrize(("link", "other_disk"), [(False, False), (True, False), (True, True)])
def test_linked_images_take_no_space_on_the_same_disk(out, tmp_path, monkeypatch, link, other_disk):
    def refused(*_):
        raise OSError(18, "Invalid cross-device link")

    if other_disk:
        monkeypatch.setattr("os.link", refused)
    export_atlas(out, tmp_path / "export", link=link)
    for file, is_linked in (("images/003.png", link and not other_disk), ("sparse/0/images.bin", False)):
        entry, other = out / "segment-000/poses" / file, tmp_path / "export/segment-000-0/colmap" / file
        assert entry.read_bytes() == other.read_bytes()
        assert entry.samefile(other) is is_linked


def test_what_cannot_be_exported_is_refused(out, tmp_path):
    export = tmp_path / "export"
    export_atlas(out, export)
    with pytest.raises(InputError, match="already exists"):
        export_atlas(out, export)
    with pytest.raises(InputError, match="a folder apart from the input"):
        export_atlas(out, out / "export")
    file = out / "segment-000" / "poses" / "atlas.json"
    content = json.loads(file.read_text())
    content["submaps"][0]["frames"].pop()
    write_json(file, content)
    before = (export / "manifest.json").read_bytes()
    with pytest.raises(InputError, match=r"sparse/0 has 14 frames, .* names 13 of it"):
        export_atlas(out, export, overwrite=True)
    assert (export / "manifest.json").read_bytes() == before
    for segment in ("segment-000", "segment-001"):
        (out / segment / "poses" / "atlas.json").write_text("{")
    with pytest.raises(InputError, match=r"has no sub-map with poses: segment-000: poses/atlas\.json"):
        export_atlas(out, export, overwrite=True)


def test_the_command_names_the_sub_maps(out, tmp_path, capsys):
    assert commands.run("poses", "export", out, "--output", tmp_path / "export") == 0
    printed = capsys.readouterr().out
    assert "segment-001/0: 14 frames, unit unknown, joined to segment-000/2" in printed
    assert "segment-000/2: 5 frames, unit unknown, no dense depth" in printed
