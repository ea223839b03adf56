"""What the tests of structure from motion share."""

from __future__ import annotations

import pytest

from coliags_plugin.phantom.generate import generate
from coliags_plugin.phantom.settings import PhantomSettings


@pytest.fixture(scope="session")
def phantom(tmp_path_factory):
    """A small phantom with enough texture for features."""
    folder = tmp_path_factory.mktemp("phantom") / "scene"
    settings = PhantomSettings(
        frames=12,
        width=200,
        height=160,
        rotation_views=0,
        mesh_spacing=0.8,
        texture_spacing=0.2,
        interreflection=0.0,
        supersampling=1,
    )
    generate(settings, folder)
    return folder
