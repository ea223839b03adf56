"""The page of a procedure: what it says of every frame, of sub-maps and joins, and of parts that are damaged."""

from __future__ import annotations

import json
import re
import shutil

import numpy as np
import pytest

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import write_json
from coliags_plugin.pipeline.procedure import page as procedure_page
from coliags_plugin.pipeline.procedure.contents import common_frames, read_procedure
from coliags_plugin.pipeline.procedure.page import write_procedure_page
from coliags_plugin.pipeline.procedure.timeline import frame_states, timeline
from tests.pipeline.procedures import FAILURE, FRAMES, SUBMAPS, join, procedure_content, similarity


def page_of(out):
    write_procedure_page(out)
    return (out / "index.html").read_text(encoding="utf-8")


def states_of(out):
    states, codes = frame_states(read_procedure(out))
    return [states[code] for code in codes]


def test_sub_maps_have_the_numbers_of_the_video_in_its_order(out):
    procedure = read_procedure(out)
    assert {one.name: [*one.names] for one in procedure.submaps} == {name: [*own] for name, own in SUBMAPS.items()}
    assert procedure.submaps[4].names[40] == "014.png"
    assert [one.results is None for one in procedure.submaps] == [False] * 6
    assert list(procedure.problems) == []
    assert (len(procedure.posed), len(procedure.kept)) == (57, 58)


def test_every_frame_has_one_state_and_the_earlier_segment_comes_first(out):
    states = states_of(out)
    expected = {frame: name for name, frames in reversed(SUBMAPS.items()) for frame in frames}
    assert [one.what for one in states[:57]] == [expected[frame] for frame in range(57)]
    assert {(one.what, one.why) for one in states[57:58]} == {("no pose", "blurred")}
    assert {(one.what, one.why) for one in states[58:70]} == {("left out", "washed with water")}
    assert {(one.what, one.why) for one in states[70:90]} == {("no pose", f"poses failed: {FAILURE}")}
    assert {(one.what, one.why) for one in states[90:]} == {("left out", "in no segment")}
    colors = [one.style for one in states]
    assert all(colors[frame] != colors[frame + 1] for frame in (13, 25, 30, 39, 51))
    assert colors[57:] == [None] * 43


def test_frames_that_were_not_used_share_the_state_of_the_used_one_before(out):
    file = out / "segment-001" / "frames" / "frames.json"
    content = json.loads(file.read_text())
    content["kept"] = [{**kept, "frame": 26 + 3 * index} for index, kept in enumerate(content["kept"][:10])]
    atlas = {
        "frames": [f"{index:03d}.png" for index in range(10)],
        "joins": [],
        "lost": [{"frame": 9, "reason": "wet"}],
    }
    atlas["submaps"] = [{"model": "sparse/0", "unit": "unknown", "frames": [*range(9)]}]
    write_json(file, content)
    write_json(out / "segment-001" / "poses" / "atlas.json", atlas)
    states = states_of(out)
    assert [one.what for one in states[26:53]] == ["segment-000/2"] * 5 + ["segment-001/0"] * 22
    assert {one.why for one in states[53:58]} == {"wet"}
    assert read_procedure(out).submaps[-1].names.keys() == {*range(26, 53, 3)}


def test_the_page_tells_what_came_out(out):
    text = page_of(out)
    for fact in (
        "100 frames, 10.0 s, 40 x 32 px",
        "57 of 58 used (98 %)",
        "2 of 3 (1 failed or not finished)",
        "4 reconstructed of 6",
        "1 of 2 places between segments",
        "23.00 dB (22.00 to 24.00 in 4 sub-maps)",
        "84.0 cm² (of 2 sub-maps with lengths in mm)",
        "62 % in the mean over 2 sub-maps",
        "mm of 2 of 6 sub-maps",
    ):
        assert fact in text
    assert f"Failed or not finished: segment-002 (poses failed: {FAILURE})" in text
    assert "The poses of 2 sub-maps (segment-000/0, segment-001/0): there the surface may be bent" in text
    assert "joined: 5 shared frames, cameras turned by 0.5 degrees, 2 % of the depth apart" in text
    assert "12 frames between them" in text and "washed with water" in text
    assert text.count('<div class="link joined"') == 1 and text.count('<div class="link"') == 4
    assert text.count('title="one frame of reference') == 2
    assert text.count('<a href="segment-001/index.html"') == 5  # of the time line, three blocks and the list
    assert "segment-002/index.html" not in text
    assert "20.00 dB: segment-000/0, frame 3, 0:00" in text and "46.00 dB: segment-001/0, frame 29, 0:02" in text
    assert str(out) not in text


