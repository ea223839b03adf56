"""Tiny phantoms in every layout, those of tests/layouts.py among them."""

from __future__ import annotations

from pathlib import Path

import tests.layouts  # noqa: F401  (registers them)
from coliags_plugin.phantom.generate import generate
from coliags_plugin.phantom.settings import PhantomSettings

TINY = {"mesh_spacing": 1.2, "texture_spacing": 0.4, "interreflection": 0.0} | {
    **{"frames": 9, "rotation_views": 2, "supersampling": 1}
}


def write_phantom(folder: Path, layout: str, width: int = 64, height: int = 51, **options) -> Path:
    """A phantom in a layout; see ``TINY``."""
    generate(PhantomSettings(**{**TINY, "layout": layout, "width": width, "height": height, **options}), folder)
    return folder
