"""Fixtures shared by every room's tests."""

from __future__ import annotations

import gc
import os
import shutil
from collections.abc import Callable
from pathlib import Path

# As the command line does, and before torch is imported: tests share their machine.
os.environ.setdefault("GOMP_SPINCOUNT", "10000")

import pytest
from filelock import FileLock

from tests.browser import Browser, find_chromium

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


def pytest_collectstart():
    """Set up torch before tests are imported; the process that only hands tests to others does without it."""
    import torch

    if not torch.cuda.is_available():
        os.environ["TRITON_INTERPRET"] = "1"  # read when the kernels are first imported
    torch.set_num_threads(1)  # as many processes run as there are CPUs, and the order of sums depends on it


def pytest_collection_finish():
    """Keep the modules and tests loaded by now out of garbage collections, which would visit a million objects each."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def repeatable_torch():
    """Equal numbers in whatever order tests run: one torch thread (the order of sums), and a seed."""
    import torch

    torch.set_num_threads(1)
    torch.default_generator.manual_seed(0)
    if torch.cuda.is_initialized():  # torch.manual_seed would note a call, with a traceback, for later
        torch.cuda.manual_seed_all(0)


@pytest.fixture(scope="session", autouse=True)
def no_waiting_for_disks():
    """Skip forcing files onto the disk: those of tests need not survive a power failure."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda handle: None)
        yield


@pytest.fixture(scope="session", autouse=True)
def compile_once(tmp_path_factory):
    """Let one of several processes of a test run compile a kernel; the others load it from numba's cache."""
    if "PYTEST_XDIST_WORKER" not in os.environ:
        yield
        return
    from numba.core.registry import CPUDispatcher

    place, compile_kernel = tmp_path_factory.getbasetemp().parent, CPUDispatcher.compile

    def compile_alone(dispatcher, signature):
        with FileLock(place / f"{dispatcher.py_func.__module__}.{dispatcher.py_func.__qualname__}.lock"):
            return compile_kernel(dispatcher, signature)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CPUDispatcher, "compile", compile_alone)
        yield


@pytest.fixture(scope="session")
def wall(shared_folder):
    """The folder of :func:`tests.scenes.wall_scene`; never changed."""
    from tests.scenes import write_wall

    return shared_folder("wall", write_wall)


@pytest.fixture(scope="session")
def browser():
    """A headless browser; the test skips where there is none."""
    executable = find_chromium()
    if executable is None:
        pytest.skip("no Chromium on this machine")
    with Browser(executable) as opened:
        yield opened


@pytest.fixture
def shared_data():
    """Real data that is not part of the repository; the test skips by name where it is absent."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"no real data at {SHARED_DATA.name} beside the checkout")
    return SHARED_DATA


@pytest.fixture(scope="session")
def shared_folder(tmp_path_factory):
    """Makes a folder of a name once for all processes of a test run: ``shared_folder(name, make)``, ``make(folder)``.

    Tests must not change what is in it.
    """
    base = tmp_path_factory.getbasetemp()
    base = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def folder(name: str, make: Callable[[Path], object]) -> Path:
        place, whole = base / "shared" / name, base / f"{name}.whole"
        with FileLock(base / f"{name}.lock"):
            if not whole.exists():
                shutil.rmtree(place, ignore_errors=True)
                place.parent.mkdir(exist_ok=True)
                make(place)
                whole.touch()
        return place

    return folder
