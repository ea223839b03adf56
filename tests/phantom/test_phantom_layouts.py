"""The table of layouts: names, what they declare, and what the page about phantoms says of them."""

from __future__ import annotations

import numpy as np
import pytest

from coliags_plugin.config.registry import datamanagers, phantom_layouts
from coliags_plugin.engine.data_formats import find_format
from coliags_plugin.phantom.generate import resolve
from coliags_plugin.phantom.layouts.base import Layout
from coliags_plugin.phantom.settings import PhantomSettings
from tests.phantom.phantom_layouts import write_phantom
from tests.test_docs import table_rows


def layout_of(name: str) -> Layout:
    return phantom_layouts.get(name)()


ROWS = {row[0]: row[1:] for row in table_rows("../docs/phantom.md", "| layout | what | size, px | rotation views |")}
BUILT_IN = [name for name in phantom_layouts if phantom_layouts.source(name) == "built in"]


def test_every_layout_is_told():
    assert sorted(ROWS) == BUILT_IN


@pytest.mark.parametrize("name", BUILT_IN)
def test_sizes_rotation_views_and_lenses_are_as_told_and_asked_for(name):
    layout, (_, size, rotation) = layout_of(name), ROWS[name]
    assert isinstance(layout, Layout)
    assert size == "x".join(map(str, layout.default_size))
    assert (rotation != "none") == layout.has_rotation
    settings = resolve(PhantomSettings(layout=name), layout)
    assert (settings.width, settings.height) == layout.default_size
    assert settings.rotation_views == (12 if layout.has_rotation else 0)
    lens, lit = layout.lens(64, 51)
    assert (lens.width, lens.height) == (64, 51)
    assert lit.shape == (51, 64)
    assert lit.mean() > 0.5


#: With a frame that REIM-NeRF validates on, number 25.
FRAMES = 27


@pytest.mark.thorough
@pytest.mark.parametrize("name", phantom_layouts)
def test_the_phantoms_split_is_the_one_that_its_manager_reads(name, tmp_path):
    """Points, masks and turned views go by the phantom's own idea of which frames are trained on."""
    options = {"frames": FRAMES, "mesh_spacing": 3.0, "texture_spacing": 1.0, "path_length": 20.0}
    write_phantom(tmp_path / "colon", name, 48, 38, **options)
    folder = tmp_path / "colon" / ("C3VD/phantom" if name == "pr-endo" else ".")
    manager = datamanagers.get(find_format(folder))
    scene = manager(manager.Settings(initial_points="none")).load(folder)
    layout = layout_of(name)
    held_out = {index for index in range(FRAMES) if layout.is_test(index)}
    assert {frame.index for frame in scene.train} == set(range(FRAMES)) - held_out
    # Masks say of every frame that is held out what training frames see of it.
    masks = sorted(layout.seen_mask(tmp_path / "colon", "video", 0).parent.glob("*_seen.png"))
    if name == "rotatecolon":
        # It holds no frame out: the turned views are its test views.
        assert not held_out and len(masks) == len(scene.test_sets["test"]) == 2
    else:
        assert {int(path.name[:4]) for path in masks} == held_out
        tested = {frame.index for frame in scene.test_sets["test"]}
        # REIM-NeRF's validation frames are neither trained nor tested on.
        assert held_out - tested == ({25} if name == "reim-nerf" else set()) and tested <= held_out
    for frame in scene.test_sets["test"]:
        assert frame.seen is not None
    assert np.load(tmp_path / "colon/truth/camera_to_world.npy").shape == (FRAMES, 4, 4)
