"""The page of a short video, and of a long one: every frame, sub-maps and joins, scenes, and parts that are damaged."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest

from coliags_plugin.core.errors import InputError
from coliags_plugin.core.files import write_json
from coliags_plugin.pipeline import page
from coliags_plugin.pipeline.contents import common_frames, read_contents
from coliags_plugin.pipeline.page import held_out_text, submap_table, verdicts, write_page
from coliags_plugin.pipeline.stages import Record
from coliags_plugin.pipeline.survey import Survey
from coliags_plugin.pipeline.timeline import clock, frame_states, timeline, with_times
from coliags_plugin.reporting.text_formats import terminal_text
from tests.pipeline.reconstructions import (
    FAILURE,
    FRAMES,
    JOINS,
    SUBMAPS,
    change_video,
    done,
    join,
    judged,
    similarity,
    span,
    video,
    write_frames,
    write_survey,
)


def page_of(out):
    write_page(out)
    return (out / "index.html").read_text(encoding="utf-8")


def rows_of(table):
    return [{column.key: cell.text for column, cell in zip(table.columns, row, strict=True)} for row in table.cells]


def states_of(out):
    return frame_states(read_contents(out))


def test_sub_maps_have_the_numbers_of_the_video_in_its_order(out):
    contents = read_contents(out)
    assert {submap.name: [*submap.names] for submap in contents.submaps} == {
        name: [*frames] for name, frames in SUBMAPS.items()
    }
    assert contents.submaps[4].names[40] == "014.png"
    assert all(submap.stages for submap in contents.submaps)
    assert (len(contents.posed), len(contents.used)) == (57, 58)


def test_every_frame_has_one_state_and_the_earlier_segment_comes_first(out):
    states = states_of(out)
    expected = {frame: name for name, frames in reversed(SUBMAPS.items()) for frame in frames}
    assert [state.what for state in states[:57]] == [expected[frame] for frame in range(57)]
    assert {(state.what, state.why) for state in states[57:58]} == {("no pose", "blurred")}
    assert {(state.what, state.why) for state in states[58:70]} == {("left out", "washed with water")}
    assert {(state.what, state.why) for state in states[70:90]} == {("no pose", f"poses failed: {FAILURE}")}
    assert {(state.what, state.why) for state in states[90:]} == {("left out", "in no segment")}
    colors = [state.style for state in states]
    assert all(colors[frame] != colors[frame + 1] for frame in (13, 25, 30, 39, 51))
    assert colors[57:] == [None] * 43


def test_frames_that_were_not_used_share_the_state_of_the_used_one_before(out):
    file = out / "segment-001" / "frames" / "frames.json"
    content = json.loads(file.read_text())
    content["kept"] = [{**frame, "frame": 26 + 3 * index} for index, frame in enumerate(content["kept"][:10])]
    atlas = {
        "frames": [f"{index:03d}.png" for index in range(10)],
        "joins": [],
        "lost": [{"frame": 9, "reason": "wet"}],
    }
    atlas["submaps"] = [{"model": "sparse/0", "unit": "unknown", "frames": [*range(9)]}]
    write_json(file, content)
    write_json(out / "segment-001" / "poses" / "atlas.json", atlas)
    states = states_of(out)
    assert [state.what for state in states[26:53]] == ["segment-000/2"] * 5 + ["segment-001/0"] * 22
    assert {state.why for state in states[53:58]} == {"wet"}
    assert read_contents(out).submaps[-1].names.keys() == {*range(26, 53, 3)}


def test_the_page_tells_what_came_out(out):
    text = page_of(out)
    for fact in (
        "100 frames, 10.0 s, 40 x 32 px",
        "57 of 58 used (98 %)",
        "2 of 3 (1 failed or not finished)",
        "2 usable, 2 doubtful, 2 failed",
        "1 of 2 places between segments",
        "23.00 dB in the mean over 4 sub-maps, usable or doubtful, 22.00 to 24.00",
        "84.0 cm² (of 2 sub-maps, usable or doubtful, with lengths in mm)",
        "62 % in the mean over 2 sub-maps, usable or doubtful",
        "mm of 2 of 4 sub-maps (the colon&#39;s inner diameter gives mm: <code>coliags reconstruct VIDEO ",
    ):
        assert fact in text
    assert f"segment-002/poses failed: {FAILURE}" in text
    assert "the poses of segment-000/0 (well), segment-001/0 (well): there the surface may be bent" in text
    assert "12 frames between them" in text and "washed with water" in text
    assert text.count("<span>joined</span>") == 1 == text.count("<span>apart</span>")
    assert text.count("<span>A</span>") == 2, "two are in one frame of reference"
    assert "segment-001: frames 26 to 57, 0:02 to 0:05; 31 of 32 used posed; 3 sub-maps" in text
    assert "segment-001/submap-1/check.html" in text
    assert str(out) not in text


def test_two_segments_may_be_joined_at_several_models(out):
    pair = ["segment-000", "segment-001"]
    apart = join(pair, ["sparse/1", "sparse/0"], reason="scales differ by 30 %")
    change_video(out, joins=[apart, *JOINS])
    text = page_of(out)
    assert "1 of 2 places between segments" in text and "scales differ by 30 %" in text


@pytest.mark.parametrize(("name", "scenes"), [("long", 4), ("short", 2)])
def test_the_page_is_one_file_without_anything_from_elsewhere(folders, name, scenes, tmp_path):
    either = shutil.copytree(folders[name], tmp_path / name)
    text = page_of(either)
    links = [link for link in re.findall(r'(?:src|href|data-file)="([^"]*)"', text) if not link.startswith("data:")]
    assert links and all(not link.startswith(("/", "http")) for link in links)
    assert all((either / link).exists() for link in links if re.search(r"index|scene|images|poses", link))
    assert text.count("<iframe") == scenes == text.count("data-page=")
    assert not (either / "index_files").exists() and str(either) not in text


def test_a_short_video_is_a_long_one_of_one_segment(out, short):
    long, text = page_of(out), page_of(short)
    heads = re.findall(r"<h2>([^<]*)", text)
    assert heads == re.findall(r"<h2>([^<]*)", long)
    assert heads[:4] == ["Time line", "Sub-maps", "Scenes", "Depth and light"]
    assert heads[4:] == ["Held-out views", "Frames without a pose", "Stages and files"]
    assert long.count('class="curve"') == 3 and 'class="curve"' not in text, "of the survey, which one has"
    assert 'href="frames/images"' in text and "the poses of sub-map 0 (well): there the surface may be bent" in text
    assert "31 of 32 used (97 %)" in text and "1 usable, 1 doubtful, 1 failed" in text


def test_the_page_of_a_scene_with_poses_does_without_frames(tmp_path):
    Record(tmp_path, {"check": done({"check.html": "check"}, frames=14), "train": done()}).write()
    text = page_of(tmp_path)
    assert "Frames with a pose" not in text and "Time line" not in text and "sub-map 1" not in text
    assert "<iframe" not in text and "1 not judged yet" in text


def test_figures_of_sub_maps_and_their_means(short):
    submaps = read_contents(short).submaps
    table = submap_table(read_contents(short))
    rows = rows_of(table)
    assert [row["submap"] for row in rows] == ["sub-map 0", "sub-map 1", "sub-map 2", "mean"]
    assert [row["verdict"] for row in rows] == ["usable", "doubtful", "", ""]
    assert [row["psnr"] for row in rows] == ["24.00", "22.00", "", "23.00"]
    assert [row["gap"] for row in rows] == ["3.50", "1.50", "", "2.50"]
    assert [row["psnr_pose_refined"] for row in rows] == ["", "23.00", "", "23.00"]
    assert [row["area"] for row in rows] == ["42.0 cm²", "900 square units", "", ""]
    assert [row["seen"] for row in rows] == ["62 %", "800 square units", "", ""]
    assert [row["steps"] for row in rows] == ["2000", "500", "", ""]
    assert rows[0]["span"] == "0 to 13, 0:00 to 0:01"
    assert held_out_text(submaps) == "23.00 dB in the mean over 2 sub-maps, usable or doubtful, 22.00 to 24.00"
    assert (held_out_text(submaps[:1]), held_out_text(submaps[2:])) == ("24.00 dB", "")
    assert "depth failed: no surface that 5 frames agree on" in terminal_text([verdicts(read_contents(short))])
    record = Record.of(short)
    record.forget([name for name in record.of_submaps("") if not name.startswith("submap-2/")])
    alone = submap_table(read_contents(short))
    assert not {"seen", "psnr_pose_refined"} & {column.key for column in alone.columns}


def test_what_is_not_usable_is_in_no_headline_and_its_wall_is_not_called_seen(out):
    record = Record.of(out)
    why = "the largest piece of the mesh has 9 % of its area"
    record.stages |= {f"segment-00{k}/verdict": judged("not usable", why) for k in (0, 1)}
    record.write()
    contents, text = read_contents(out), page_of(out)
    for fact in ("2 doubtful, 2 not usable, 2 failed", "22.00 dB in the mean over 2 sub-maps, usable or doubtful"):
        assert fact in text
    assert text.index(f"not usable: {why}") < text.index('data-name="submaps"') < text.index("<iframe")
    assert "Wall seen" not in text and "62 %" not in text and ">Area</dt>" not in text
    rows = {row["submap"]: (row["psnr"], row["seen"]) for row in rows_of(submap_table(contents))}
    assert rows["segment-000/0"] == ("24.00", "") and rows["segment-000/1"] == ("22.00", "800 square units")
    assert rows["mean"] == ("22.00", "")


def test_names_of_frames_get_numbers_and_times(out):
    contents, names = read_contents(out), "at frame_000000, frame_000057 and 003.png"
    assert with_times(contents, names) == "at frame 0 (0:00), frame 57 (0:05) and 003.png"
    change_video(out, rate=None)
    (out / "survey.npz").unlink()
    assert with_times(read_contents(out), names) == "at frame 0, frame 57 and 003.png"


def test_the_time_line_has_one_axis(out):
    values = timeline(read_contents(out), frame_states(read_contents(out))).values
    assert sum(bar["width"] for bar in values["ribbon"]) == pytest.approx(100.0)
    named = [bar["name"] for bar in values["ribbon"]]
    assert named == ["000/0", "000/1", "000/2", "001/0", "001/1", "001/2", "", "", "", ""]
    assert [bar["left"] for row in values["rows"] for bar in row] == [0.0, 70.0, 26.0]
    assert len(values["thumbs"]) == 24 and sum(thumb["image"] is not None for thumb in values["thumbs"]) == 14
    assert [curve["top"] for curve in values["curves"]] == ["0.02", "100", "1"]
    assert values["ticks"][1] == {"left": 20.0, "texts": ["0:02", "20"]}
    first, last = values["curves"][1]["path"].strip("M").split("L")[:: FRAMES - 1]
    assert (first, last) == ("5.0 100.0", "995.0 0.0")  # middles of columns; shares of 0 and 1
    assert values["curves"][2]["path"].count("M") == 1
    assert values["curves"][2]["path"].startswith("M105.0")  # where motion was measured first


def test_times_are_those_of_frames_where_the_rate_varies_and_frame_numbers_where_it_is_unknown(out):
    times = np.concatenate([np.arange(50) / 10.0, 65.0 + np.arange(50) / 10.0])
    replace(Survey.read(out), times=times).write(out)
    contents = read_contents(out)
    assert [clock(contents, frame) for frame in (0, 49, 50, 99)] == ["0:00", "0:04", "1:05", "1:09"]
    ticks = timeline(contents, frame_states(contents)).values["ticks"]
    assert [tick["texts"] for tick in (ticks[0], ticks[-1])] == [["0:00", "0"], ["1:00", "50"]]
    assert "100 frames, 1 min 10 s" in page_of(out)
    change_video(out, rate=None)
    text = page_of(out)
    assert "min:s" not in text and ">frame number<" in text
    assert "100 frames, 40 x 32 px" in text


def test_frames_are_counted_from_where_the_survey_began(out):
    change_video(out, first=20, frames=80, segments=video()["segments"][1:], joins=[])
    (out / "survey.npz").unlink()
    states = states_of(out)
    assert len(states) == 80
    assert [state.what for state in states[6:20]] == ["segment-001/0"] * 14
    assert states[0].why == "in no segment"
    assert 'class="curve"' not in page_of(out)


def test_a_long_video_has_a_time_line_of_bounded_size(out):
    frames = 8000
    used = [{"frame": frame, "name": f"frame_{frame:06d}", "blurred": False} for frame in range(frames)]
    atlas = {
        "frames": [f"{item['name']}.png" for item in used],
        "submaps": [{"model": "sparse/0", "unit": "unknown", "frames": [*range(0, frames, 2)]}],
        "joins": [],
        "lost": [{"frame": frame, "reason": "blurred"} for frame in range(1, frames, 2)],
    }
    write_json(out / "segment-000" / "poses" / "atlas.json", atlas)
    write_frames(out / "segment-000", used)
    change_video(out, frames=frames, segments=[span("segment-000", 0, frames - 1)], skipped=[], joins=[])
    (out / "survey.npz").unlink()
    contents = read_contents(out)
    assert len(timeline(contents, frame_states(contents)).values["ribbon"]) <= 2000
    text = page_of(out)
    assert len(text) < 1_000_000
    assert "4,000 of 8,000 used (50 %)" in text


def test_what_has_no_room_is_loaded_from_the_folder(out, monkeypatch):
    whole = len(page_of(out).encode())
    monkeypatch.setattr(page, "_SCENES", 5000)
    assert page_of(out).count("data-page=") == 2
    monkeypatch.setattr(page, "_SCENES", 100)
    monkeypatch.setattr(page, "_LIMIT", whole - 10_000)
    text = page_of(out)
    assert len(text.encode()) <= whole - 10_000
    assert "data-page=" not in text
    assert re.findall(r'data-file="([^"]*)"', text)[:2] == [f"segment-00{k}/run/scene.html" for k in (0, 1)]
    monkeypatch.setattr(page, "_LIMIT", 70_000)
    assert 'src="index_files/' in page_of(out)
    assert page._SCENES < page._LIMIT


def remove(path):
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink()


def garble(path):
    path.write_bytes(b'{"frames": [1, ')


def first_named(name):
    def rename(path):
        content = json.loads(path.read_text())
        write_json(path, {**content, "frames": [name, *content["frames"][1:]]})

    return rename


@pytest.mark.parametrize(
    ("part", "spoil", "message"),
    [
        ("segment-000/poses/atlas.json", garble, "poses/atlas.json"),
        ("segment-000/poses/atlas.json", first_named("../000.png"), "does not fit the frames: the name '../000.png'"),
        ("segment-000/poses/atlas.json", first_named("frame_000100.png"), "frame_000100.png is none of the frames"),
        ("segment-000/poses/atlas.json", remove, ""),
        ("segment-000/frames/frames.json", garble, "frames/frames.json"),
        ("segment-000/frames/frames.json", remove, "poses/atlas.json does not fit the frames: 000.png is none of"),
        ("segment-000/frames/images", remove, ""),
        ("segment-000/run/eval/paper/result.json", garble, ""),
        ("segment-000/run/eval/paper/renders", remove, ""),
        ("segment-000/run/scene.html", remove, ""),
        ("segment-000", remove, ""),
        ("survey.npz", garble, "cannot read .*survey.npz"),
        ("survey.npz", remove, ""),
        ("survey.npz", lambda path: np.savez(path, sharpness=np.zeros(100)), "survey.npz lacks followed"),
        ("survey.npz", lambda path: write_survey(path.parent, 99), "a number for each of 100 frames"),
    ],
)
def test_damaged_files_are_refused_and_without_missing_ones_the_rest_is_shown(out, part, spoil, message):
    spoil(out / part)
    if message:
        with pytest.raises(InputError, match=message):
            write_page(out)
    else:
        text = page_of(out)
        assert "segment-001/0" in text and ('class="curve"' in text) == (part != "survey.npz")


def test_a_video_without_any_pose_has_a_page_that_says_so(tmp_path):
    with pytest.raises(InputError, match=r"no stage in .*reconstruction\.json"):
        write_page(tmp_path)
    record = Record(tmp_path, {"survey": done(**video(segments=[span("segment-000", 0, 99)], skipped=[]))})
    record.write()
    text = page_of(tmp_path)
    assert "no frame of this video has a pose: it was not begun" in text
    assert "No sub-map was reconstructed." in text
    assert text.count('class="lost"') == 1


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frames": 0}, "survey: frames"),
        ({"frames": 10**12}, "survey: frames"),
        ({"rate": 0.0}, "survey: rate"),
        ({"segments": [span("../other", 0, 3)]}, "survey: segments.0.name"),
        ({"segments": [span("segment-0", 3, 2)]}, "frames 3 to 2"),
        ({"segments": [span("segment-0", 0, 100)]}, "frames 0 to 100, not of 0 to 99"),
        ({"segments": [span("segment-0", 0, 1)] * 2}, "the same name"),
        ({"joins": [join(["a", "b"], ["x", "y"], np.diag([1.0, 1.0, -1.0, 1.0]))]}, "no similarity"),
        ({"joins": [join(["a", "b"], ["x", "y"], np.diag([1.0, 2.0, 1.0, 1.0]))]}, "no similarity"),
        ({"joins": [join(["a", "b"], ["x", "y"], np.zeros((4, 4)))]}, "no similarity"),
        ({"joins": [join(["a", "b"], ["x", "y"], np.eye(3))]}, "joins: joins.0.transform"),
    ],
)
def test_a_damaged_record_is_refused(out, changes, message):
    change_video(out, **changes)
    with pytest.raises(InputError, match=r"cannot read .*reconstruction\.json") as caught:
        write_page(out)
    assert message in str(caught.value)
    assert not (out / "index.html").exists()


def test_sub_maps_are_brought_into_the_frame_of_the_first_they_are_joined_to(out):
    """Worlds placed at random: joins between them give their places back, whichever way they are written."""
    worlds = {name: similarity(number) for number, name in enumerate(SUBMAPS)}

    def between(first, second, *, is_known=True):
        (a, i), (b, k) = first.split("/"), second.split("/")
        transform = np.linalg.inv(worlds[first]) @ worlds[second] if is_known else None
        return join([a, b], [f"sparse/{i}", f"sparse/{k}"], transform, "" if is_known else "apart")

    joins = [
        between("segment-001/0", "segment-000/0"),
        between("segment-000/2", "segment-001/0"),
        between("segment-000/2", "segment-001/2"),
        between("segment-000/1", "segment-001/1", is_known=False),
    ]
    change_video(out, joins=joins)
    placed = common_frames(read_contents(out))
    named = {f"{segment}/{model[-1]}": value for (segment, model), value in placed.items()}
    together = ("segment-000/0", "segment-000/2", "segment-001/0", "segment-001/2")
    for name in SUBMAPS:
        (segment, model), matrix = named[name]
        first = "segment-000/0" if name in together else name
        assert f"{segment}/{model[-1]}" == first
        np.testing.assert_allclose(worlds[first] @ matrix, worlds[name], atol=1e-12)


@pytest.mark.thorough
@pytest.mark.parametrize("width", [1400, 390])
def test_the_page_in_a_browser(browser, out, short, monkeypatch, width):
    monkeypatch.setattr(page, "_SCENES", 2500)
    file = out / "segment-001" / "poses" / "atlas.json"
    content = json.loads(file.read_text())
    content["lost"] = [{"frame": frame, "reason": f"reason {frame}"} for frame in range(12, 31)]
    content["submaps"] = content["submaps"][:1]
    write_json(file, content)
    write_page(out)
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
    write_page(short)
    browser.open(short / "index.html", width, phone=width < 500)
    assert browser.run("document.documentElement.scrollWidth <= innerWidth")
    assert browser.run(loaded).startswith("short")
    assert browser.errors() == []
