"""Fixtures shared by every room's tests."""

from __future__ import annotations

import os
from pathlib import Path

# As the command line does, and before torch is imported: tests share their machine.
os.environ.setdefault("GOMP_SPINCOUNT", "10000")

import pytest
import torch

if not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"  # read when the kernels are first imported

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(autouse=True)
def repeatable_torch():
    """The same numbers in whatever order tests run: two torch threads (the order of sums), and a seed."""
    torch.set_num_threads(2)
    torch.manual_seed(0)


@pytest.fixture
def shared_data():
    """Real data that is not part of the repository; the test skips by name where it is absent."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"no real data at {SHARED_DATA.name} beside the checkout")
    return SHARED_DATA
