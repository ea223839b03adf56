"""What is wrong with a folder is one clear error, or a warning, whatever its layout: never a traceback."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from coliags_plugin.checks.data.check import check_scene
from coliags_plugin.config.registry import datamanagers
from coliags_plugin.core.errors import InputError
from coliags_plugin.datamanagers.recognition import find_format, formats
from tests.datamanagers.layout_faults import REFUSED, WARNED, WITH_DEPTH, every_row, load
from tests.datamanagers.spoiling import (
    FRAMES,
    KINDS,
    Spoil,
    change_json,
    repaint,
)


@pytest.mark.parametrize(("fault", "name", "row"), every_row(REFUSED))
def test_one_clear_error(copied, fault, name, row):
    spoil, pattern = REFUSED[fault][name][row]
    folder = copied(name)
    spoil(folder)
    # Whatever is in the folder, looking which format it is does not fail.
    datamanagers.get(KINDS[name].format).recognise(folder)
    with pytest.raises(InputError) as caught:
        load(folder, name)
    message = str(caught.value)
    assert caught.value.expected and "\n" not in message
    assert re.search(pattern, message), message


@pytest.mark.parametrize("name", KINDS)
def test_a_folder_that_is_not_there(tmp_path, name):
    with pytest.raises(InputError, match=r"no (folder|file) .*nowhere"):
        load(tmp_path / "nowhere", name)


def test_a_file_in_the_place_of_a_folder(copied, tmp_path):
    folder = copied("nerfstudio")
    with pytest.raises(InputError, match=rf"transforms.json is a file of a scene. .* Give {folder}\.$"):
        find_format(folder / "transforms.json")
    (folder / "a clip.MP4").touch()
    with pytest.raises(InputError, match=rf"is a video\. .* coliags reconstruct '{folder}/a clip.MP4' --output FOLDER"):
        find_format(folder / "a clip.MP4")
    (tmp_path / "notes.txt").touch()
    with pytest.raises(
        InputError, match=r"notes.txt is a file\. Expected a scene's folder, as docs/data.md describes\.$"
    ):
        find_format(tmp_path / "notes.txt")


def test_every_fault_meets_every_layout_it_can_befall():
    """The table is complete: of the faults that any scene can have, no layout is left out."""
    for fault in ("an image of another size", "an image cut short", "an empty folder", "no images"):
        assert set(REFUSED[fault]) == set(KINDS), fault
    for fault in ("a number that is none", "a rotation that is none", "a pose file cut short"):
        assert set(REFUSED[fault]) == set(KINDS), fault
    for fault in ("a depth file cut short", "a depth file of another size"):
        assert set(REFUSED[fault]) == set(WITH_DEPTH), fault
    # By time, there may be more poses than images, and what has no depth is left out with a warning.
    assert set(REFUSED["an image that is gone"]) == set(KINDS) - {"rgbd"}
    assert set(REFUSED["depth that is missing for a frame"]) == set(WITH_DEPTH) - {"rgbd"}
    assert {KINDS[name].format for name in KINDS} == set(formats())


@pytest.mark.parametrize(("fault", "name", "row"), every_row(WARNED))
def test_one_clear_warning(copied, caplog, fault, name, row):
    spoil, message = WARNED[fault][name][row]
    folder = copied(name)
    spoil(folder)
    with caplog.at_level(logging.WARNING):
        load(folder, name)
    (warning,) = [record.getMessage() for record in caplog.records if re.search(message, record.getMessage())]
    assert str(folder) in warning


@pytest.mark.parametrize("name", KINDS)
def test_nothing_is_wrong_with_an_unspoilt_folder(phantoms, caplog, name):
    folder = phantoms[name] / KINDS[name].scene
    with caplog.at_level(logging.WARNING):
        scene = load(folder, name)
    assert caplog.records == []
    assert find_format(folder) == KINDS[name].format
    test_frames = scene.test_sets["rotation" if name == "rotatecolon" else "test"] if name != "rotatecolon" else []
    assert len(scene.train) + len(test_frames) == FRAMES


# What data check is for


def _shallow_exr(folder: Path) -> None:
    for place in range(FRAMES):
        repaint("depth_train/*.exr", place, lambda pixels: pixels / 1000.0)(folder)


METRES = {
    "rgbd": change_json("camera.json", lambda content: content.update(depth_scale=1000.0 * content["depth_scale"])),
    "nerfstudio": change_json(
        "transforms.json",
        lambda content: content.update(depth_unit_scale_factor=content["depth_unit_scale_factor"] / 1000.0),
    ),
    "rotatecolon": _shallow_exr,
}


@pytest.mark.parametrize("name", METRES)
def test_depth_in_metres_is_suspect(copied, name):
    folder = copied(name)
    METRES[name](folder)
    found = {finding.what: finding for finding in check_scene(load(folder, name)).findings}
    assert "unit=m" in found["depth looks like metres"].do
    assert "depth and poses are in different units" in found


# What the pages say is refused

PAGES = Path(__file__).parents[2] / "docs/layouts"
_MODEL_OF_NOTHING = change_json("transforms.json", lambda content: content.update(camera_model="PANORAMA"))


def _with_confidence(spoil: Callable[[dict], object] = lambda content: None, dtype: str = "uint8") -> Spoil:
    """Every frame gets a confidence, then the content is spoilt."""

    def change(folder: Path) -> None:
        content = json.loads((folder / "transforms.json").read_text())
        for frame in content["frames"]:
            frame["confidence_file_path"] = frame["depth_file_path"].replace("depth/", "confidence/")
            file = folder / frame["confidence_file_path"]
            file.parent.mkdir(exist_ok=True)
            depth = cv2.imread(str(folder / frame["depth_file_path"]), cv2.IMREAD_UNCHANGED)
            cv2.imwrite(str(file), np.zeros(depth.shape, dtype if "00003" in file.name else "uint8"))
        spoil(content)
        (folder / "transforms.json").write_text(json.dumps(content))

    return change


#: By page, in the order of its table: the kind, and how to spoil it, or the fault above that does.
TOLD: dict[str, list[tuple[str, str | Spoil]]] = {
    "colmap": [
        ("colmap", "an empty folder"),
        ("colmap", "a model without images"),
        ("colmap", "another file of the layout cut short"),
        ("colmap-text", "another file of the layout cut short"),
        ("colmap-text", "a rotation that is none"),
        ("colmap-text", "a model without images"),
        ("colmap", "an image that is gone"),
        ("colmap", "an image of another size"),
        ("colmap", "an image cut short"),
    ],
    "nerfstudio": [
        ("nerfstudio", "an empty folder"),
        ("nerfstudio", "a pose file cut short"),
        ("nerfstudio", change_json("transforms.json", lambda content: content["frames"].clear())),
        ("nerfstudio", "an image that is gone"),
        ("nerfstudio", "depth that is missing for a frame"),
        ("nerfstudio", change_json("transforms.json", lambda content: content["frames"][3].pop("depth_file_path"))),
        ("nerfstudio", _with_confidence(lambda content: content["frames"][3].pop("confidence_file_path"))),
        ("nerfstudio", _with_confidence(lambda content: [frame.pop("depth_file_path") for frame in content["frames"]])),
        ("nerfstudio", _with_confidence(dtype="uint16")),
        ("nerfstudio", _MODEL_OF_NOTHING),
        ("nerfstudio", change_json("transforms.json", lambda content: content.update(k4=0.1))),
        ("nerfstudio", "a rotation that is none"),
        ("nerfstudio", "a left-handed pose"),
        ("nerfstudio", "an image of another size"),
        ("nerfstudio", "a depth file of three channels"),
        ("nerfstudio", "an image cut short"),
    ],
}


def examples(page: str) -> list[str]:
    """The second column of the page's table of what is refused."""
    lines = (PAGES / f"{page}.md").read_text().split("| found | example of the message |\n|---|---|\n")[1].splitlines()
    rows = [line.strip("|").split("|") for line in lines if line.startswith("|")]
    return [row[1].strip().strip("`") for row in rows]


@pytest.mark.parametrize(("page", "row"), [(page, row) for page in TOLD for row in range(len(TOLD[page]))])
def test_the_pages_examples_are_what_is_said(copied, page, row):
    told = examples(page)
    assert len(told) == len(TOLD[page])
    name, fault = TOLD[page][row]
    folder = copied(name)
    (REFUSED[fault][name][0][0] if isinstance(fault, str) else fault)(folder)
    with pytest.raises(InputError) as caught:
        load(folder, name)
    said = str(caught.value).replace(f"{folder}/", "")
    # Bytes and the numbers of points are the phantom's.
    assert re.search(re.sub(r"\d{2,}", r"\\d+", re.escape(told[row])), said), said
