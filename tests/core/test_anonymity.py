from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from coliags_plugin.core.anonymity import without_places


@pytest.mark.parametrize(
    ("text", "left"),
    [
        ("/home/doctor/patient 12/scene", "scene"),
        ("/data/scene/", "scene"),
        ("~/data/scene", "scene"),
        (r"C:\Users\doctor\scene", "scene"),
        ("cannot read /home/doctor/scene/camera.json: no file", "cannot read camera.json: no file"),
        ("'/home/doctor/a.png' and '/home/doctor/b.png'", "'a.png' and 'b.png'"),
        ("images/0000.png", "images/0000.png"),
        ("12 mm/s, 3/4, and/or", "12 mm/s, 3/4, and/or"),
        ("https://example.org/a/b", "https://example.org/a/b"),
    ],
)
def test_of_absolute_paths_the_last_part_stays(text, left):
    assert without_places(text) == left


def test_plain_data_keep_their_form():
    value = {"a": [1, "/x/y", None], "b": ("/x/z", 2.5), "c": {"d": Path("/x/w")}, "e": True}
    assert without_places(value) == {"a": [1, "y", None], "b": ("z", 2.5), "c": {"d": "w"}, "e": True}


@given(st.lists(st.text("abc-_.é ", min_size=1).filter(lambda part: part.strip(". ")), min_size=2, max_size=5))
def test_no_folder_of_a_path_is_left(parts):
    assert without_places("/" + "/".join(parts)) == parts[-1]
