"""Phantoms in every layout, generated once for all tests of data managers."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.datamanagers.spoiling import KINDS, write_all


@pytest.fixture(scope="session")
def phantoms(tmp_path_factory) -> dict[str, Path]:
    """Folder of the phantom by kind; never changed. The scene is in its sub-folder ``KINDS[name].scene``."""
    return write_all(tmp_path_factory.mktemp("phantoms"))


@pytest.fixture
def copied(phantoms, tmp_path) -> Callable[[str], Path]:
    """A copy of the scene of a kind, to be spoilt."""
    return lambda name: Path(shutil.copytree(phantoms[name], tmp_path / "data")) / KINDS[name].scene
