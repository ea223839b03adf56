"""The wall in every kind of layout, written once for all tests of data managers."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.datamanagers.kinds import KINDS, write_kind


@pytest.fixture(scope="session")
def walls(tmp_path_factory) -> Callable[[str], Path]:
    """The scene's folder by kind, written when first asked for; never changed."""
    written: dict[str, Path] = {}

    def wall(name: str) -> Path:
        if name not in written:
            written[name] = write_kind(tmp_path_factory.mktemp("walls") / name, name)
        return written[name]

    return wall


@pytest.fixture
def copied(walls, tmp_path) -> Callable[[str], Path]:
    """A copy of the scene of a kind, to be spoilt."""

    def copy(name: str) -> Path:
        whole = walls(name)
        for _ in Path(KINDS[name].scene).parts:
            whole = whole.parent
        return Path(shutil.copytree(whole, tmp_path / "data")) / KINDS[name].scene

    return copy


@pytest.fixture
def mine(copied, request) -> Path:
    """A copy, to be spoilt, of the scene of the kind that a test module is about."""
    return copied(request.module.KIND)