def test_two_segments_may_be_joined_at_several_models(out):
    pair = ["segment-000", "segment-001"]
    apart = join(pair, ["sparse/1", "sparse/0"], reason="scales differ by 30 %")
    joins = procedure_content()["joins"]
    write_json(out / "procedure.json", procedure_content(joins=[apart, *joins]))
    text = page_of(out)
    assert "1 of 2 places between segments" in text
    assert "<span>joined: 5 shared frames" in text and "scales differ by 30 %" in text
    write_json(
        out / "procedure.json", procedure_content(joins=[join(pair, ["sparse/0", "sparse/1"], similarity(2)), apart])
    )
    assert "<span>no frame has a pose in both</span>" in page_of(out)
    write_json(out / "procedure.json", procedure_content(joins=[apart]))
    assert "<span>scales differ by 30 %</span>" in page_of(out)


def test_the_page_is_one_file_without_anything_from_elsewhere(out):
    text = page_of(out)
    links = re.findall(r'(?:src|href|data-file)="([^"]*)"', text)
    assert {link for link in links if not re.match(r"data:|segment-00[01]/", link)} == set()
    assert all((out / link).is_file() for link in links if link.startswith("segment"))
    assert text.count("<iframe") == 4 and text.count("data-page=") == 4
    assert not (out / "index_files").exists()


def test_the_time_line_has_one_axis(out):
    values = timeline(read_procedure(out), *frame_states(read_procedure(out))).values
    assert sum(bar["width"] for bar in values["ribbon"]) == pytest.approx(100.0)
    assert [bar["left"] for row in values["rows"] for bar in row] == [0.0, 70.0, 26.0]
    assert len(values["thumbs"]) == 24 and sum(thumb["image"] is not None for thumb in values["thumbs"]) == 14
    assert [curve["top"] for curve in values["curves"]] == ["0.02", "100", "1"]
    assert values["ticks"][1] == {"left": 20.0, "texts": ["0:02", "20"]}
    first, last = values["curves"][1]["path"].strip("M").split("L")[:: FRAMES - 1]
    assert (first, last) == ("5.0 100.0", "995.0 0.0")  # middles of columns; shares of 0 and 1
    assert values["curves"][2]["path"].count("M") == 1
    assert values["curves"][2]["path"].startswith("M105.0")  # where motion was measured first


def test_an_unknown_rate_leaves_frame_numbers(out):
    write_json(out / "procedure.json", procedure_content(rate=None))
    text = page_of(out)
    assert "min:s" not in text and ">frame number<" in text
    assert "100 frames, 40 x 32 px" in text


def test_frames_are_counted_from_where_the_survey_began(out):
    content = procedure_content(first=20, frames=80, segments=procedure_content()["segments"][1:], joins=[])
    write_json(out / "procedure.json", content)
    (out / "survey.npz").unlink()
    states = states_of(out)
    assert len(states) == 80
    assert [one.what for one in states[6:20]] == ["segment-001/0"] * 14
    assert states[0].why == "in no segment"
    assert "survey" not in page_of(out)


def test_a_long_video_has_a_time_line_of_bounded_size(out):
    frames = 8000
    kept = [{"frame": frame, "name": f"frame_{frame:06d}", "blurred": False} for frame in range(frames)]
    atlas = {
        "frames": [f"{one['name']}.png" for one in kept],
        "submaps": [{"model": "sparse/0", "unit": "unknown", "frames": [*range(0, frames, 2)]}],
        "joins": [],
        "lost": [{"frame": frame, "reason": "blurred"} for frame in range(1, frames, 2)],
    }
    write_json(out / "segment-000" / "poses" / "atlas.json", atlas)
    write_json(out / "segment-000" / "frames" / "frames.json", {"kept": kept, "dropped": [], "deinterlaced": False})
    segments = [{"name": "segment-000", "first": 0, "last": frames - 1}]
    write_json(out / "procedure.json", procedure_content(frames=frames, segments=segments, skipped=[], joins=[]))
    procedure = read_procedure(out)
    assert len(timeline(procedure, *frame_states(procedure)).values["ribbon"]) <= 2000
    (out / "survey.npz").unlink()
    text = page_of(out)
    assert len(text) < 1_000_000
    assert "the 200 longest of 4000" in text and "4,000 of 8,000 used (50 %)" in text


