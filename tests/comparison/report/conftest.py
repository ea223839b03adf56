"""Fixtures of the report's tests."""

from __future__ import annotations

import pytest

from coliags_plugin.comparison.report.study import read_study
from coliags_plugin.results.reading import write_result


@pytest.fixture
def study_of(tmp_path):
    """A study of results, read from files."""

    def read(results):
        files = []
        for index, result in enumerate(results):
            files.append(tmp_path / f"result-{index}.json")
            write_result(files[-1], result)
        return read_study(files)

    return read
