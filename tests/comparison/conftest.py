"""Fixtures of the tests of comparisons."""

from __future__ import annotations

import pytest


@pytest.fixture
def written(tmp_path):
    """Path of a YAML file with a text."""

    def write(text):
        (tmp_path / "mine.yaml").write_text(text)
        return str(tmp_path / "mine.yaml")

    return write
