"""The file that states a scene's unit of length."""

from __future__ import annotations

from pathlib import Path

import pytest

from coliags_plugin.core.errors import InputError
from coliags_plugin.datamanagers.units import read_unit, write_unit


def test_the_unit_is_that_of_the_format_where_nothing_is_stated(tmp_path: Path) -> None:
    assert read_unit(tmp_path, otherwise="mm") == "mm"
    assert read_unit(tmp_path) == "unknown"


@pytest.mark.parametrize("unit", ["mm", "cm", "m", "unknown"])
def test_a_stated_unit_is_read_back(tmp_path: Path, unit: str) -> None:
    write_unit(tmp_path, unit)  # type: ignore[arg-type]
    assert read_unit(tmp_path) == unit


def test_another_word_is_refused(tmp_path: Path) -> None:
    (tmp_path / "unit.txt").write_text("inches\n")
    with pytest.raises(InputError, match="inches"):
        read_unit(tmp_path)
