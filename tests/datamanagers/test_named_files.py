"""What a scene's files name lies in the scene's folder, or is asked for."""

from __future__ import annotations

import json
import shutil

import pytest

from coliags_plugin.core.errors import InputError
from coliags_plugin.datamanagers.nerfstudio.reader import NerfstudioDataManager
from coliags_plugin.datamanagers.reading.files import named_file
from tests.phantom.phantom_layouts import write_phantom


@pytest.mark.parametrize("name", ["a.png", "images/a.png", "images/../a.png", "./a.png", "", "..png"])
def test_names_within(tmp_path, name):
    assert named_file(tmp_path, name, "x.json", outside=False) == tmp_path / name


@pytest.mark.parametrize("name", ["../a.png", "images/../../a.png", "/etc/hostname", ".."])
def test_names_outside(tmp_path, name):
    with pytest.raises(InputError, match=r"x\.json names .* outside of .*outside_files=true"):
        named_file(tmp_path, name, "x.json", outside=False)
    assert named_file(tmp_path, name, "x.json", outside=True) == tmp_path / name


@pytest.mark.parametrize("name", ["a\0b", "a" * 300, "a/" * 3000])
def test_names_that_no_file_can_have(tmp_path, name):
    with pytest.raises(InputError, match=r"x\.json names .*Expected the name of a file"):
        named_file(tmp_path, name, "x.json", outside=False)


def test_an_absolute_path_into_the_folder(tmp_path):
    assert named_file(tmp_path, str(tmp_path / "a.png"), "x.json", outside=False) == tmp_path / "a.png"


@pytest.mark.parametrize("absolute", [False, True])
def test_a_scene_whose_images_lie_elsewhere_has_to_be_trusted(tmp_path, absolute):
    scene = write_phantom(tmp_path / "scene", "nerfstudio", mesh_spacing=3.0, texture_spacing=1.0)
    shutil.move(scene / "images", tmp_path / "elsewhere")
    file = scene / "transforms.json"
    content = json.loads(file.read_text())
    start = str(tmp_path) if absolute else ".."
    for frame in content["frames"]:
        frame["file_path"] = frame["file_path"].replace("images/", f"{start}/elsewhere/")
    file.write_text(json.dumps(content))
    with pytest.raises(InputError, match="outside_files=true"):
        NerfstudioDataManager(NerfstudioDataManager.Settings()).load(scene)
    trusted = NerfstudioDataManager(NerfstudioDataManager.Settings(outside_files=True)).load(scene)
    assert len(trusted.train) == 7
