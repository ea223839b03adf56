"""What a scene's files name lies in the scene's folder, or is asked for."""

from __future__ import annotations

import pytest

from coliags_plugin.core.errors import InputError
from coliags_plugin.datamanagers.reading.files import named_file


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