def test_what_has_no_room_is_loaded_from_the_folder(out, monkeypatch):
    whole = len(page_of(out).encode())
    monkeypatch.setattr(procedure_page, "_SCENES", 5000)
    assert page_of(out).count("data-page=") == 2
    monkeypatch.setattr(procedure_page, "_SCENES", 100)
    monkeypatch.setattr(procedure_page, "_LIMIT", whole - 10_000)
    text = page_of(out)
    assert len(text.encode()) <= whole - 10_000
    assert "data-page=" not in text
    assert re.findall(r'data-file="([^"]*)"', text)[:2] == [f"segment-00{k}/run/scene.html" for k in (0, 1)]
    monkeypatch.setattr(procedure_page, "_LIMIT", 70_000)
    assert 'src="index_files/' in page_of(out)
    assert procedure_page._SCENES < procedure_page._LIMIT


def remove(path):
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink()


def garble(path):
    path.write_bytes(b'{"frames": [1, ')


@pytest.mark.parametrize(
    ("part", "spoil", "told"),
    [
        ("segment-000/reconstruction.json", remove, "segment-000: segment-000 already exists and is no reconstruction"),
        ("segment-000/reconstruction.json", garble, "segment-000: cannot read reconstruction.json"),
        ("segment-000/poses/atlas.json", garble, "segment-000: poses/atlas.json"),
        ("segment-000/poses/atlas.json", remove, ""),
        ("segment-000/frames/frames.json", garble, "segment-000: frames/frames.json"),
        ("segment-000/frames/frames.json", remove, "poses/atlas.json does not fit the frames: 000.png is none of"),
        ("segment-000/frames/images", remove, ""),
        ("segment-000/run/eval/paper/result.json", garble, ""),
        ("segment-000/run/eval/paper/renders", remove, ""),
        ("segment-000/run/scene.html", remove, ""),
        ("segment-000", remove, "segment-000 (it was not begun)"),
        ("survey.npz", garble, "cannot read survey.npz"),
        ("survey.npz", remove, ""),
        ("survey.npz", lambda path: np.savez(path, sharpness=np.zeros(99)), "a number for each of 100 frames"),
        ("survey.npz", lambda path: np.savez(path, sharpness=np.zeros((100, 2))), "a number for each of 100 frames"),
    ],
)
def test_what_is_damaged_or_missing_is_said_and_the_rest_shown(out, part, spoil, told):
    spoil(out / part)
    text = page_of(out)
    assert told in text
    assert "segment-001/0" in text and "46.00 dB" in text
    assert ('class="curve"' in text) == (part != "survey.npz")


def test_an_atlas_that_names_frames_elsewhere_is_not_used(out):
    file = out / "segment-000" / "poses" / "atlas.json"
    content = json.loads(file.read_text())
    for name in ("../000.png", "frame_000100.png"):
        write_json(file, {**content, "frames": [name, *content["frames"][1:]]})
        assert f"{name}" in read_procedure(out).problems[0]


def test_a_procedure_without_any_pose_has_a_page_that_says_so(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    segments = [{"name": "segment-000", "first": 0, "last": 99}]
    write_json(out / "procedure.json", procedure_content(segments=segments, skipped=[], joins=[]))
    text = page_of(out)
    assert "No frame of this video has a pose: it was not begun" in text
    assert "No sub-map was reconstructed." in text
    assert text.count('class="lost"') == 1
    write_json(out / "procedure.json", procedure_content(segments=[], skipped=[], joins=[]))
    assert "No frame of this video has a pose" in page_of(out)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"frames": 0}, "frames"),
        ({"frames": 10**12}, "frames"),
        ({"rate": 0.0}, "rate"),
        ({"segments": [{"name": "../other", "first": 0, "last": 3}]}, "segments.0.name"),
        ({"segments": [{"name": "a", "first": 3, "last": 2}]}, "frames 3 to 2"),
        ({"segments": [{"name": "a", "first": 0, "last": 100}]}, "frames 0 to 100, not of 0 to 99"),
        ({"segments": [{"name": "a", "first": 0, "last": 1}] * 2}, "the same name"),
        ({"joins": [join(["a", "b"], ["x", "y"], np.diag([1.0, 1.0, -1.0, 1.0]))]}, "no similarity"),
        ({"joins": [join(["a", "b"], ["x", "y"], np.diag([1.0, 2.0, 1.0, 1.0]))]}, "no similarity"),
        ({"joins": [join(["a", "b"], ["x", "y"], np.zeros((4, 4)))]}, "no similarity"),
        ({"joins": [join(["a", "b"], ["x", "y"], np.eye(3))]}, "joins.0.transform"),
    ],
)
def test_a_damaged_record_is_refused(tmp_path, changes, told):
    write_json(tmp_path / "procedure.json", procedure_content(**changes))
    with pytest.raises(InputError, match=r"procedure\.json") as caught:
        write_procedure_page(tmp_path)
    assert told in str(caught.value)
    assert not (tmp_path / "index.html").exists()


