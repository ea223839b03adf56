"""What the pages say of the data sets' sequences, against the lists their authors publish."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import pytest

from coliags_plugin.datamanagers.splits import held_out

PAGE = Path(__file__).parents[2] / "docs/layouts/c3vd.md"
SEGMENTS = {"desc": "descending", "trans": "transverse"}


def told() -> dict[str, tuple[int, int]]:
    """Frames and test frames of every sequence in the page's table."""
    rows = re.findall(r"(\w+_t\d_[a-z]) \| (\d+) \| (\d+)", PAGE.read_text())
    return {name: (int(frames), int(test)) for name, frames, test in rows}


@pytest.fixture
def official(shared_data) -> list[dict[str, str]]:
    path = shared_data / "c3vd_summary_csv" / "C3VD_data_summary_registered.csv"
    with path.open(encoding="utf-8-sig", newline="") as file:
        return [row for row in csv.DictReader(file) if row["Video Name"]]


def test_the_sequences_and_their_frames_are_the_official_ones(official):
    assert {row["Old Name"]: int(row["Num_frames"]) for row in official} == {
        name: frames for name, (frames, _) in told().items()
    }
    assert len(official) == 22


def test_test_frames_are_every_eighth_of_the_official_numbers(official):
    table = told()
    for row in official:
        assert held_out("every-8th", int(row["Num_frames"])).sum() == table[row["Old Name"]][1]


def test_new_names_follow_from_the_old_ones_as_the_page_says(official):
    for row in official:
        segment, texture, letter = row["Old Name"].split("_")
        number = "abc".index(letter) + 1
        assert row["Video Name"] == f"c0_{SEGMENTS.get(segment, segment)}_{texture}_v{number}"
    assert "`c0_transverse_t2_v2`" in PAGE.read_text()
