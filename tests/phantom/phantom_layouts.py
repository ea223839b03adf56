"""Tiny phantoms in every layout, those of tests/layouts among them, read as scenes."""

from __future__ import annotations

from pathlib import Path

import tests.layouts  # noqa: F401  (registers them)
from coliags_plugin.config.registry import datamanagers
from coliags_plugin.core.scenes import Frame, Scene
from coliags_plugin.engine.data_formats import find_format
from coliags_plugin.phantom.generate import generate
from coliags_plugin.phantom.settings import PhantomSettings

COARSE = {"mesh_spacing": 1.2, "texture_spacing": 0.4, "interreflection": 0.0}
TINY = COARSE | {"frames": 9, "rotation_views": 2, "supersampling": 1}


def write_phantom(folder: Path, layout: str, width: int = 64, height: int = 51, **options) -> Path:
    """A phantom in a layout; see ``TINY``."""
    generate(PhantomSettings(**{**TINY, "layout": layout, "width": width, "height": height, **options}), folder)
    return folder


def read(folder: Path, name: str, **options) -> Scene:
    """The scene in a folder, by the data manager of a name, which must be the one that recognises it."""
    assert find_format(folder) == name
    manager = datamanagers.get(name)
    return manager(manager.Settings(**options)).load(folder)


def in_video_order(scene: Scene) -> list[Frame]:
    return sorted([*scene.train, *scene.test_sets.get("test", [])], key=lambda frame: frame.index)
