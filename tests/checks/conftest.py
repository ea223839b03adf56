"""Threads of the tests of checks."""

from __future__ import annotations

import pytest
import torch


@pytest.fixture(autouse=True)
def one_thread(repeatable_torch):
    """On so few pixels a second thread costs more than it gains."""
    torch.set_num_threads(1)
