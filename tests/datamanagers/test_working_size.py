"""What size images have by default: what is published for their data, or else what fits the paper's."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from coliags_plugin.config.registry import datamanagers
from coliags_plugin.datamanagers.c3vd.reader import C3VDDataManager, C3VDSettings
from coliags_plugin.datamanagers.recognition import formats
from coliags_plugin.datamanagers.recorded import RecordedDataManager
from tests.datamanagers.wall_scenes import write_undistorted

ROOT = Path(__file__).parents[2]

RAW, PREPARED, PAPER, FIFTH = (1350, 1080), (675, 540), (338, 270), (270, 216)
HD, HD_FITTED = (1920, 1080), (338, 190)
SMALL = (169, 135)


def manager(name: str, **options) -> RecordedDataManager:
    kind = datamanagers.get(name)
    return kind(kind.Settings(**options))


@pytest.mark.parametrize(
    ("name", "stored", "size"),
    [
        *((name, RAW, PAPER) for name in ("c3vd", "c3vd-v2", "colmap", "nerfstudio", "rgbd", "endomapper")),
        *((name, HD, HD_FITTED) for name in ("c3vd", "c3vd-v2", "colmap", "nerfstudio", "rgbd", "endomapper")),
        *(
            (name, SMALL, SMALL)
            for name in ("c3vd", "c3vd-v2", "colmap", "nerfstudio", "rgbd", "endomapper", "reim-nerf")
        ),
        *((name, size, size) for name in ("c3vd-endogslam", "rotatecolon") for size in (RAW, PREPARED, HD, SMALL)),
        *(("reim-nerf", size, FIFTH) for size in (RAW, PREPARED, PAPER, FIFTH)),
    ],
)
def test_of_every_format(name, stored, size):
    assert manager(name).working_size(*stored) == size
    assert manager(name, width=338, height=270).working_size(*stored) == PAPER


def told(page: str, header: str) -> dict[str, str]:
    """The second column of a table, by each of the formats in the first."""
    lines = (ROOT / page).read_text().splitlines()
    rows = {}
    for line in lines[lines.index(header) + 2 :]:
        if not line.startswith("|"):
            break
        names, second, *_ = (cell.strip().replace("`", "") for cell in line.strip("|").split("|"))
        rows |= dict.fromkeys(names.split(", "), second)
    return rows


def test_the_pages_say_so():
    fits = told("docs/data.md", "| format | default size | published by |")
    others = fits.pop("others")
    for name in formats():
        fit = fits.pop(name, others)
        kind = datamanagers.get(name)
        assert fit.split(",")[0] == ("as stored" if kind.fits is None else "x".join(map(str, kind.fits)))
        assert kind.seen_split == kind.Settings().split
    assert not fits


class TestSmallerImages:
    @pytest.fixture(scope="class")
    def large(self, tmp_path_factory):
        return write_undistorted(tmp_path_factory.mktemp("large") / "wall", count=3, width=400, height=300)

    def told(self, folder, caplog, **options) -> list[str]:
        with caplog.at_level(logging.INFO):
            C3VDDataManager(C3VDSettings(**options)).load(folder)
        return [record.getMessage() for record in caplog.records if "stored at" in record.getMessage()]

    def test_both_sizes_and_the_setting_are_told_once(self, large, caplog):
        assert self.told(large, caplog) == [
            f"{large}: images stored at 400 x 300 are used at 338 x 254; --set datamanager.width=W "
            "--set datamanager.height=H sets another size"
        ]

    def test_nothing_is_told_of_a_size_that_was_asked_for(self, large, caplog):
        assert self.told(large, caplog, width=200, height=150) == []

    def test_nothing_is_told_where_nothing_is_smaller(self, tmp_path, caplog):
        assert self.told(write_undistorted(tmp_path / "wall", count=3), caplog) == []
