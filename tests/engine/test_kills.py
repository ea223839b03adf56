"""Runs that are killed end like runs that are not."""

import pytest

from tests.engine.kills import kill_and_compare


@pytest.mark.slow
def test_killed_runs_end_like_an_undisturbed_one(tmp_path):
    found = kill_and_compare(tmp_path, kills=6)
    assert found.count == 6
    assert found.lives >= 1
