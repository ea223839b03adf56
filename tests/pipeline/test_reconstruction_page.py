"""The page and the last lines of a reconstruction of several sub-maps."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from coliags_plugin.core.files import write_json
from coliags_plugin.datamanagers.atlas import ATLAS_FILE, read_atlas
from coliags_plugin.outputs.image_files import write_png
from coliags_plugin.pipeline.page import held_out_text, remarks, results_of, submap_table, write_index
from coliags_plugin.pipeline.stages import StageRecord
from coliags_plugin.reporting.text_formats import terminal_text
from tests.pipeline.records import FOLDER, SCENE_FILE, done, record_in


def test_figures_of_sub_maps_and_their_means(tmp_path):
    results = results_of(record_in(tmp_path))
    table = submap_table(results, ["0 to 13", None, None])
    rows = [{column.key: cell.text for column, cell in zip(table.columns, row, strict=True)} for row in table.cells]
    assert [row["submap"] for row in rows] == ["0, the largest", "1", "2", "mean"]
    assert [row["psnr"] for row in rows] == ["24.00", "22.00", "", "23.00"]
    assert [row["gap"] for row in rows] == ["3.50", "1.50", "", "2.50"]
    assert [row["psnr_pose_refined"] for row in rows] == ["26.00", "", "", "26.00"]
    assert [row["area"] for row in rows] == ["42.0 cm²", "900 square units", "", ""]
    assert [row["seen"] for row in rows] == ["62 %", "800 square units", "", ""]
    assert [row["steps"] for row in rows] == ["2000", "500", "", ""]
    assert rows[0]["span"] == "0 to 13"
    assert held_out_text(results) == "23.00 dB in the mean over 2 sub-maps (0: 24.00, 1: 22.00)"
    assert held_out_text(results[:1]) == "24.00 dB"
    assert held_out_text(results[2:]) == ""
    assert "depth failed: no surface that 5 frames agree on" in terminal_text([submap_table(results)])
    alone = submap_table(results[2:])
    assert not {"span", "seen", "psnr_pose_refined"} & {column.key for column in alone.columns}
    assert len(alone.rows) == 1


def test_what_failed_and_what_is_suspect_is_said_with_what_to_do(tmp_path):
    record = record_in(tmp_path)
    failed, suspect = remarks(record)
    assert failed == "submap-2/depth failed: no surface that 5 frames agree on. Check the poses."
    assert suspect.startswith("the poses of sub-map 0 (well): there the surface may be bent or torn. Compare")
    record.stages["check"] = StageRecord({}, "failed", "no two frames overlap.")
    assert remarks(record) == ["check failed: no two frames overlap.", failed]


@pytest.fixture
def page(atlas, tmp_path):
    out = tmp_path / "out"
    for number, folder in enumerate((out, out / "submap-1")):
        (folder / SCENE_FILE).parent.mkdir(parents=True)
        (folder / SCENE_FILE).write_text(f"<title>scene {number}</title>")
    for kind in ("recorded", "depth", "flattened light"):
        write_png(out / FOLDER / "a1" / f"{kind}.png", np.full((4, 4, 3), len(kind), np.uint8))

    def written(record=None):
        write_index(record or record_in(tmp_path / "out"), atlas, "Reconstruction of film.mp4")
        return (tmp_path / "out" / "index.html").read_text(encoding="utf-8")

    return written


def test_the_page_tells_which_frames_have_a_pose_and_why_others_have_none(page, atlas):
    joins = [{"after": 13, "joined": False, "reason": "7 points are seen from both sides"}]
    content = read_atlas(atlas).model_dump()
    write_json(atlas / ATLAS_FILE, content | {"joins": joins})
    write_png(atlas / "atlas.png", np.full((60, 120, 3), 200, np.uint8))
    text = page()
    assert "31 of 32 used (97 %)" in text
    assert "2 reconstructed of 3 (1 failed)" in text
    assert "apart from what follows: 7 points are seen from both sides" in text
    assert "blurred" in text
    assert "data:image/png" in text and "index_files/" not in text  # all in one file


def test_the_page_holds_all_scenes_and_pictures(page):
    text = page()
    assert text.count("<iframe") == 2 and text.count('data-page="&lt;title&gt;') == 2
    assert text.index("sub-map 0</option>") < text.index("sub-map 1</option>")
    for kind in ("recorded", "depth", "flattened light"):
        assert text.count(f'<div class="name">{kind}</div>') == 1
    assert "the camera jumps" in text
    assert text.index("<h2>Scene") < text.index("<h2>Depth and light") < text.index("<h2>Sub-maps")


def test_the_page_does_without_atlas_and_scenes(page, atlas, tmp_path):
    shutil.rmtree(atlas)
    record = record_in(tmp_path / "out")
    record.stages = {"check": done({"check.html": "check"}, frames=14), "train": done()}
    text = page(record)
    assert "<iframe" not in text
    assert "Frames with a pose" not in text
    assert "sub-map 1" not in text


@pytest.mark.thorough
@pytest.mark.parametrize("width", [1400, 390])
def test_another_scene_is_chosen_in_a_browser(browser, page, tmp_path, width):
    page()
    browser.open(tmp_path / "out" / "index.html", width, phone=width < 500)

    def titles():
        """Of the frames, '' of hidden ones, once the shown one is loaded."""
        return browser.run(
            "new Promise(done => { const look = () => { const frames = [...document.querySelectorAll('iframe')]"
            ".map(f => f.hidden ? '' : f.contentDocument.title); frames.some(Boolean) ? done(frames)"
            " : setTimeout(look, 20); }; look(); })"
        )

    assert titles() == ["scene 0", ""]
    browser.run(
        "(select => (select.selectedIndex = 1, select.dispatchEvent(new Event('change'))))"
        "(document.querySelector('.scenes select'))"
    )
    assert titles() == ["", "scene 1"]
    assert browser.run("document.documentElement.scrollWidth <= innerWidth")
    assert browser.errors() == []