def test_another_folder_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"no .*procedure\.json"):
        write_procedure_page(tmp_path)


def test_sub_maps_are_brought_into_the_frame_of_the_first_they_are_joined_to(out):
    """Worlds placed at random: joins between them give their places back, whichever way they are written."""
    worlds = {name: similarity(number) for number, name in enumerate(SUBMAPS)}

    def between(one, other, *, known=True):
        (a, i), (b, k) = one.split("/"), other.split("/")
        transform = np.linalg.inv(worlds[one]) @ worlds[other] if known else None
        return join([a, b], [f"sparse/{i}", f"sparse/{k}"], transform, "" if known else "apart")

    joins = [
        between("segment-001/0", "segment-000/0"),
        between("segment-000/2", "segment-001/0"),
        between("segment-000/2", "segment-001/2"),
        between("segment-000/1", "segment-001/1", known=False),
    ]
    write_json(out / "procedure.json", procedure_content(joins=joins))
    placed = common_frames(read_procedure(out))
    named = {f"{segment}/{model[-1]}": value for (segment, model), value in placed.items()}
    together = ("segment-000/0", "segment-000/2", "segment-001/0", "segment-001/2")
    for name in SUBMAPS:
        (segment, model), matrix = named[name]
        first = "segment-000/0" if name in together else name
        assert f"{segment}/{model[-1]}" == first
        np.testing.assert_allclose(worlds[first] @ matrix, worlds[name], atol=1e-12)


@pytest.mark.thorough
@pytest.mark.parametrize("width", [1400, 390])
def test_the_page_in_a_browser(browser, out, monkeypatch, width):
    monkeypatch.setattr(procedure_page, "_SCENES", 2500)
    monkeypatch.setattr(procedure_page, "_LISTED", 30)
    file = out / "segment-001" / "poses" / "atlas.json"
    content = json.loads(file.read_text())
    content["lost"] = [{"frame": frame, "reason": f"reason {frame}"} for frame in range(12, 31)]
    content["submaps"] = content["submaps"][:1]
    write_json(file, content)
    write_procedure_page(out)
    browser.open(out / "index.html", width, phone=width < 500)
    assert browser.run("document.documentElement.scrollWidth <= innerWidth")
    browser.run("document.querySelector('.ribbon i').dispatchEvent(new PointerEvent('pointerover', {bubbles: true}))")
    assert browser.run("document.querySelector('.readout').textContent").startswith("segment-000/0: frames 0 to 13")
    rows = "[...document.querySelectorAll('[data-name=reasons] tbody tr')].filter(r => !r.hidden).length"
    assert browser.run(rows) > 16
    browser.run(
        "(input => (input.value = 'WASHED', input.dispatchEvent(new Event('input'))))"
        "(document.querySelector('.filter input'))"
    )
    assert browser.run(rows) == 1
    loaded = (
        "new Promise(done => { const frames = [...document.querySelectorAll('iframe')]; const look = () => "
        "{ const shown = frames.find(f => !f.hidden), title = shown.contentDocument?.title; title ? done(title)"
        " : shown.src ? done(shown.getAttribute('src')) : setTimeout(look, 20); }; look(); })"
    )
    assert browser.run(loaded).startswith("segment-000")
    browser.run(
        "(select => (select.selectedIndex = 1, select.dispatchEvent(new Event('change'))))"
        "(document.querySelector('.scenes select'))"
    )
    assert browser.run(loaded) == "segment-001/run/scene.html"
    assert browser.errors() == []
