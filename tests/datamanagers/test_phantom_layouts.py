"""The table of layouts: names, what they declare, and what the page about phantoms says of them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import get_args

import pytest

from coliags_plugin.datamanagers.phantom.layouts import LAYOUTS, LayoutName, layout_of
from coliags_plugin.datamanagers.phantom.layouts.base import Layout
from coliags_plugin.datamanagers.phantom.settings import PhantomSettings

PAGE = Path(__file__).parents[2] / "docs/phantom.md"


def told() -> dict[str, list[str]]:
    lines = PAGE.read_text().splitlines()
    start = lines.index("| layout | what | size, px | rotation views |") + 2
    rows = {}
    for line in lines[start:]:
        if not line.startswith("|"):
            break
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        rows[cells[0].strip("`")] = cells[1:]
    return rows


def test_every_name_is_a_layout_and_every_layout_is_told():
    assert list(get_args(LayoutName)) == list(LAYOUTS) == list(told())


@pytest.mark.parametrize("name", LAYOUTS)
def test_sizes_and_rotation_views_are_as_told(name):
    layout, (_, size, rotation) = layout_of(name), told()[name]
    assert isinstance(layout, Layout)
    assert size == "x".join(map(str, layout.default_size))
    assert (rotation != "none") == layout.has_rotation


@pytest.mark.parametrize("name", LAYOUTS)
def test_settings_resolve_to_what_the_layout_has(name):
    layout, settings = layout_of(name), PhantomSettings(layout=name).resolved()
    assert settings.size == layout.default_size
    assert settings.rotation_views == (12 if layout.has_rotation else 0)


@pytest.mark.parametrize("name", LAYOUTS)
def test_optics_are_of_the_size_asked_for(name):
    optics, lit = layout_of(name).optics(64, 51)
    assert (optics.width, optics.height) == (64, 51)
    assert lit.shape == (51, 64)
    assert lit.mean() > 0.5


def test_names_load_nothing():
    code = (
        "import sys, coliags_plugin.datamanagers.phantom.layouts; "
        "print([name for name in ('numpy', 'cv2', 'scipy', 'torch', 'open3d') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "[]"
