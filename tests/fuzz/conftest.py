from __future__ import annotations

import pytest

from tests.fuzz.targets import make_seeds


@pytest.fixture(scope="session")
def seeds(shared_folder):
    """A folder of files for each target (:mod:`tests.fuzz.targets`)."""
    return shared_folder("fuzz-seeds", make_seeds)
